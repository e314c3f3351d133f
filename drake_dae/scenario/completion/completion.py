"""Completion of a scenario: missing outputs, and the start."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from drake_dae.arrays import FloatArray
from drake_dae.errors import ScenarioError
from drake_dae.robots.constraints import Constraint
from drake_dae.robots.constraints.constraint_set import ConstraintSet
from drake_dae.robots.links.links import Links
from drake_dae.scenario.completion.candidates import merged
from drake_dae.scenario.completion.choice import best_joints, first_independent
from drake_dae.scenario.completion.postures import Posture, Postures
from drake_dae.scenario.completion.referred import ReferredRows
from drake_dae.scenario.completion.search import TRIES, best_posture, near_posture, nearest_posture
from drake_dae.scenario.completion.setting import Setting
from drake_dae.scenario.completion.shortage import check_independent, why_none
from drake_dae.scenario.scenario import Scenario

REGULAR = 1e-3
"""A start with an `independence` below this is singular."""

_DIGITS = 4
"""The number of decimals of m and rad of a start."""


@dataclass(frozen=True)
class Completed:
    """A scenario with all outputs and a start.

    Attributes:
        scenario: The scenario.
        notes: The library's choices, one line each.
    """

    scenario: Scenario
    notes: tuple[str, ...] = ()


def complete(
    scenario: Scenario,
    links: Links,
    constraints: Sequence[Constraint],
    of_plant: Sequence[Constraint],
    guess: FloatArray,
) -> Completed:
    """Chooses the missing outputs of a scenario, and the start.

    Outputs are missing if there are fewer outputs than actuators. They are chosen as described for
    `complete_scenario`.

    Newton's method finds a start from the default configuration with start.positions. If it finds
    none within the limits of joints, it is repeated from 60 random guesses of the joints that are
    not in start.positions, and the posture of best `quality` is taken.

    Args:
        scenario: The scenario.
        links: Its robot.
        constraints: Its constraints.
        of_plant: The constraints in the robot's file.
        guess: The default configuration with start.positions, shape (nq,).

    Raises:
        ScenarioError: The robot cannot reach the start, or no choice of outputs is independent.
    """
    setting = Setting.of(scenario, links, constraints, of_plant)
    bound, size, missing = setting.bound, len(setting.names), setting.missing
    _check_coordinates(scenario, bound, setting.names)
    is_placed = len(scenario.start.positions) == len(links.position_signals)
    if (
        # A robot that is only simulated.
        not (size or setting.S.shape[0] or scenario.references)
        or scenario.law.control_weights
        or scenario.compliances is not None
        # The model refuses such actuators.
        or np.linalg.matrix_rank(links.actuation_matrix) < len(links.actuator_signals)
        or missing < 0
        or (missing == 0 and is_placed)
    ):
        return Completed(scenario)
    candidates, names = setting.candidates(scenario, links), setting.forces
    postures = setting.postures(scenario, links, candidates)
    # Rows named by references are known before the posture, from the normal near the guess.
    near = postures.at(postures.solve((), np.zeros(0), guess)) if missing else None
    if near is not None:
        check_independent(names, near)
    movable = _movable(postures) if missing else []
    along = [row for row in candidates.points(near) if row in movable] if near else []
    try:
        referred = ReferredRows(scenario, candidates, size, missing, names, along)
    except ScenarioError:
        if missing == 0 and scenario.start.positions:
            return Completed(scenario)  # The wiring of references reports more details.
        raise
    if missing == 0:
        return _with_start(scenario, referred, postures, guess)
    every = [signal.name for signal in bound.force_signals]
    return _with_outputs(scenario, referred, postures, guess, every)


def _check_coordinates(scenario: Scenario, bound: ConstraintSet, outputs: Sequence[str]) -> None:
    """Refuses references to coordinates along a constraint that are not outputs."""
    for constraint in bound.constraints:
        for signal in constraint.coordinate_signals:
            for key in scenario.references:
                if signal.name in map(str.strip, key.split(",")) and signal.name not in outputs:
                    text = (
                        f"no output '{signal.name}'; it is a coordinate along the constraint "
                        f"{constraint.name}: add !SurfaceCoordinates {{constraint: "
                        f"{constraint.name}}} to outputs"
                    )
                    raise ScenarioError((f"references.{key}", text))


def _with_start(
    scenario: Scenario, referred: ReferredRows, postures: Postures, guess: FloatArray
) -> Completed:
    """Adds a start to a scenario whose default configuration leads to none."""
    rows = referred.rows
    wanted = referred.at_start(rows)
    near = near_posture(postures, rows, wanted, guess)
    is_given = bool(scenario.start.positions)
    # The structure is evaluated at the guess.
    if near is not None and (
        is_given or all(p.independence(rows) > REGULAR for p in (near, postures.at(guess)))
    ):
        return Completed(scenario)
    if is_given:
        posture = best_posture(postures, rows, wanted, list(_guesses(referred, postures, guess)))
        if posture is None:  # The start reports it.
            return Completed(scenario)
    else:
        posture = _search(referred, postures, rows, wanted, guess)
    return Completed(_started(scenario, referred, posture), (_start_note(referred, posture),))


def _with_outputs(
    scenario: Scenario,
    referred: ReferredRows,
    postures: Postures,
    guess: FloatArray,
    forces: Sequence[str],
) -> Completed:
    """Adds the missing outputs and a start; `forces` are the names of all constraint forces."""
    candidates, named = referred.candidates, referred.rows
    posture, is_normal = _posture(referred, postures, named, guess)
    # The completing outputs, in order of preference.
    open_points = [row for row in candidates.points(posture) if row not in named]
    room = referred.missing - len(named) + referred.given
    along = first_independent(posture, named, open_points, room)
    rows = [*named, *along]
    room -= len(along)
    axes = [row for row in candidates.axes if row not in rows]
    directions = first_independent(posture, rows, axes, len(axes))
    directions = directions if len(directions) <= room else []
    rows += directions
    wanted = [referred.wanted(time)[: len(named)] for time in referred.times()]
    free = [row for row in candidates.joints if row not in rows]
    joints = best_joints(postures, posture, rows, free, room - len(directions), np.array(wanted))
    if joints is None:
        why = why_none(posture, rows, free, referred.missing, referred.given, forces)
        if why is not None:
            raise ScenarioError(why)
        names = ", ".join(candidates.signals[row].name for row in rows) or "the constraints"
        text = (
            f"{referred.missing} are missing, and no positions of joints beside {names} leave "
            "B(x) regular; name others under outputs"
        )
        raise ScenarioError(("outputs", text))
    resting = [*along, *directions, *joints]
    chosen = [*named[referred.given :], *resting]
    values = rounded(posture.rows)
    if is_normal:
        values[candidates.tilts] = 0.0
    constants = {candidates.signals[row].name: float(values[row]) for row in resting}
    completed = replace(
        scenario,
        outputs=[*scenario.outputs, *merged(candidates.form(row) for row in chosen)],
        references={**scenario.references, **constants},
    )
    names = ", ".join(candidates.signals[row].name for row in chosen)
    reason = " (joints so that B(x) is best conditioned)" if joints else ""
    note = f"outputs completed by {names}{reason}"
    return Completed(_started(completed, referred, posture), (note, _start_note(referred, posture)))


def _movable(postures: Postures) -> list[int]:
    """The rows that vary with q; some rows of a planar arm are constant."""
    some = [postures.at(q).gradients for q in postures.guesses(4)]
    return np.flatnonzero(np.linalg.norm(some, axis=2).max(axis=0) > 1e-9).tolist()


def _posture(
    referred: ReferredRows,
    postures: Postures,
    rows: Sequence[int],
    guess: FloatArray,
) -> tuple[Posture, bool]:
    """The posture at the start, and whether the tools are normal to their surfaces there."""
    candidates, wanted = referred.candidates, referred.at_start(rows)
    both = [*rows, *candidates.tilts]
    goal = np.concatenate([wanted, np.zeros(len(candidates.tilts))])
    if referred.scenario.start.positions:
        for chosen, values in ((both, goal), (rows, wanted)):
            near = near_posture(postures, chosen, values, guess)
            if near is not None and near.independence(rows) > REGULAR:
                return near, len(chosen) > len(rows)
    if candidates.tilts:
        posture = best_posture(postures, both, goal, [guess, *_guesses(referred, postures, guess)])
        if posture is not None:
            return posture, True
    return _search(referred, postures, rows, wanted, guess), False


def _guesses(referred: ReferredRows, postures: Postures, guess: FloatArray) -> FloatArray:
    """Random guesses of the joints without start.positions, shape (TRIES, nq)."""
    names = [referred.candidates.signals[row].name for row in referred.candidates.joints]
    is_given = [name in referred.scenario.start.positions for name in names]
    return np.where(is_given, guess, postures.guesses(TRIES))


def _search(
    referred: ReferredRows,
    postures: Postures,
    rows: Sequence[int],
    wanted: FloatArray,
    guess: FloatArray,
) -> Posture:
    """The best posture with these values of outputs.

    Raises:
        ScenarioError: There is none; the message has the remaining errors of the nearest one.
    """
    guesses = [guess, *_guesses(referred, postures, guess)]
    best = best_posture(postures, rows, wanted, guesses)
    if best is not None:
        return best
    nearest = nearest_posture(postures, rows, wanted, guesses)
    polished = near_posture(postures, rows, wanted, nearest.q)
    if polished is not None:
        return polished
    signals = [referred.candidates.signals[row] for row in rows]
    missed = [
        f"{signal.name} comes to {value:.4g} {signal.unit}, "
        f"{abs(goal - value):.2g} {signal.unit} from {goal:.4g} {signal.unit}".replace(" ,", ",")
        for signal, value, goal in zip(signals, nearest.rows[list(rows)], wanted, strict=True)
        if abs(goal - value) > 1e-6
    ]
    residual = float(np.max(np.abs(nearest.left), initial=0.0))
    if residual > 1e-6:
        missed.append(f"{residual:.2g} (m or rad) is left of the constraints")
    text = (
        "the robot cannot start there within its joint limits; the nearest start found has: "
        f"{'; '.join(missed) or 'nothing, but at a limit'}. Change the first values of the "
        "references, start.errors or the surface's place, or give start.positions"
    )
    raise ScenarioError(("references" if len(rows) else "constraints", text))


def _started(scenario: Scenario, referred: ReferredRows, posture: Posture) -> Scenario:
    """The scenario with a start."""
    return replace(scenario, start=replace(scenario.start, positions=_named(referred, posture)))


def _named(referred: ReferredRows, posture: Posture) -> dict[str, float]:
    """The positions of a posture by their names, rounded."""
    names = [referred.candidates.signals[row].name for row in referred.candidates.joints]
    return dict(zip(names, rounded(posture.q).tolist(), strict=True))


def rounded(values: FloatArray) -> FloatArray:
    """Values as they are written, without -0."""
    return np.round(values, _DIGITS) + 0.0


def _start_note(referred: ReferredRows, posture: Posture) -> str:
    return start_note(_named(referred, posture))


def start_note(positions: Mapping[str, float]) -> str:
    """The note on a start: the positions of all joints."""
    texts = (f"{name}: {value:.4g}" for name, value in positions.items())
    return f"start found: {{{', '.join(texts)}}}"
