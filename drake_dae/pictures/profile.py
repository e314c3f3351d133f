"""The picture of a time-optimal profile in the plane of s and s'."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from drake_dae.dae.timing.profile import TimeProfile

if TYPE_CHECKING:  # Loaded with the first figure: most runs draw none.
    from matplotlib.figure import Figure

PROFILE = "profile.png"
"""The plot of a time-optimal profile, of a run that has one."""

MOST_COLOURS = 10
"""The number of limits with a colour of their own, those that act longest; others are grey."""


def save_profile(profile: TimeProfile, folder: str | Path) -> Path:
    """Draws a profile into a PNG file.

    Args:
        profile: The profile.
        folder: The folder to write to.
    """
    file = Path(folder) / PROFILE
    plot_profile(profile).savefig(file, dpi=110)
    return file


def plot_profile(profile: TimeProfile) -> Figure:
    """s' over s, in the colour of what limits it; grey above it what could not be braked.

    s is the distance along the path relative to the ranges of the outputs that move. Dotted lines
    are rests.

    Args:
        profile: The profile.
    """
    from matplotlib.collections import LineCollection
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D

    shares = profile.shares
    colours = {name: f"C{i}" for i, name in enumerate(list(shares)[:MOST_COLOURS])}
    figure = Figure(figsize=(9.0, 5.0))
    axis = figure.add_axes((0.08, 0.11, 0.58, 0.81))
    first = 0.0
    for one in profile.pieces:
        if one.piece.is_pause:
            continue
        s, speed = first + one.piece.distances, np.sqrt(one.b)
        axis.plot(s, np.sqrt(one.highest), color="0.75", linewidth=3, zorder=1)
        points = np.column_stack([s, speed])
        lines = np.stack([points[:-1], points[1:]], axis=1)
        names = [profile.causes[place].text for place in one.limiting.tolist()]
        chosen = [colours.get(name, "0.4") for name in names]
        axis.add_collection(LineCollection(list(lines), colors=chosen, linewidths=1.8, zorder=2))
        first = float(s[-1])
        axis.axvline(first, color="0.5", linestyle=":", linewidth=0.8)
    axis.set_xlim(0.0, first)
    axis.set_ylim(bottom=0.0)
    axis.grid(True, alpha=0.3)
    axis.set_xlabel("s, relative to the ranges of the outputs", fontsize=10)
    axis.set_ylabel("s' [1/s]", fontsize=10)
    axis.set_title(f"time-optimal motion of {profile.duration:.4g} s", fontsize=10)
    handles = [Line2D([], [], color="0.75", linewidth=3, label="can brake up to here")]
    for name, share in shares.items():
        if name in colours:
            label = f"{name}, {share:.0%} of the time"
            handles.append(Line2D([], [], color=colours[name], label=label))
    figure.legend(handles=handles, loc="upper left", bbox_to_anchor=(0.67, 0.93), fontsize=8)
    return figure
