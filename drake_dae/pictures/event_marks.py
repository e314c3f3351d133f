"""Marks in pictures over time: impacts, where contacts were open, and phases of a task."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from drake_dae.simulation.open_contacts import open_spans
from drake_dae.simulation.records.events import impacts
from drake_dae.simulation.records.phases import phase_spans
from drake_dae.simulation.records.record import Record

if TYPE_CHECKING:  # Loaded with the first figure: most runs draw none.
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

IMPACT, OPEN = "impact", "contact open"
"""The labels of marks in a plot."""


def mark_labels(record: Record) -> tuple[str, ...]:
    """The legend entries of the marks of a record, in any order."""
    found = [OPEN] if open_spans(record) else []
    return (*found, IMPACT) if impacts(record.events) else tuple(found)


def mark_events(axes: Sequence[Axes], record: Record) -> None:
    """Marks in axes over time where contacts were open, and impacts."""
    for axis in axes:
        for number, span in enumerate(open_spans(record)):
            label = "" if number else OPEN
            axis.axvspan(*span, color="0.9", linewidth=0.0, zorder=0.4, label=label)
        for number, event in enumerate(impacts(record.events)):
            label = "" if number else IMPACT
            axis.axvline(event.time, color="C3", linewidth=0.8, alpha=0.7, zorder=0.6, label=label)


def mark_phases(figure: Figure, record: Record) -> None:
    """Shades every second phase of a task in axes over time, with the names of all."""
    spans = phase_spans(record)
    for axis in figure.axes:
        axis.margins(x=0.01)
        for number, span in enumerate(spans):
            if number % 2:
                axis.axvspan(
                    span.begin, span.end, color="C0", alpha=0.06, linewidth=0.0, zorder=0.3
                )
            axis.text(
                span.begin,
                0.97,
                f" {span.name}",
                transform=axis.get_xaxis_transform(),
                rotation=90,
                va="top",
                fontsize=6,
                color="0.45",
                zorder=0.5,
            )
