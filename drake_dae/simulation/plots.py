"""Pictures of a run."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from drake_dae.arrays import FloatArray
from drake_dae.dae.signals import Signal
from drake_dae.simulation.record import Record

if TYPE_CHECKING:  # Loaded with the first figure: most runs draw none.
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

PLOTS = ("outputs.png", "errors.png", "residual.png", "controls.png")
"""The files that `save_plots` writes."""

# Of a figure, in inches: the axes' height, what is left and right of them for the numbers of their
# scale, between rows, below the last and above the first; of a legend, a line, what stands before
# a label, and a letter of it.
_AXES, _LEFT, _RIGHT, _GAP, _BOTTOM, _TITLE = 1.4, 0.75, 0.2, 0.5, 0.55, 0.25
_LINE, _HANDLE, _LETTER = 0.2, 0.65, 0.075


def save_plots(
    record: Record, predicted: FloatArray, limits: FloatArray | None, folder: str | Path
) -> list[Path]:
    """Draws a run into PNG files: outputs, errors, constraint residual, controls.

    Args:
        record: A record with desired_output, controlled_output, constraint_residual and control.
        predicted: The tracking error by theory, shape (k, p).
        limits: The largest |u|, shape (p,), infinite or None where there is none.
        folder: The folder to write to.
    """
    figures = (
        plot_outputs(record),
        plot_errors(record, predicted),
        plot_residual(record),
        plot_controls(record, limits),
    )
    paths = [Path(folder) / name for name in PLOTS]
    for path, figure in zip(paths, figures, strict=True):
        figure.savefig(path, dpi=120)
    return paths


def plot_outputs(record: Record) -> Figure:
    """Controlled outputs, with their references dashed."""
    values = record["controlled_output"]
    desired = record["desired_output"]
    signals = record.signals["controlled_output"].signals
    figure, axes = _grid([_label(signal) for signal in signals], ("actual", "reference"))
    for i, axis in enumerate(axes):
        axis.plot(record.time, values[:, i], color="C0", label="actual")
        axis.plot(record.time, desired[:, i], color="C1", linestyle="--", label="reference")
        if np.ptp(desired[:, i]) == 0.0:
            # Held at a constant: the small error that is left is in the plot of the errors.
            scale = 1.0 + np.max(np.abs(desired[:, i]))
            _flatten(axis, np.append(values[:, i], desired[0, i]), 1e-4 * scale, 0.05 * scale)
    _legend(figure, axes[0])
    return figure


def plot_errors(record: Record, predicted: FloatArray) -> Figure:
    """|z - r| of every output on a log scale, over the error that theory predicts."""
    values = record["controlled_output"]
    errors = values - record["desired_output"]
    signals = record.signals["controlled_output"].signals
    titles = [_label(Signal(f"|error of {s.name}|", s.unit)) for s in signals]
    figure, axes = _grid(titles, ("predicted", "actual", "round-off"))
    for i, axis in enumerate(axes):
        floor = _round_off(values[:, i])
        for data, style in (
            (predicted[:, i], {"color": "C1", "linewidth": 4, "alpha": 0.5, "label": "predicted"}),
            (errors[:, i], {"color": "C0", "label": "actual"}),
        ):
            axis.semilogy(record.time, np.maximum(np.abs(data), floor), **style)
        axis.axhline(floor, color="0.5", linestyle=":", label="round-off")
        axis.set_ylim(floor / 3.0, max(axis.get_ylim()[1], 1e4 * floor))
    _legend(figure, axes[0])
    return figure


def plot_residual(record: Record) -> Figure:
    """Constraint outputs and their derivatives, as the steps leave them before projection."""
    values = np.abs(record["constraint_residual"])
    labels = [_label(signal) for signal in record.signals["constraint_residual"].signals]
    title = "|constraint residual|, before each step's projection"
    figure, (axis,) = _grid([title], (*labels, "round-off"))
    floor = _round_off(np.ones(1))
    for i, label in enumerate(labels):
        axis.semilogy(record.time, np.maximum(values[:, i], floor), label=label)
    axis.axhline(floor, color="0.5", linestyle=":", label="round-off")
    axis.set_yscale("log")
    axis.set_ylim(floor / 3.0, max(axis.get_ylim()[1], 1e4 * floor))
    _legend(figure, axis)
    return figure


def plot_controls(record: Record, limits: FloatArray | None = None) -> Figure:
    """Controls, with the actuators' limits, drawn where these are in sight."""
    values = record["control"]
    signals = record.signals["control"].signals
    bounds = np.full(len(signals), np.inf) if limits is None else limits
    figure, axes = _grid(
        [
            _label(signal) + (f", limit ±{bound:g}" if np.isfinite(bound) else "")
            for signal, bound in zip(signals, bounds, strict=True)
        ]
    )
    for i, axis in enumerate(axes):
        axis.plot(record.time, values[:, i], color="C0")
        scale = max(np.max(np.abs(values[:, i])), 1e-3)
        _flatten(axis, values[:, i], 1e-5 * scale, 0.05 * scale)
        low, high = axis.get_ylim()
        margin = 0.5 * (high - low)
        for bound in (-bounds[i], bounds[i]):
            if low - margin <= bound <= high + margin:
                axis.axhline(bound, color="C3", linestyle=":")
    return figure


