"""Plots of a study: the distributions of its figures, and their dependence on two keys."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from drake_dae.arrays import Booleans, FloatArray
from drake_dae.studies.results import Outcome

MOST_PLOTS = 24
"""The largest number of figures in a plot; the first ones that vary are drawn."""


def save_study_plots(
    table: Mapping[str, Sequence[Any]],
    keys: Sequence[str],
    figures: Sequence[str],
    folder: Path,
) -> list[Path]:
    """Writes `histograms.png`, and also `map.png` if a numeric key varies.

    Args:
        table: The columns that `Study.table` returns.
        keys: The varied keys.
        figures: The names of the figures.
        folder: The folder to write to.

    Returns:
        The files; an empty list if no figure varies.
    """
    columns = {name: _numbers(table[name]) for name in (*keys, *figures)}
    varying = {name: column for name, column in columns.items() if _varies(column)}
    drawn = {name: varying[name] for name in [n for n in figures if n in varying][:MOST_PLOTS]}
    axes = {key: varying[key] for key in [k for k in keys if k in varying][:2]}
    pictures = {}
    if drawn:
        pictures["histograms.png"] = plot_histograms(drawn)
    if drawn and axes:
        is_finished = np.array([outcome == Outcome.FINISHED for outcome in table["outcome"]])
        pictures["map.png"] = plot_map(axes, drawn, is_finished)
    for name, figure in pictures.items():
        figure.savefig(folder / name, dpi=100)
    return [folder / name for name in pictures]


def plot_histograms(figures: Mapping[str, FloatArray]) -> Figure:
    """Plots a histogram of each figure over the runs, with a dashed line at the median."""
    figure, axes = _grid(figures)
    for axis, values in zip(axes, figures.values(), strict=True):
        finite = values[np.isfinite(values)]
        axis.hist(finite, bins=int(np.clip(np.sqrt(finite.size), 5, 50)), color="C0")
        axis.axvline(float(np.median(finite)), color="C1", linestyle="--")
        axis.set_ylabel("runs", fontsize=8)
    return figure


def plot_map(
    keys: Mapping[str, FloatArray], figures: Mapping[str, FloatArray], is_finished: Booleans
) -> Figure:
    """Plots each figure over two keys, as colours, or over one key, as points.

    If several runs have the same values of the keys, the worst one is on top: the least margin or
    force, or the largest error. A red cross is a run that did not finish.
    """
    figure, axes = _grid(figures)
    for axis, (title, values) in zip(axes, figures.items(), strict=True):
        badness = -values if title.startswith(("margin", "least")) else np.abs(values)
        order = np.argsort(np.where(np.isfinite(values), badness, -np.inf), kind="stable")
        names, coordinates = list(keys), [column[order] for column in keys.values()]
        values, failed = values[order], ~is_finished[order]
        axis.set_xlabel(_text(names[0]), fontsize=8)
        if len(names) == 1:
            axis.plot(coordinates[0], values, ".", color="C0")
            axis.plot(coordinates[0][failed], values[failed], "x", color="C3")
            continue
        axis.set_ylabel(_text(names[1]), fontsize=8)
        colours = _draw_colours(axis, coordinates[0], coordinates[1], values)
        axis.plot(coordinates[0][failed], coordinates[1][failed], "x", color="C3")
        figure.colorbar(colours, ax=axis).ax.tick_params(labelsize=8)
    return figure


def _draw_colours(axis: Axes, x: FloatArray, y: FloatArray, values: FloatArray) -> Any:
    """Draws values as cells if the runs form a full grid, otherwise as points."""
    levels = [np.unique(column[np.isfinite(column)]) for column in (x, y)]
    cells = np.full([level.size for level in levels], np.nan)
    is_finite = np.isfinite([x, y, values]).all(axis=0)
    for column, row, value in zip(x[is_finite], y[is_finite], values[is_finite], strict=True):
        cells[np.searchsorted(levels[0], column), np.searchsorted(levels[1], row)] = value
    # Random values differ in all runs, so that the grid would have more cells than runs.
    if cells.size <= values.size:
        return axis.pcolormesh(*levels, np.ma.masked_invalid(cells.T), shading="nearest")
    return axis.scatter(x, y, c=values, s=12)


def _grid(figures: Mapping[str, FloatArray]) -> tuple[Figure, list[Axes]]:
    columns = min(3, len(figures))
    rows = -(-len(figures) // columns)
    width, height = 4.2 * columns, 0.3 + 2.7 * rows
    figure = Figure(figsize=(width, height))
    # Margins in inches: a layout that measures all texts takes as long as drawing them.
    edges = {"left": 0.75 / width, "right": 1 - 0.3 / width}
    edges |= {"bottom": 0.55 / height, "top": 1 - 0.55 / height}
    figure.subplots_adjust(**edges, wspace=0.28, hspace=0.6)
    axes = []
    for index, name in enumerate(figures):
        axis = figure.add_subplot(rows, columns, index + 1)
        axis.set_title(_text(name), fontsize=9, pad=14)  # Above the factor of the ticks.
        axis.tick_params(labelsize=8)
        axis.locator_params(axis="x", nbins=5)
        axes.append(axis)
    return figure, axes


def _text(name: str) -> str:
    return name.replace("$", r"\$")  # Matplotlib would read mathematics.


def _numbers(column: Sequence[Any]) -> FloatArray:
    """Returns a column as numbers, from numbers or lists of one number; nan for other entries."""
    flat = [entry[0] if isinstance(entry, list) and len(entry) == 1 else entry for entry in column]
    is_number = [isinstance(e, (int, float)) and not isinstance(e, bool) for e in flat]
    return np.array([e if yes else np.nan for e, yes in zip(flat, is_number, strict=True)], float)


def _varies(values: FloatArray) -> bool:
    """Whether the numbers of a column differ by more than round-off."""
    finite = values[np.isfinite(values)]
    return finite.size > 1 and bool(np.ptp(finite) > 1e-9 * np.max(np.abs(finite)))
