"""The phases of a task in pictures of its record."""

from __future__ import annotations

from typing import TYPE_CHECKING

from drake_dae.simulation.records.phases import phase_spans
from drake_dae.simulation.records.record import Record

if TYPE_CHECKING:  # Loaded with the first figure.
    from matplotlib.figure import Figure


def mark_phases(figure: Figure, record: Record) -> None:
    """Marks the start of each phase in axes over time, with its name."""
    spans = phase_spans(record)
    for axis in figure.axes:
        axis.margins(x=0.01)
        for span in spans:
            axis.axvline(span.begin, color="0.6", linewidth=0.6, linestyle=":", zorder=0.3)
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
