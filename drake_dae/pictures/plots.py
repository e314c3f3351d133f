"""Plots of one run, and of signals of several runs over each other."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patheffects import withStroke
from pydrake.systems.framework import Context

from drake_dae.arguments import checked
from drake_dae.arrays import FloatArray, unknown_name
from drake_dae.dae import Signal
from drake_dae.diagrams.closed_loop import ClosedLoop
from drake_dae.diagrams.record import Record, Recorded, phase_spans
from drake_dae.errors import ModelError
from drake_dae.pictures.motion import ContactPath, contact_paths, follow

# The signals in which an entry's name is looked up first; of these the first has the outputs.
_FIRST = ("controlled_output", "constraint_force", "control", "state")
# Signals whose entries have the names of the outputs, and are drawn with these.
_DERIVED = ("desired_output", "tracking_error", "predicted_error")
_PHASE = 0.11  # The width of a phase's name, which is vertical, in inches.
# The style of predicted errors and desired paths, below the narrow actual ones.
_WIDE: dict[str, Any] = {"linewidth": 4, "alpha": 0.4}

Entry = tuple[str, int]  # The name of a record's signal, and the index of an entry in it.


class ShownFigure(Figure):
    """A figure that a notebook displays, with or without Matplotlib's inline mode."""

    def _repr_png_(self) -> bytes:
        file = BytesIO()
        self.savefig(file, format="png", dpi=110)
        return file.getvalue()


@checked(ModelError)
def plot_runs(
    records: Mapping[str, Record], names: Sequence[str] = (), errors: bool = False
) -> Figure:
    """Plots signals of several runs over each other, outputs with dashed references.

    A notebook displays the figure; its `savefig` writes a file. If there is only one run, the
    phases of its task are marked.

    Args:
        records: Label of a run -> its record.
        names: The names of signals of the records, as "control", or of single entries, as
            "wall.force". If several signals have an entry with the same name, write the signal
            before it, as "state/joint1". All outputs are drawn if there are no names.
        errors: Whether to draw |z - r| of outputs on a log scale, over the predicted error.

    Raises:
        ModelError: There is no run, a run has no such signal, or `errors` is set for a signal that
            is not an output.
    """
    if not records:
        raise ModelError("there is no run to draw")
    first = next(iter(records.values()))
    names = names or _FIRST[:1]
    entries = [entry for name in names for entry in _entries(first, name)]
    if not entries:
        raise ModelError(f"there is nothing to draw: '{', '.join(names)}' is empty")
    for group, index in entries:
        signal = first.signals[group].signals[index]
        if errors and group != _FIRST[0]:
            raise ModelError(f"an error is that of an output, and {signal.name} is none")
        for label, record in records.items():
            if group not in record.signals or signal not in record.signals[group].signals:
                unit = signal.unit or "1"
                raise ModelError(f"the run '{label}' has no {group} '{signal.name}' in {unit}")
    return _draw(records, entries, errors)


def save_plots(loop: ClosedLoop, record: Record, context: Context, folder: Path) -> None:
    """Writes the plots of a run of a loop of a robot as PNG files, `PLOTS`."""
    motion, predicted = follow(loop, record, context), loop.predicted_error(record)
    figures = figures_of_run(record, predicted, motion.model.control_limits)
    if paths := contact_paths(motion):
        figures["path.png"] = plot_paths(paths)
    folder.mkdir(parents=True, exist_ok=True)
    for name, figure in figures.items():
        figure.savefig(folder / name, dpi=110)


def figures_of_run(
    record: Record, predicted: FloatArray, limits: FloatArray | None = None
) -> dict[str, Figure]:
    """Name of a file -> its figure: outputs, errors, residual and controls of one run.

    `limits` are the largest |u|, shape (p,), inf for an actuator without one.
    """
    outputs = record.signals["controlled_output"].signals
    signals = {**record.signals, "predicted_error": Recorded(predicted, outputs)}
    run, figures = {"actual": replace(record, signals=signals)}, {}
    if entries := _entries(record, "controlled_output"):
        figures["outputs.png"] = _draw(run, entries, False)
        figures["errors.png"] = _draw(run, entries, True)
    figures["residual.png"] = _plot_residual(record)
    if entries := _entries(record, "control"):
        figures["controls.png"] = _draw(run, entries, False, limits)
    return figures


