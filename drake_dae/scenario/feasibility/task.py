"""A task before it runs: its requirements phase by phase, by a run of the law's model."""

from collections.abc import Sequence
from copy import copy
from dataclasses import asdict, dataclass, replace
from math import inf, isfinite
from typing import Any

import numpy as np

from drake_dae.analysis.tables import Table, digits
from drake_dae.arrays import FloatArray
from drake_dae.dae.states.margins import RankMargin, find_margin
from drake_dae.dae.states.samples import Samples
from drake_dae.dae.structure.structure import Structure
from drake_dae.dae.system.layout import Indices
from drake_dae.errors import SimulationError
from drake_dae.robots.model import RobotModel
from drake_dae.scenario.controllers.task_controller import opening_contact
from drake_dae.scenario.feasibility.faces import FaceNeeds, FaceTips
from drake_dae.scenario.feasibility.holding import HoldingWatch
from drake_dae.scenario.feasibility.holes import HoleForce, hole_forces, misfit
from drake_dae.scenario.feasibility.touches import TaskTouch, period_of, touches_of
from drake_dae.scenario.loop import build_loop
from drake_dae.scenario.parts.parts import MeasuredForce
from drake_dae.scenario.plants import IdealConstraints
from drake_dae.scenario.scenario import Scenario
from drake_dae.scenario.start import start_scenario
from drake_dae.simulation.job import JobOutcome, judge_job
from drake_dae.simulation.records.record import Record
from drake_dae.simulation.summary import Limits
from drake_dae.systems.control.phase_change import PhaseChange
from drake_dae.systems.control.sampling import Sampling
from drake_dae.systems.task.controller import TaskController
from drake_dae.systems.task.phases import Phase

_STATES = 10
"""The number of states of a phase at which margins are taken."""


@dataclass(frozen=True)
class PhaseNeeds:
    """The requirements of one phase.

    Attributes:
        name: The phase.
        begin, end: Its start and end, in s.
        drive, share: The drive closest to its limit, and the largest share; "" and 0 without.
        joint, room: The joint that is closest to a limit, and the smallest distance, in its unit;
            "" and infinity without limits.
        force: The largest force of the contact, in N.
        margin: The smallest margin of the matrix that the active law inverts, B(x); 0 if singular.
        is_singular: Whether that is singular.
        face: How near its face is to tipping; None without a face that presses.
    """

    name: str
    begin: float
    end: float
    drive: str
    share: float
    joint: str
    room: float
    force: float
    margin: float
    is_singular: bool
    face: FaceNeeds | None = None


@dataclass(frozen=True, eq=False)
class TaskNeeds:
    """The requirements of a task, in an ideal contact where the law's model has it.

    Attributes:
        record: The record of the run.
        parameters: The values of all parameters at its times, shape (k, P).
        phases: The requirements of each phase, in order.
        touches: The touches.
        holes: The forces at a hole that it searches, or inserts a tool into.
        tipping: Where its face is nearest to tipping, in words; empty without a face.
        outcome: The end of the task in words.
        problems: The problems, one text each.
    """

    record: Record
    parameters: FloatArray
    phases: tuple[PhaseNeeds, ...]
    touches: tuple[TaskTouch, ...]
    holes: tuple[HoleForce, ...]
    tipping: str
    outcome: str
    problems: tuple[str, ...]

    @property
    def times(self) -> FloatArray:
        """The times of the run in s, shape (k,)."""
        return self.record.time

    @property
    def states(self) -> FloatArray:
        """x at these times, shape (k, n)."""
        return self.record["state"]

    @property
    def controls(self) -> FloatArray:
        """u at these times, shape (k, p)."""
        return self.record["control"]

    @property
    def constraint_inputs(self) -> FloatArray:
        """The constraint forces at these times, shape (k, m)."""
        return self.record["constraint_force"]

    def table(self) -> Table:
        """A row for each phase."""
        head = ["phase", "from [s]", "to [s]", "force [N]", "margin", "drive", "", "joint", ""]
        faces, rows = any(needs.face for needs in self.phases), []
        for needs in self.phases:
            drive = f"{needs.share:.0%}" if needs.drive else ""
            room = f"{needs.room:.3g} left" if isfinite(needs.room) else ""
            numbers = [digits(number) for number in (needs.begin, needs.end, needs.force)]
            texts = [f"{needs.margin:.2g}", drive, needs.drive, room, needs.joint]
            if needs.face is not None:
                texts += [f"{needs.face.eccentricity:.2f}", f"{needs.face.tips:.2g}"]
            elif faces:
                texts += ["", ""]
            rows.append([needs.name, *numbers, *texts])
        head += ["eccentricity", "tips at [N]"] if faces else []
        return Table(head, rows)

    @property
    def lines(self) -> list[str]:
        """The touches, the forces at a hole, the face, and the end of the task."""
        told = [*self.touches, *self.holes, self.tipping, self.outcome]
        return [text for text in map(str, told) if text]

    def to_dict(self) -> dict[str, Any]:
        """The requirements as plain data; None for an infinite number."""
        rows = [asdict(needs) for needs in self.phases]
        for row in rows:
            row["room"] = row["room"] if isfinite(row["room"]) else None
        return {
            "phases": rows,
            "touches": [asdict(touch) for touch in self.touches],
            "holes": [asdict(hole) for hole in self.holes],
            "tipping": self.tipping,
            "outcome": self.outcome,
        }


