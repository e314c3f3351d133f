"""The figures of runs as numbers, with names for tables of many runs.

A record is that of several runs with the same times, see `computed_record`.
"""

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
        values: For each run, the least distance of each signal from its limits.
    """

    signals: Sequence[Signal]
    values: list[list[float]]

    def exceeded(self) -> list[tuple[str, ...]]:
        """For each run, the names of the signals beyond their limits."""
        return [
            tuple(s.name for s, margin in zip(self.signals, of_run, strict=True) if margin < 0.0)
            for of_run in self.values
        ]


def figures_of(record: Record, found: Margins) -> list[dict[str, float]]:
    """The figures of each run: name with unit, such as "largest error of tool.z [m]" -> number.

    For each output: the largest |z - r|, the last z - r, and the "late" error, the root mean square
    of z - r over the second half of the time. For each constraint force: its least and largest
    value. For each control: the largest |u|. Then the `margins`, the largest constraint residual
    before a projection, and the time at which the record ends.

    Args:
        record: A record of runs, with tracking_error, constraint_force, control,
            constraint_residual and state; runs with an empty one have no figures.
        found: Its `margins`.
    """
    if not record.time.size:
        return [{} for _ in found.values]
    names = ("tracking_error", "constraint_force", "control")
    errors, forces, controls = (record.signals[name] for name in names)
    late = late_rms(record.time, errors.values)
    groups: list[tuple[tuple[str, ...], Sequence[Signal], tuple[FloatArray, ...]]] = [
        (
            ("largest error of", "final error of", "late error of"),
            errors.signals,
            (errors.sizes, errors.values[:, -1], late),
        ),
        (("least", "largest"), forces.signals, forces.extremes),
        (("largest",), controls.signals, (controls.sizes,)),
    ]
    labels = [_label(what, s) for whats, signals, _ in groups for s in signals for what in whats]
    columns = [np.stack(each, axis=-1).reshape(len(late), -1) for *_, each in groups]
    known = set(labels)  # The margin of a force that may not pull is its least value.
    margin_labels = [
        _label("margin of", s) if _label("least", s) not in known else "" for s in found.signals
    ]
    residuals = np.max(record.signals["constraint_residual"].sizes, axis=-1, initial=0.0)
    rows = zip(np.hstack(columns).tolist(), found.values, residuals.tolist(), strict=True)
    return [
        {
            **dict(zip(labels, row, strict=True)),
            **{
                label: room
                for label, room in zip(margin_labels, margins, strict=True)
                if label and isfinite(room)
            },
            "largest residual": residual,
            "end [s]": float(record.time[-1]),
        }
        for row, margins, residual in rows
    ]


def margins(record: Record, limits: Limits) -> Margins:
    """The distance of each signal from its limits, in its unit; negative beyond a limit.

    The limit of a control is on |u|, the lower limit of a unilateral force is 0, and positions and
    velocities have two limits. An excess by round-off counts as 0, since a start may be on a limit.
    The distance of a signal without limits is infinite. There is none in an empty record.

    Args:
        record: A record of runs.
        limits: The limits of their robot.
    """
    runs = len(record["control"])
    if not record.time.size:
        return Margins([], [[] for _ in range(runs)])
    forces, controls = record.signals["constraint_force"], record.signals["control"]
    signals, distances = list(controls.signals), []
    distances.append((np.inf if limits.control is None else limits.control) - controls.sizes)
    pushing = [i for i, signal in enumerate(forces.signals) if not limits.can_pull(signal)]
    signals += [forces.signals[i] for i in pushing]
    distances.append(forces.extremes[0][:, pushing])
    for name, bounds in (("state", limits.state), ("loop_state", limits.loops)):
        if bounds is not None and name in record.signals:
            (low, high), recorded = bounds, record.signals[name]
            least, largest = (values[:, : low.size] for values in recorded.extremes)
            room = np.minimum(least - low, high - largest)
            signals += recorded.signals[: low.size]
            distances.append(np.where((room >= -SLACK) & (room < 0.0), 0.0, room))
    return Margins(signals, np.hstack(distances).tolist())


def _label(what: str, signal: Signal) -> str:
    return f"{what} {signal.name} [{signal.unit}]" if signal.unit else f"{what} {signal.name}"
