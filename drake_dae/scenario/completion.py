"""The outputs and the start that a scenario leaves out."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import combinations
from math import comb
from typing import Any

import casadi as ca
import numpy as np

from drake_dae.arrays import FloatArray, unknown_name
from drake_dae.dae import Signal
from drake_dae.errors import ReferenceSignalError, ScenarioError
from drake_dae.references import Reference
from drake_dae.references.by_name import denoted
from drake_dae.robots import (
    AxisCoordinates,
    Constraint,
    ConstraintSet,
    JointPositions,
    Links,
    PointCoordinates,
    PositionOutput,
    as_force_outputs,
    force_rows,
    plant_constraints,
)
from drake_dae.scenario.form import at
from drake_dae.scenario.parts import TiltFromNormalForm, WrittenOutput, make
from drake_dae.scenario.postures import INDEPENDENT, Posture, Postures, tool_axis
from drake_dae.scenario.scenario import Scenario

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
    """A scenario with all outputs and a start, and the library's choices, one line each."""

    scenario: Scenario
    notes: tuple[str, ...] = ()


def completions(
    scenario: Scenario, links: Links, constraints: Sequence[Constraint], guess: FloatArray
) -> Iterator[Completed]:
    """Yields a scenario with its missing outputs and its start, the best one first.

    Starts and sets of joints are compared by the least `Postures.quality` along the reference.
    """
    bound = ConstraintSet([*constraints, *plant_constraints(links)])
    outputs = [make(form, constraints) for form in scenario.outputs]
    steered = as_force_outputs(scenario.forces, bound)
    S = force_rows(steered, bound, links)
    rows = _Rows(scenario, links, outputs, bound)
    missing = len(links.actuator_signals) + len(bound.motors) - rows.given - S.shape[0]
    start, task = scenario.start.positions, scenario.task
    is_placed = bool(start) if task else len(start) == len(links.position_signals)
    if (
        missing < 0
        or (missing == 0 and is_placed)
        or not (rows.given or S.shape[0] or scenario.references or task)  # Only simulated.
        or scenario.law.control_weights
        or scenario.compliances is not None
        # The model refuses such actuators.
        or np.linalg.matrix_rank(links.actuation_matrix) < len(links.actuator_signals)
    ):
        yield Completed(scenario)
        return
    postures = rows.postures(scenario, bound, S)
    # Rows named by references are known before the posture, from the normal near the guess.
    first = postures.solve((), np.zeros(0), guess)
    near = postures.at(guess if first is None else first)
    forces = [signal.name for output in steered for signal in output.signals(bound)]
    # Some rows of a planar arm are constant.
    some = [np.abs(postures.at(q).gradients).max(axis=1) for q in postures.guesses(4)]
    along = [row for row in rows.points(near) if max(one[row] for one in some) > 1e-9]
    goals = _Goals(scenario, rows, forces, missing, near, along)
    named, begin = goals.rows, goals.path[0][0]
    errors = scenario.start.errors
    begin = begin + [errors.get(rows.signals[row].name, 0.0) for row in named]
    if missing == 0 and task is None:
        q = postures.solve(named, begin, guess)
        if q is not None and (
            start or min(postures.at(x).independence(named) for x in (q, guess)) > _REGULAR
        ):
            yield Completed(scenario)
            if start:
                return
    starts = _starts(postures, rows, named, begin, guess, bool(start), missing)
    found = list[tuple[tuple[bool, int, float], Posture, list[int], list[int]]]()
    for posture in starts[: 1 if start else _POSTURES]:
        for added in _added(rows, named, posture, missing):
            held, count = [*named, *added], len({*added} - {*rows.joints})
            rivals = sorted((rank[2] for rank, *_ in found if rank[1] >= count), reverse=True)
            enough = rivals[MOST - 1] if len(rivals) >= MOST else 0.0
            quality = _least(postures, goals, posture, held, enough)
            found.append(((quality > 0.0, count, quality), posture, held, added))
    if not found:
        raise ScenarioError(_why_none(starts[0], rows, named, missing, bound, forces))
    # Of those that are equal along the reference, the best one at the start.
    found.sort(key=lambda entry: entry[0], reverse=True)
    fewer = [entry for entry in found[MOST:] if entry[0][1] < found[0][0][1]]
    for _, posture, held, added in [*found[:MOST], *fewer[:1]]:
        yield _written(scenario, rows, postures, posture, held, added)


