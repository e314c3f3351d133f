"""The events of opening contacts: on disk, as a table, and in animations."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from drake_dae.arrays import FloatArray
from drake_dae.systems.plants.contact_events import ContactChange, ContactEvent

FLASH = 0.3
"""The duration of an impact in an animation, in s."""


def event_arrays(events: Sequence[ContactEvent]) -> dict[str, np.ndarray]:
    """Converts events to arrays of numbers and text, one row per event; {} for no events.

    The columns of "events.happened", "events.closed" and "events.impulses" (N s) are the contacts
    "events.contacts"; "events.rest_time" is nan without a value.
    """
    if not events:
        return {}
    names = list(dict.fromkeys(n for event in events for n in (*event.contacts, *event.closed)))
    impulses = [dict(zip(e.contacts, e.impulses, strict=False)) for e in events]
    rests = [np.nan if e.rest_time is None else e.rest_time for e in events]
    return {
        "events.time": np.array([e.time for e in events]),
        "events.kind": np.array([e.kind.value for e in events], dtype=str),
        "events.contacts": np.array(names, dtype=str),
        "events.happened": np.array([[n in e.contacts for n in names] for e in events]),
        "events.closed": np.array([[n in e.closed for n in names] for e in events]),
        "events.impulses": np.array([[given.get(n, 0.0) for n in names] for given in impulses]),
        "events.energy_lost": np.array([e.energy_lost for e in events]),
        "events.rest_time": np.array(rests),
    }


def events_of_arrays(arrays: Mapping[str, np.ndarray]) -> tuple[ContactEvent, ...]:
    """Converts arrays of `event_arrays` back to events.

    Raises:
        KeyError, ValueError: The arrays are those of something else.
    """
    if "events.time" not in arrays:
        return ()
    names = [str(name) for name in arrays["events.contacts"]]
    columns = ("time", "kind", "happened", "closed", "impulses", "energy_lost", "rest_time")
    events = []
    for time, kind, happened, closed, impulses, lost, rest in zip(
        *(arrays[f"events.{column}"] for column in columns), strict=True
    ):
        change = ContactChange(str(kind))
        is_impact = change in (ContactChange.IMPACT, ContactChange.REST)
        events.append(
            ContactEvent(
                time=float(time),
                kind=change,
                contacts=_chosen(names, happened),
                closed=_chosen(names, closed),
                impulses=tuple(impulses[happened].tolist()) if is_impact else (),
                energy_lost=float(lost),
                rest_time=None if np.isnan(rest) else float(rest),
            )
        )
    return tuple(events)


def _chosen(names: Sequence[str], which: np.ndarray) -> tuple[str, ...]:
    return tuple(name for name, yes in zip(names, which.tolist(), strict=True) if yes)


def event_rows(events: Sequence[ContactEvent]) -> list[dict[str, Any]]:
    """Events as rows of plain values; see `Record.event_rows`."""
    return [
        {
            "time [s]": event.time,
            "event": event.kind.value,
            "contacts": ", ".join(event.contacts),
            "closed": ", ".join(event.closed),
            "impulse [N s]": float(sum(event.impulses)),
            "energy lost [J]": event.energy_lost,
        }
        for event in events
    ]


def impacts(events: Sequence[ContactEvent]) -> list[ContactEvent]:
    """The events with an impulse."""
    return [event for event in events if any(event.impulses)]


def flashes(events: Sequence[ContactEvent], names: Sequence[str], times: FloatArray) -> FloatArray:
    """The brightness of each contact's flash, which fades after an impact.

    Args:
        events: The events of a run.
        names: The names of the contacts.
        times: The moments, in s.

    Returns:
        0 to 1, one row for each moment.
    """
    brightness = np.zeros((times.size, len(names)))
    largest = max((max(event.impulses) for event in impacts(events)), default=1.0)
    for event in impacts(events):
        since = times - event.time
        fading = np.where((since >= 0.0) & (since < FLASH), 1.0 - since / FLASH, 0.0)
        for name, impulse in zip(event.contacts, event.impulses, strict=True):
            if name in names:
                column = brightness[:, list(names).index(name)]
                # The size of a ball of that volume.
                np.maximum(column, np.cbrt(impulse / largest) * fading, out=column)
    return brightness
