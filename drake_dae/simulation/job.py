"""Judges whether a run succeeded: outputs reach their references, and no limit is violated."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import Enum
from typing import Any

import numpy as np

from drake_dae.arrays import FloatArray, by_columns
from drake_dae.dae.system.signals import Signal
from drake_dae.simulation.records.record import Record
from drake_dae.simulation.verdict import ROUND_OFF, output_sizes
from drake_dae.systems.control.phase_change import PhaseChange

SHARE = 0.01
"""The default tolerance of an output, as a fraction of the range of references in its unit."""

LATE = 0.5
"""The fraction of a run from which outputs must be within tolerance, unless predicted later."""

GRACE = 0.1
"""The permitted delay relative to the prediction, as a fraction of the run."""


_MOST_FAILURES = 3
"""The number of failed phases, the last ones, that the verdict of a task names."""


class JobOutcome(Enum):
    """Whether a run succeeded. The verdict's sentence begins with the value."""

    GOOD = "GOOD"
    BAD = "BAD"
    UNDECIDED = "UNDECIDED"


@dataclass(frozen=True)
class OutputQuality:
    """How well an output followed its reference.

    Attributes:
        signal: The output.
        tolerance: The tolerated |z - r|, in its unit.
        since: The time from which |z - r| stayed within the tolerance, in s; None if it was outside
            at the end.
        predicted_since: The same time for the predicted error; None if the run is too short.
        follows_prediction: Whether the error is within the tolerance of the predicted one in the
            second half of the run.
        largest: The largest |z - r| in the second half of the run.
        rms: The root mean square of z - r in the second half of the run.
        settled: The largest |z - r| in the second half of the run, from `since` on.
    """

    signal: Signal
    tolerance: float
    since: float | None
    predicted_since: float | None
    follows_prediction: bool
    largest: float
    rms: float
    settled: float = 0.0


@dataclass(frozen=True)
class JobVerdict:
    """Whether a run succeeded, and why.

    Attributes:
        outcome: Good, bad, or undecided if the run is too short to tell.
        outputs: The quality of each output; empty for a task, whose phases have their own criteria.
        problems: The violations, a phrase each.
        remarks: Further information, a phrase each.
    """

    outcome: JobOutcome
    outputs: tuple[OutputQuality, ...] = ()
    problems: tuple[str, ...] = ()
    remarks: tuple[str, ...] = ()

    def __str__(self) -> str:
        parts = [*self.problems, *self.remarks] or ["there is no output, and nothing is violated"]
        return f"{self.outcome.value}: {'; '.join(parts)}."

    def to_dict(self) -> dict[str, Any]:
        """The verdict as plain data."""
        return {
            "outcome": self.outcome.name.lower(),
            "problems": list(self.problems),
            "remarks": list(self.remarks),
            "outputs": {
                output.signal.name: {
                    "unit": output.signal.unit,
                    "tolerance": output.tolerance,
                    "within_since": output.since,
                    "largest": output.largest,
                    "rms": output.rms,
                }
                for output in self.outputs
            },
        }


def judge_job(
    record: Record,
    predicted: FloatArray,
    tolerances: Mapping[str, float] | None = None,
    violations: Sequence[str] = (),
    pushing: frozenset[str] | None = frozenset(),
    changes: Sequence[PhaseChange] = (),
    is_cut_short: bool = False,
    notes: Sequence[str] = (),
) -> JobVerdict:
    """Judges whether a run succeeded.

    Without phases, each output must be within its tolerance from the first half of the run on, or
    from the time at which the predicted error is. If the predicted error exceeds the tolerance even
    at the end, and the run follows it, the run is undecided. With phases, the last one must end.

    Args:
        record: A record with desired_output, tracking_error and constraint_force.
        predicted: The tracking error by theory, shape (k, p).
        tolerances: Output name -> tolerated |z - r|. For the others it is 1 % of the range of the
            references in their unit, or of their largest value where they do not move.
        violations: Further violations, such as of joint limits, a phrase each.
        pushing: Names of the unilateral constraint forces; None if all are.
        changes: The starts of phases of a task.
        is_cut_short: Whether the run failed or was interrupted before its end.
        notes: Further remarks, a phrase each.
    """
    ended = [f"the run broke off at {record.time[-1]:.4g} s"] if is_cut_short else []
    problems, remarks = [*ended, *violations], list[str]()
    if changes:
        undecided = _judge_task(changes, problems, remarks)
        outputs: tuple[OutputQuality, ...] = ()
    else:
        outputs = tuple(_qualities(record, predicted, dict(tolerances or {})))
        _judge_contacts(record, pushing, problems, remarks)
        undecided = _judge_outputs(record, outputs, problems, remarks)
    outcome = JobOutcome.BAD if problems else JobOutcome.UNDECIDED if undecided else JobOutcome.GOOD
    return JobVerdict(outcome, outputs, tuple(problems), (*remarks, *notes))


