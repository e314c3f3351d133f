"""Pictures of a run."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from drake_dae.arrays import FloatArray
from drake_dae.dae.signals import Signal
from drake_dae.simulation.record import Record

PLOTS = ("outputs.png", "errors.png", "residual.png", "controls.png")
"""The files that `save_plots` writes."""


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
    figure, axes = _grid([_label(signal) for signal in signals])
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
    figure, axes = _grid([_label(Signal(f"|error of {s.name}|", s.unit)) for s in signals])
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
    figure, (axis,) = _grid(["|constraint residual|, before each step's projection"])
    floor = _round_off(np.ones(1))
    for i, signal in enumerate(record.signals["constraint_residual"].signals):
        axis.semilogy(record.time, np.maximum(values[:, i], floor), label=_label(signal))
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


def _grid(titles: Sequence[str]) -> tuple[Figure, list[Axes]]:
    """Axes over time in two columns; a last one alone in its row fills it."""
    count = len(titles)
    columns = 1 if count <= 2 else 2
    rows = -(-count // columns)
    figure = Figure(figsize=(6.0 * columns, 1.2 + 1.9 * rows), layout="constrained")
    cells = figure.add_gridspec(rows, columns)
    axes: list[Axes] = []
    for i, title in enumerate(titles):
        row, column = divmod(i, columns)
        place = cells[row, :] if i == count - 1 and column == 0 else cells[row, column]
        axis = figure.add_subplot(place, sharex=axes[0] if axes else None)
        axis.set_title(title, fontsize=10)
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
    figure.legend(handles, labels, loc="outside upper center", ncols=len(labels), fontsize=9)


def _flatten(axis: Axes, values: FloatArray, noise: float, margin: float) -> None:
    """Shows a signal that varies by less than the noise as a flat line."""
    low, high = float(np.min(values)), float(np.max(values))
    if high - low < noise:
        axis.set_ylim((low + high) / 2 - margin, (low + high) / 2 + margin)


def _round_off(values: FloatArray) -> float:
    """Where errors of a signal of this size disappear, at least 1e-16: a logarithm has no zero."""
    return float(np.finfo(float).eps * max(np.max(np.abs(values), initial=0.0), 0.45))
