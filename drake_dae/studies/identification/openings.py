"""When the contacts of a record open and close, and which of its steps have no derivative there."""

from collections.abc import Sequence

import numpy as np

from drake_dae.arrays import FloatArray, listed
from drake_dae.errors import ModelError
from drake_dae.simulation.records.record import Record
from drake_dae.systems.plants.contract import Plant

SAME = 1e-3
"""An event this close to a row, in steps, may be before or after it."""


def modes(record: Record, plant: Plant, title: str) -> FloatArray:
    """For each contact that opens 1 where it is closed and 0 where it is open, shape (k, m).

    Raises:
        ModelError: The record does not say it.
    """
    if not plant.contacts:
        return np.zeros((record.time.size, 0))
    signals = plant.further_signals["mode"]
    recorded = record.signals.get("mode")
    columns = (
        {} if recorded is None else dict(zip(recorded.signals, recorded.values.T, strict=True))
    )
    found = {signal.name: values for signal, values in columns.items()}
    missing = [signal.name for signal in signals if signal.name not in found]
    if missing:
        raise ModelError(
            f"{title} does not say when contacts are closed: it needs columns {listed(missing)} of "
            "the signal 'mode', 1 where closed and 0 where open, such as mode.wall.closed"
        )
    values = np.column_stack([found[signal.name] for signal in signals])
    if not np.isin(values, (0.0, 1.0)).all():
        row = int(np.argmin(np.isin(values, (0.0, 1.0)).all(axis=1)))
        raise ModelError(
            f"{title}: 'mode' is {listed(map(str, values[row]))} at {record.time[row]:g} s; it "
            "must be 1 where a contact is closed and 0 where it is open"
        )
    return values


def cuts(record: Record, own: FloatArray, is_held: bool) -> np.ndarray:
    """Between which rows a contact opens, closes or is struck, or a control jumps, shape (k - 1,).

    Args:
        record: The record, with its events if it knows them.
        own: What `modes` returned.
        is_held: Whether the control is held between samples; one that is not jumps where a phase of
            a task ends.
    """
    times = record.time
    changing = [own, *([] if is_held or "phase" not in record.signals else [record["phase"]])]
    found = (np.diff(np.hstack(changing), axis=0) != 0.0).any(axis=1)
    if own.shape[1]:
        steps = SAME * np.diff(times)
        for event in record.events:
            found |= (times[:-1] - steps <= event.time) & (event.time <= times[1:] + steps)
    return found


def parts(cut: np.ndarray) -> Sequence[tuple[int, int]]:
    """First and last rows of the parts between events; a row alone is none."""
    ends = np.append(np.flatnonzero(cut), cut.size)
    firsts = np.append(0, ends[:-1] + 1)
    return [(a, b) for a, b in zip(firsts.tolist(), ends.tolist(), strict=True) if b > a]
