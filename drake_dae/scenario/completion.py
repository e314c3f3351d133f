"""The outputs and the start that a scenario leaves out."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import combinations, groupby
from math import comb
from typing import Any

import casadi as ca
import numpy as np

from drake_dae.arrays import FloatArray, unknown_name
from drake_dae.dae import Signal
from drake_dae.errors import ReferenceSignalError, ScenarioError
from drake_dae.references import ConstantReference, Reference
from drake_dae.references.by_name import denoted
from drake_dae.robots import (
    LETTERS,
    AxisCoordinates,
    Constraint,
    ConstraintSet,
    JointPositions,
    Links,
    PointCoordinates,
    as_force_outputs,
    force_rows,
    plant_constraints,
)
from drake_dae.scenario.form import at
from drake_dae.scenario.postures import INDEPENDENT, Posture, Postures, tool_axis
from drake_dae.scenario.scenario import Scenario, TiltFromNormalForm, WrittenOutput, make

BEFORE = 0.02
"""The distance in m from its surface at which a task without start.positions begins."""

MOST = 3
"""The number of ways to complete a scenario that are examined along its references."""

_GUESSES, _PATIENCE = 60, 20
"""The number of guesses of a start, and after how many of them without any a search ends."""

_POSTURES, _SETS, _TIMES = 8, 3, 25
"""The numbers of starts, of sets of joints for each, and of times at which they are compared."""

_REGULAR = 1e-3
"""A start with an `independence` below this is singular."""


@dataclass(frozen=True)
class Completed:
    """A scenario with all outputs and a start, and the library's choices, one line each.

    `critical_friction` is the least one along the references of what has been completed.
    """

    scenario: Scenario
    notes: tuple[str, ...] = ()
    critical_friction: float = np.inf


def completions(
    scenario: Scenario, links: Links, constraints: Sequence[Constraint], guess: FloatArray
) -> Iterator[Completed]:
    """Yields a scenario with its missing outputs and its start, the best one first.

    Starts and sets of joints are compared by the least `Postures.quality` along the reference.
    """
    search, given = _Search(scenario, links, constraints), scenario.start.positions
    # Nothing is missing, nothing can be said, or the model refuses the actuators.
    is_placed = bool(given) if scenario.task else len(given) == len(links.position_signals)
    if (
        search.missing < (1 if is_placed else 0)
        or not search.is_controlled
        or scenario.law.control_weights
        or scenario.compliances is not None
        or np.linalg.matrix_rank(links.actuation_matrix) < len(links.actuator_signals)
    ):
        yield Completed(scenario)
        return
    search.follow(guess)
    postures, named = search.postures, search.named
    if search.missing == 0 and scenario.task is None:
        q = postures.solve(named, search.begin, guess)
        if q is not None and (
            given or min(postures.at(x).independence(named) for x in (q, guess)) > _REGULAR
        ):
            yield Completed(scenario)
            if given:
                return
    starts = search.starts(guess)
    found = list[tuple[tuple[bool, int, float], Posture, list[int]]]()
    for posture in starts[: 1 if given else _POSTURES]:
        for added in search.added(posture):
            count = len({*added} - {*search.joints})
            rivals = sorted((rank[2] for rank, *_ in found if rank[1] >= count), reverse=True)
            enough = rivals[MOST - 1] if len(rivals) >= MOST else 0.0
            quality = search.least_quality(posture, [*named, *added], enough)
            found.append(((quality > 0.0, count, quality), posture, added))
    if not found:
        steered = ", ".join([*search.names(named), *search.forces]) or "the constraints"
        text = (
            f"{search.missing} outputs are missing, one for each actuator that is left, and no "
            f"positions of joints beside {steered} leave B(x) of (16) regular at the start. Name "
            "others, leave out what depends on others, or leave actuators out by robot.actuators"
        )
        raise ScenarioError(("outputs or forces", text))
    # Of those that are equal along the reference, the best one at the start.
    found.sort(key=lambda entry: entry[0], reverse=True)
    fewer = [entry for entry in found[MOST:] if entry[0][1] < found[0][0][1]]
    for _, posture, added in [*found[:MOST], *fewer[:1]]:
        yield search.written(posture, added)


class _Search:
    """The rows that outputs may have: `given` ones of the scenario, then those that complete them.

    `tilts` are zero where tools are normal to their surfaces; `axes` are the rows of the tools'
    directions that may be outputs, by `tool_axis`. `named` are the rows to which references refer,
    and `path` their values at some times, of which `begin` are the first.
    """

    def __init__(self, scenario: Scenario, links: Links, constraints: Sequence[Constraint]) -> None:
        self._scenario, self._links = scenario, links
        self._bound = ConstraintSet([*constraints, *plant_constraints(links)])
        with at("forces"):
            steered = as_force_outputs(scenario.forces, self._bound)
        self.forces = [s.name for output in steered for s in output.signals(self._bound)]
        self._S = force_rows(steered, self._bound, links)
        self._signals, self._expressions = list[Signal](), list[ca.SX]()
        # Of each row its output, the attribute that holds its rows, and the first of them.
        self._forms = list[tuple[Any, str, int]]()
        for form in scenario.outputs:
            self._add(form, "")
        self._given = len(self._signals)
        controls = len(links.actuator_signals) + len(self._bound.motors)
        self.missing = controls - self._given - self._S.shape[0]
        self.is_controlled = self._given or self.forces or scenario.references or scenario.task
        touches = {c.name: c.touch(links) for c in self._bound.constraints}
        self._touches = {name: touch for name, touch in touches.items() if touch is not None}
        taken, kind = {signal.name for signal in self._signals}, scenario.tool_axis
        self._points, self._outward = list[list[int]](), list[ca.SX]()
        self._tilts, self._axes = list[int](), list[int]()
        for name, touch in self._touches.items():
            # Names are unique: the constraint's name is used if the frame's is taken.
            rows, others = dict[str, int](), [a for a in "xyz" if f"{touch.frame}.{a}" in taken]
            for prefix, axes in (("", {*"xyz"} - {*others}), (f"{name}_point", others)):
                if letters := "".join(sorted(axes)):
                    point = PointCoordinates(touch.frame, letters, touch.point, prefix)
                    rows |= zip(letters, self._add(point, "axes"), strict=True)
            self._points.append([rows[axis] for axis in "xyz"])
            column, sign = tool_axis(links, touch)
            axis = LETTERS[column]
            self._outward.append(sign * links.rotation(touch.frame)[:, column])
            if kind != "free":
                tilt = TiltFromNormalForm(name, axis, "xyz".replace(axis, ""))
                self._tilts += self._add(tilt, "components")
            if kind == "fixed":
                self._axes += self._add(AxisCoordinates(touch.frame, axis, "xyz"), "components")
        self._axes = self._axes or self._tilts
        self._joints = [s.name for s in links.position_signals]
        self.joints = self._add(JointPositions(self._joints), "joints")

    def _add(self, form: WrittenOutput, of_rows: str) -> list[int]:
        output, begin = make(form, self._bound.constraints), len(self._signals)
        self._expressions.append(output.expression(self._links))
        self._signals += output.signals(self._links)
        rows = [*range(begin, len(self._signals))]
        self._forms += [(form, of_rows, begin)] * len(rows)
        return rows

    def _postures(self, moved: Mapping[str, FloatArray]) -> Postures:
        """The configurations of the robot at the start, with some parameters moved."""
        scenario = self._scenario
        values = {name: np.atleast_1d(value) for name, value in scenario.plant.parameters.items()}
        for name, references in scenario.exogenous.items():
            parts = [_values_of(r, getattr(r, "size", 1)) for r in references]
            at_start = [part(scenario.integrator.start_time) for part in parts]
            values[name] = np.concatenate([np.zeros(0), *at_start])
        rows = ca.vertcat(ca.SX(0, 1), *self._expressions)
        touches = list(zip(self._touches.values(), self._outward, strict=True))
        with at("plant.parameters or exogenous"):
            return Postures(self._links, self._bound, rows, self._S, touches, {**values, **moved})

    # What references say.

    def follow(self, guess: FloatArray) -> None:
        """Finds the rows that references name, and their values."""
        scenario, postures = self._scenario, self._postures({})
        self.postures = postures
        # Rows named by references are known before the posture, from the normal near the guess.
        first = postures.solve((), np.zeros(0), guess)
        near = postures.at(guess if first is None else first)
        # Some rows of a planar arm are constant.
        some = [np.abs(postures.at(q).gradients).max(axis=1) for q in postures.guesses(4)]
        along = [row for row in self._along(near) if max(one[row] for one in some) > 1e-9]
        key, references = "references", scenario.references
        if scenario.task is not None:
            key, references = "task.phases", self._of_phases()
        known = list[tuple[Callable[[float], FloatArray], list[int | None]]]()
        for name, reference in references.items():
            at_key, rows = f"{key}.{name}", list[int | None]()
            for part in map(str.strip, name.split(",")):
                rows += self._denoted(part, at_key, along)
            if isinstance(reference, Reference) and reference.size != len(rows):
                text = f"{reference.size} values for {len(rows)} outputs"
                raise ScenarioError((at_key, text))
            known.append((_values_of(reference, len(rows)), rows))
        every = dict.fromkeys(row for _, rows in known for row in rows if row is not None)
        more = [row for row in every if row >= self._given]
        if len(more) > self.missing:
            text = f"are {len(more)} outputs, but only {self.missing} are missing"
            raise ScenarioError((key, f"{', '.join(self.names(more))} {text}"))
        left = [row for row in range(self._given) if row not in every]
        if left and scenario.task is None:
            raise ScenarioError((key, f"missing: {', '.join(self.names(left))}"))
        self.named, self._room = [*range(self._given), *more], self.missing - len(more)

        def values_at(time: float) -> FloatArray:
            values = near.rows.copy()  # Those that nothing refers to stay.
            for function, rows in known:
                for row, value in zip(rows, function(time), strict=True):
                    if row is not None:
                        values[row] = value
            return values[self.named]

        begin = scenario.integrator.start_time
        end = begin if scenario.task else begin + scenario.duration
        self.path = [values_at(time) for time in np.unique(np.linspace(begin, end, _TIMES))]
        errors = scenario.start.errors
        off = [errors.get(self._signals[row].name, 0.0) for row in self.named]
        self.begin = self.path[0] + off

    def names(self, rows: Sequence[int]) -> list[str]:
        return [self._signals[row].name for row in rows]

    def _of_phases(self) -> dict[str, Any]:
        """The first reference that a phase of the task gives each output, without distances."""
        assert self._scenario.task is not None
        distances = {signal.name for signal in self._bound.residual_signals}
        references = dict[str, Any]()
        for phase in self._scenario.task.phases:
            for key, reference in getattr(phase, "references", {}).items():
                parts = [part.strip() for part in key.split(",")]
                kept = [part for part in parts if part not in distances]
                # The rows of a Reference cannot be taken apart here.
                if kept and (kept == parts or not isinstance(reference, Reference)):
                    references.setdefault(", ".join(kept), reference)
        return references

    def _denoted(self, name: str, key: str, along: Sequence[int]) -> Sequence[int | None]:
        """The rows that a name in references denotes; None for a force."""
        signals, forces = [signal.name for signal in self._signals], self.forces
        outputs = [*signals[: self._given], *forces]
        with suppress(ReferenceSignalError):
            places = denoted(name, outputs, [2] * self._given + [0] * len(forces))
            return [place if place < self._given else None for place in places]
        if self.missing:  # Of a point the rows along its surface first.
            first = [signals[row] for row in along]
            others = [*first, *(s for s in signals[self._given :] if s not in first)]
            of_point = [signal for signal in first if signal.rpartition(".")[0] == name]
            with suppress(ReferenceSignalError):
                chosen = of_point or [others[k] for k in denoted(name, others, [2] * len(others))]
                return [signals.index(signal) for signal in chosen]
            outputs += others
        for constraint in self._bound.constraints:
            if name in [signal.name for signal in constraint.coordinate_signals]:
                text = f"no output '{name}', a coordinate along the constraint '{constraint.name}'"
                form = f"!SurfaceCoordinates {{constraint: {constraint.name}}}"
                raise ScenarioError((key, f"{text}: add {form} to outputs"))
        raise ScenarioError((key, unknown_name("output", name, outputs)))

    def _along(self, posture: Posture) -> list[int]:
        """The rows along each surface: of the world's axes all but that closest to the normal."""
        across = abs(posture.normals).argmax(axis=1)
        pairs = zip(self._points, across, strict=True)
        return [row for rows, axis in pairs for k, row in enumerate(rows) if k != axis]

    # Where it starts, and by which outputs.

    def starts(self, guess: FloatArray) -> list[Posture]:
        """The postures in which the references begin, the best first; tools normal if possible."""
        postures, named, begin = self.postures, self.named, self.begin
        start = self._scenario.start.positions
        # Joints in start.positions stay at them; others are guessed.
        fixed = np.array([name in start for name in self._joints])
        guesses = [guess, *np.where(fixed, guess, postures.guesses(_GUESSES))]
        ways = [(named, begin)]
        if self.missing and self._tilts:
            upright = np.concatenate([begin, np.zeros(len(self._tilts))])
            ways.insert(0, ([*named, *self._tilts], upright))
        for rows, values in ways if start else ():
            q = postures.solve(rows, values, guess)
            if q is not None and (near := postures.at(q)).independence(named) > _REGULAR:
                return [near]
        for rows, values in ways:
            found: list[Posture] = []
            for count, one in enumerate(guesses):
                if count == _PATIENCE and not found:
                    break
                q = postures.solve(rows, values, one)
                if q is not None and all(np.max(np.abs(q - p.q)) > 0.02 for p in found):
                    found.append(postures.at(q))
            if found:
                return sorted(found, key=lambda p: -postures.quality(p, named))
        goals = (f"{name} = {v:.4g}" for name, v in zip(self.names(named), begin, strict=True))
        text = (
            "no start was found on the constraints and within joint limits with "
            f"{', '.join(goals) or 'these constraints'}. Change the first values of the "
            "references, start.errors or the surface's place, or give start.positions"
        )
        key = "references" if self._scenario.task is None else "task.phases"
        raise ScenarioError((key if named else "constraints", text))

    def added(self, posture: Posture) -> Iterator[list[int]]:
        """The rows that complete the named ones, by the rule of `complete_scenario`."""
        named, room = self.named, self._room
        if not room:
            yield []
            return
        along = [row for row in self._along(posture) if row not in named]
        added = posture.independent(named, along, room)
        axes = [row for row in self._axes if row not in named]
        axes = posture.independent([*named, *added], axes, len(axes))
        axes = axes if len(axes) <= room - len(added) else []
        # Where no start keeps the axis and all limits, it is left free.
        for directions in [axes, []] if axes else [[]]:
            held = [*named, *added, *directions]
            count = room - len(added) - len(directions)
            joints, one = [row for row in self.joints if row not in held], list[int]()
            sets = [one]
            if comb(len(joints), count) <= 500:
                sets = [list(chosen) for chosen in combinations(joints, count)]
            else:  # Each is the most independent of those before it.
                for _ in range(count):
                    rest = [row for row in joints if row not in one]
                    quality = [posture.independence([*held, *one, row]) for row in rest]
                    one.append(rest[int(np.argmax(quality))])
                one.sort()
            ranked = [(posture.independence([*held, *chosen]), chosen) for chosen in sets]
            ranked = [entry for entry in ranked if entry[0] > INDEPENDENT / 10]
            for _, chosen in sorted(ranked, key=lambda entry: -entry[0])[:_SETS]:
                yield [*added, *directions, *chosen]

    def least_quality(self, posture: Posture, rows: Sequence[int], enough: float) -> float:
        """The least quality along the references; 0 if they cannot be followed.

        A value below `enough` need not be exact.
        """
        least = self.postures.quality(posture, rows)
        for now in self._followed(posture, rows):
            least = 0.0 if now is None else min(least, self.postures.quality(now, rows))
            if least <= enough:
                break
        return least

    def _followed(self, posture: Posture, rows: Sequence[int]) -> Iterator[Posture | None]:
        """The posture at each time of the references; None where they are out of reach."""
        wanted, q = posture.rows[list(rows)], posture.q
        for values in self.path:
            wanted[: len(self.named)] = values
            found = self.postures.solve(rows, wanted, q)
            q = posture.q if found is None else found
            yield None if found is None else self.postures.at(q)

    def written(self, posture: Posture, added: Sequence[int]) -> Completed:
        """The scenario with outputs, references and start, and notes."""
        scenario, notes, held = self._scenario, list[str](), [*self.named, *added]
        if chosen := held[self._given :]:
            joints = " (joints so that B(x) is best conditioned)" * bool({*added} & {*self.joints})
            is_free = self._axes and not {*held} & {*self._axes}
            left = "; the tool's axis is left free" * bool(is_free)
            notes.append(f"outputs completed by {', '.join(self.names(chosen))}{joints}{left}")
            outputs = [*scenario.outputs]
            for (form, key, begin), rows in groupby(chosen, lambda row: self._forms[row]):
                part = getattr(form, key)
                parts = [part[row - begin] for row in rows]
                outputs.append(
                    replace(form, **{key: "".join(parts) if isinstance(part, str) else parts})
                )
            scenario = replace(scenario, outputs=outputs)
        if added and scenario.task is None:
            # A joint that the task leaves free is held where it starts: its error is no fault.
            values = _rounded(posture.rows)
            upright = np.max(np.abs(posture.rows[self._tilts]), initial=0.0) < 1e-6
            values[self._tilts] *= not upright
            resting = {self._signals[row].name: float(values[row]) for row in added}
            free = {self._signals[row].name: None for row in added if row in self.joints}
            tolerances = {**free, **scenario.judgement.tolerances}
            scenario = replace(
                scenario,
                references={**scenario.references, **resting},
                judgement=replace(scenario.judgement, tolerances=tolerances),
            )
        if scenario.task is not None and scenario.start.positions:
            return Completed(scenario, tuple(notes))
        q = posture.q
        if scenario.task is not None and not scenario.task.phases[0].begins_in_contact:
            q = self._off_surface(posture, held)
        positions = dict(zip(self._joints, _rounded(q).tolist(), strict=True))
        texts = (f"{name}: {value:.4g}" for name, value in positions.items())
        notes.append(f"start found: {{{', '.join(texts)}}}")
        scenario = replace(scenario, start=replace(scenario.start, positions=positions))
        followed = [now for now in self._followed(posture, held) if now is not None]
        points = enumerate(self._points)
        critical = [now.critical_friction(*point) for point in points for now in followed]
        return Completed(scenario, tuple(notes), min(critical, default=np.inf))

    def _off_surface(self, touching: Posture, held: Sequence[int]) -> FloatArray:
        """The configuration with the same outputs, `BEFORE` the surface of a task."""
        assert self._scenario.task is not None
        contact = self._scenario.task.contact
        values = {p.name: p.value for p in self._bound.parameters} | self._scenario.plant.parameters
        moved = {
            f"{name}.position": np.add(values[f"{name}.position"], BEFORE * normal)
            for name, normal in zip(self._touches, touching.normals, strict=True)
            if f"{name}.position" in values and contact in (name, "")
        }
        q = self._postures(moved).solve(held, touching.rows[list(held)], touching.q)
        if q is None or not moved:
            text = f"needed: no start was found {BEFORE:g} m before the surface of the task"
            raise ScenarioError(("start.positions", text))
        return q


def _rounded(values: FloatArray) -> FloatArray:
    """Values in m and rad as they are written, without -0."""
    return np.round(values, 4) + 0.0


def _values_of(reference: Any, size: int) -> Callable[[float], FloatArray]:
    """The values of a reference, or of a number, as a function of time in s, shape (size,)."""
    if not isinstance(reference, Reference):
        reference = ConstantReference([reference] * size)
    values: Callable[[float], FloatArray] = reference.derivatives([0] * size)
    return values
