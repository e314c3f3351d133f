"""The layout of axes in figures, their labels and their scales."""

from __future__ import annotations

from collections.abc import Sequence
from textwrap import fill
from typing import TYPE_CHECKING

import numpy as np

from drake_dae.arrays import FloatArray
from drake_dae.dae import Signal

if TYPE_CHECKING:  # Loaded with the first figure: most runs draw none.
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# In inches: the height of axes, or the side of square axes; the space to their left, to their
# right, between rows, below the last row, and above the first row.
_AXES, _SQUARE, _LEFT, _RIGHT, _GAP, _BOTTOM, _TITLE = 1.4, 3.6, 0.85, 0.2, 0.5, 0.55, 0.25

# In inches: the height of a legend's line, the width of its sample of a curve, and of a letter.
_LINE, _HANDLE, _LETTER = 0.2, 0.65, 0.075

_RAISED = str.maketrans(
    "-0123456789", "\u207b\u2070\u00b9\u00b2\u00b3\u2074\u2075\u2076\u2077\u2078\u2079"
)


def grid(
    titles: Sequence[str],
    labels: Sequence[str] = (),
    notes: Sequence[str] = (),
    notes_title: str = "",
) -> tuple[Figure, list[Axes]]:
    """Returns a figure and its axes over time, in two columns; a single last one fills its row.

    The positions are computed here, since Matplotlib's automatic layout takes longer than drawing.
    Of axes in one column only the lowest have tick labels.

    Args:
        titles: The titles of the axes.
        labels: The labels of a legend, for which space is reserved above all axes.
        notes: Notes below all axes.
        notes_title: The text before the notes.
    """
    from drake_dae.pictures.shown import ShownFigure

    count = len(titles)
    columns = 1 if count <= 2 else 2
    rows = -(-count // columns)
    width = 6.0 * columns if count or not notes else 12.0
    top = _TITLE + (_LINE * legend_shape(labels, width)[0] + 0.15 if labels else 0.1)
    # No line break within a note.
    entries = ", ".join(note.replace(" ", "\u00a0") for note in notes)
    text = fill(notes_title + _plain(entries), int(width / _LETTER) - 6) if notes else ""
    below = (_BOTTOM if count else 0.1) + _LINE * len(text.splitlines())
    height = below + rows * _AXES + max(rows - 1, 0) * _GAP + top
    figure = ShownFigure(figsize=(width, height))
    if text:
        figure.text(0.1 / width, 0.08 / height, text, fontsize=9, va="bottom")
    if not count:
        return figure, []
    cells = figure.add_gridspec(
        rows,
        columns,
        left=_LEFT / width,
        right=1.0 - _RIGHT / width,
        bottom=below / height,
        top=1.0 - top / height,
        wspace=(_LEFT + _RIGHT) / (width / columns - _LEFT - _RIGHT),
        hspace=_GAP / _AXES,
    )
    # The axes above a wide one are narrower, and keep their tick labels.
    numbered = count - count % columns
    axes: list[Axes] = []
    for i, title in enumerate(titles):
        row, column = divmod(i, columns)
        cell = cells[row, :] if i == count - 1 and column == 0 else cells[row, column]
        axis = figure.add_subplot(cell, sharex=axes[0] if axes else None)
        axis.set_title(title, y=1.0, fontsize=10)  # With y, Matplotlib does not search a position.
        axis.tick_params(axis="x", labelbottom=row == rows - 1 or i + columns >= numbered)
        axis.grid(True, alpha=0.3)
        axes.append(axis)
    figure.supxlabel("time [s]", fontsize=10, y=(below - 0.5) / height, va="bottom")
    return figure, axes


def squares(titles: Sequence[str], labels: Sequence[str]) -> tuple[Figure, list[Axes]]:
    """Returns a figure and its square axes, in up to three columns.

    Args:
        titles: The titles of the axes.
        labels: The labels of a legend, for which space is reserved above all axes.
    """
    from drake_dae.pictures.shown import ShownFigure

    columns = min(len(titles), 3)
    rows = -(-len(titles) // columns)
    cell = _SQUARE + _LEFT + _RIGHT
    width = cell * columns
    top = _TITLE + _LINE * legend_shape(labels, width)[0] + 0.15
    height = rows * (_SQUARE + _BOTTOM) + (rows - 1) * _TITLE + top
    figure = ShownFigure(figsize=(width, height))
    axes: list[Axes] = []
    for i, title in enumerate(titles):
        row, column = divmod(i, columns)
        left = column * cell + _LEFT
        bottom = height - top - (row + 1) * _SQUARE - row * (_BOTTOM + _TITLE)
        box = (left / width, bottom / height, _SQUARE / width, _SQUARE / height)
        axis = figure.add_axes(box)
        axis.set_title(title, y=1.0, fontsize=10)
        axis.locator_params(nbins=6)
        axis.grid(True, alpha=0.3)
        axes.append(axis)
    return figure, axes


def decades(axis: Axes, floor: float) -> None:
    """Sets the range of a logarithmic axis, from a third of `floor` upward, and a few tick labels.

    The labels are plain text: Matplotlib draws its mathematical labels slower than the curves.
    """
    low, high = floor / 3.0, max(axis.get_ylim()[1], 1e4 * floor)
    axis.set_ylim(low, high)
    first, last = int(np.ceil(np.log10(low))), int(np.floor(np.log10(high)))
    powers = range(first, last + 1, max(1, -(-(last - first) // 5)))
    axis.set_yticks([10.0**k for k in powers], [f"10{str(k).translate(_RAISED)}" for k in powers])
    axis.set_yticks([], minor=True)


def short(value: float, digits: int = 3) -> str:
    """Returns a number as short text, as 4e-10."""
    mantissa, _, exponent = f"{value:.{digits}g}".partition("e")
    return f"{mantissa}e{int(exponent)}" if exponent else mantissa


def labelled(signal: Signal) -> str:
    """Returns a signal's name with its unit, as Matplotlib's text."""
    name = _plain(signal.name)
    return f"{name} [{signal.unit}]" if signal.unit else name


def _plain(text: str) -> str:
    """Returns a text in which Matplotlib does not read $ as mathematics."""
    return text.replace("$", r"\$")


def legend(figure: Figure, axis: Axes) -> None:
    """Adds one legend above all axes, with the labels of the curves in `axis`."""
    handles, labels = axis.get_legend_handles_labels()
    columns = legend_shape(labels, figure.get_figwidth())[1]
    anchor = (0.5, 1.0 - 0.05 / figure.get_figheight())
    figure.legend(
        handles,
        labels,
        loc="upper center",
        bbox_to_anchor=anchor,
        borderaxespad=0.0,
        ncols=columns,
        fontsize=9,
    )


def legend_shape(labels: Sequence[str], width: float) -> tuple[int, int]:
    """Returns the rows and columns of a legend that fits into a figure of this width, in inches."""
    if sum(_HANDLE + _LETTER * len(label) for label in labels) <= width - 0.2:
        return 1, len(labels)
    entry = _HANDLE + _LETTER * max(map(len, labels))
    columns = max(1, min(len(labels), int((width - 0.2) / entry)))
    return -(-len(labels) // columns), columns


def flatten(axis: Axes, values: FloatArray, noise: float, margin: float) -> None:
    """Sets the range of an axis so that a signal that varies less than `noise` is a flat line."""
    low, high = float(np.min(values)), float(np.max(values))
    if high - low < noise:
        axis.set_ylim((low + high) / 2 - margin, (low + high) / 2 + margin)


def round_off(values: FloatArray) -> float:
    """Returns the round-off of a signal's largest value, at least 1e-16 for a logarithmic axis."""
    return float(np.finfo(float).eps * max(np.max(np.abs(values), initial=0.0), 0.45))
