"""Plots of a run."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from drake_dae.arrays import FloatArray
from drake_dae.dae import Signal
from drake_dae.diagrams.record import Record
from drake_dae.pictures.axes import (
    decades,
    flatten,
    grid,
    labelled,
    legend,
    round_off,
    short,
    squares,
)
from drake_dae.pictures.event_marks import mark_events, mark_labels, mark_phases
from drake_dae.pictures.moments import RunEvent
from drake_dae.running.judgement import ROUND_OFF, output_sizes

if TYPE_CHECKING:  # Loaded with the first figure: most runs draw none.
    from matplotlib.figure import Figure

    from drake_dae.pictures.run_motion import ContactPath

PATHS = "path.png"
"""The plot of contact points that move on surfaces; omitted if there are none."""

PLOTS = ("outputs.png", "errors.png", "residual.png", "controls.png", PATHS)
"""The files that `save_plots` writes."""

HELD = 1e-4
"""An output with a constant reference is listed as held instead of drawn, if its error relative to
its size is at most this."""

_DPI = 110


def save_plots(
    record: Record,
    predicted: FloatArray,
    limits: FloatArray | None,
    folder: str | Path,
    paths: Sequence[ContactPath] = (),
    accuracy: float | None = None,
    events: Sequence[RunEvent] = (),
) -> list[Path]:
    """Writes the plots of a run as PNG files: outputs, errors, residual, controls, paths.

    Args:
        record: A record with desired_output, controlled_output, constraint_residual and control.
        predicted: The predicted tracking error, shape (k, p).
        limits: The largest |u|, shape (p,), inf for an actuator without a limit; None without any.
        folder: The folder to write to.
        paths: The paths of contact points on surfaces; if empty, no such plot is written.
        accuracy: The accuracy of the integrator; None with fixed steps.
        events: The events of the run, marked on the time axes.

    Returns:
        The files.
    """
    figures = [
        plot_outputs(record, predicted, events),
        plot_errors(record, predicted, accuracy, events),
        plot_residual(record, events),
        plot_controls(record, limits, events),
    ]
    for figure in figures:
        mark_phases(figure, record)
    if paths:
        figures.append(plot_paths(paths))
    files = [Path(folder) / name for name in PLOTS[: len(figures)]]
    for file, figure in zip(files, figures, strict=True):
        figure.savefig(file, dpi=_DPI)
    return files


def plot_outputs(record: Record, predicted: FloatArray, events: Sequence[RunEvent] = ()) -> Figure:
    """Plots the controlled outputs, with dashed references; lists held outputs below as text.

    Args:
        record: A record with controlled_output and desired_output.
        predicted: The predicted tracking error, shape (k, p).
        events: The events of the run.
    """
    values = record["controlled_output"]
    desired = record["desired_output"]
    signals = record.signals["controlled_output"].signals
    size = output_sizes(record, predicted)
    error = np.max(np.abs(values - desired), axis=0, initial=0.0)
    is_held = (np.ptp(desired, axis=0) == 0.0) & (error <= HELD * size)
    drawn = np.flatnonzero(~is_held)
    figure, axes = grid(
        [labelled(signals[i]) for i in drawn],
        ("actual", "reference", *mark_labels(events)) if len(drawn) else (),
        [
            f"{signals[i].name} = {short(desired[0, i])} {signals[i].unit}".rstrip()
            + (f" (within {short(error[i], 1)})" if error[i] > ROUND_OFF * size[i] else "")
            for i in np.flatnonzero(is_held)
        ],
        "held: ",
    )
    for axis, i in zip(axes, drawn, strict=False):
        axis.plot(record.time, values[:, i], color="C0", label="actual")
        axis.plot(record.time, desired[:, i], color="C1", linestyle="--", label="reference")
    mark_events(axes, events)
    if len(drawn):
        legend(figure, axes[0])
    return figure


def plot_errors(
    record: Record,
    predicted: FloatArray,
    accuracy: float | None = None,
    events: Sequence[RunEvent] = (),
) -> Figure:
    """Plots |z - r| of each output on a log scale, over the predicted error.

    Errors below the integrator's accuracy are in a grey region. An output whose predicted and
    actual errors are below it all the time is listed below as text.

    Args:
        record: A record with controlled_output and desired_output.
        predicted: The predicted tracking error, shape (k, p).
        accuracy: The accuracy of the integrator; None with fixed steps.
        events: The events of the run.
    """
    values = record["controlled_output"]
    errors = np.abs(values - record["desired_output"])
    signals = record.signals["controlled_output"].signals
    size = output_sizes(record, predicted)
    accurate_to = (accuracy or 0.0) * size
    largest = np.max(np.maximum(errors, np.abs(predicted)), axis=0, initial=0.0)
    drawn = np.flatnonzero((largest > accurate_to) | (accuracy is None))
    label = "below the integrator's accuracy" if accuracy is not None else "round-off"
    titles = [labelled(Signal(f"|error of {signals[i].name}|", signals[i].unit)) for i in drawn]
    figure, axes = grid(
        titles,
        ("predicted", "actual", label, *mark_labels(events)) if len(drawn) else (),
        [
            f"{signals[i].name} ("
            + (
                f"{short(largest[i], 1)} {signals[i].unit}".rstrip()
                if largest[i] > ROUND_OFF * size[i]
                else "round-off"
            )
            + ")"
            for i in range(len(signals))
            if i not in drawn
        ],
        f"below the integrator's accuracy of {short(accuracy or 0.0)} all the time: ",
    )
    for axis, i in zip(axes, drawn, strict=False):
        floor = round_off(values[:, i])
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
            axis.axhspan(floor / 3.0, accurate_to[i], color="0.88", zorder=0.5, label=label)
        decades(axis, floor)
    mark_events(axes, events)
    if len(drawn):
        legend(figure, axes[0])
    return figure


def plot_residual(record: Record, events: Sequence[RunEvent] = ()) -> Figure:
    """Plots the constraint functions and their derivatives after each step, before projection."""
    values = np.abs(record["constraint_residual"])
    labels = [labelled(signal) for signal in record.signals["constraint_residual"].signals]
    title = "|constraint residual|, before each step's projection"
    figure, (axis,) = grid([title], (*labels, "round-off", *mark_labels(events)))
    floor = round_off(np.ones(1))
    for i, label in enumerate(labels):
        axis.semilogy(record.time, np.maximum(values[:, i], floor), label=label)
    axis.axhline(floor, color="0.5", linestyle=":", label="round-off")
    axis.set_yscale("log")
    decades(axis, floor)
    mark_events([axis], events)
    legend(figure, axis)
    return figure


def plot_controls(
    record: Record, limits: FloatArray | None = None, events: Sequence[RunEvent] = ()
) -> Figure:
    """Plots the controls, with those limits of the actuators that are near the values."""
    values = record["control"]
    signals = record.signals["control"].signals
    bounds = np.full(len(signals), np.inf) if limits is None else limits
    figure, axes = grid(
        [
            labelled(signal) + (f", limit ±{bound:g}" if np.isfinite(bound) else "")
            for signal, bound in zip(signals, bounds, strict=True)
        ],
        marks := mark_labels(events),
    )
    mark_events(axes, events)
    if axes and marks:
        legend(figure, axes[0])
    for i, axis in enumerate(axes):
        axis.plot(record.time, values[:, i], color="C0")
        scale = max(np.max(np.abs(values[:, i])), 1e-3)
        flatten(axis, values[:, i], 1e-5 * scale, 0.05 * scale)
        low, high = axis.get_ylim()
        margin = 0.5 * (high - low)
        for bound in (-bounds[i], bounds[i]):
            if low - margin <= bound <= high + margin:
                axis.axhline(bound, color="C3", linestyle=":")
    return figure


def plot_paths(paths: Sequence[ContactPath]) -> Figure:
    """Plots the actual over the desired paths of points on surfaces, seen from the free side."""
    figure, axes = squares(
        [f"path on {labelled(Signal(path.name))}" for path in paths], ("desired", "actual", "start")
    )
    for axis, path in zip(axes, paths, strict=True):
        for points, style in (
            (path.desired, {"color": "C1", "linewidth": 4, "alpha": 0.5, "label": "desired"}),
            (path.actual, {"color": "C0", "label": "actual"}),
            (path.actual[:1], {"color": "C0", "marker": "o", "linestyle": "", "label": "start"}),
        ):
            axis.plot(*points.T, **style)
        # Both directions have the same scale, also if the path is a line.
        both = np.vstack([path.actual, path.desired])
        middle = (np.min(both, axis=0) + np.max(both, axis=0)) / 2.0
        half = 0.55 * float(np.max(np.ptp(both, axis=0))) or 1e-3
        right = -half if path.points_left else half
        axis.set_xlim(middle[0] - right, middle[0] + right)
        axis.set_ylim(middle[1] - half, middle[1] + half)
        axis.set_xlabel("along the surface [m]", fontsize=10)
        axis.set_ylabel("across [m]", fontsize=10)
    legend(figure, axes[0])
    return figure
