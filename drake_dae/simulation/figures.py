"""The figures of a run as numbers, with names for tables of many runs."""

from collections.abc import Iterator
from math import isfinite
from typing import Any

import numpy as np

from drake_dae.arrays import FloatArray
from drake_dae.dae.system.signals import Signal
from drake_dae.simulation.job import late_rms
from drake_dae.simulation.records.record import Record, Recorded
from drake_dae.simulation.summary import SLACK, Limits

Rooms = list[tuple[Signal, float]]
"""Signals that have limits, each with its distance from them."""


def run_figures(record: Record, rooms: Rooms) -> dict[str, float]:
    """The figures of a run: name with unit, such as "largest error of tool.z [m]" -> number.

    For each output: the largest |z - r|, the last z - r, and the "late" error, the root mean square
    of z - r over the second half of the time. For each constraint force: its least and largest
    value. For each control: the largest |u|. Then the `margins`, the largest constraint residual
    before a projection, and the time at which the record ends.

    Args:
        record: A record with tracking_error, constraint_force, control, constraint_residual and
            state; an empty one has no figures.
        rooms: Its `margins`.
    """
    if not record.time.size:
        return {}
    figures = {}
    errors = record.signals["tracking_error"]
    late_errors = late_rms(record.time, errors.values)
    for signal, largest, final, late in _each(errors, errors.sizes, errors.values[-1], late_errors):
        figures[_label("largest error of", signal)] = largest
        figures[_label("final error of", signal)] = final
        figures[_label("late error of", signal)] = late
    forces, controls = record.signals["constraint_force"], record.signals["control"]
    for signal, least, largest in _each(forces, *forces.extremes):
        figures[_label("least", signal)] = least
        figures[_label("largest", signal)] = largest
    for signal, largest in _each(controls, controls.sizes):
        figures[_label("largest", signal)] = largest
    residual = np.max(record.signals["constraint_residual"].sizes, initial=0.0)
    return {
        **figures,
        **{
            _label("margin of", signal): room
            for signal, room in rooms
            if _label("least", signal) not in figures  # They are equal.
        },
        "largest residual": float(residual),
        "end [s]": float(record.time[-1]),
    }


def margins(record: Record, limits: Limits) -> Rooms:
    """The distance of each signal from its limits, in its unit; negative beyond a limit.

    The limit of a control is on |u|, the lower limit of a unilateral force is 0, and positions and
    velocities have two limits. An excess by round-off counts as 0, since a start may be on a limit.
    An empty record has none.
    """
    if not record.time.size:
        return []
    rooms = []
    forces, controls = record.signals["constraint_force"], record.signals["control"]
    for index, (signal, largest) in enumerate(_each(controls, controls.sizes)):
        limit = np.inf if limits.control is None else limits.control[index]
        rooms.append((signal, float(limit - largest)))
    for signal, least, _ in _each(forces, *forces.extremes):
        if not limits.can_pull(signal):
            rooms.append((signal, least))
    for name, bounds in (("state", limits.state), ("loop_state", limits.loops)):
        if bounds is not None and name in record.signals:
            extremes = _each(record.signals[name], *record.signals[name].extremes)
            for (signal, least, largest), low, high in zip(extremes, *bounds, strict=False):
                room = float(min(least - low, high - largest))
                rooms.append((signal, 0.0 if -SLACK <= room < 0.0 else room))
    return [(signal, room) for signal, room in rooms if isfinite(room)]


def exceeded(rooms: Rooms) -> tuple[str, ...]:
    """Names of the signals beyond their limits, by their `margins`."""
    return tuple(signal.name for signal, room in rooms if room < 0.0)


def _each(recorded: Recorded, *numbers: FloatArray) -> Iterator[tuple[Any, ...]]:
    """The entries of a signal, each with its name and unit and with some numbers."""
    return zip(recorded.signals, *(values.tolist() for values in numbers), strict=True)


def _label(what: str, signal: Signal) -> str:
    return f"{what} {signal.name} [{signal.unit}]" if signal.unit else f"{what} {signal.name}"
