"""The figures as a picture: position error against force error, a panel for each plant."""

from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
from matplotlib.axes import Axes
from matplotlib.lines import Line2D

from contact_peers.plants import CONDITIONS
from contact_peers.table import OURS, VERSION_0_1, Row

STYLES = {
    VERSION_0_1: ("x", "0.45"),
    "InverseDynamicsController + J^T lambda": ("s", "tab:brown"),
    "JointStiffnessController + J^T lambda": ("D", "tab:olive"),
    "hybrid position/force, PI": ("o", "tab:blue"),
    "impedance + force ahead": ("^", "tab:green"),
    "admittance": ("v", "tab:purple"),
    "least squares (as TSID)": ("P", "tab:orange"),
    OURS: ("*", "tab:red"),
}
"""Law -> marker and colour."""

X, Y = (2e-3, 1.5e2), (2e-3, 3e1)
"""Limits in mm and N; what is lost stands at the upper right."""


def draw(rows: list[Row], path: Path) -> None:
    """Draws all figures into a file."""
    figure, grid = plt.subplots(2, 4, figsize=(13, 6.6), sharex=True, sharey=True)
    figure.subplots_adjust(0.055, 0.085, 0.99, 0.93, 0.06, 0.16)
    for axes, condition in zip(grid.flat, CONDITIONS, strict=False):
        _panel(axes, rows, condition.title)
    for axes in grid[-1, :3]:
        axes.set_xlabel("position error [mm]")
    grid[0, 3].tick_params(labelbottom=True)
    grid[0, 3].set_xlabel("position error [mm]")
    for axes in grid[:, 0]:
        axes.set_ylabel("force error [N]")
    _legend(grid[-1, -1])
    figure.suptitle(
        "A circle at 0.1 m/s under 20 + 5 sin 2t N on Drake's contact, friction 0.3, 1 kHz: "
        "rms after 2 s",
        fontsize=11,
    )
    figure.savefig(path, dpi=110)
    plt.close(figure)


def _panel(axes: Axes, rows: list[Row], title: str) -> None:
    axes.set(xscale="log", yscale="log", xlim=X, ylim=Y)
    axes.set_title(title, fontsize=10)
    axes.grid(True, which="major", color="0.9", linewidth=0.8)
    axes.set_axisbelow(True)
    for name, (marker, color) in STYLES.items():
        found = [row for row in rows if row.law == name]
        places = [_place(row, title) for row in found]
        axes.plot(*zip(*places, strict=True), color=color, linewidth=0.8, alpha=0.5, zorder=2)
        for row, place in zip(found, places, strict=True):
            size = 190 if name == OURS else 60
            face = color if row.knows or marker == "x" else "white"
            axes.scatter(
                *place, s=size, marker=marker, facecolors=face, edgecolors=color, zorder=3,
                linewidths=1.4, clip_on=False,
            )  # fmt: skip
            if row.figures[title].is_lost:
                axes.annotate("lost", place, (-28, -3), textcoords="offset points", fontsize=8)


def _place(row: Row, title: str) -> tuple[float, float]:
    figures = row.figures[title]
    if figures.is_lost:
        return X[1], Y[1]
    return min(max(figures.position, X[0]), X[1]), min(max(figures.force, Y[0]), Y[1])


def _legend(axes: Axes) -> None:
    axes.axis("off")
    handles = [
        Line2D([], [], marker=marker, color=color, linestyle="", markersize=13 if n == OURS else 8)
        for n, (marker, color) in STYLES.items()
    ]
    labels = list(STYLES)
    for face, label in (("0.3", "friction known"), ("white", "friction unknown")):
        handles.append(
            Line2D(
                [], [], marker="o", color="0.3", markerfacecolor=face, linestyle="", markersize=8
            )
        )
        labels.append(label)
    axes.legend(handles, labels, loc="center left", fontsize=9, frameon=False, labelspacing=0.8)
