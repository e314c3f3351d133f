"""Plots of a study: the distribution of its figures, and their dependence on two keys."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from drake_dae.arrays import Booleans, FloatArray
from drake_dae.studies.results import Outcome

MOST_PLOTS = 24
"""The largest number of figures in a plot, the first ones that vary."""


def save_study_plots(
    table: Mapping[str, Sequence[Any]],
    keys: Sequence[str],
    figures: Sequence[str],
    folder: Path,
) -> list[Path]:
    """Draws `histograms.png`, and `map.png` if a key with numbers varies.

    Args:
        table: What `Study.table` returns.
        keys: The keys that vary.
        figures: The names of the figures.
        folder: The folder to write to.

    Returns:
        What was written; nothing where no figure varies.
    """
    columns = {name: _numbers(table[name]) for name in (*keys, *figures)}
    varying = [name for name in columns if _varies(columns[name])]
    drawn = [name for name in figures if name in varying][:MOST_PLOTS]
    axes = [key for key in keys if key in varying][:2]
    pictures = {}
    if drawn:
        pictures["histograms.png"] = plot_histograms({name: columns[name] for name in drawn})
    if drawn and axes:
        is_finished = np.array([outcome == Outcome.FINISHED for outcome in table["outcome"]])
        pictures["map.png"] = plot_map(
            {key: columns[key] for key in axes}, {n: columns[n] for n in drawn}, is_finished
        )
    for name, figure in pictures.items():
        figure.savefig(folder / name, dpi=100)
    return [folder / name for name in pictures]


def plot_histograms(figures: Mapping[str, FloatArray]) -> Figure:
    """How often each figure has which values; the median is dashed."""
    figure, axes = _grid(figures)
    for axis, values in zip(axes, figures.values(), strict=True):
        known = values[np.isfinite(values)]
        axis.hist(known, bins=int(np.clip(np.sqrt(known.size), 5, 50)), color="C0")
        axis.axvline(float(np.median(known)), color="C1", linestyle="--")
        axis.set_ylabel("runs", fontsize=8)
    return figure


def plot_map(
    keys: Mapping[str, FloatArray], figures: Mapping[str, FloatArray], is_finished: Booleans
) -> Figure:
    """Each figure over two keys, as colours, or over one key, as points.

    Where several runs have the same values of the keys, the worst is seen: the least margin or
    force, the largest error. A run that did not finish is a red cross.
    """
    figure, axes = _grid(figures)
    for axis, (title, values) in zip(axes, figures.items(), strict=True):
        badness = -values if title.startswith(("margin", "least")) else np.abs(values)
        order = np.argsort(np.where(np.isfinite(values), badness, -np.inf), kind="stable")
        names, places = list(keys), [column[order] for column in keys.values()]
        shown, finished = values[order], is_finished[order]
        axis.set_xlabel(_text(names[0]), fontsize=8)
        if len(names) == 1:
            axis.plot(places[0], shown, ".", color="C0")
            axis.plot(places[0][~finished], shown[~finished], "x", color="C3")
            continue
        axis.set_ylabel(_text(names[1]), fontsize=8)
        colours = _coloured(axis, places, shown)
        axis.plot(places[0][~finished], places[1][~finished], "x", color="C3")
        figure.colorbar(colours, ax=axis)
    return figure


def _coloured(axis: Axes, places: Sequence[FloatArray], shown: FloatArray) -> Any:
    """A full grid as cells, anything else as points."""
    levels = [np.unique(place[np.isfinite(place)]) for place in places]
    cells = np.full([level.size for level in levels], np.nan)
    for x, y, value in zip(*places, shown, strict=True):
        if np.isfinite([x, y, value]).all():
            cells[np.searchsorted(levels[0], x), np.searchsorted(levels[1], y)] = value
    # Of random runs hardly two have the same value.
    if cells.size <= shown.size:
        return axis.pcolormesh(*levels, np.ma.masked_invalid(cells.T), shading="nearest")
    return axis.scatter(places[0], places[1], c=shown, s=12)


def _grid(figures: Mapping[str, FloatArray]) -> tuple[Figure, list[Axes]]:
    columns = min(3, len(figures))
    rows = -(-len(figures) // columns)
    figure = Figure(figsize=(4.2 * columns, 0.3 + 2.7 * rows), layout="tight")
    axes = []
    for index, name in enumerate(figures):
        axis = figure.add_subplot(rows, columns, index + 1)
        axis.set_title(_text(name), fontsize=9)
        axis.tick_params(labelsize=8)
        axes.append(axis)
    return figure, axes


def _text(name: str) -> str:
    return name.replace("$", r"\$")  # Matplotlib would read mathematics.


def _numbers(column: Sequence[Any]) -> FloatArray:
    """A column as numbers; nan where it has none. A list with one number is that number."""
    flat = [entry[0] if isinstance(entry, list) and len(entry) == 1 else entry for entry in column]
    is_number = [isinstance(e, (int, float)) and not isinstance(e, bool) for e in flat]
    return np.array([e if yes else np.nan for e, yes in zip(flat, is_number, strict=True)], float)


def _varies(values: FloatArray) -> bool:
    """Whether a column has different numbers, by more than round-off."""
    known = values[np.isfinite(values)]
    return known.size > 1 and bool(np.ptp(known) > 1e-9 * np.max(np.abs(known)))