def _judge_task(changes: Sequence[PhaseChange], problems: list[str], remarks: list[str]) -> bool:
    """Adds the problems and remarks of a task; returns whether it had not ended yet."""
    last, count = changes[-1], len({change.place for change in changes})
    failures = [
        change
        for before, change in zip((None, *changes), changes, strict=False)
        if change.failed and not (before is not None and before.chosen == "leave")
    ]
    followed = [
        f"at {change.time:.4g} s {change.reason}, and {change.phase} followed, as chosen"
        for change in failures[-_MOST_FAILURES:]
    ]
    leaves = last.failed and last.chosen == "leave" and last.phase != "done"
    if leaves or (last.phase == "held" and last.failed):
        why = failures[-1] if failures else last
        left = ", and has left the contact" if why.chosen == "leave" and not leaves else ""
        problems.append(f"the task was given up at {why.time:.4g} s{left}: {why.reason}")
    elif last.phase == "held":
        remarks.append(f"the task ended as chosen at {last.time:.4g} s: {last.reason}")
    elif last.phase == "done":
        again = len(changes) - count
        repeated = f", {again} of them again" if again else ""
        ended = f"{len(changes) - 1} phases" if len(changes) > 2 else "1 phase"
        remarks.append(f"the task was done at {last.time:.4g} s, in {ended}{repeated}")
        remarks += followed
    else:
        remarks.append(
            f"the run ended during phase {last.place + 1}, {last.phase}, which began at "
            f"{last.time:.4g} s"
        )
        remarks += followed
        return True
    return False


def _judge_contacts(
    record: Record, pushing: frozenset[str] | None, problems: list[str], remarks: list[str]
) -> None:
    """Adds lost contacts: as problems if they are lost in the second half of the run."""
    times, forces = record.time, record.signals["constraint_force"]
    steps, middle = np.diff(times), times[0] + LATE * (times[-1] - times[0])
    for signal, values in zip(forces.signals, forces.values.T, strict=True):
        touches = np.flatnonzero(values > 0.0)
        if pushing is not None and signal.name not in pushing:
            continue
        if not touches.size:
            if values.size > 1 and not values.any():
                problems.append(f"{signal.name} is 0 all the time")
            continue
        lost = touches[0] + np.flatnonzero(values[touches[0] : -1] == 0.0)
        if lost.size:
            first = times[lost[0]]
            text = f"{signal.name} was 0 for {steps[lost].sum():.2g} s, first at {first:.4g} s"
            (problems if times[lost[-1]] >= middle else remarks).append(text)