def _plot_residual(record: Record) -> Figure:
    """Plots the constraint functions and their derivatives after each step, before projection."""
    residual = record.signals["constraint_residual"]
    figure, (axis,) = _figure(["|constraint residual| after each step"])
    floor = round_off(np.ones(1))
    for signal, values in zip(residual.signals, residual.values.T, strict=True):
        values = np.maximum(np.abs(values), floor)
        axis.semilogy(record.time, values, label=_labelled(signal))
    axis.axhline(floor, color="0.5", linestyle=":", label="round-off")
    axis.set_yscale("log")
    _set_decades(axis, floor)
    _mark(figure, record)
    _add_legend(figure)
    return figure


def plot_paths(paths: Sequence[ContactPath]) -> Figure:
    """Plots the actual over the desired paths of points on surfaces, seen from the free side."""
    titles = [f"path on {_plain(path.name)}" for path in paths]
    figure, axes = _figure(titles, square=True)
    for axis, path in zip(axes, paths, strict=True):
        axis.plot(*path.desired.T, color="C1", label="desired", **_WIDE)
        axis.plot(*path.actual.T, color="C0", label="actual")
        axis.plot(*path.actual[:1].T, color="C0", marker="o", linestyle="", label="start")
        # Both directions have the same scale, also if the path is a line.
        both = np.vstack([path.actual, path.desired])
        middle = (np.min(both, axis=0) + np.max(both, axis=0)) / 2.0
        half = 0.55 * float(np.max(np.ptp(both, axis=0))) or 1e-3
        right = -half if path.points_left else half
        axis.set_xlim(middle[0] - right, middle[0] + right)
        axis.set_ylim(middle[1] - half, middle[1] + half)
        axis.set_box_aspect(1.0)
        axis.locator_params(nbins=6)
        axis.set_xlabel("along the surface [m]", fontsize=10)
        axis.set_ylabel("across [m]", fontsize=10)
    _add_legend(figure)
    return figure


def _entries(record: Record, name: str) -> list[Entry]:
    """The entries that a name refers to: all entries of a signal, or a single entry."""
    groups = {key: [s.name for s in recorded.signals] for key, recorded in record.signals.items()}
    if name in groups:
        return [(name, index) for index in range(len(groups[name]))]
    group, slash, entry = name.partition("/")
    if slash and group in groups:
        if entry not in groups[group]:
            raise ModelError(unknown_name(f"entry of {group}", entry, groups[group]))
        return [(group, groups[group].index(entry))]
    order = [*_FIRST, *(key for key in groups if key not in (*_FIRST, *_DERIVED))]
    for group in order:
        if name in groups.get(group, ()):
            return [(group, groups[group].index(name))]
    known = [*groups, *(entry for group in order for entry in groups.get(group, ()))]
    raise ModelError(unknown_name("signal", name, list(dict.fromkeys(known))))


def _draw(
    records: Mapping[str, Record],
    entries: Sequence[Entry],
    errors: bool,
    limits: FloatArray | None = None,
) -> Figure:
    """Entries of signals over time, one axes each: their values, or errors over predicted ones."""
    first = next(iter(records.values()))
    signals = [first.signals[group].signals[index] for group, index in entries]
    titles = [_labelled(signal, "|error of {}|" if errors else "{}") for signal in signals]
    if limits is not None:
        bounds = [f", limit ±{most:g}" if np.isfinite(most) else "" for most in limits]
        titles = [title + bound for title, bound in zip(titles, bounds, strict=True)]
    figure, axes = _figure(titles)
    own_color = "C1" if len(records) == 1 else None
    for axis, (group, at), signal in zip(axes, entries, signals, strict=True):
        drawn, floors = list[FloatArray](), list[float]()
        for number, (label, record) in enumerate(records.items()):
            index, color = record.signals[group].signals.index(signal), f"C{number % 10}"
            drawn.append(values := record[group][:, index])
            floors.append(floor := round_off(values))
            desired, predicted = (
                record[name][:, index] if group == _FIRST[0] and name in record.signals else None
                for name in ("desired_output", "predicted_error")
            )
            if errors and predicted is not None:
                wide = {"color": own_color or color, **_WIDE}
                axis.semilogy(record.time, np.maximum(np.abs(predicted), floor), **wide)
            if errors and desired is not None:
                error = np.maximum(np.abs(values - desired), floor)
                axis.semilogy(record.time, error, color=color, label=label)
                continue
            axis.plot(record.time, values, color=color, label=label)
            if desired is not None:
                drawn.append(desired)
                axis.plot(record.time, desired, color=own_color or color, linestyle="--", alpha=0.7)
        style: dict[str, Any] = {"color": own_color or "0.5"}
        if errors:
            axis.plot([], [], label="predicted", **style, **_WIDE)
            _set_decades(axis, min(floors))
            continue
        if group == _FIRST[0]:
            axis.plot([], [], label="reference", linestyle="--", **style)
        _flatten(axis, np.concatenate(drawn))
        if limits is not None:
            low, high = axis.get_ylim()
            for bound in (-limits[at], limits[at]):
                if low - 0.5 * (high - low) <= bound <= high + 0.5 * (high - low):
                    axis.axhline(bound, color="C3", linestyle=":")
    if len(records) == 1:
        _mark(figure, first)
    _add_legend(figure)
    return figure


