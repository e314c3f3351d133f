"""Pictures of a run."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from textwrap import fill
from typing import TYPE_CHECKING

import numpy as np

from drake_dae.arrays import FloatArray
from drake_dae.dae.signals import Signal
from drake_dae.simulation.record import Record
from drake_dae.simulation.verdict import ROUND_OFF, output_sizes

if TYPE_CHECKING:  # Loaded with the first figure: most runs draw none.
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from drake_dae.simulation.course import ContactPath

PATHS = "path.png"
"""The plot of the points that move on surfaces, where there are any."""

PLOTS = ("outputs.png", "errors.png", "residual.png", "controls.png", PATHS)
"""The files that `save_plots` writes."""

HELD = 1e-4
"""An output whose reference stands still is held, and not drawn, where it is as near as this beside
its size."""

# Of a figure, in inches: the axes' height, what is left and right of them for the numbers of their
# scale, between rows, below the last and above the first; of a legend, a line, what stands before
# a label, and a letter of it.
_AXES, _LEFT, _RIGHT, _GAP, _BOTTOM, _TITLE = 1.4, 0.75, 0.2, 0.5, 0.55, 0.25
_LINE, _HANDLE, _LETTER = 0.2, 0.65, 0.075

_DPI = 110

_RAISED = str.maketrans(
    "-0123456789", "\u207b\u2070\u00b9\u00b2\u00b3\u2074\u2075\u2076\u2077\u2078\u2079"
)


def save_plots(
    record: Record,
    predicted: FloatArray,
    limits: FloatArray | None,
    folder: str | Path,
    paths: Sequence[ContactPath] = (),
    accuracy: float | None = None,
) -> list[Path]:
    """Draws a run into PNG files: outputs, errors, constraint residual, controls, paths.

    Args:
        record: A record with desired_output, controlled_output, constraint_residual and control.
        predicted: The tracking error by theory, shape (k, p).
        limits: The largest |u|, shape (p,), infinite or None where there is none.
        folder: The folder to write to.
        paths: The paths of points on surfaces; without any there is no such file.
        accuracy: The accuracy that the integrator was asked for; None with fixed steps.
    """
    figures = [
        plot_outputs(record, predicted),
        plot_errors(record, predicted, accuracy),
        plot_residual(record),
        plot_controls(record, limits),
    ]
    if paths:
        figures.append(plot_paths(paths))
    files = [Path(folder) / name for name in PLOTS[: len(figures)]]
    for file, figure in zip(files, figures, strict=True):
        figure.savefig(file, dpi=_DPI)
    return files


def plot_outputs(record: Record, predicted: FloatArray) -> Figure:
    """Controlled outputs, with their references dashed; one that is held is a line of text.

    Args:
        record: A record with controlled_output and desired_output.
        predicted: The tracking error by theory, shape (k, p).
    """
    values = record["controlled_output"]
    desired = record["desired_output"]
    signals = record.signals["controlled_output"].signals
    size = output_sizes(record, predicted)
    off = np.max(np.abs(values - desired), axis=0, initial=0.0)
    held = (np.ptp(desired, axis=0) == 0.0) & (off <= HELD * size)
    drawn = np.flatnonzero(~held)
    figure, axes = _grid(
        [_label(signals[i]) for i in drawn],
        ("actual", "reference") if len(drawn) else (),
        [
            f"{signals[i].name} = {_short(desired[0, i])} {signals[i].unit}".rstrip()
            + (f" (within {_short(off[i], 1)})" if off[i] > ROUND_OFF * size[i] else "")
            for i in np.flatnonzero(held)
        ],
        "held: ",
    )
    for axis, i in zip(axes, drawn, strict=False):
        axis.plot(record.time, values[:, i], color="C0", label="actual")
        axis.plot(record.time, desired[:, i], color="C1", linestyle="--", label="reference")
    if len(drawn):
        _legend(figure, axes[0])
    return figure


def plot_errors(record: Record, predicted: FloatArray, accuracy: float | None = None) -> Figure:
    """|z - r| of every output on a log scale, over the error that theory predicts.

    With an accuracy, what lies below it is grey: there errors are those of the integrator. An
    output that is predicted to have no error, and stays there, is a line of text.

    Args:
        record: A record with controlled_output and desired_output.
        predicted: The tracking error by theory, shape (k, p).
        accuracy: The accuracy that the integrator was asked for; None with fixed steps.
    """
    values = record["controlled_output"]
    errors = np.abs(values - record["desired_output"])
    signals = record.signals["controlled_output"].signals
    size = output_sizes(record, predicted)
    blurred = (accuracy or 0.0) * size
    largest = np.max(np.maximum(errors, np.abs(predicted)), axis=0, initial=0.0)
    drawn = np.flatnonzero((largest > blurred) | (accuracy is None))
    label = "below the integrator's accuracy" if accuracy is not None else "round-off"
    titles = [_label(Signal(f"|error of {signals[i].name}|", signals[i].unit)) for i in drawn]
    figure, axes = _grid(
        titles,
        ("predicted", "actual", label) if len(drawn) else (),
        [
            f"{signals[i].name} ("
            + (
                f"{_short(largest[i], 1)} {signals[i].unit}".rstrip()
                if largest[i] > ROUND_OFF * size[i]
                else "round-off"
            )
            + ")"
            for i in range(len(signals))
            if i not in drawn
        ],
        f"below the integrator's accuracy of {_short(accuracy or 0.0)} all the time: ",
    )
    for axis, i in zip(axes, drawn, strict=False):
        floor = _round_off(values[:, i])
        for data, style in (
            (
                np.abs(predicted[:, i]),
                {"color": "C1", "linewidth": 4, "alpha": 0.5, "label": "predicted"},
            ),
            (errors[:, i], {"color": "C0", "label": "actual"}),
        ):
            axis.semilogy(record.time, np.maximum(data, floor), **style)
        if accuracy is None:
            axis.axhline(floor, color="0.5", linestyle=":", label=label)
        else:
            axis.axhspan(floor / 3.0, blurred[i], color="0.88", zorder=0.5, label=label)
        _decades(axis, floor)
    if len(drawn):
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
    _decades(axis, floor)
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


def plot_paths(paths: Sequence[ContactPath]) -> Figure:
    """The paths of points on their surfaces, over those that the references want."""
    from matplotlib.figure import Figure

    columns = min(len(paths), 3)
    rows = -(-len(paths) // columns)
    labels = ("desired", "actual", "start")
    width, side = 4.5 * columns, 3.6
    top = _TITLE + _LINE * _legend_shape(labels, width)[0] + 0.15
    height = rows * (side + _BOTTOM) + (rows - 1) * _TITLE + top
    figure = Figure(figsize=(width, height))
    for number, path in enumerate(paths):
        row, column = divmod(number, columns)
        left = column * 4.5 + _LEFT
        bottom = height - top - (row + 1) * side - row * (_BOTTOM + _TITLE)
        box = (left / width, bottom / height, side / width, side / height)
        axis = figure.add_axes(box)
        for points, style in (
            (path.desired, {"color": "C1", "linewidth": 4, "alpha": 0.5, "label": "desired"}),
            (path.actual, {"color": "C0", "label": "actual"}),
            (path.actual[:1], {"color": "C0", "marker": "o", "linestyle": "", "label": "start"}),
        ):
            axis.plot(*points.T, **style)
        # A metre is as long in both directions, also where the path is a line.
        both = np.vstack([path.actual, path.desired])
        middle = (np.min(both, axis=0) + np.max(both, axis=0)) / 2.0
        half = 0.55 * float(np.max(np.ptp(both, axis=0))) or 1e-3
        axis.set_xlim(middle[0] - half, middle[0] + half)
        axis.set_ylim(middle[1] - half, middle[1] + half)
        axis.set_title(f"path on {_label(Signal(path.name))}", y=1.0, fontsize=10)
        axis.set_xlabel("along the surface [m]", fontsize=10)
        axis.set_ylabel("across [m]", fontsize=10)
        axis.locator_params(nbins=6)
        axis.grid(True, alpha=0.3)
    _legend(figure, figure.axes[0])
    return figure


def _grid(
    titles: Sequence[str],
    labels: Sequence[str] = (),
    notes: Sequence[str] = (),
    noted: str = "",
) -> tuple[Figure, list[Axes]]:
    """Axes over time in two columns; a last one alone in its row fills it.

    Their places are known beforehand: a layout that measures what it draws takes longer than the
    drawing itself. Those below each other share their numbers, too.

    Args:
        titles: What stands above each of them.
        labels: The entries of a legend above all axes, for which room is left.
        notes: What stands in words below all axes.
        noted: What stands before the notes.
    """
    from matplotlib.figure import Figure

    count = len(titles)
    columns = 1 if count <= 2 else 2
    rows = -(-count // columns)
    width = 6.0 * columns if count or not notes else 12.0
    top = _TITLE + (_LINE * _legend_shape(labels, width)[0] + 0.15 if labels else 0.1)
    # An entry is not broken at the end of a line.
    entries = ", ".join(note.replace(" ", "\u00a0") for note in notes)
    text = fill(noted + entries, int(width / _LETTER) - 6) if notes else ""
    below = (_BOTTOM if count else 0.1) + _LINE * len(text.splitlines())
    height = below + rows * _AXES + max(rows - 1, 0) * _GAP + top
    figure = Figure(figsize=(width, height))
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
    figure.supxlabel("time [s]", fontsize=10, y=(below - 0.5) / height, va="bottom")
    return figure, axes


def _decades(axis: Axes, floor: float) -> None:
    """Scales a logarithmic axis from the floor up, with few numbers.

    They are plain text: Matplotlib's own ones are mathematics, which takes longer than the curves.
    """
    low, high = floor / 3.0, max(axis.get_ylim()[1], 1e4 * floor)
    axis.set_ylim(low, high)
    first, last = int(np.ceil(np.log10(low))), int(np.floor(np.log10(high)))
    powers = range(first, last + 1, max(1, -(-(last - first) // 5)))
    axis.set_yticks([10.0**k for k in powers], [f"10{str(k).translate(_RAISED)}" for k in powers])
    axis.set_yticks([], minor=True)


def _short(value: float, digits: int = 3) -> str:
    """A number for a line of text, as 4e-10."""
    mantissa, _, exponent = f"{value:.{digits}g}".partition("e")
    return f"{mantissa}e{int(exponent)}" if exponent else mantissa


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
    if sum(_HANDLE + _LETTER * len(label) for label in labels) <= width - 0.2:
        return 1, len(labels)
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