def _starts(
    postures: Postures,
    rows: "_Rows",
    named: Sequence[int],
    wanted: FloatArray,
    guess: FloatArray,
    is_given: bool,
    missing: int,
) -> list[Posture]:
    """The postures in which the references begin, the best first; tools normal where possible."""
    # Joints in start.positions stay at them; others are guessed.
    fixed = np.array([name in rows.start for name in (s.name for s in rows.links.position_signals)])
    guesses = [guess, *np.where(fixed, guess, postures.guesses(_GUESSES))]
    ways = [(named, wanted)]
    if missing and rows.tilts:
        upright = [*named, *rows.tilts]
        ways.insert(0, (upright, np.concatenate([wanted, np.zeros(len(rows.tilts))])))
    for chosen, values in ways if is_given else ():
        q = postures.solve(chosen, values, guess)
        if q is not None and (near := postures.at(q)).independence(named) > _REGULAR:
            return [near]
    for chosen, values in ways:
        found: list[Posture] = []
        for count, one in enumerate(guesses):
            if count == _PATIENCE and not found:
                break
            q = postures.solve(chosen, values, one)
            if q is not None and all(np.max(np.abs(q - p.q)) > 0.02 for p in found):
                found.append(postures.at(q))
        if found:
            return sorted(found, key=lambda p: -postures.quality(p, named))
    q, left = postures.nearest(named, wanted, guesses)
    polished = postures.solve(named, wanted, q)
    if polished is not None:
        return [postures.at(polished)]
    signals, missed = [rows.signals[row] for row in named], list[str]()
    for s, value, goal in zip(signals, postures.at(q).rows[list(named)], wanted, strict=True):
        if abs(goal - value) > 1e-6:
            missed.append(f"{s.name} comes to {value:.4g} {s.unit}, and not to {goal:.4g} {s.unit}")
    residual = float(np.max(np.abs(left[: left.size - len(named)]), initial=0.0))
    if residual > 1e-6:
        missed.append(f"{residual:.2g} (m or rad) is left of the constraints")
    text = (
        "the robot cannot start there within its joint limits; the nearest start found has: "
        f"{'; '.join(missed) or 'nothing, but at a limit'}. Change the first values of the "
        "references, start.errors or the surface's place, or give start.positions"
    )
    key = "task.phases" if rows.is_task else "references"
    raise ScenarioError((key if len(named) else "constraints", text))


def _added(
    rows: "_Rows", named: Sequence[int], posture: Posture, missing: int
) -> Iterator[list[int]]:
    """The rows that complete the named ones, by the rule of `complete_scenario`."""
    room = missing - (len(named) - rows.given)
    if not room:
        yield []
        return
    along = [row for row in rows.points(posture) if row not in named]
    added = posture.independent(named, along, room)
    axes = [row for row in rows.axes if row not in named]
    axes = posture.independent([*named, *added], axes, len(axes))
    axes = axes if len(axes) <= room - len(added) else []
    # Where no start keeps the axis and all limits, it is left free.
    for directions in [axes, []] if axes else [[]]:
        held = [*named, *added, *directions]
        count = room - len(added) - len(directions)
        joints = [row for row in rows.joints if row not in held]
        if comb(len(joints), count) <= 500:
            sets = [list(chosen) for chosen in combinations(joints, count)]
        else:
            sets = [posture.most_independent(held, joints, count)]
        ranked = [(posture.independence([*held, *chosen]), chosen) for chosen in sets]
        ranked = [entry for entry in ranked if entry[0] > INDEPENDENT / 10]
        for _, chosen in sorted(ranked, key=lambda entry: -entry[0])[:_SETS]:
            yield [*added, *directions, *chosen]


