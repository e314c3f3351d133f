"""The figures of a run as numbers, with names for tables of many runs."""

from collections.abc import Iterator
from math import isfinite
from typing import Any

import numpy as np

from drake_dae.arrays import FloatArray, by_columns
from drake_dae.dae.system.signals import Signal
from drake_dae.simulation.job import late_rms
from drake_dae.simulation.records.record import Record
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
    errors = record["tracking_error"]
    rows = _each(
        record, "tracking_error", _largest(errors), errors[-1], late_rms(record.time, errors)
    )
    for signal, largest, final, late in rows:
        figures[_label("largest error of", signal)] = largest
        figures[_label("final error of", signal)] = final
        figures[_label("late error of", signal)] = late
    for signal, least, largest in _each(
        record, "constraint_force", *_extremes(record["constraint_force"])
    ):
        figures[_label("least", signal)] = least
        figures[_label("largest", signal)] = largest
    for signal, largest in _each(record, "control", _largest(record["control"])):
        figures[_label("largest", signal)] = largest
    residual = np.max(np.abs(record["constraint_residual"]), initial=0.0)
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
    for index, (signal, largest) in enumerate(
        _each(record, "control", _largest(record["control"]))
    ):
        limit = np.inf if limits.control is None else limits.control[index]
        rooms.append((signal, float(limit - largest)))
    forces = record["constraint_force"]
    for signal, least, _ in _each(record, "constraint_force", *_extremes(forces)):
        if not limits.can_pull(signal):
            rooms.append((signal, least))
    for name, bounds in (("state", limits.state), ("loop_state", limits.loops)):
        if bounds is not None and name in record.signals:
            extremes = _each(record, name, *_extremes(record[name]))
            for (signal, least, largest), low, high in zip(extremes, *bounds, strict=False):
                room = float(min(least - low, high - largest))
                rooms.append((signal, 0.0 if -SLACK <= room < 0.0 else room))
    return [(signal, room) for signal, room in rooms if isfinite(room)]


def exceeded(rooms: Rooms) -> tuple[str, ...]:
    """Names of the signals beyond their limits, with negative unilateral forces, from margins."""
    return tuple(signal.name for signal, room in rooms if room < 0.0)


def _each(record: Record, name: str, *numbers: FloatArray) -> Iterator[tuple[Any, ...]]:
    """The entries of a signal, each with its name and unit and with some numbers."""
    signals = record.signals[name].signals
    return zip(signals, *(values.tolist() for values in numbers), strict=True)


def _extremes(values: FloatArray) -> tuple[FloatArray, FloatArray]:
    """The least and the largest number in each column."""
    columns = by_columns(values)
    return columns.min(axis=1), columns.max(axis=1)


def _largest(values: FloatArray) -> FloatArray:
    """The largest size in each column."""
    least, largest = _extremes(values)
    return np.maximum(-least, largest)


def _label(what: str, signal: Signal) -> str:
    return f"{what} {signal.name} [{signal.unit}]" if signal.unit else f"{what} {signal.name}"
