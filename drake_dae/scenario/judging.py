"""Judges a scenario: before its run, along its references; and after it, by its record."""

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import casadi as ca
import numpy as np
from pydrake.systems.framework import Context

from drake_dae import analysis as theory
from drake_dae.analysis import LimitKind, LimitsAlong, SignalRange
from drake_dae.arrays import FloatArray
from drake_dae.dae import Signal, Structure
from drake_dae.dae.advised_gains import RAMP
from drake_dae.diagrams.closed_loop import ClosedLoop
from drake_dae.diagrams.record import Record
from drake_dae.errors import AssumptionError, ScenarioError
from drake_dae.references.reference import common_period, stack_references
from drake_dae.robots import Constraint, LinkBehind, RobotModel, Surface, links_behind, own_values
from drake_dae.running.judgement import (
    FindingKind,
    Outcome,
    OutputQuality,
    RunFinding,
    RunStatistics,
    RunSummary,
)
from drake_dae.scenario.build import check_task, tracking_law
from drake_dae.scenario.form import at
from drake_dae.scenario.gains import advised, expected, moved_points, stated_errors
from drake_dae.scenario.model import (
    completed_model,
    exogenous_references,
    of_steered,
    reference_and_start,
    references_of,
    scenario_structure,
)
from drake_dae.scenario.scenario import Scenario

# The least number of examined times along a reference, and the most along a fast one.
SAMPLES, MOST_SAMPLES = 1001, 20_000
# The allowed deviation of a reference from linear interpolation between two times, relative to its
# range; the shortest interval that is divided, relative to the whole; and the share of a run that
# broke off, at its end, in which its limits are not judged.
STRAIGHT, SHORTEST, BREAK = 0.01, 1e-6, 0.01
_BEYOND = 2.0  # A run is reported whose errors exceed the stated ones by this factor.
# The remedy for a link behind a surface.
WRONG_SIDE = "turn its normal around if its free side is the other one, or choose another posture"


@dataclass(frozen=True, eq=False)
class Feasibility:
    """The analysis of a scenario's robot, and what its reference requires at least, without errors.

    `gains` is why none can be computed where they are left out. Unless `is_resolved`, values
    between the examined times are not known. `slowing` is how much slower the references keep all
    limits, and None where they do.
    """

    analysis: theory.Analysis
    duration: float
    gains: str = ""
    is_resolved: bool = True
    ranges: tuple[SignalRange, ...] = ()
    behind: tuple[LinkBehind, ...] = ()
    slowing: LimitsAlong | None = None

    def of(self, *kinds: LimitKind) -> tuple[SignalRange, ...]:
        """The ranges of some kinds; of joints only those with limits."""
        free = {LimitKind.POSITION, LimitKind.SPEED}
        ranges = (r for r in self.ranges if r.kind in kinds)
        return tuple(r for r in ranges if {r.kind} - free or np.isfinite([r.low, r.high]).any())

    @property
    def problems(self) -> tuple[str, ...]:
        """The problems, one text each; empty if there are none."""
        found = [*self.analysis.problems, *(str(r.excess) for r in self.ranges if r.excess)]
        found += [*(f"{link}: {WRONG_SIDE}" for link in self.behind), self.gains]
        if self.slowing is not None:
            found.append(f"most of all {self.slowing.excess}; {self.slowing.remedy}")
        return tuple(filter(None, found))

    def to_dict(self) -> dict[str, Any]:
        groups = {
            "controls": self.of(LimitKind.CONTROL),
            "joint_forces": self.of(LimitKind.EFFORT),
            "constraint_forces": self.of(LimitKind.FORCE),
            "joints": self.of(LimitKind.POSITION, LimitKind.SPEED),
        }
        return {
            "analysis": self.analysis.to_dict(),
            "duration": self.duration,
            "resolved": self.is_resolved,
            **{key: [r.to_dict() for r in ranges] for key, ranges in groups.items()},
            "behind": [asdict(link) for link in self.behind],
            "slowing": None if self.slowing is None else asdict(self.slowing),
            "problems": list(self.problems),
        }

    def __str__(self) -> str:
        rows, parts, motion = list[list[str]](), self.analysis.parts(), self.analysis.motion
        for r in self.of(*LimitKind):
            limits = f"{r.low:.4g} to {r.high:.4g}" if r.low != -r.high else f"{r.high:.4g}"
            limits = "pushes only" if r.kind is LimitKind.FORCE and r.low == 0.0 else limits
            limits = "none" if np.isinf([r.low, r.high]).all() else limits
            # The extremes of a constant are round-off, and have no times.
            moves = r.largest - r.least > 1e-9 * max(abs(r.least), abs(r.largest))
            low, high = (f"{t:.4g} s" * moves for t in (r.least_time, r.largest_time))
            remark = "" if r.beyond_time is None else f"left at {r.beyond_time:.4g} s"
            row = [theory.digits(r.least), low, theory.digits(r.largest), high, limits, remark]
            rows.append([r.signal.name, r.signal.unit or "1", *row])
        if rows:
            head = ["needed along the reference", "unit", "least", "at", "largest", "at", "limit"]
            parts.append(theory.Table([*head, ""], rows, left=2))
        if motion is not None and motion.times.size:
            text = f"Started without errors, and examined at {motion.times.size} times."
            if not self.is_resolved:
                text += (
                    " The reference varies too fast for these: what lies between them is not "
                    "known. A shorter duration takes them closer together."
                )
            parts.append([text])
        parts.append([f"PROBLEM  {text}" for text in self.problems] or ["no problem found"])
        return theory.to_text(parts)