def _least(
    postures: Postures, goals: "_Goals", posture: Posture, rows: Sequence[int], enough: float
) -> float:
    """The least quality along the references; 0 if they cannot be followed.

    A value below `enough` need not be exact.
    """
    wanted, count = posture.rows[list(rows)], len(goals.rows)
    q, least = posture.q, postures.quality(posture, rows)
    for values, rates in goals.path:
        wanted[:count] = values
        found = postures.solve(rows, wanted, q)
        if found is None:
            return 0.0
        q, now = found, postures.at(found)
        all_rates = np.concatenate([rates, np.zeros(len(rows) - count)])
        least = min(least, postures.quality(now, rows))
        if least <= enough or postures.is_too_fast(now, rows, all_rates):
            return min(least, enough) if least else 0.0
    return least


def _written(
    scenario: Scenario,
    rows: "_Rows",
    postures: Postures,
    posture: Posture,
    held: Sequence[int],
    added: Sequence[int],
) -> Completed:
    """The scenario with outputs, references and start, and notes."""
    names, notes = [signal.name for signal in rows.signals], []
    chosen = list(held[rows.given :])
    if chosen:
        joints = " (joints so that B(x) is best conditioned)" * bool(set(added) & {*rows.joints})
        left = "; the tool's axis is left free" * bool(rows.axes and not {*held} & {*rows.axes})
        listed = ", ".join(names[row] for row in chosen)
        notes.append(f"outputs completed by {listed}{joints}{left}")
        outputs = [*scenario.outputs, *_joined(rows.forms[row] for row in chosen)]
        scenario = replace(scenario, outputs=outputs)
    if added and not rows.is_task:
        # A joint that the task leaves free is held where it starts: its error is no fault of a run.
        values = _rounded(posture.rows)
        upright = np.max(np.abs(posture.rows[rows.tilts]), initial=0.0) < 1e-6
        values[rows.tilts] *= not upright
        resting = {names[row]: float(values[row]) for row in added}
        free = dict.fromkeys(names[row] for row in added if row in rows.joints)
        scenario = replace(
            scenario,
            references={**scenario.references, **resting},
            judgement=replace(
                scenario.judgement, tolerances={**free, **scenario.judgement.tolerances}
            ),
        )
    if rows.is_task and scenario.start.positions:
        return Completed(scenario, tuple(notes))
    q = posture.q
    if scenario.task is not None and not scenario.task.phases[0].begins_in_contact:
        q = rows.off_surface(scenario, posture)
    joints_at = _rounded(q).tolist()
    positions = dict(zip((s.name for s in rows.links.position_signals), joints_at, strict=True))
    texts = (f"{name}: {value:.4g}" for name, value in positions.items())
    notes.append(f"start found: {{{', '.join(texts)}}}")
    start = replace(scenario.start, positions=positions)
    return Completed(replace(scenario, start=start), tuple(notes))


def _rounded(values: FloatArray) -> FloatArray:
    """Values in m and rad as they are written, without -0."""
    return np.round(values, 4) + 0.0


_JOINED = {
    PointCoordinates: "axes",
    AxisCoordinates: "components",
    TiltFromNormalForm: "components",
    JointPositions: "joints",
}
"""Which attribute of an output holds its rows."""


def _joined(forms: Iterator[WrittenOutput]) -> list[WrittenOutput]:
    """The same rows in fewer outputs: neighbours that differ only in their rows are joined."""
    outputs: list[Any] = []
    for form in forms:
        key, last = _JOINED[type(form)], outputs[-1] if outputs else None
        if type(last) is type(form) and replace(form, **{key: getattr(last, key)}) == last:
            outputs[-1] = replace(form, **{key: getattr(last, key) + getattr(form, key)})
        else:
            outputs.append(form)
    return outputs


