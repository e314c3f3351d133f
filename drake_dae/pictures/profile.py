"""The plot of a time-optimal profile in the plane of s and s'."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from drake_dae.dae.timing.profile import TimeProfile

if TYPE_CHECKING:  # Loaded with the first figure: most runs draw none.
    from matplotlib.figure import Figure

PROFILE = "profile.png"
"""The name of the plot's file."""

MOST_COLOURS = 10
"""The number of limits with different colours, those that act longest; the others are grey."""


def save_profile(profile: TimeProfile, folder: str | Path) -> Path:
    """Writes the plot of a profile as a PNG file, and returns the file.

    Args:
        profile: The profile.
        folder: The folder to write to.
    """
    file = Path(folder) / PROFILE
    plot_profile(profile).savefig(file, dpi=110)
    return file


def plot_profile(profile: TimeProfile) -> Figure:
    """Plots the speed s' over s, in the colour of the limit that acts there.

    The grey curve above is the highest speed from which the robot can still brake. s is the
    distance along the path, relative to the ranges of the moving outputs. Dotted lines are stops.

    Args:
        profile: The profile.
    """
    from matplotlib.collections import LineCollection
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D

    fractions = profile.shares
    colours = {limit: f"C{i}" for i, limit in enumerate(list(fractions)[:MOST_COLOURS])}
    figure = Figure(figsize=(9.0, 5.0))
    axis = figure.add_axes((0.08, 0.11, 0.58, 0.81))
    start = 0.0
    for timed in profile.pieces:
        if timed.piece.is_pause:
            continue
        s, speed = start + timed.piece.distances, np.sqrt(timed.b)
        axis.plot(s, np.sqrt(timed.highest), color="0.75", linewidth=3, zorder=1)
        points = np.column_stack([s, speed])
        lines = np.stack([points[:-1], points[1:]], axis=1)
        limits = [profile.causes[cause].text for cause in timed.limiting.tolist()]
        shades = [colours.get(limit, "0.4") for limit in limits]
        axis.add_collection(LineCollection(list(lines), colors=shades, linewidths=1.8, zorder=2))
        start = float(s[-1])
        axis.axvline(start, color="0.5", linestyle=":", linewidth=0.8)
    axis.set_xlim(0.0, start)
    axis.set_ylim(bottom=0.0)
    axis.grid(True, alpha=0.3)
    axis.set_xlabel("s, relative to the ranges of the outputs", fontsize=10)
    axis.set_ylabel("s' [1/s]", fontsize=10)
    axis.set_title(f"time-optimal motion of {profile.duration:.4g} s", fontsize=10)
    handles = [Line2D([], [], color="0.75", linewidth=3, label="can brake up to here")]
    for limit, colour in colours.items():
        label = f"{limit}, {fractions[limit]:.0%} of the time"
        handles.append(Line2D([], [], color=colour, label=label))
    figure.legend(handles=handles, loc="upper left", bbox_to_anchor=(0.67, 0.93), fontsize=8)
    return figure