def _judge_outputs(
    record: Record,
    outputs: Sequence[OutputQuality],
    problems: list[str],
    remarks: list[str],
) -> bool:
    """Adds the problems and remarks of outputs; returns whether the run is too short for some."""
    times = record.time
    middle, grace = times[0] + LATE * (times[-1] - times[0]), GRACE * (times[-1] - times[0])
    short = []
    for output in outputs:
        predicted, name = output.predicted_since, output.signal.name
        due = None if predicted is None else max(middle, predicted + grace)
        if output.since is not None and (due is None or output.since <= due):
            continue
        if due is None and output.follows_prediction:
            short.append(name)
            continue
        unit = f" {output.signal.unit}".rstrip()
        when = "ends off its reference"
        if output.since is not None:
            when = f"is off its reference until {output.since:.3g} s"
        problems.append(
            f"{name} {when}, by up to {output.largest:.2g}{unit} in the second half of the run "
            f"({output.tolerance:.2g}{unit} tolerated)"
        )
    if short:
        remarks.append(
            f"the run is too short: {', '.join(short)} cannot yet be at the reference, by the gains"
        )
    settled = [output for output in outputs if output.since is not None]
    if settled and not problems:
        worst = max(settled, key=lambda output: output.settled / output.tolerance)
        since = max(output.since for output in settled if output.since is not None)
        which = "every output" if len(settled) == len(outputs) else "every other output"
        unit = f" {worst.signal.unit}".rstrip()
        when = "in the second half of the run" if since <= middle else "there"
        remarks.append(
            f"{which} is at its reference from {since:.3g} s on; {when} "
            f"{worst.signal.name} comes closest to its tolerance, with {worst.settled:.2g} of "
            f"{worst.tolerance:.2g}{unit}"
        )
    return bool(short)


def _qualities(
    record: Record, predicted: FloatArray, tolerances: dict[str, float]
) -> list[OutputQuality]:
    error = record["tracking_error"]
    if not error.size:
        return []
    signals = record.signals["tracking_error"].signals
    tolerated = SHARE * _ranges(record, predicted)
    rms, qualities = late_rms(record.time, error), []
    first = int(np.searchsorted(record.time, (record.time[0] + record.time[-1]) / 2.0))
    for i, signal in enumerate(signals):
        tolerance = tolerances.get(signal.name, float(tolerated[i]))
        since = _within_since(record.time, error[:, i], tolerance)
        late = np.inf if since is None else since
        qualities.append(
            OutputQuality(
                signal,
                tolerance,
                since,
                _within_since(record.time, predicted[:, i], tolerance),
                bool(np.all(np.abs(error - predicted)[first:, i] <= tolerance)),
                float(np.max(np.abs(error[first:, i]))),
                float(rms[i]),
                float(np.max(np.abs(error[first:, i][record.time[first:] >= late]), initial=0.0)),
            )
        )
    return qualities


def _ranges(record: Record, predicted: FloatArray) -> FloatArray:
    """The range of the references in the unit of each output, shape (p,), positive."""
    desired = record["desired_output"]
    sizes = output_sizes(record, predicted)
    ranges = desired.max(axis=0) - desired.min(axis=0)
    ranges[ranges <= ROUND_OFF * sizes] = 0.0
    largest = np.abs(desired).max(axis=0)
    units = np.array([signal.unit for signal in record.signals["desired_output"].signals])
    for i, unit in enumerate(units.tolist()):
        span = ranges[units == unit].max()
        is_pure = unit in ("", "rad")
        sizes[i] = max(span, 1.0) if is_pure else span or largest[units == unit].max() or sizes[i]
    return sizes


def _within_since(times: FloatArray, error: FloatArray, tolerance: float) -> float | None:
    """The first time from which |error| stays within the tolerance; None if the last is outside."""
    outside = np.flatnonzero(~(np.abs(error) <= tolerance))
    if not outside.size:
        return float(times[0])
    return float(times[outside[-1] + 1]) if outside[-1] + 1 < times.size else None


def late_rms(times: FloatArray, errors: FloatArray) -> FloatArray:
    """Root mean squares over the second half of the time, shape (p,).

    Args:
        times: The times in s, shape (k,), k >= 1.
        errors: The errors at these times, shape (k, p); linear between them.
    """
    values = by_columns(errors)
    middle = 0.5 * (times[0] + times[-1])
    first = int(np.searchsorted(times, middle, side="right"))
    if first == times.size:
        return np.abs(values[..., -1])
    before, after = values[..., first - 1], values[..., first]
    begin = (after - before) / (times[first] - times[first - 1]) * (middle - times[first - 1])
    courses = np.concatenate([(before + begin)[..., None], values[..., first:]], axis=-1)
    steps = np.diff(np.concatenate([[middle], times[first:]]))
    begins, ends = courses[..., :-1], courses[..., 1:]
    squares = (begins**2 + begins * ends + ends**2) / 3.0
    sizes: FloatArray = np.sqrt(squares @ steps / steps.sum())
    return sizes
