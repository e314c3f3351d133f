"""The figures of a run as numbers, with names for tables of many runs."""

from collections.abc import Sequence
from math import isfinite
from typing import NamedTuple

import numpy as np

from drake_dae.arrays import FloatArray
from drake_dae.dae.system.signals import Signal
from drake_dae.simulation.job import late_rms
from drake_dae.simulation.records.record import Record
from drake_dae.simulation.summary import SLACK, Limits


class Margins(NamedTuple):
    """Distances of signals from their limits.

    Attributes:
        signals: The signals that have limits.
        values: The least distance of each signal from its limits.
    """

    signals: Sequence[Signal]
    values: Sequence[float]

    @property
    def exceeded(self) -> tuple[str, ...]:
        """The names of the signals beyond their limits."""
        pairs = zip(self.signals, self.values, strict=True)
        return tuple(signal.name for signal, margin in pairs if margin < 0.0)


def figures_of(record: Record, found: Margins) -> dict[str, float]:
    """The figures of a run: name with unit, such as "largest error of tool.z [m]" -> number.

    For each output: the largest |z - r|, the last z - r, and the "late" error, the root mean square
    of z - r over the second half of the time. For each constraint force: its least and largest
    value. For each control: the largest |u|. Then the `margins`, the largest constraint residual
    before a projection, and the time at which the record ends. An empty record has none.

    Args:
        record: The record of a closed loop.
        found: Its `margins`.
    """
    if not record.time.size:
        return {}
    names = ("tracking_error", "constraint_force", "control")
    errors, forces, controls = (record.signals[name] for name in names)
    late, figures = late_rms(record.time, errors.values), dict[str, float]()
    for i, signal in enumerate(errors.signals):
        values = errors.values[:, i]
        figures[_label("largest error of", signal)] = float(np.max(np.abs(values)))
        figures[_label("final error of", signal)] = float(values[-1])
        figures[_label("late error of", signal)] = float(late[i])
    for i, signal in enumerate(forces.signals):
        figures[_label("least", signal)] = float(np.min(forces.values[:, i]))
        figures[_label("largest", signal)] = float(np.max(forces.values[:, i]))
    for i, signal in enumerate(controls.signals):
        figures[_label("largest", signal)] = float(np.max(np.abs(controls.values[:, i])))
    for signal, room in zip(found.signals, found.values, strict=True):
        # The margin of a force that may not pull is its least value.
        if isfinite(room) and _label("least", signal) not in figures:
            figures[_label("margin of", signal)] = room
    residuals = np.abs(record["constraint_residual"])
    figures["largest residual"] = float(np.max(residuals, initial=0.0))
    figures["end [s]"] = float(record.time[-1])
    return figures


def margins(record: Record, limits: Limits) -> Margins:
    """The distance of each signal from its limits, in its unit; negative beyond a limit.

    The limit of a control is on |u|, the lower limit of a unilateral force is 0, and positions and
    velocities have two limits. An excess by round-off counts as 0, since a start may be on a limit.
    The distance of a signal without limits is infinite. There is none in an empty record.

    Args:
        record: The record of a closed loop.
        limits: The limits of its robot.
    """
    if not record.time.size:
        return Margins([], [])
    forces, controls = record.signals["constraint_force"], record.signals["control"]
    largest = np.max(np.abs(controls.values), axis=0)
    signals, distances = list(controls.signals), list[FloatArray]()
    distances.append((np.inf if limits.control is None else limits.control) - largest)
    pushing = [i for i, signal in enumerate(forces.signals) if not limits.can_pull(signal)]
    signals += [forces.signals[i] for i in pushing]
    distances.append(np.min(forces.values[:, pushing], axis=0))
    for name, bounds in (("state", limits.state), ("loop_state", limits.loops)):
        if bounds is not None and name in record.signals:
            (low, high), recorded = bounds, record.signals[name]
            values = recorded.values[:, : low.size]
            room = np.minimum(values.min(axis=0) - low, high - values.max(axis=0))
            signals += recorded.signals[: low.size]
            distances.append(np.where((room >= -SLACK) & (room < 0.0), 0.0, room))
    return Margins(signals, np.concatenate(distances).tolist())


def _label(what: str, signal: Signal) -> str:
    return f"{what} {signal.name} [{signal.unit}]" if signal.unit else f"{what} {signal.name}"
