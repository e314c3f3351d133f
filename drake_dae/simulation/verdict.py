"""The comparison of a run with its prediction, as a value, as data and in words."""

from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum
from math import isfinite
from typing import Any

import numpy as np

from drake_dae.arrays import FloatArray
from drake_dae.dae.system.signals import Signal
from drake_dae.simulation.growth import with_sizes
from drake_dae.simulation.records.record import Record

ROUND_OFF = 1e-13
"""A number below this, relative to the size of its terms, is round-off."""

CLOSE, NEAR = 1e-5, 1e-2
"""Deviations from the prediction, as fractions of the outputs' sizes, below which a run is as
predicted, or nearly as predicted."""

SLACK = 10.0
"""The allowed deviation of a run, as a multiple of the accuracy of a step."""


class TrackingResult(Enum):
    """The errors of a run compared with the predicted ones. The sentence begins with the value."""

    AS_PREDICTED = "Tracked as predicted"
    NEARLY = "Tracked nearly as predicted"
    OFF = "Not tracked as predicted"


@dataclass(frozen=True)
class RunVerdict:
    """The comparison of a run with its prediction.

    Attributes:
        tracking: As predicted, nearly, or not.
        worst: The output with the largest relative deviation; None without outputs.
        off: The largest deviation of its error from the predicted error, in its unit.
        time: The time of this deviation, in s; if the run is not as predicted, the time from which
            it is not.
        share: The deviation relative to the size of the output.
        settled: The largest relative deviation in the second half of the run.
    """

    tracking: TrackingResult
    worst: Signal | None = None
    off: float = 0.0
    time: float = 0.0
    share: float = 0.0
    settled: float = 0.0


def unit_sizes(record: Record) -> dict[str, float]:
    """Unit -> the largest number of it in a record; at least one for angles and pure numbers.

    Args:
        record: A record with any of state, control, constraint_force and desired_output.
    """
    sizes = {"": 1.0, "rad": 1.0}
    for name in ("state", "control", "constraint_force", "desired_output"):
        if name in record:
            largest = np.max(np.abs(record[name]), axis=0, initial=0.0)
            sizes = with_sizes(sizes, record.signals[name].signals, largest)
    return sizes


def output_sizes(record: Record, predicted: FloatArray) -> FloatArray:
    """The sizes of the outputs of a run, shape (p,), positive.

    The size of an output is the largest value of references and predicted errors in its unit, so
    that an output with a reference of 0 has the size of others. If all are zero, it is the largest
    value of the record in that unit, or 1.

    Args:
        record: A record with desired_output.
        predicted: The tracking error by theory, shape (k, p).
    """
    signals = record.signals["desired_output"].signals
    courses = np.vstack([record["desired_output"], predicted])
    largest = np.max(np.abs(courses), axis=0, initial=0.0)
    of_all = unit_sizes(record)
    sizes = with_sizes({"": 1.0, "rad": 1.0}, signals, largest)
    for unit, size in sizes.items():
        if size <= ROUND_OFF * of_all.get(unit, 0.0):
            sizes[unit] = of_all[unit] or 1.0
    return np.array([sizes[signal.unit] for signal in signals])


def judge(record: Record, predicted: FloatArray, accuracy: float | None = None) -> RunVerdict:
    """Compares a run with its prediction.

    Args:
        record: A record with desired_output and tracking_error.
        predicted: The tracking error by theory, shape (k, p).
        accuracy: The accuracy of error control; None with fixed steps.
    """
    error = record["tracking_error"]
    if not error.size:
        return RunVerdict(TrackingResult.AS_PREDICTED)
    signals = record.signals["tracking_error"].signals
    shares = np.abs(error - predicted) / output_sizes(record, predicted)
    row, column = map(int, np.unravel_index(np.argmax(shares), shares.shape))
    share = float(shares[row, column])
    if share <= max(CLOSE, SLACK * (accuracy or 0.0)):
        tracking = TrackingResult.AS_PREDICTED
    elif share <= NEAR:
        tracking = TrackingResult.NEARLY
    else:
        tracking, row = TrackingResult.OFF, int(np.argmax(shares[:, column] > NEAR))
    off = float(np.max(np.abs(error - predicted)[:, column]))
    settled = float(np.max(shares[len(shares) // 2 :]))
    return RunVerdict(tracking, signals[column], off, float(record.time[row]), share, settled)


def as_data(verdict: RunVerdict, reasons: Sequence[str] = ()) -> dict[str, Any]:
    """Converts a verdict to plain data; a number that is not finite becomes None.

    Args:
        verdict: The verdict.
        reasons: Reasons for a deviation, as in `in_words`.
    """
    worst = verdict.worst
    return {
        "tracking": verdict.tracking.name.lower(),
        "worst_output": None if worst is None else worst.name,
        "off_prediction": _finite(verdict.off),
        "unit": "" if worst is None else worst.unit,
        "share_of_size": _finite(verdict.share),
        "share_in_second_half": _finite(verdict.settled),
        "reasons": list(reasons),
    }


def _finite(value: float) -> float | None:
    return value if isfinite(value) else None


def in_words(
    verdict: RunVerdict,
    accuracy: float | None = None,
    reasons: Sequence[str] = (),
    ended: str = "",
) -> str:
    """A verdict as sentences.

    Args:
        verdict: The verdict.
        accuracy: The accuracy of error control; None with fixed steps.
        reasons: Reasons for a deviation, such as "the drives were saturated".
        ended: The end of the run, such as "The run failed at 2.1 s"; empty if it is complete.
    """
    head = f"{ended}; up to there: " if ended else ""
    if verdict.worst is None:
        return f"{head}There are no outputs to track." if ended else "There is no output to track."
    step = (
        f"the integrator's accuracy is {accuracy:g}"
        if accuracy is not None
        else "the steps are fixed"
    )
    unit = f" {verdict.worst.unit}".rstrip()
    off, name = f"{verdict.off:.2g}{unit}", verdict.worst.name
    if verdict.tracking is TrackingResult.AS_PREDICTED:
        return (
            f"{head}{verdict.tracking.value}: errors stay within {off} of the predicted ones "
            f"({name} is the farthest off); {step}."
        )
    beside = (
        f"{verdict.share:.2g} times" if verdict.share > 1.0 else f"{100.0 * verdict.share:.2g} % of"
    )
    when = f"at {verdict.time:.3g} s"
    if verdict.tracking is TrackingResult.OFF:
        when = f"from {verdict.time:.3g} s on"
    text = (
        f"{head}{verdict.tracking.value}: {when} the error of {name} is off the predicted one, by "
        f"up to {off}, {beside} its size"
    )
    if reasons:
        text = f"{text}. Likely because {', and '.join(reasons)}."
        if verdict.tracking is TrackingResult.OFF and verdict.settled <= NEAR:
            late = f"{100.0 * verdict.settled:.2g} % of its size"
            text += f" In the second half of the run none is off by more than {late}."
        return text
    if verdict.tracking is TrackingResult.NEARLY:
        return f"{text}; {step}, and a finer one would tell whether that is why."
    return f"{text}; {step}. If a finer one changes nothing, plant and law differ."