def find_feasibility(scenario: Scenario) -> Feasibility:
    """Analyzes the robot of a scenario, and what its reference requires of drives and joints."""
    # The robot, and gains for it if they are left out.
    check_task(scenario)
    completed, model, _ = completed_model(scenario)
    scenario, gains = completed.scenario, ""
    examined, structure, law = None, None, None
    try:
        if scenario.task is None:
            examined = of_steered(model, theory.examine)
            structure = None if examined.problems else examined.structure
        structure = structure or scenario_structure(model)
    except AssumptionError:
        return Feasibility(theory.analyze(model.dae), scenario.duration)
    try:
        law = tracking_law(advised(scenario, model, structure).scenario, model, structure)
    except ScenarioError as error:
        if not scenario.is_advised:
            raise
        gains = str(error)
    if examined is None:
        return Feasibility(theory.analyze(model.dae), scenario.duration, gains)

    # The motion along the reference, at times that resolve it.
    reference, start = reference_and_start(scenario, model, structure)
    degrees = None if law is None or scenario.estimator is not None else law.exogenous_degrees
    exogenous = exogenous_references(scenario, model.dae, degrees)
    names = [signal.name for signal in model.dae.output_signals]
    outputs = references_of(scenario, names, structure.layout.reference_degrees)
    period = common_period([r.repeats for r in (*outputs, *exogenous)])
    moving = stack_references(exogenous, [1] * sum(r.size for r in exogenous))

    def signals(time: float) -> FloatArray:
        return np.concatenate([reference(time), moving(time)] if exogenous else [reference(time)])

    begin = scenario.integrator.start_time
    times, is_resolved = sample_times(signals, begin, begin + scenario.duration)
    analysis = theory.along(examined, reference, times, start, period or None, exogenous)
    motion, found = analysis.motion, (scenario.duration, gains, is_resolved)
    if motion is None or not motion.times.size:
        return Feasibility(analysis, *found)

    # Its limits.
    with at("judgement.friction_cones"):
        limits = theory.robot_limits(model, scenario.judgement.friction_cones)
    ranges = limits.ranges(motion.times, limits.of_motion(motion))
    behind, slowing = links_behind(model, motion.times, motion.states, motion.parameters), None
    if analysis.structure is not None:
        slowing = theory.limits_along(analysis.structure, limits, reference, motion)
    return Feasibility(analysis, *found, ranges, behind, slowing)