def _figure(titles: Sequence[str], square: bool = False) -> tuple[Figure, list[Axes]]:
    """A figure, with axes that have a common time unless square."""
    columns = min(len(titles), 3) if square else 1 if len(titles) <= 2 else 2
    rows, (wide, high) = -(-len(titles) // columns), (4.65, 4.4) if square else (6.0, 2.2)
    size = max(columns * wide, 6.0), rows * high + 0.4
    figure, axes = ShownFigure(figsize=size, layout="constrained"), list[Axes]()
    for i, title in enumerate(titles):
        shared = axes[0] if axes and not square else None
        axis = figure.add_subplot(rows, columns, i + 1, sharex=shared)
        axis.set_title(title, fontsize=10)
        axis.grid(True, alpha=0.3)
        if not square and i + columns >= len(titles):
            axis.set_xlabel("time [s]", fontsize=10)
        axes.append(axis)
    return figure, axes


def _add_legend(figure: Figure) -> None:
    """Adds one legend above all axes, with the labels of the curves in the first."""
    handles, labels = figure.axes[0].get_legend_handles_labels()
    columns = max(1, int(figure.get_figwidth() / (0.7 + 0.08 * max(map(len, labels)))))
    figure.legend(handles, labels, ncols=columns, fontsize=9, loc="outside upper center")


def _mark(figure: Figure, record: Record) -> None:
    """Shades every second phase of a task on all axes of time, and writes the phases' names."""
    spans = phase_spans(record)
    for axis in figure.axes:
        axis.margins(x=0.01)
        below = axis.get_xaxis_transform()
        width = axis.get_position().width * figure.get_figwidth()
        # The names of short phases are moved to the right, so that they do not overlap.
        apart = _PHASE / width * float(record.time[-1] - record.time[0]) if spans else 0.0
        time = -float("inf")
        for number, span in enumerate(spans):
            if number % 2:
                axis.axvspan(span.begin, span.end, color="C0", alpha=0.06, linewidth=0, zorder=0.3)
            time = max(span.begin, time + apart)
            halo = [withStroke(linewidth=2.0, foreground="white")]
            small: dict[str, Any] = {"fontsize": 6, "color": "0.45", "path_effects": halo}
            look = {"rotation": 90, "va": "top", "zorder": 0.7, **small}  # Below the curves.
            axis.text(time, 0.97, f" {span.name}", transform=below, **look)


def _set_decades(axis: Axes, floor: float) -> None:
    """Sets the range of a logarithmic axis, from a third of `floor` upward, with plain labels."""
    axis.set_ylim(floor / 3.0, max(axis.get_ylim()[1], 1e4 * floor))
    axis.yaxis.set_major_formatter("{x:.0e}")
    axis.minorticks_off()


def _flatten(axis: Axes, values: FloatArray) -> None:
    """Sets the range of an axis so that what does not vary is a flat line, and no noise."""
    low, high = float(np.min(values)), float(np.max(values))
    scale = max(abs(low), abs(high), 1e-3)
    if high - low < 1e-4 * scale:
        axis.set_ylim((low + high) / 2 - 0.05 * scale, (low + high) / 2 + 0.05 * scale)


def _labelled(signal: Signal, form: str = "{}") -> str:
    """A signal's name with its unit, as Matplotlib's text."""
    name = form.format(_plain(signal.name))
    return f"{name} [{signal.unit}]" if signal.unit else name


def _plain(text: str) -> str:
    """A text in which Matplotlib does not read $ as mathematics."""
    return text.replace("$", r"\$")


def round_off(values: FloatArray) -> float:
    """The round-off of a signal's largest value, at least 1e-16 for a logarithmic axis."""
    return float(np.finfo(float).eps * max(np.max(np.abs(values), initial=0.0), 0.45))
