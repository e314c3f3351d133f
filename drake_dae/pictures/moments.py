"""The events of a run that pictures mark: contact changes, limits, sliding."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from enum import Enum

import numpy as np

from drake_dae.analysis.limits import LimitKind, SignalLimits
from drake_dae.diagrams.record import Record
from drake_dae.running.limits import limited_values

APART = 0.01
"""Events with the same text that follow each other within this fraction of the run are shown as
one."""


class RunEventKind(Enum):
    """The kind of an event: its label in a legend, and its color."""

    TOUCH = "touch", "#2ca02c"
    OPENING = "contact opens", "#7f7f7f"
    SLIDE = "begins to slide", "#9467bd"
    STICK = "sticks", "#8c564b"
    LIMIT = "limit reached", "#ff7f0e"

    def __init__(self, label: str, color: str) -> None:
        self.label, self.color = label, color


@dataclass(frozen=True)
class RunEvent:
    """An event of a run, as pictures mark it.

    Attributes:
        time: The time in s.
        kind: Its kind.
        text: A description, as "wall: touch".
    """

    time: float
    kind: RunEventKind
    text: str


def events_of(record: Record, limits: SignalLimits | None = None) -> list[RunEvent]:
    """Returns the events of a recorded run, sorted by time.

    Args:
        record: A record with control, state and constraint_force.
        limits: The limits of the robot, `robot_limits`.
    """
    at_limits = [] if limits is None else _limits(record, limits)
    return sorted_events(record, [*_contacts(record), *at_limits])


def sorted_events(record: Record, events: Sequence[RunEvent]) -> list[RunEvent]:
    """Returns events sorted by time, without repetitions within `APART`."""
    if not record.time.size:
        return []
    apart = APART * float(record.time[-1] - record.time[0])
    last_times, shown = dict[tuple[RunEventKind, str], float](), list[RunEvent]()
    for event in sorted(events, key=lambda event: event.time):
        key = event.kind, event.text
        if event.time - last_times.get(key, -np.inf) > apart:
            shown.append(event)
        last_times[key] = event.time
    return shown


def event_kinds(events: Sequence[RunEvent]) -> list[RunEventKind]:
    """Returns the kinds of events that occur, in the order of `RunEventKind`."""
    occurring = {event.kind for event in events}
    return [kind for kind in RunEventKind if kind in occurring]


def _contacts(record: Record) -> Iterator[RunEvent]:
    """Yields when compliant contacts open and close."""
    if "contact_force" not in record.signals:
        return
    forces = record.signals["constraint_force"]
    for signal, values in zip(forces.signals, forces.values.T, strict=True):
        is_closed = values > 0.0
        name = signal.name.removesuffix(".force")
        for kind, changed in (
            (RunEventKind.TOUCH, is_closed[1:] & ~is_closed[:-1]),
            (RunEventKind.OPENING, is_closed[:-1] & ~is_closed[1:]),
        ):
            for time in record.time[1:][changed]:
                yield RunEvent(float(time), kind, f"{name}: {kind.label}")


def _limits(record: Record, limits: SignalLimits) -> Iterator[RunEvent]:
    """Yields when a control or a joint reaches its limit."""
    controls = [signal.name for signal in record.signals["control"].signals]
    columns = zip(
        limits.kinds, limits.signals, limited_values(limits, record).T, limits.bounds.T, strict=True
    )
    for kind, signal, values, (low, high) in columns:
        if kind in (LimitKind.FORCE, LimitKind.CONE):
            continue
        # A control that is cut off keeps its limit by round-off.
        reached = np.zeros(values.size, dtype=bool)
        if np.isfinite(low):
            reached |= values <= low + 1e-9 * abs(low)
        if np.isfinite(high):
            reached |= values >= high - 1e-9 * abs(high)
        if kind is LimitKind.CONTROL and "excess" in record:
            reached |= record["excess"][:, controls.index(signal.name)] != 0.0
        begins = reached & ~np.concatenate([[False], reached[:-1]])
        for time in record.time[begins]:
            yield RunEvent(float(time), RunEventKind.LIMIT, f"{signal.name} is at its limit")