def task_needs(scenario: Scenario, model: RobotModel, structure: Structure) -> TaskNeeds:
    """Runs a task by the law's model in ideal contact, and collects its requirements.

    Args:
        scenario: The completed scenario with gains, from `advised`.
        model: Its robot.
        structure: The structure of the model's system.

    Raises:
        ScenarioError: Something does not fit; the message names its key.
    """
    from drake_dae.scenario.rolled import roll_scenario

    ideal = _ideal(scenario)
    loop = build_loop(ideal, _without_holes(scenario, model), structure)
    controller, context = loop.controller, start_scenario(ideal, loop)
    assert isinstance(controller, TaskController)
    watch = HoldingWatch(model)
    found = roll_scenario(ideal, loop, context, look=watch.look)
    watch.look(found.record.after, always=True)
    if watch.failure is not None:
        found = found.ended(watch.failure)
    record, changes = found.record, loop.changes(found.context or context)
    changes = tuple(change for change in changes if change.time <= record.time[-1])
    points = opening_contact(scenario, model)
    tips = FaceTips(model, controller, points) if len(points) > 1 else None
    phases = _phases(record, changes, controller, model, tips)
    touches, trips = touches_of(record, changes, controller, scenario, model)
    plan = controller.task.plan.phases
    tipping = "" if tips is None else tips.nearest(scenario, phases, record["state"][-1])
    holes = hole_forces(scenario, model, controller, record["state"][-1])
    problems = [
        f"{needs.name} passes a singular configuration, after {needs.begin:.4g} s"
        for needs in phases
        if needs.is_singular
    ]
    problems += [*trips, *filter(None, [misfit(scenario, model)])]
    outcome, failed = _outcome(record, changes, found.failure)
    if failed and not (changes and _feels_shape(plan, changes)):
        problems.append(outcome)
    outcome = f"In the law's model {outcome}."
    parameters = np.tile(model.dae.parameter_values, (record.time.size, 1))
    return TaskNeeds(
        record, parameters, phases, tuple(touches), holes, tipping, outcome, tuple(problems)
    )


def _without_holes(scenario: Scenario, model: RobotModel) -> RobotModel:
    """The model without the edges and holes of its surfaces, if the task enters a hole.

    The law has the hole right under its tool, which would fall into it without a touch.
    """
    assert scenario.task is not None
    if not any(phase.enters_holes for phase in scenario.task.phases):
        return model
    whole = copy(model)
    whole.constraints = tuple(constraint.whole for constraint in model.constraints)
    return whole


