"""Marks in plots over time: events, and phases of a task."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from drake_dae.diagrams.record import Record
from drake_dae.pictures.moments import RunEvent, event_kinds
from drake_dae.running.phases import phase_spans

if TYPE_CHECKING:  # Loaded with the first figure: most runs draw none.
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_NAME = 0.11
"""The width of a phase's name, which is vertical, in inches along the time axis."""


def mark_labels(events: Sequence[RunEvent] = ()) -> tuple[str, ...]:
    """Returns the legend labels of the marks of events."""
    return tuple(kind.label for kind in event_kinds(events))


def mark_events(axes: Sequence[Axes], events: Sequence[RunEvent] = ()) -> None:
    """Marks events on the time axis."""
    for axis in axes:
        for kind in event_kinds(events):
            times = [event.time for event in events if event.kind is kind]
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


def mark_phases(figure: Figure, record: Record) -> None:
    """Shades every second phase of a task in all axes of a figure, and writes the phases' names."""
    from matplotlib.patheffects import withStroke

    spans = phase_spans(record)
    halo = withStroke(linewidth=2.0, foreground="white")
    for axis in figure.axes:
        axis.margins(x=0.01)
        width = axis.get_position().width * figure.get_figwidth()
        # The names of short phases are moved to the right, so that they do not overlap.
        apart = _NAME / width * float(record.time[-1] - record.time[0]) if spans else 0.0
        text_time = -float("inf")
        for number, span in enumerate(spans):
            if number % 2:
                axis.axvspan(
                    span.begin, span.end, color="C0", alpha=0.06, linewidth=0.0, zorder=0.3
                )
            text_time = max(span.begin, text_time + apart)
            axis.text(
                text_time,
                0.97,
                f" {span.name}",
                transform=axis.get_xaxis_transform(),
                rotation=90,
                va="top",
                fontsize=6,
                color="0.45",
                path_effects=[halo],
                zorder=0.7,  # Below the curves.
            )
