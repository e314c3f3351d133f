"""The figures of a run as numbers, under names for tables of many runs."""

import numpy as np

from drake_dae.arrays import FloatArray
from drake_dae.dae.system.signals import Signal
from drake_dae.simulation.records.record import Record
from drake_dae.simulation.summary import SLACK, Limits


def run_figures(record: Record, limits: Limits) -> dict[str, float]:
    """The figures of a run, by names with units such as "largest error of tool.z [m]".

    For each output the largest |z - r|, the last z - r, and the root mean square of z - r over the
    second half of the time, the "late" error; for each constraint force its least and
    largest value, for each control the largest |u|, then the `margins`, the largest constraint
    residual before a projection, and the time at which the record ends.

    Args:
        record: A record with tracking_error, constraint_force, control, constraint_residual and
            state; an empty one has no figures.
        limits: The limits of the robot.
    """
    if not record.time.size:
        return {}
    found = {}
    for signal, values in _columns(record, "tracking_error"):
        found[_label("largest error of", signal)] = float(np.max(np.abs(values)))
        found[_label("final error of", signal)] = float(values[-1])
        found[_label("late error of", signal)] = _late_size(record.time, values)
    for signal, values in _columns(record, "constraint_force"):
        found[_label("least", signal)] = float(np.min(values))
        found[_label("largest", signal)] = float(np.max(values))
    for signal, values in _columns(record, "control"):
        found[_label("largest", signal)] = float(np.max(np.abs(values)))
    residual = np.max(np.abs(record["constraint_residual"]), initial=0.0)
    return {
        **found,
        **{
            _label("margin of", signal): room
            for signal, room in margins(record, limits)
            if _label("least", signal) not in found  # They are equal.
        },
        "largest residual": float(residual),
        "end [s]": float(record.time[-1]),
    }


def _late_size(times: FloatArray, values: FloatArray) -> float:
    """The root mean square over the second half of a piecewise linear signal."""
    middle = 0.5 * (times[0] + times[-1])
    late = times > middle
    if not late.any():
        return float(abs(values[-1]))
    found = np.concatenate([[np.interp(middle, times, values)], values[late]])
    steps = np.diff(np.concatenate([[middle], times[late]]))
    squares = (found[:-1] ** 2 + found[:-1] * found[1:] + found[1:] ** 2) / 3.0
    return float(np.sqrt(squares @ steps / steps.sum()))


def margins(record: Record, limits: Limits) -> list[tuple[Signal, float]]:
    """The distance of each signal from its limit, in its unit; negative beyond it.

    The limit of a control is on |u|, that of a unilateral force is zero, and positions and
    velocities have a lower and an upper limit. A start may be on a limit, up to round-off.
    """
    found = []
    for index, (signal, values) in enumerate(_columns(record, "control")):
        limit = np.inf if limits.control is None else limits.control[index]
        found.append((signal, float(limit - np.max(np.abs(values)))))
    for signal, values in _columns(record, "constraint_force"):
        if not limits.can_pull(signal):
            found.append((signal, float(np.min(values))))
    for name, bounds in (("state", limits.state), ("loop_state", limits.loops)):
        if bounds is not None and name in record.signals:
            for (signal, values), low, high in zip(_columns(record, name), *bounds, strict=False):
                room = float(min(np.min(values) - low, high - np.max(values)))
                found.append((signal, 0.0 if -SLACK <= room < 0.0 else room))
    return [(signal, room) for signal, room in found if np.isfinite(room)]


def exceeded(record: Record, limits: Limits) -> list[str]:
    """Names of the signals beyond their limits, including negative unilateral forces."""
    if not record.time.size:
        return []
    return [signal.name for signal, room in margins(record, limits) if room < 0.0]


def _columns(record: Record, name: str) -> list[tuple[Signal, FloatArray]]:
    recorded = record.signals[name]
    return list(zip(recorded.signals, recorded.values.T, strict=True))


def _label(what: str, signal: Signal) -> str:
    return f"{what} {signal.name} [{signal.unit}]" if signal.unit else f"{what} {signal.name}"