class _Rows:
    """The `given` rows of the scenario's outputs, then the rows that may complete them.

    `tilts` are zero where tools are normal to their surfaces; `axes` are the rows of the tools'
    directions that may be outputs, by `tool_axis`.
    """

    def __init__(
        self,
        scenario: Scenario,
        links: Links,
        outputs: Sequence[PositionOutput],
        bound: ConstraintSet,
    ) -> None:
        self.links, self.start, self.is_task = links, scenario.start.positions, bool(scenario.task)
        self.signals: list[Signal] = [s for output in outputs for s in output.signals(links)]
        self._expressions = [output.expression(links) for output in outputs]
        self.given, self.bound, self._scenario = len(self.signals), bound, scenario
        self.forms: dict[int, WrittenOutput] = {}
        touches = {c.name: c.touch(links) for c in bound.constraints}
        self.touches = {name: touch for name, touch in touches.items() if touch is not None}
        taken, kind = {s.name for s in self.signals}, scenario.tool_axis
        self._points: list[list[int]] = []
        self.tilts: list[int] = []
        self.axes: list[int] = []
        self.outward: list[ca.SX] = []
        for name, touch in self.touches.items():
            # Names are unique: the constraint's name is used if the frame's is taken.
            others = {a: f"{name}_point" * (f"{touch.frame}.{a}" in taken) for a in "xyz"}
            points = [PointCoordinates(touch.frame, a, touch.point, others[a]) for a in "xyz"]
            self._points.append([self._add(form) for form in points])
            column, sign = tool_axis(links, touch)
            axis = "xyz"[column]
            self.outward.append(sign * links.rotation(touch.frame)[:, column])
            if kind != "free":
                forms = [TiltFromNormalForm(name, axis, a) for a in "xyz" if a != axis]
                self.tilts += [self._add(form) for form in forms]
            if kind == "fixed":
                fixed = [AxisCoordinates(touch.frame, axis, component) for component in "xyz"]
                self.axes += [self._add(form) for form in fixed]
        self.axes = self.axes or self.tilts
        names = [signal.name for signal in links.position_signals]
        self.joints = [self._add(JointPositions([name])) for name in names]

    def _add(self, form: WrittenOutput) -> int:
        output, row = make(form, self.bound.constraints), len(self.signals)
        self._expressions.append(output.expression(self.links))
        self.forms[row] = form
        self.signals += output.signals(self.links)
        return row

    def points(self, posture: Posture) -> list[int]:
        """The rows along each surface: of the world's axes all but that closest to the normal."""
        across = abs(posture.normals).argmax(axis=1)
        pairs = zip(self._points, across, strict=True)
        return [row for rows, axis in pairs for k, row in enumerate(rows) if k != axis]

    def postures(
        self,
        scenario: Scenario,
        bound: ConstraintSet,
        S: ca.SX,
        moved: Mapping[str, FloatArray] | None = None,
    ) -> Postures:
        """The configurations of the robot at the start, with some parameters moved."""
        begin = scenario.integrator.start_time
        values = {name: np.atleast_1d(value) for name, value in scenario.plant.parameters.items()}
        for name, references in scenario.exogenous.items():
            sizes = [getattr(r, "size", 1) for r in references]
            pairs = zip(references, sizes, strict=True)
            at_start = [_values_of(r, size)(begin)[:, 0] for r, size in pairs]
            values[name] = np.concatenate([np.zeros(0), *at_start])
        rows = ca.vertcat(ca.SX(0, 1), *self._expressions)
        touches = list(zip(self.touches.values(), self.outward, strict=True))
        with at("plant.parameters or exogenous"):
            return Postures(self.links, bound, rows, S, touches, {**values, **(moved or {})})

    def off_surface(self, scenario: Scenario, touching: Posture) -> FloatArray:
        """The configuration with the same outputs, `BEFORE` the surface of a task."""
        assert scenario.task is not None
        outputs = [make(form, self.bound.constraints) for form in scenario.outputs]
        rows = _Rows(scenario, self.links, outputs, self.bound)
        contact, bound = scenario.task.contact, self.bound
        names = [contact] if isinstance(contact, str) else [*contact]
        values = {p.name: p.value for p in bound.parameters}
        values |= {name: np.atleast_1d(v) for name, v in scenario.plant.parameters.items()}
        moved = {
            f"{name}.position": values[f"{name}.position"] + BEFORE * normal
            for name, normal in zip(self.touches, touching.normals, strict=True)
            if f"{name}.position" in values and (name in names or names == [""])
        }
        outputs_at = rows.postures(scenario, bound, ca.SX(0, bound.size)).at(touching.q).rows
        postures = rows.postures(scenario, bound, ca.SX(0, bound.size), moved)
        q = postures.solve(range(rows.given), outputs_at[: rows.given], touching.q)
        if q is None or not moved:
            text = f"needed: no start was found {BEFORE:g} m before the surface of the task"
            raise ScenarioError(("start.positions", text))
        return q