def sample_times(
    reference: Callable[[float], FloatArray], begin: float, end: float
) -> tuple[FloatArray, bool]:
    """Sample times between which a reference is nearly linear, and whether there are enough."""
    # Equidistant times would miss a sinusoid whose period is the interval. Each interval is tested
    # at a random time, and divided if the reference is not linear there.
    random, times = np.random.default_rng(0), np.linspace(begin, end, SAMPLES)
    values = np.array([reference(time) for time in times])
    while True:
        share = random.uniform(0.3, 0.7, times.size - 1)
        tried = times[:-1] + share * np.diff(times)
        new_values = np.array([reference(time) for time in tried])
        all_values = np.concatenate([values, new_values])
        # A constant varies by round-off.
        allowed = STRAIGHT * np.ptp(all_values, axis=0) + 1e-9 * np.abs(all_values).max(axis=0)
        off = np.abs(new_values - values[:-1] - share[:, None] * np.diff(values, axis=0))
        # At a jump of the derivative no division suffices.
        is_long = np.diff(times) > SHORTEST * (end - begin)
        new = np.flatnonzero(np.any(off > allowed, axis=1) & is_long)
        if not new.size or times.size + new.size > MOST_SAMPLES:
            return times, not new.size
        times = np.insert(times, new + 1, tried[new])
        values = np.insert(values, new + 1, new_values[new], axis=0)


def judge_run(
    scenario: Scenario,
    loop: ClosedLoop,
    context: Context,
    record: Record,
    statistics: RunStatistics | None = None,
    failure: str = "",
) -> RunSummary:
    """Judges a run by its record."""
    # What exceeds its limits, and which links are behind surfaces. The last numbers of a run that
    # broke off are not those of its motion.
    wanted, notes = scenario.judgement, list[str]()
    model, law = loop.plant.robot("a scenario"), loop.controller.law
    dae, times, stop = model.dae, record.time, record.time.size
    limits = theory.robot_limits(model, wanted.friction_cones)
    if failure:
        stop = max(1, int(np.searchsorted(times, times[-1] - BREAK * (times[-1] - times[0]))))
    ranges = limits.ranges(times[:stop], limits.of_record(record)[:stop])
    behind = []
    for link in links_behind(model, times, record["state"], loop.plant_parameters(record, context)):
        numbers = Signal(link.link, "m"), link.depth, 0.0, link.time
        behind.append(RunFinding(FindingKind.BEHIND, str(link), Outcome.BAD, *numbers, WRONG_SIDE))

    # Approximations, and places beyond the data of surfaces.
    for constraint in model.constraints:
        surface = constraint.surface_at(own_values(constraint, dae, dae.parameter_values))
        if surface is not None:
            note = f"{constraint.name}: {surface.remark}" * bool(surface.remark)
            notes += [note, _beyond_edge(constraint, surface, model, record)]

    # How the run ended, and the judgement.
    ended = failure
    if statistics is not None:
        ended = ended or "interrupted" * (statistics.interrupted is not None)
        left = scenario.duration - statistics.simulated_time
        early = left > 1e-9 * scenario.duration and not ended
        notes += [f"the task stopped the run {left:.4g} s early"] * early
    is_fixed = loop.plant.time_step or not scenario.integrator.use_error_control
    accuracy = None if is_fixed else scenario.integrator.accuracy
    # Friction of the plant's material alone, at a contact for which the law has none.
    material = scenario.plant.material
    touching = [c for c in model.constraints if any(c.is_unilateral)]
    is_unknown = any(contact.friction_parameter is None for contact in touching)
    reasons = {
        "the drives were saturated": "excess" in record and bool(record["excess"].any()),
        "parameters of the plant differ from those of the law": scenario.plant.parameters,
        "the plant carries payloads that the law does not know": scenario.plant.payloads,
        "disturbances act on the plant, unknown to the law": scenario.plant.disturbances,
        "the contact has friction that the law does not know": (
            material is not None and material.friction and is_unknown
        ),
        "the contact is compliant": not loop.plant.is_ideal,
        "the force is measured by a sensor": scenario.sensors.force is not None,
        "the state is measured by encoders": scenario.sensors.encoders is not None,
        "the law is sampled": scenario.sampling is not None,
    }
    summary = RunSummary(
        record,
        loop.predicted_error(record),
        ranges,
        tolerances={n: np.inf if e is None else e for n, e in wanted.tolerances.items()},
        changes=loop.changes(record),
        ended=ended,
        accuracy=accuracy,
        reasons=[reason for reason, holds in reasons.items() if holds],
        more=behind,
        statistics=statistics,
        named=(scenario.estimator.parameters if scenario.estimator else None) or (),
    )
    notes.append(beyond_stated(scenario, model, law.structure, summary.outputs, record))
    return replace(summary, notes=tuple(dict.fromkeys(filter(None, notes))))


