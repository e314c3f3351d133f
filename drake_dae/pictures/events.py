"""The events of a run that pictures mark: contacts that touch and open, limits that are reached."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from enum import Enum

import numpy as np

from drake_dae.analysis import LimitKind, robot_limits
from drake_dae.diagrams.record import Record
from drake_dae.robots import RobotModel

_APART = 0.01
"""Events with the same text that follow each other within this fraction of the run are shown as
one."""


class RunEventKind(Enum):
    """The kind of an event: its label in a legend, and its color."""

    TOUCH = "touch", "#2ca02c"
    OPENING = "contact opens", "#7f7f7f"
    LIMIT = "limit reached", "#ff7f0e"

    def __init__(self, label: str, color: str) -> None:
        self.label, self.color = label, color


@dataclass(frozen=True)
class RunEvent:
    """An event of a run: its time in s, its kind, and a text as "wall: touch"."""

    time: float
    kind: RunEventKind
    text: str


def events_of(record: Record, model: RobotModel | None = None) -> list[RunEvent]:
    """The events of a record with control, state and constraint_force, sorted by time.

    Limits are those of the robot, if it is given. Of repetitions at once the first is kept.
    """
    if not record.time.size:
        return []
    found = [*_contacts(record), *(_limits(record, model) if model is not None else ())]
    apart = _APART * float(record.time[-1] - record.time[0])
    last_times, shown = dict[str, float](), list[RunEvent]()
    for event in sorted(found, key=lambda event: event.time):
        if event.time - last_times.get(event.text, -np.inf) > apart:
            shown.append(event)
        last_times[event.text] = event.time
    return shown


def kinds_of(events: Sequence[RunEvent]) -> list[RunEventKind]:
    """The kinds of events that occur, in the order of `RunEventKind`."""
    return [kind for kind in RunEventKind if any(event.kind is kind for event in events)]


def _contacts(record: Record) -> Iterator[RunEvent]:
    """When compliant contacts open and close."""
    if "contact_force" not in record.signals:
        return
    forces = record.signals["constraint_force"]
    for signal, values in zip(forces.signals, forces.values.T, strict=True):
        is_closed = values > 0.0
        for kind, before in ((RunEventKind.TOUCH, False), (RunEventKind.OPENING, True)):
            changed = (is_closed[:-1] == before) & (is_closed[1:] != before)
            for time in record.time[1:][changed].tolist():
                yield RunEvent(time, kind, f"{signal.name.removesuffix('.force')}: {kind.label}")


def _limits(record: Record, model: RobotModel) -> Iterator[RunEvent]:
    """When a control, a joint or a drive reaches its limit."""
    limits, controls = robot_limits(model), [s.name for s in record.signals["control"].signals]
    columns = limits.of_record(record).T, limits.bounds.T
    for kind, signal, values, bounds in zip(limits.kinds, limits.signals, *columns, strict=True):
        if kind in (LimitKind.FORCE, LimitKind.CONE):
            continue
        # A control that is cut off keeps its limit by round-off.
        low, high = bounds
        reached = np.zeros(values.size, dtype=bool)
        if np.isfinite(low):
            reached |= values <= low + 1e-9 * abs(low)
        if np.isfinite(high):
            reached |= values >= high - 1e-9 * abs(high)
        if kind is LimitKind.CONTROL and "excess" in record:
            reached |= record["excess"][:, controls.index(signal.name)] != 0.0
        begins = reached & ~np.concatenate([[False], reached[:-1]])
        for time in record.time[begins].tolist():
            yield RunEvent(time, RunEventKind.LIMIT, f"{signal.name} is at its limit")