def _grid(titles: Sequence[str], labels: Sequence[str] = ()) -> tuple[Figure, list[Axes]]:
    """Axes over time in two columns; a last one alone in its row fills it.

    Their places are known beforehand: a layout that measures what it draws takes longer than the
    drawing itself. Those below each other share their numbers, too.

    Args:
        titles: What stands above each of them.
        labels: The entries of a legend above all axes, for which room is left.
    """
    from matplotlib.figure import Figure

    count = len(titles)
    columns = 1 if count <= 2 else 2
    rows = -(-count // columns)
    width = 6.0 * columns
    top = _TITLE + (_LINE * _legend_shape(labels, width)[0] + 0.15 if labels else 0.1)
    height = _BOTTOM + rows * _AXES + (rows - 1) * _GAP + top
    figure = Figure(figsize=(width, height))
    cells = figure.add_gridspec(
        rows,
        columns,
        left=_LEFT / width,
        right=1.0 - _RIGHT / width,
        bottom=_BOTTOM / height,
        top=1.0 - top / height,
        wspace=(_LEFT + _RIGHT) / (width / columns - _LEFT - _RIGHT),
        hspace=_GAP / _AXES,
    )
    numbered = count - count % columns  # Above a wide one stands another scale.
    axes: list[Axes] = []
    for i, title in enumerate(titles):
        row, column = divmod(i, columns)
        place = cells[row, :] if i == count - 1 and column == 0 else cells[row, column]
        axis = figure.add_subplot(place, sharex=axes[0] if axes else None)
        axis.set_title(title, y=1.0, fontsize=10)  # With y there is no search for room.
        axis.tick_params(axis="x", labelbottom=row == rows - 1 or i + columns >= numbered)
        axis.grid(True, alpha=0.3)
        axes.append(axis)
    figure.supxlabel("time [s]", fontsize=10)
    return figure, axes


def _label(signal: Signal) -> str:
    name = signal.name.replace("$", r"\$")  # Matplotlib would read mathematics.
    return f"{name} [{signal.unit}]" if signal.unit else name


def _legend(figure: Figure, axis: Axes) -> None:
    """One legend above all axes, where it hides nothing."""
    handles, labels = axis.get_legend_handles_labels()
    columns = _legend_shape(labels, figure.get_figwidth())[1]
    place = (0.5, 1.0 - 0.05 / figure.get_figheight())
    figure.legend(
        handles,
        labels,
        loc="upper center",
        bbox_to_anchor=place,
        borderaxespad=0.0,
        ncols=columns,
        fontsize=9,
    )


def _legend_shape(labels: Sequence[str], width: float) -> tuple[int, int]:
    """Rows and columns of a legend that is no wider than a figure."""
    entry = _HANDLE + _LETTER * max(map(len, labels))
    columns = max(1, min(len(labels), int((width - 0.2) / entry)))
    return -(-len(labels) // columns), columns


def _flatten(axis: Axes, values: FloatArray, noise: float, margin: float) -> None:
    """Shows a signal that varies by less than the noise as a flat line."""
    low, high = float(np.min(values)), float(np.max(values))
    if high - low < noise:
        axis.set_ylim((low + high) / 2 - margin, (low + high) / 2 + margin)


def _round_off(values: FloatArray) -> float:
    """Where errors of a signal of this size disappear, at least 1e-16: a logarithm has no zero."""
    return float(np.finfo(float).eps * max(np.max(np.abs(values), initial=0.0), 0.45))
