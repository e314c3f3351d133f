"""What happens in a run, as marks on the axis of time: from records made by hand."""

from itertools import pairwise

import numpy as np
import pytest
from arms import arm

from drake_dae import plot_runs
from drake_dae.dae import Signal
from drake_dae.diagrams.record import Record, Recorded
from drake_dae.pictures.events import RunEventKind, events_of

TIMES = np.linspace(0.0, 10.0, 101)


def record(**signals):
    given = {"control": np.zeros(101), "state": np.zeros(101), "constraint_force": np.ones(101)}
    found = {
        name: Recorded(
            values.reshape(101, -1), [Signal(f"{name}{k}") for k in range(values.size // 101)]
        )
        for name, values in {**given, **signals}.items()
    }
    return Record(TIMES, found)


def test_a_control_and_a_joint_at_their_limits_are_marked_where_they_come_there():
    model = arm("two_link").model  # Its drives have 300 and 120 N m, its first joint 3.1416 rad.
    control, state = np.zeros((101, 2)), np.zeros((101, 4))
    control[:, 0] = np.clip(400.0 * np.sin(TIMES), -300.0, 300.0)  # First from asin(0.75) on.
    state[:, 0] = np.minimum(TIMES, 3.1416)
    found = events_of(record(control=control, state=state), model)
    assert {one.kind for one in found} == {RunEventKind.LIMIT}
    drive = [one.time for one in found if "joint1_motor" in one.text]
    wanted = [np.arcsin(0.75) + k * np.pi for k in range(4)]
    np.testing.assert_allclose(drive, wanted[: len(drive)], atol=0.1)  # The rows are 0.1 s apart.
    assert len(drive) >= 3
    (stop,) = [one for one in found if "joint1 " in one.text]
    assert stop.time == pytest.approx(3.2)
    assert events_of(record(control=control, state=state)) == []


def test_compliant_contact_touches_and_opens_and_of_chatter_the_first_is_kept():
    """Two events of one kind within a hundredth of the run are one."""
    force, times = np.where((TIMES > 2.05) & (TIMES < 5.05), 3.0, 0.0), TIMES.copy()
    force[[22, 24]] = 0.0
    times[21:26] = 2.1 + 0.001 * np.arange(5)
    signals = record(constraint_force=force, contact_force=np.zeros((101, 3))).signals
    found = [(round(one.time, 3), one.kind) for one in events_of(Record(times, signals))]
    assert found == [
        (2.1, RunEventKind.TOUCH),
        (2.101, RunEventKind.OPENING),
        (5.1, RunEventKind.OPENING),
    ]


def test_marks_and_names_of_short_phases_stand_at_their_times_and_apart():
    phase, force = np.zeros((101, 4)), np.where(TIMES > 5.05, 3.0, 0.0)
    for k, begin in enumerate((0, 50, 52, 54)):
        phase[begin:, k], phase[begin:, :k] = 1.0, 0.0
    one = record(phase=phase, constraint_force=force, contact_force=np.zeros((101, 3)))
    figure = plot_runs({"one": one}, ["control"])
    (axis,) = figure.axes
    marks = [line for line in axis.lines if line.get_marker() == "^"]
    assert [line.get_xdata().tolist() for line in marks] == [pytest.approx([5.1])]
    (legend,) = figure.legends
    assert [text.get_text() for text in legend.get_texts()] == ["one", "touch"]
    figure.draw_without_rendering()
    boxes = [text.get_window_extent() for text in axis.texts]
    assert len(boxes) == 4
    assert all(a.x1 <= b.x0 for a, b in pairwise(boxes))