class _Goals:
    """The rows to which references refer; `path` are their values and rates at some times."""

    def __init__(
        self,
        scenario: Scenario,
        rows: _Rows,
        forces: Sequence[str],
        missing: int,
        near: Posture,
        along: Sequence[int],
    ) -> None:
        key = "references"
        references: Mapping[str, Any] = scenario.references
        self._held = near.rows  # What a task gives no reference.
        if scenario.task is not None:
            key = "task.phases"
            distances = {signal.name for signal in rows.bound.residual_signals}
            references = _of_phases(scenario, distances)
        self._references: list[tuple[_Values, list[int | None]]] = []
        for name, reference in references.items():
            at_key, meaning = f"{key}.{name}", list[int | None]()
            for part in map(str.strip, name.split(",")):
                meaning += _meaning(part, at_key, rows, forces, missing, along)
            if isinstance(reference, Reference) and reference.size != len(meaning):
                text = f"{reference.size} values for {len(meaning)} outputs"
                raise ScenarioError((at_key, text))
            self._references.append((_values_of(reference, len(meaning)), meaning))
        every = dict.fromkeys(row for _, meaning in self._references for row in meaning)
        beside = [row for row in every if row is not None and row >= rows.given]
        if len(beside) > missing:
            names = ", ".join(rows.signals[row].name for row in beside)
            text = f"{names} are {len(beside)} outputs, but only {missing} are missing"
            raise ScenarioError((key, text))
        left = [rows.signals[row].name for row in range(rows.given) if row not in every]
        if left and scenario.task is None:
            raise ScenarioError((key, f"missing: {', '.join(left)}"))
        self.rows = [*range(rows.given), *beside]
        begin = scenario.integrator.start_time
        end = begin if scenario.task else begin + scenario.duration
        self.path = [self._values(time) for time in np.unique(np.linspace(begin, end, _TIMES))]

    def _values(self, time: float) -> tuple[FloatArray, FloatArray]:
        """The values of the rows and their rates at a time in s, shape (len(rows),) each."""
        found = {row: (self._held[row], 0.0) for row in self.rows}
        for reference, meaning in self._references:
            pairs = zip(meaning, reference(time), strict=True)
            found |= {row: (pair[0], pair[1]) for row, pair in pairs if row is not None}
        values, rates = np.array([found[row] for row in self.rows]).reshape(-1, 2).T
        return values, rates


