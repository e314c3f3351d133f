"""The times at which contacts open and close in a record, and its steps without a derivative."""

from collections.abc import Sequence

import numpy as np

from drake_dae.arrays import FloatArray, listed
from drake_dae.errors import ModelError
from drake_dae.simulation.records.record import Record
from drake_dae.systems.plants.contract import Plant

SAME = 1e-3
"""An event that is this close to a row, in steps, counts as before and as after the row."""


def modes(record: Record, plant: Plant, title: str) -> FloatArray:
    """Returns the mode of each unilateral contact, 1 closed and 0 open, shape (k, m).

    Raises:
        ModelError: The record lacks the signal 'mode', or it has other values.
    """
    if not plant.contacts:
        return np.zeros((record.time.size, 0))
    signals = plant.further_signals["mode"]
    recorded = record.signals.get("mode")
    pairs = [] if recorded is None else zip(recorded.signals, recorded.values.T, strict=True)
    columns = {signal.name: values for signal, values in pairs}
    missing = [signal.name for signal in signals if signal.name not in columns]
    if missing:
        raise ModelError(
            f"{title} does not say when contacts are closed: it needs columns {listed(missing)} of "
            "the signal 'mode', 1 where closed and 0 where open, such as mode.wall.closed"
        )
    values = np.column_stack([columns[signal.name] for signal in signals])
    if not np.isin(values, (0.0, 1.0)).all():
        row = int(np.argmin(np.isin(values, (0.0, 1.0)).all(axis=1)))
        raise ModelError(
            f"{title}: 'mode' is {listed(map(str, values[row]))} at {record.time[row]:g} s; it "
            "must be 1 where a contact is closed and 0 where it is open"
        )
    return values


def cuts(record: Record, mode: FloatArray, is_held: bool) -> np.ndarray:
    """Whether a contact changes or has an impact, or a control jumps, after each row: (k - 1,).

    Args:
        record: The record, with its events.
        mode: The result of `modes`.
        is_held: Whether the control has a zero-order hold; without one it jumps where a phase of a
            task ends.
    """
    times = record.time
    changing = [mode]
    if not is_held and "phase" in record.signals:
        changing.append(record["phase"])
    is_cut = (np.diff(np.hstack(changing), axis=0) != 0.0).any(axis=1)
    if mode.shape[1]:
        steps = SAME * np.diff(times)
        for event in record.events:
            is_cut |= (times[:-1] - steps <= event.time) & (event.time <= times[1:] + steps)
    return is_cut


def parts_between(cut: np.ndarray) -> Sequence[tuple[int, int]]:
    """First and last row of each part between events; parts of a single row are left out."""
    ends = np.append(np.flatnonzero(cut), cut.size)
    firsts = np.append(0, ends[:-1] + 1)
    return [(a, b) for a, b in zip(firsts.tolist(), ends.tolist(), strict=True) if b > a]
