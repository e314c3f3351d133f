"""The opening contacts of a record, in words and as intervals of time."""

import numpy as np

from drake_dae.simulation.records.events import impacts
from drake_dae.simulation.records.record import Record

_BELOW = 1e-6
"""Below minus this gap, in m, an open contact is beside its face."""


def contact_notes(record: Record) -> list[tuple[str, str]]:
    """The impacts and open times of contacts as (label, text); empty if no contact can open."""
    if "mode" not in record.signals:
        return []
    hits = impacts(record.events)
    text = "no impacts"
    if hits:
        hardest = max(hits, key=lambda event: max(event.impulses))
        lost = sum(event.energy_lost for event in hits)
        strength = f"{max(hardest.impulses):.3g} N s"
        text = f"1 impact, at {hits[0].time:.4g} s with {strength}; {lost:.3g} J lost"
        if len(hits) > 1:
            text = (
                f"{len(hits)} impacts, the first at {hits[0].time:.4g} s, the hardest with "
                f"{strength} at {hardest.time:.4g} s; {lost:.3g} J lost"
            )
    notes = [("contacts", text)]
    modes, gaps, taken = record["mode"], record["gap"], np.diff(record.time, prepend=record.time[0])
    for column, signal in enumerate(record.signals["gap"].signals):
        # A sample describes the step before it.
        is_open = modes[:, column] == 0.0
        is_open[0] = False
        name, away = signal.name.removesuffix(".gap"), gaps[is_open, column]
        if not away.size:
            notes.append((name, "always closed"))
            continue
        first = record.time[int(np.argmax(is_open)) - 1]
        text = f"open for {taken[is_open].sum():.4g} s, first from {first:.4g} s on"
        if (most := np.max(away)) > 0.0:
            text += f", up to {most:.3g} {signal.unit} away"
        if (least := np.min(away)) < -_BELOW:
            text += f", beside its face up to {-least:.3g} {signal.unit} below it"
        notes.append((name, text))
    return notes


def open_spans(record: Record) -> list[tuple[float, float]]:
    """The intervals in which some contact was open, in s."""
    if "mode" not in record.signals or record.time.size < 2:
        return []
    is_open = np.concatenate([[False], (record["mode"][1:] == 0.0).any(axis=1), [False]])
    edges = np.flatnonzero(is_open[1:] != is_open[:-1])
    times = record.time[edges]
    return list(zip(times[::2].tolist(), times[1::2].tolist(), strict=True))
