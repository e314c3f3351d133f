"""What happens in a run at one moment: impacts, touches, limits, sliding."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from enum import Enum

import numpy as np

from drake_dae.arrays import Booleans
from drake_dae.simulation.records.events import impacts
from drake_dae.simulation.records.record import Record
from drake_dae.simulation.summary import Limits
from drake_dae.systems.plants.contact_events import ContactChange

APART = 0.01
"""Of moments of one kind and place that follow each other within this fraction of the run, the
first is shown; of impacts all are."""


class RunEventKind(Enum):
    """The kind of a moment: its label in a legend, and its color."""

    IMPACT = "impact", "#ffbf1a"
    TOUCH = "touch", "#2ca02c"
    OPENING = "contact opens", "#7f7f7f"
    SLIDE = "begins to slide", "#9467bd"
    STICK = "sticks", "#8c564b"
    LIMIT = "limit reached", "#ff7f0e"

    def __init__(self, label: str, color: str) -> None:
        self.label, self.color = label, color


@dataclass(frozen=True)
class RunEvent:
    """Something that happens in a run.

    Attributes:
        time: When, in s.
        kind: Its kind.
        text: What happens, in words.
    """

    time: float
    kind: RunEventKind
    text: str


def moments_of(record: Record, limits: Limits | None = None) -> list[RunEvent]:
    """The moments that a record shows, in order.

    Args:
        record: A record with control, state and constraint_force.
        limits: The limits of the robot.
    """
    found = [*_contacts(record), *_limits(record, limits or Limits())]
    return ordered(record, found)


def ordered(record: Record, moments: Sequence[RunEvent]) -> list[RunEvent]:
    """Moments in order, without repetitions shortly after, except those of impacts."""
    if not record.time.size:
        return []
    apart = APART * float(record.time[-1] - record.time[0])
    last, found = dict[tuple[RunEventKind, str], float](), list[RunEvent]()
    for moment in sorted(moments, key=lambda one: one.time):
        key = moment.kind, moment.text
        if moment.kind is RunEventKind.IMPACT or moment.time - last.get(key, -np.inf) > apart:
            found.append(moment)
        last[key] = moment.time
    return found


def _contacts(record: Record) -> Iterator[RunEvent]:
    if "mode" in record.signals:
        hits = {id(event) for event in impacts(record.events)}
        kinds = {
            ContactChange.CLOSING: RunEventKind.TOUCH,
            ContactChange.OPENING: RunEventKind.OPENING,
        }
        for event in record.events:
            kind = RunEventKind.IMPACT if id(event) in hits else kinds.get(event.kind)
            if kind is not None:
                names = ", ".join(event.contacts)
                yield RunEvent(event.time, kind, f"{names}: {kind.label}")
    elif "contact_force" in record.signals:  # Compliant contact opens and closes without events.
        forces = record.signals["constraint_force"]
        for signal, values in zip(forces.signals, forces.values.T, strict=True):
            pushes = values > 0.0
            name = signal.name.removesuffix(".force")
            for kind, changed in (
                (RunEventKind.TOUCH, pushes[1:] & ~pushes[:-1]),
                (RunEventKind.OPENING, pushes[:-1] & ~pushes[1:]),
            ):
                for time in record.time[1:][changed]:
                    yield RunEvent(float(time), kind, f"{name}: {kind.label}")


def _limits(record: Record, limits: Limits) -> Iterator[RunEvent]:
    """When a control or a joint comes to its limit."""
    rows: list[tuple[str, Booleans]] = []
    controls = record.signals["control"]
    if limits.control is not None:
        at = np.abs(controls.values) >= limits.control * (1.0 - 1e-9)
        if "excess" in record.signals:
            at |= record["excess"] != 0.0
        rows += [(one.name, at[:, i]) for i, one in enumerate(controls.signals)]
    for key, bounds in (("state", limits.state), ("loop_state", limits.loops)):
        if bounds is not None and key in record.signals:
            found = record.signals[key]
            for one, values, low, high in zip(found.signals, found.values.T, *bounds, strict=False):
                rows.append((one.name, (values <= low) | (values >= high)))
    for name, reached in rows:
        begins = reached & ~np.concatenate([[False], reached[:-1]])
        for time in record.time[begins]:
            yield RunEvent(float(time), RunEventKind.LIMIT, f"{name} is at its limit")