def _of_phases(scenario: Scenario, distances: set[str]) -> dict[str, Any]:
    """The first reference that a phase of the task gives each output, without distances."""
    assert scenario.task is not None
    references = dict[str, Any]()
    for phase in scenario.task.phases:
        for key, reference in getattr(phase, "references", {}).items():
            parts = [part.strip() for part in key.split(",")]
            kept = [part for part in parts if part not in distances]
            # The rows of a Reference cannot be taken apart here.
            if kept and (kept == parts or not isinstance(reference, Reference)):
                references.setdefault(", ".join(kept), reference)
    return references


_Values = Callable[[float], FloatArray]


def _values_of(reference: Any, size: int) -> _Values:
    """The values of a reference and their rates as a function of time in s, shape (size, 2)."""
    if not isinstance(reference, Reference):
        constant = np.array([[float(reference), 0.0]] * size)
        return lambda time: constant
    try:
        function = reference.derivatives([1] * size)
        return lambda time: function(time).reshape(-1, 2)
    except ReferenceSignalError:  # One of a force may jump.
        values = reference.derivatives([0] * size)
        return lambda time: values(time)[:, None] * [1.0, 0.0]


def _meaning(
    name: str, key: str, rows: _Rows, forces: Sequence[str], missing: int, along: Sequence[int]
) -> Sequence[int | None]:
    """The rows that a name in references denotes; None for a force."""
    signals = [signal.name for signal in rows.signals]
    outputs = [*signals[: rows.given], *forces]
    with suppress(ReferenceSignalError):
        places = denoted(name, outputs, [2] * rows.given + [0] * len(forces))
        return [place if place < rows.given else None for place in places]
    if missing:  # Of a point the rows along its surface first.
        first = [signals[row] for row in along]
        others = [*first, *(signal for signal in signals[rows.given :] if signal not in first)]
        of_point = [signal for signal in first if signal.rpartition(".")[0] == name]
        with suppress(ReferenceSignalError):
            chosen = of_point or [others[k] for k in denoted(name, others, [2] * len(others))]
            return [signals.index(signal) for signal in chosen]
        outputs += others
    for constraint in rows.bound.constraints:
        if name in [signal.name for signal in constraint.coordinate_signals]:
            text = f"no output '{name}', a coordinate along the constraint '{constraint.name}'"
            form = f"!SurfaceCoordinates {{constraint: {constraint.name}}}"
            raise ScenarioError((key, f"{text}: add {form} to outputs"))
    raise ScenarioError((key, unknown_name("output", name, outputs)))


def _why_none(
    posture: Posture,
    rows: _Rows,
    named: Sequence[int],
    missing: int,
    bound: ConstraintSet,
    forces: Sequence[str],
) -> tuple[str, str]:
    """The key and text of the problem if no positions complete the outputs."""
    left, values, _ = np.linalg.svd(posture.forces)
    rank = int(np.count_nonzero(values > 1e-6 * np.max(values, initial=0.0)))
    if rank < len(forces):
        weights = np.linalg.norm(left[:, rank:], axis=1)
        dependent = [name for name, weight in zip(forces, weights, strict=True) if weight > 1e-6]
        return "forces", (
            f"{', '.join(dependent)} depend on each other at the start: of {len(forces)} force "
            f"outputs {rank} are independent. Leave out {len(forces) - rank} of them; a force "
            "across several contacts of one plane is a !ForceCombination of those normal to it"
        )
    ways = len(posture.mass) - int(np.linalg.matrix_rank(posture.constraints, 1e-9))
    lacking = rows.given + missing - ways
    if lacking <= 0:
        names = ", ".join(rows.signals[row].name for row in named) or "the constraints"
        return "outputs", (
            f"{missing} are missing, and no positions of joints beside {names} leave B(x) regular; "
            "name others under outputs"
        )
    return "forces", (
        f"{rows.given + missing} outputs more are needed, one for each actuator that is left, but "
        f"on its constraints the robot moves in {ways} ways: at most {ways} can be positions, and "
        f"{lacking} more must be forces, of {', '.join(s.name for s in bound.force_signals)}; or "
        "leave actuators out by robot.actuators"
    )
