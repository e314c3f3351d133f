"""What happens in a run, as marks on the axis of time: from records made by hand, and from runs."""

from itertools import pairwise

import numpy as np
import pytest
from arms import arm
from runs import scenario

from drake_dae.dae import Signal
from drake_dae.diagrams.record import Record, Recorded
from drake_dae.pictures.event_marks import mark_phases
from drake_dae.pictures.friction import friction_cones, slips
from drake_dae.pictures.moments import RunEvent, RunEventKind, events_of, sorted_events
from drake_dae.pictures.plots import plot_controls
from drake_dae.pictures.run_motion import follow
from drake_dae.running.limits import robot_limits
from drake_dae.running.simulate import simulate
from drake_dae.scenario.build import build_scenario

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
    found = events_of(record(control=control, state=state), robot_limits(model))
    assert {one.kind for one in found} == {RunEventKind.LIMIT}
    drive = [one.time for one in found if "joint1_motor" in one.text]
    wanted = [np.arcsin(0.75) + k * np.pi for k in range(4)]
    np.testing.assert_allclose(drive, wanted[: len(drive)], atol=0.1)  # The rows are 0.1 s apart.
    assert len(drive) >= 3
    (stop,) = [one for one in found if "joint1 " in one.text]
    assert stop.time == pytest.approx(3.2)
    assert events_of(record(control=control, state=state)) == []


def test_compliant_contact_touches_and_opens_where_its_force_begins_and_ends():
    force = np.where((TIMES > 2.05) & (TIMES < 5.05), 3.0, 0.0)
    found = events_of(record(constraint_force=force, contact_force=np.zeros((101, 3))))
    assert [(round(one.time, 9), one.kind) for one in found] == [
        (2.1, RunEventKind.TOUCH),
        (5.1, RunEventKind.OPENING),
    ]


def test_of_moments_that_follow_each_other_at_once_the_first_is_kept():
    chatter = [RunEvent(1.0 + 0.01 * k, RunEventKind.TOUCH, "tip: touch") for k in range(20)]
    other = RunEvent(1.05, RunEventKind.OPENING, "tip: contact opens")
    late = RunEvent(5.0, RunEventKind.TOUCH, "tip: touch")
    assert sorted_events(record(), [late, other, *chatter]) == [chatter[0], other, late]


def test_marks_stand_at_their_times_with_one_entry_in_the_legend():
    moments = [RunEvent(t, RunEventKind.LIMIT, "x") for t in (1.0, 2.0)] + [
        RunEvent(3.0, RunEventKind.TOUCH, "y")
    ]
    figure = plot_controls(record(), None, moments)
    (axis,) = figure.axes
    marks = [line for line in axis.lines if line.get_marker() == "^"]
    assert [line.get_xdata().tolist() for line in marks] == [[3.0], [1.0, 2.0]]
    (legend,) = figure.legends
    assert [text.get_text() for text in legend.get_texts()] == ["touch", "limit reached"]


def test_names_of_short_phases_stand_apart():
    phase = np.zeros((101, 4))
    for k, begin in enumerate((0, 50, 52, 54)):
        phase[begin:, k], phase[begin:, :k] = 1.0, 0.0
    one = record(phase=phase)
    figure = plot_controls(one)
    mark_phases(figure, one)
    (axis,) = figure.axes
    figure.draw_without_rendering()
    boxes = [text.get_window_extent() for text in axis.texts]
    assert len(boxes) == 4
    assert all(a.x1 <= b.x0 for a, b in pairwise(boxes))


@pytest.mark.slow
def test_a_tool_that_goes_from_rest_slides_from_the_stiction_tolerance_on():
    """In the ideal plant z follows its reference, whose rate is known: here 0.3 sin^2."""
    settings = ["duration=2.0", "start.errors={}", "constraints.0.friction=0.3"]
    case = scenario("two_link_wall", *settings)
    loop, context = build_scenario(case)
    simulate(loop.diagram, context, case.duration, case.integrator)
    run = follow(loop, loop.record(context), context, 200.0)
    (cone,) = friction_cones(run)
    assert cone.coefficient == 0.3
    forces = np.array([wrench.forces[0] for wrench in run.wrenches])
    lengths = np.linalg.norm(forces, axis=1)
    angles = np.arccos(np.clip(np.sum(forces * cone.normals, axis=1) / lengths, -1.0, 1.0))
    # The arrow is in its cone, and on it where the tool slides fast.
    assert angles.max() <= np.arctan(0.3) + 1e-9
    speeds = np.abs(np.gradient(run.points[:, 0, 2], run.times))
    tolerance = next(p for p in run.model.dae.parameters if p.name == "wall.stiction_tolerance")
    fast = speeds > 10.0 * tolerance.value[0]
    fast[:2] = False  # It begins from rest, which a difference does not see.
    assert fast.any()
    # v / sqrt(v^2 + v_s^2) of Coulomb's friction at ten times v_s.
    assert np.all(angles[fast] > np.arctan(0.3 * 0.99))
    slides = [one for one in slips(run) if one.kind is RunEventKind.SLIDE]
    for one in slides:
        k = round((one.time - run.start_time) * 200.0)
        assert k <= 1 or speeds[k - 2] < tolerance.value[0] < speeds[k + 2]
    # It may reverse between two frames, and then sticks in none.
    turns = np.count_nonzero(np.diff(np.sign(np.diff(run.points[:, 0, 2]))))
    assert 1 <= len(slides) <= 1 + turns


@pytest.mark.slow
def test_a_contact_without_friction_has_no_cone_and_does_not_slide():
    case = scenario("two_link_wall", "duration=0.1")
    loop, context = build_scenario(case)
    simulate(loop.diagram, context, case.duration, case.integrator)
    run = follow(loop, loop.record(context), context)
    assert friction_cones(run) == slips(run) == []


@pytest.mark.slow
def test_on_compliant_contact_the_cone_is_the_plants_and_not_the_laws():
    """The law of `wall_point_contact` knows 0; the force of Drake's contact leans by atan 0.3."""
    case = scenario(
        "wall_point_contact",
        "duration=1.2",
        "plant=!CompliantContact {stiffness: 1.0e5, friction: 0.3}",
    )
    loop, context = build_scenario(case)
    simulate(loop.diagram, context, case.duration, case.integrator)
    run = follow(loop, loop.record(context), context)
    (cone,) = friction_cones(run)
    assert cone.coefficient == 0.3
    force = run.wrenches[-1].forces[0]
    angle = np.arccos(force @ cone.normals[-1] / np.linalg.norm(force))
    assert angle == pytest.approx(np.arctan(0.3), rel=1e-3)  # It slides at 0.1 m/s, v_s is 1e-4.


@pytest.mark.slow
def test_drakes_own_contact_has_the_cone_of_its_material():
    plant = "plant=!MultibodyPlant {stiffness: 1.0e5, friction: 0.4}"
    case = scenario("wall_point_contact", "duration=0.05", plant)
    loop, context = build_scenario(case)
    simulate(loop.diagram, context, case.duration, case.integrator)
    (cone,) = friction_cones(follow(loop, loop.record(context), context))
    assert cone.coefficient == 0.4
