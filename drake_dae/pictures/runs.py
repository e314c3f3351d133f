"""Signals of runs, drawn over each other."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from drake_dae.arguments import checked
from drake_dae.arrays import FloatArray, unknown_name
from drake_dae.dae.system.signals import Signal
from drake_dae.errors import ModelError
from drake_dae.pictures.axes import decades, grid, labelled, legend, round_off
from drake_dae.pictures.event_marks import mark_events, mark_labels, mark_phases
from drake_dae.pictures.moments import moments_of
from drake_dae.simulation.records.record import Record

if TYPE_CHECKING:  # Loaded with the first figure.
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
else:
    Figure = Any  # `checked` reads all annotations.

_FIRST = ("controlled_output", "constraint_force", "control", "state")
"""Where a name is looked up first."""

_DERIVED = ("desired_output", "tracking_error", "predicted_error")
"""Signals whose entries are named as the outputs, and are drawn with these."""


@dataclass(frozen=True)
class _Course:
    """An entry of a signal of a record.

    Attributes:
        signal: Its name and unit.
        group: The name of the signal that has it.
        place: Its index there.
    """

    signal: Signal
    group: str
    place: int


@checked(ModelError)
def plot_runs(
    records: Mapping[str, Record], names: Sequence[str] = (), errors: bool = False
) -> Figure:
    """Draws signals of runs over each other, outputs with their references dashed.

    A notebook shows the figure; its `savefig` writes it into a file. With one run its phases and
    what happens to its contacts are marked.

    Args:
        records: Label of a run -> its record.
        names: What to draw: a signal of the records, as "control", or an entry of one, as
            "wall.force" or "state/joint1", where several signals have one of that name; all outputs
            if there are none.
        errors: Whether to draw |z - r| of outputs on a log scale, over the predicted error.

    Raises:
        ModelError: There is no run, a run has no such signal, or an error is asked of something
            that is no output.
    """
    if not records:
        raise ModelError("there is no run to draw")
    first, *others = records.values()
    chosen = [one for name in names or _FIRST[:1] for one in _courses(first, name)]
    if not chosen:
        raise ModelError(f"there is nothing to draw: '{', '.join(names or _FIRST[:1])}' is empty")
    for course in chosen:
        if errors and course.group != _FIRST[0]:
            raise ModelError(f"an error is that of an output, and {course.signal.name} is none")
        for label, record in zip(list(records)[1:], others, strict=True):
            if course.signal not in _signals(record, course.group):
                text = f"the run '{label}' has no {course.group} '{course.signal.name}'"
                raise ModelError(f"{text} in {course.signal.unit or '1'}")
    single = first if not others else None
    moments = [] if single is None else moments_of(single)
    marks = () if single is None else mark_labels(single, moments)
    figure, axes = grid(
        [
            labelled(Signal(f"|error of {one.signal.name}|", one.signal.unit))
            if errors
            else labelled(one.signal)
            for one in chosen
        ],
        (*records, "predicted" if errors else "reference", *marks),
    )
    draw = _draw_errors if errors else _draw_signals
    for axis, course in zip(axes, chosen, strict=True):
        draw(axis, records, course)
    if single is not None:
        mark_events(axes, single, moments)
        mark_phases(figure, single)
    legend(figure, axes[0])
    return figure


def _draw_signals(axis: Axes, records: Mapping[str, Record], course: _Course) -> None:
    """An entry of each run; of outputs with its reference."""
    for number, (label, record) in enumerate(records.items()):
        place, color = _signals(record, course.group).index(course.signal), f"C{number % 10}"
        axis.plot(record.time, record[course.group][:, place], color=color, label=label)
        desired = _entry(record, "desired_output", place)
        if course.group == _FIRST[0] and desired is not None:
            axis.plot(record.time, desired, color=color, linestyle="--", alpha=0.6)
    axis.plot([], [], color="0.5", label="reference", linestyle="--")


def _draw_errors(axis: Axes, records: Mapping[str, Record], course: _Course) -> None:
    """|z - r| of an output in each run, over the predicted one."""
    wide: dict[str, Any] = {"linewidth": 4, "alpha": 0.35}
    floors = []
    for number, (label, record) in enumerate(records.items()):
        place, color = _signals(record, course.group).index(course.signal), f"C{number % 10}"
        values = record[course.group][:, place]
        floors.append(floor := round_off(values))
        predicted = _entry(record, "predicted_error", place)
        if predicted is not None:
            axis.semilogy(record.time, np.maximum(np.abs(predicted), floor), color=color, **wide)
        error = np.abs(values - record["desired_output"][:, place])
        axis.semilogy(record.time, np.maximum(error, floor), color=color, label=label)
    decades(axis, min(floors))
    axis.plot([], [], color="0.5", label="predicted", **wide)


def _courses(record: Record, name: str) -> list[_Course]:
    """The entries with a name; several for the name of a signal."""
    signals = {key: each.signals for key, each in record.signals.items()}
    if name in signals:
        return [_Course(one, name, place) for place, one in enumerate(signals[name])]
    group, slash, entry = name.partition("/")
    if slash and group in signals:
        named = [one.name for one in signals[group]]
        if entry not in named:
            raise ModelError(unknown_name(f"entry of {group}", entry, named))
        place = named.index(entry)
        return [_Course(signals[group][place], group, place)]
    order = [*_FIRST, *(key for key in signals if key not in (*_FIRST, *_DERIVED))]
    for key in order:
        for place, one in enumerate(signals.get(key, ())):
            if one.name == name:
                return [_Course(one, key, place)]
    known = [one.name for key in order for one in signals.get(key, ())]
    raise ModelError(unknown_name("signal", name, list(dict.fromkeys([*signals, *known]))))


def _signals(record: Record, group: str) -> Sequence[Signal]:
    return record.signals[group].signals if group in record.signals else ()


def _entry(record: Record, name: str, place: int) -> FloatArray | None:
    """A column of a signal that a record may not have."""
    return record[name][:, place] if name in record.signals else None