def _ideal(scenario: Scenario) -> Scenario:
    """The scenario with the plant of the law's model, exact sensors and an exact link."""
    force, sampling, period = scenario.force_feedback, scenario.sampling, period_of(scenario)
    if isinstance(force, MeasuredForce):
        force = replace(force, bias=0.0, noise_deviation=0.0, drift=0.0)
    if sampling is not None:
        sampling = replace(sampling, jitter=0.0, loss=0.0)
    elif period:
        sampling = Sampling(period)
    return replace(
        scenario,
        plant=IdealConstraints(),
        plant_parameters={},
        plant_payloads=[],
        plant_disturbances=[],
        force_feedback=force,
        sampling=sampling,
        encoders=None,
        observer=None,
        identified=[],
        saturation=False,
        may_diverge=True,
    )


def _outcome(
    record: Record, changes: Sequence[PhaseChange], failure: SimulationError | None
) -> tuple[str, bool]:
    """The end of the task in words, and whether it failed or did not end."""
    if failure is not None:
        return str(failure), True
    empty = np.zeros_like(record["tracking_error"])
    job = judge_job(record, empty, changes=changes)
    return "; ".join([*job.problems, *job.remarks]), job.outcome is not JobOutcome.GOOD


def _feels_shape(plan: Sequence[Phase], changes: Sequence[PhaseChange]) -> bool:
    """Whether the last phase that failed searches a shape, which the law's model does not have."""
    return any(plan[one.place].is_relative for one in changes if one.place < len(plan))


def phase_rows(record: Record, begin: float, end: float) -> Indices:
    """The indices of the rows of a phase; at the time of a change a row has the values before."""
    first = int(np.searchsorted(record.time, begin, side="right")) if begin > record.time[0] else 0
    last = int(np.searchsorted(record.time, end, side="right"))
    return np.arange(first, max(last, min(first + 1, record.time.size)))


def _phases(
    record: Record,
    changes: Sequence[PhaseChange],
    controller: TaskController,
    model: RobotModel,
    tips: FaceTips | None,
) -> tuple[PhaseNeeds, ...]:
    limits, needs = Limits.of(model), []
    ends = [*(change.time for change in changes[1:]), float(record.time[-1])]
    for change, end in zip(changes, ends, strict=True):
        rows = phase_rows(record, change.time, end)
        if not rows.size or (change.place >= len(controller.task.plan.phases)):
            continue
        pair = controller.pairs[change.law // 2]
        forces = record["constraint_force"][rows][:, list(pair.contact.forces)]
        holds = tips is not None and controller.task.plan.phases[change.place].holds_contact
        margin = _margin(pair.laws[change.law % 2].structure, record["state"][rows])
        needs.append(
            PhaseNeeds(
                change.phase,
                change.time,
                end,
                *_nearest_drive(record, rows, limits),
                *_nearest_joint(record, rows, limits),
                float(np.max(pair.contact.total(forces), initial=0.0)),
                margin.relative,
                margin.is_singular,
                tips.needs(record, rows) if tips is not None and holds else None,
            )
        )
    return tuple(needs)


def _margin(structure: Structure, states: FloatArray) -> RankMargin:
    chosen = states[np.unique(np.linspace(0, len(states) - 1, _STATES).astype(int))]
    return find_margin(Samples(structure.manifold, chosen), structure.control_matrix)


def _nearest_drive(record: Record, rows: Indices, limits: Limits) -> tuple[str, float]:
    if limits.control is None or not np.isfinite(limits.control).any():
        return "", 0.0
    shares = np.max(np.abs(record["control"][rows]), axis=0) / limits.control
    index = int(np.argmax(shares))
    return record.signals["control"].signals[index].name, float(shares[index])


def _nearest_joint(record: Record, rows: Indices, limits: Limits) -> tuple[str, float]:
    if limits.state is None:
        return "", inf
    lower, upper = limits.state
    values = record["state"][rows][:, : lower.size]
    signals = record.signals["state"].signals
    room = np.minimum(values - lower, upper - values).min(axis=0)
    # Positions; velocities have another unit.
    room[[index for index in range(room.size) if signals[index].unit.endswith("/s")]] = inf
    index = int(np.argmin(room))
    return (signals[index].name, float(room[index])) if isfinite(room[index]) else ("", inf)
