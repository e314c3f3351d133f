"""Marks in pictures over time: impacts, where contacts were open, and phases of a task."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from drake_dae.pictures.moments import RunEvent, RunEventKind
from drake_dae.simulation.open_contacts import open_spans
from drake_dae.simulation.records.phases import phase_spans
from drake_dae.simulation.records.record import Record

if TYPE_CHECKING:  # Loaded with the first figure: most runs draw none.
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_NAME = 0.11
"""The room for the name of a phase, in inches along the axis of time."""

OPEN = "contact open"
"""The label of the time in which a contact was open."""


def mark_labels(record: Record, moments: Sequence[RunEvent] = ()) -> tuple[str, ...]:
    """The legend entries of the marks of a record, in any order."""
    found = [OPEN] if open_spans(record) else []
    return (*found, *(kind.label for kind in _kinds(moments)))


def mark_events(axes: Sequence[Axes], record: Record, moments: Sequence[RunEvent] = ()) -> None:
    """Marks in axes over time where contacts were open, and on the axis of time what happens.

    An impact has a line through all of the plot.
    """
    for axis in axes:
        for number, span in enumerate(open_spans(record)):
            label = "" if number else OPEN
            axis.axvspan(*span, color="0.9", linewidth=0.0, zorder=0.4, label=label)
        for kind in _kinds(moments):
            times = [one.time for one in moments if one.kind is kind]
            for time in times if kind is RunEventKind.IMPACT else ():
                axis.axvline(time, color=kind.color, linewidth=0.8, alpha=0.7, zorder=0.6)
            axis.plot(
                times,
                [0.0] * len(times),
                color=kind.color,
                linestyle="",
                marker="^",
                markersize=5,
                clip_on=False,
                transform=axis.get_xaxis_transform(),
                label=kind.label,
                zorder=3.0,
            )


def _kinds(moments: Sequence[RunEvent]) -> list[RunEventKind]:
    return [kind for kind in RunEventKind if any(one.kind is kind for one in moments)]


def mark_phases(figure: Figure, record: Record) -> None:
    """Shades every second phase of a task in axes over time, with the names of all."""
    spans = phase_spans(record)
    for axis in figure.axes:
        axis.margins(x=0.01)
        width = axis.get_position().width * figure.get_figwidth()
        # Names of short phases stand beside each other.
        apart = _NAME / width * float(record.time[-1] - record.time[0]) if spans else 0.0
        place = -float("inf")
        for number, span in enumerate(spans):
            if number % 2:
                axis.axvspan(
                    span.begin, span.end, color="C0", alpha=0.06, linewidth=0.0, zorder=0.3
                )
            place = max(span.begin, place + apart)
            axis.text(
                place,
                0.97,
                f" {span.name}",
                transform=axis.get_xaxis_transform(),
                rotation=90,
                va="top",
                fontsize=6,
                color="0.45",
                zorder=0.5,
            )
