"""Plots that compare the signals of several runs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from drake_dae.arguments import checked
from drake_dae.arrays import FloatArray, unknown_name
from drake_dae.dae import Signal
from drake_dae.diagrams.record import Record
from drake_dae.errors import ModelError
from drake_dae.pictures.axes import decades, grid, labelled, legend, round_off
from drake_dae.pictures.event_marks import mark_events, mark_labels, mark_phases
from drake_dae.pictures.moments import events_of

if TYPE_CHECKING:  # Loaded with the first figure.
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
else:
    Figure = Any  # `checked` reads all annotations.

_FIRST = ("controlled_output", "constraint_force", "control", "state")
"""The signals in which an entry's name is looked up first; of these the first has the outputs."""

_DERIVED = ("desired_output", "tracking_error", "predicted_error")
"""Signals whose entries have the names of the outputs, and are drawn with these."""


@dataclass(frozen=True)
class _Course:
    """One entry of a signal of a record.

    Attributes:
        signal: Its name and unit.
        group: The name of the record's signal.
        index: Its index in this signal.
    """

    signal: Signal
    group: str
    index: int


@checked(ModelError)
def plot_runs(
    records: Mapping[str, Record], names: Sequence[str] = (), errors: bool = False
) -> Figure:
    """Plots signals of several runs over each other, outputs with dashed references.

    A notebook displays the figure; its `savefig` writes a file. If there is only one run, its
    phases and contact events are marked.

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
    first, *others = records.values()
    courses = [course for name in names or _FIRST[:1] for course in _courses(first, name)]
    if not courses:
        raise ModelError(f"there is nothing to draw: '{', '.join(names or _FIRST[:1])}' is empty")
    for course in courses:
        if errors and course.group != _FIRST[0]:
            raise ModelError(f"an error is that of an output, and {course.signal.name} is none")
        for label, record in zip(list(records)[1:], others, strict=True):
            if course.signal not in _signals(record, course.group):
                text = f"the run '{label}' has no {course.group} '{course.signal.name}'"
                raise ModelError(f"{text} in {course.signal.unit or '1'}")
    events = [] if others else events_of(first)
    marks = () if others else mark_labels(events)
    figure, axes = grid(
        [
            labelled(Signal(f"|error of {course.signal.name}|", course.signal.unit))
            if errors
            else labelled(course.signal)
            for course in courses
        ],
        (*records, "predicted" if errors else "reference", *marks),
    )
    draw = _draw_errors if errors else _draw_signals
    for axis, course in zip(axes, courses, strict=True):
        draw(axis, records, course)
    if not others:
        mark_events(axes, events)
        mark_phases(figure, first)
    legend(figure, axes[0])
    return figure


def _draw_signals(axis: Axes, records: Mapping[str, Record], course: _Course) -> None:
    """Draws one entry of a signal for each run; for outputs also the reference."""
    for number, (label, record) in enumerate(records.items()):
        index, color = _signals(record, course.group).index(course.signal), f"C{number % 10}"
        axis.plot(record.time, record[course.group][:, index], color=color, label=label)
        desired = _entry(record, "desired_output", index)
        if course.group == _FIRST[0] and desired is not None:
            axis.plot(record.time, desired, color=color, linestyle="--", alpha=0.6)
    axis.plot([], [], color="0.5", label="reference", linestyle="--")


def _draw_errors(axis: Axes, records: Mapping[str, Record], course: _Course) -> None:
    """Draws |z - r| of an output for each run, over the predicted error."""
    wide: dict[str, Any] = {"linewidth": 4, "alpha": 0.35}
    floors = []
    for number, (label, record) in enumerate(records.items()):
        index, color = _signals(record, course.group).index(course.signal), f"C{number % 10}"
        values = record[course.group][:, index]
        floors.append(floor := round_off(values))
        predicted = _entry(record, "predicted_error", index)
        if predicted is not None:
            axis.semilogy(record.time, np.maximum(np.abs(predicted), floor), color=color, **wide)
        error = np.abs(values - record["desired_output"][:, index])
        axis.semilogy(record.time, np.maximum(error, floor), color=color, label=label)
    decades(axis, min(floors))
    axis.plot([], [], color="0.5", label="predicted", **wide)


def _courses(record: Record, name: str) -> list[_Course]:
    """Returns the entries that a name refers to: all entries of a signal, or a single entry."""
    groups = {key: recorded.signals for key, recorded in record.signals.items()}
    if name in groups:
        return [_Course(signal, name, index) for index, signal in enumerate(groups[name])]
    group, slash, entry = name.partition("/")
    if slash and group in groups:
        entries = [signal.name for signal in groups[group]]
        if entry not in entries:
            raise ModelError(unknown_name(f"entry of {group}", entry, entries))
        index = entries.index(entry)
        return [_Course(groups[group][index], group, index)]
    order = [*_FIRST, *(key for key in groups if key not in (*_FIRST, *_DERIVED))]
    courses = [
        _Course(signal, key, index)
        for key in order
        for index, signal in enumerate(groups.get(key, ()))
    ]
    for course in courses:
        if course.signal.name == name:
            return [course]
    entries = [course.signal.name for course in courses]
    raise ModelError(unknown_name("signal", name, list(dict.fromkeys([*groups, *entries]))))


def _signals(record: Record, group: str) -> Sequence[Signal]:
    return record.signals[group].signals if group in record.signals else ()


def _entry(record: Record, name: str, index: int) -> FloatArray | None:
    """Returns a column of a signal; None if the record does not have this signal."""
    return record[name][:, index] if name in record.signals else None
