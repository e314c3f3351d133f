"""The figures as a picture: position error against force error, a panel for each plant."""

from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.patches import Rectangle

from contact_peers.plants import CONDITIONS, Condition
from contact_peers.table import OURS, VERSION_0_1, Row

STYLES = {
    VERSION_0_1: ("x", "0.45"),
    "InverseDynamicsController + J^T lambda": ("s", "tab:brown"),
    "JointStiffnessController + J^T lambda": ("D", "tab:olive"),
    "hybrid position/force, PI": ("o", "tab:blue"),
    "impedance + force ahead": ("^", "tab:green"),
    "admittance": ("v", "tab:purple"),
    "least squares (as TSID)": ("P", "tab:orange"),
    "hybrid, PI + momentum observer": ("h", "tab:cyan"),
    "impedance + momentum observer": ("<", "tab:pink"),
    OURS: ("*", "tab:red"),
}
"""Law -> marker and colour."""

X, Y = (2e-4, 1.5e2), (1e-3, 6e1)
"""Limits in mm and N."""


def draw(rows: list[Row], path: Path) -> None:
    """Draws all figures into a file."""
    figure, grid = plt.subplots(2, 4, figsize=(13, 6.6), sharex=True, sharey=True)
    figure.subplots_adjust(0.055, 0.085, 0.99, 0.9, 0.06, 0.18)
    for axes, condition in zip(grid.flat, CONDITIONS, strict=False):
        _panel(axes, rows, condition)
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


def _panel(axes: Axes, rows: list[Row], condition: Condition) -> None:
    axes.set(xscale="log", yscale="log", xlim=X, ylim=Y)
    axes.set_title(condition.title, fontsize=10)
    axes.grid(True, which="major", color="0.9", linewidth=0.8)
    axes.set_axisbelow(True)
    axes.add_patch(Rectangle((X[0], Y[0]), *condition.asked, color="tab:green", alpha=0.1))
    lost = 0
    for name, (marker, color) in STYLES.items():
        kept = []
        for row in (row for row in rows if row.law == name):
            style = {
                "s": 170 if name == OURS else 55,
                "marker": marker,
                "facecolors": color if row.knows or marker == "x" else "white",
                "edgecolors": None if marker == "x" else color,
                "linewidths": 1.4,
                "zorder": 3,
            }
            figures = row.figures[condition.title]
            if figures.is_lost:
                axes.scatter(0.95 - 0.07 * lost, 0.93, transform=axes.transAxes, **style)
                lost += 1
            else:
                kept.append((figures.position, figures.force))
                axes.scatter(*kept[-1], **style)
        if kept:
            axes.plot(*zip(*kept, strict=True), color=color, linewidth=0.8, alpha=0.5, zorder=2)
    if lost:
        place = (0.9 - 0.07 * (lost - 1), 0.93)
        axes.text(*place, "lost", transform=axes.transAxes, ha="right", va="center", fontsize=9)


def _legend(axes: Axes) -> None:
    axes.axis("off")
    handles = [
        Line2D([], [], marker=marker, color=color, linestyle="", markersize=13 if n == OURS else 8)
        for n, (marker, color) in STYLES.items()
    ]
    labels = [name.removesuffix(" + J^T lambda").removesuffix(" + force ahead") for name in STYLES]
    for face, label in (("0.3", "friction known"), ("white", "friction unknown")):
        handles.append(
            Line2D(
                [], [], marker="o", color="0.3", markerfacecolor=face, linestyle="", markersize=8
            )
        )
        labels.append(label)
    handles.append(Rectangle((0, 0), 1, 1, color="tab:green", alpha=0.1))
    labels.append("asked for")
    axes.legend(handles, labels, loc="lower left", fontsize=9, frameon=False, labelspacing=0.4)