def beyond_stated(
    scenario: Scenario,
    model: RobotModel,
    structure: Structure,
    outputs: Sequence[OutputQuality],
    record: Record,
) -> str:
    """Which assumption failed if the errors of a run are beyond the stated ones, or ""."""
    stated = stated_errors(scenario, model, structure)
    if stated is None:
        return ""
    points, late = moved_points(model), record.time >= record.time[[0, -1]].mean()
    pressing = [signal.name for signal in model.dae.constraint_input_signals]
    found = [
        float(np.linalg.norm([o.late_rms for o in outputs if o.signal.name in names]))
        for names in (points, pressing)
    ]
    if all(own <= _BEYOND * most for own, most in zip(found, stated, strict=True)):
        return ""
    names = [signal.name for signal in record.signals["desired_output"].signals]
    wanted = record["desired_output"][late][:, [name in pressing for name in names]]
    step = np.gradient(wanted, record.time[late], axis=0)
    slope, least = float(np.sqrt(np.mean(step**2))), np.min(record["constraint_force"][late])
    estimator = scenario.estimator
    causes = {
        "drives were at their limits": "excess" in record and bool(record["excess"].any()),
        "the contact was lost": estimator is not None and least < estimator.least_force,
        f"the reference of the force changes by {slope:.2g} N/s rms": slope > RAMP,
    }
    failed = [cause for cause, holds in causes.items() if holds]
    if not failed:
        unknown = "is wrong by more than that"
        if estimator is not None and estimator.parameters is not None:
            unknown += "; only " + (", ".join(estimator.parameters) or "a disturbance")
            unknown += " is estimated"
        failed = [f"the law's model {unknown}"]
    return (
        f"errors of {1e3 * found[0]:.2g} mm and {found[1]:.2g} N rms, where "
        f"{expected(scenario, stated)}: {', '.join(failed)}"
    )


def _beyond_edge(
    constraint: Constraint, surface: Surface, model: RobotModel, record: Record
) -> str:
    """When a point is beyond the edge of its surface's data first; "" if it is not."""
    dae, extent, coordinates = model.dae, surface.extent, constraint.coordinates(model.links)
    # The record does not contain the position of a moving surface.
    if extent is None or any(ca.depends_on(coordinates, p.symbol) for p in dae.exogenous.moving):
        return ""
    function = dae.trace("coordinates", {"coordinates": coordinates})
    places = np.array([function(x, dae.parameter_values)[0] for x in record["state"]])
    beyond = np.max(np.maximum(extent[0] - places, places - extent[1]), axis=1)
    if not np.any(beyond > 0.0):
        return ""
    first, most = record.time[int(np.argmax(beyond > 0.0))], 1e3 * float(np.max(beyond))
    return (
        f"{constraint.name}: the robot is beyond the edge of the data by up to {most:.2g} mm, "
        f"first at {first:.3g} s; there the surface continues as a plane"
    )
