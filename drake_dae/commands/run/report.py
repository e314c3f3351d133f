"""What a run achieved, as text and as data."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

from pydrake.systems.framework import Context

from drake_dae.arrays import FloatArray
from drake_dae.diagrams.closed_loop import ClosedLoop
from drake_dae.robots.links_behind import LinkBehind, links_behind
from drake_dae.scenario.feasibility.limits import limits_of_run
from drake_dae.scenario.scenario import Scenario
from drake_dae.simulation.job import JobOutcome, JobVerdict, judge_job
from drake_dae.simulation.records.record import Record
from drake_dae.simulation.remarks import (
    ball_remarks,
    limit_remarks,
    reference_remarks,
    stop_remarks,
    surface_remarks,
    touch_remarks,
)
from drake_dae.simulation.simulate import RunStatistics
from drake_dae.simulation.summary import Limits, shortfalls, summary
from drake_dae.simulation.verdict import TrackingResult, as_data, judge
from drake_dae.systems.control.phase_change import PhaseChange


@dataclass(frozen=True, eq=False)
class RunReport:
    """The figures and verdicts of a run.

    Attributes:
        record: The record of the run.
        predicted: The tracking error by theory, shape (k, p).
        limits: The limits of the robot.
        accuracy: The accuracy of error control; None with fixed steps.
        job: Whether the run succeeded, and why.
        text: The summary, in lines for the screen.
        data: The results as plain data; "missed" says whether a wish or the prediction was missed.
    """

    record: Record
    predicted: FloatArray
    limits: Limits
    accuracy: float | None
    job: JobVerdict
    text: str
    data: dict[str, Any]


def report_run(
    scenario: Scenario,
    loop: ClosedLoop,
    context: Context,
    record: Record,
    statistics: RunStatistics | None = None,
    failure: str = "",
) -> RunReport:
    """Judges a run by its record.

    Args:
        scenario: The completed scenario.
        loop: The loop that ran.
        context: The context of the loop at the end of the run.
        record: The record of the run, of at least one time.
        statistics: The statistics of the run; None for a failed run, or one of an earlier time.
        failure: The reason of the failure.
    """
    model, config = loop.plant.model, scenario.integrator
    predicted = loop.predicted_error(record)
    limits = Limits() if model is None else Limits.of(model)
    exceeded = limits_of_run(loop, record, scenario.judgement.friction_cones)
    fixed = loop.plant.time_step or not config.use_error_control
    accuracy = None if fixed else config.accuracy
    reasons = _reasons(scenario, loop, record)
    behind: tuple[LinkBehind, ...] = ()
    if model is not None:
        own = loop.plant_parameters(record, context)
        behind = links_behind(model, record.time, record["state"], own)
    changes = loop.changes(context)
    is_interrupted = statistics is not None and statistics.interrupted is not None
    job = judge_job(
        record,
        predicted,
        scenario.judgement.tolerances,
        [
            *shortfalls(record, limits),
            *exceeded,
            *map(str, behind),
        ],
        limits.pushing,
        changes,
        is_cut_short=bool(failure) or is_interrupted,
        notes=limit_remarks(record, limits),
    )
    verdict = judge(record, predicted, accuracy)
    lines = [summary(record, predicted, limits, statistics, failure, accuracy, reasons)]
    lines += _contact_remarks(scenario, loop, record)
    lines += reference_remarks({**scenario.references, **scenario.exogenous, "task": scenario.task})
    lines += _task_remarks(scenario, changes, statistics)
    is_unexplained = verdict.tracking is TrackingResult.OFF and not reasons
    data = {
        "missed": job.outcome is JobOutcome.BAD or is_unexplained,
        "job": job.to_dict(),
        "phases": [asdict(change) for change in changes],
        "behind": [asdict(link) for link in behind],
        **as_data(verdict, reasons),
        "interrupted": is_interrupted,
        **{
            name: getattr(statistics, name, None)
            for name in ("simulated_time", "steps", "wall_time")
        },
    }
    return RunReport(record, predicted, limits, accuracy, job, "\n".join(lines), data)


def _contact_remarks(scenario: Scenario, loop: ClosedLoop, record: Record) -> list[str]:
    """Remarks on the surfaces of a robot and on its plant."""
    if loop.plant.model is None:
        return []
    material = scenario.plant.material
    return [
        *surface_remarks(loop.plant.model, record),
        *ball_remarks(None if material is None else material.radius),
    ]


def _task_remarks(
    scenario: Scenario, changes: Sequence[PhaseChange], statistics: RunStatistics | None
) -> list[str]:
    """The phases of a task, and remarks on its end and its touches."""
    if not changes:
        return []
    stopped = stop_remarks(statistics, scenario.duration)
    return ["", *map(str, changes), *stopped, *touch_remarks(changes)]


def _reasons(scenario: Scenario, loop: ClosedLoop, record: Record) -> list[str]:
    """Reasons for deviations from the prediction for an ideal run."""
    reasons = {
        "the drives were saturated": "excess" in record and bool(record["excess"].any()),
        "parameters of the plant differ from those of the law (plant.parameters)": bool(
            scenario.plant.parameters
        ),
        "the plant carries payloads that the law does not know": bool(scenario.plant.payloads),
        "disturbance forces act on the plant, unknown to the law": bool(
            scenario.plant.disturbances
        ),
        "the contact has friction that the law does not know (friction of its constraint)": (
            _has_unknown_friction(scenario, loop)
        ),
        "the contact is compliant": not loop.plant.is_ideal,
        "the force is measured by a sensor": scenario.sensors.force is not None,
        "the state is measured by encoders": scenario.sensors.encoders is not None,
        "the law is sampled": scenario.sampling is not None,
    }
    return [reason for reason, holds in reasons.items() if holds]


def _has_unknown_friction(scenario: Scenario, loop: ClosedLoop) -> bool:
    """Whether contacts of the plant alone have friction, of which the law's model has none."""
    material, model = scenario.plant.material, loop.plant.model
    if material is None or model is None or not material.friction:
        return False
    return any(any(c.is_unilateral) and c.friction_parameter is None for c in model.constraints)
