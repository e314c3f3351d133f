"""Tasks in phases: touches as designed, changes without bumps, reactions, and what is refused."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from arms import arm, numbers
from numpy.testing import assert_allclose
from polishing import FAR, OVER, PERIOD, POLE, SPEED, WHOLE, laws, push, run_on, started, task_loop

import drake_dae as dd
from drake_dae.diagrams import wire_loop
from drake_dae.diagrams.record import phase_spans, phases_at
from drake_dae.errors import ModelError, WiringError
from drake_dae.systems import open_contact
from drake_dae.systems.automaton import faded

TOUCH = FAR / SPEED + OVER / 2.0
"""The speed rises for OVER, on its mean half of it: v OVER / 2 less on the way."""


@pytest.fixture(scope="module")
def whole():
    """The whole task: loop, context after it, and record."""
    loop = task_loop(WHOLE)
    context = started(loop)
    run_on(loop, context, 2.0)
    return loop, context, loop.record(context)


@pytest.mark.slow
def test_phases_follow_each_other_and_say_why(whole):
    loop, context, record = whole
    found = loop.changes(loop.record(context))
    names = ["Approach", "Press", "Move", "Release", "Retreat", "done"]
    assert [change.phase for change in found] == names
    assert [change.place for change in found] == list(range(6))
    assert [change.in_contact for change in found] == [False, True, True, True, False, False]
    assert found[1].reason == "after a force above 0.5 N"
    assert str(found[1]).startswith(f"{found[1].time:.6g} s: Press, after a force above 0.5 N; ")
    # A sample at the moment of a change shows what was before.
    places = np.searchsorted([c.time for c in found[1:]], record.time)
    assert_allclose(np.argmax(record["phase"], axis=1), places)
    assert_allclose(record["phase"].sum(axis=1), 1.0)
    spans = phase_spans(record)
    assert [span.name for span in spans] == [*names[:-1], "end"]
    assert_allclose([span.begin for span in spans], [change.time for change in found])
    middles = np.array([(span.begin + span.end) / 2.0 for span in spans])
    assert phases_at(record, middles) == [span.name for span in spans]


def test_it_touches_when_and_as_fast_as_designed(whole):
    """A sample of 1 ms later at most, on a wall that takes 0.5 N after 5e-6 m: 0.1 ms."""
    loop, context, record = whole
    press = loop.changes(loop.record(context))[1]
    assert TOUCH < press.time < TOUCH + 2.0 * PERIOD
    before = np.flatnonzero(record["constraint_force"][:, 0] == 0.0)
    before = before[record.time[before] < press.time][-1]
    assert_allclose(record["distance"][before], [0.0, -SPEED], atol=SPEED * PERIOD)
    assert_allclose(record["distance"][before, 1], -SPEED, rtol=1e-3)


def test_references_begin_as_those_before_end(whole):
    """The speed of each output is at most what it was a sample ago, and more as it accelerates."""
    loop, _, record = whole
    for change in loop.changes(record)[1:]:
        row = int(np.searchsorted(record.time, change.time + 0.5 * PERIOD)) - 1
        before, after = record["desired_output"][row], record["desired_output"][row + 1]
        assert abs(after[0] - before[0]) < 1.1 * PERIOD  # tool.z moves at 1 m/s at most.
        column = 1 if change.in_contact else 2
        wanted = change.force if change.in_contact else change.distance
        if not before[column]:  # What has no reference begins as it was measured.
            assert_allclose(after[column], wanted, rtol=0.05, atol=SPEED * PERIOD)


def test_control_jumps_by_what_the_laws_explain_otherwise():
    """By M, J and P of MultibodyPlant, B du = lambda (A M [P; J]^-1 (0, 1) - J') at a touch.

    All outputs are at their references, and the free law presses with lambda.
    """
    system, pressed = arm("two_link").model.dae, 7.0
    law = dd.TrackingLaw(system, dd.poles(POLE))
    free = dd.TrackingLaw(open_contact(system, "wall.force"), dd.poles(POLE))
    state = np.array([1.1, -1.5, 0.4, -0.7])
    found = numbers("two_link", *np.split(state, 2))
    J, P = found.constraint_jacobian, found.output_jacobian
    A = (J @ np.linalg.solve(found.mass, J.T)).item()
    at_rest = free.error_coordinates(state, np.zeros(6), free.system.parameter_values)
    wanted = np.array([*at_rest[:2], 0.3, *at_rest[2:], -A * pressed])
    jump = law.control(state, np.array([*at_rest[:2], 0.3, pressed])) - free.control(state, wanted)
    pushed = found.mass @ np.linalg.solve(np.vstack([P, J]), [0.0, 1.0])
    assert_allclose(jump, pressed * (A * pushed - J[0]), rtol=1e-9)


def test_outputs_stay_at_their_references(whole):
    """Measured 0.6 mm at the touch, and 0.03 N once the force has settled."""
    _, _, record = whole
    moving = record["phase"][:, 2] > 0.0
    assert np.abs(record["tracking_error"][:, 0]).max() < 1e-3
    assert np.abs(record["tracking_error"][moving, 1]).max() < 0.3
    assert_allclose(record["desired_output"][moving, 1], 20.0, atol=1e-9)
    assert_allclose(record["controlled_output"][-1, [0, 2]], [0.4, 0.03], atol=1e-4)


HOLDING = dd.Approach(0.1, over=0.1)


def test_a_task_that_may_not_try_again_ends():
    phases = (HOLDING, dd.Press(10.0, over=0.1), dd.Dwell(5.0, if_lost="approach"))
    loop = task_loop(phases, patience=0.02, retries=0)
    context = started(loop, distance=0.01)
    run_on(loop, context, 0.4)
    push(loop, context, -40.0)
    run_on(loop, context, 0.5)
    last = loop.changes(loop.record(context))[-1]
    assert (last.phase, last.failed) == ("held", True)


def test_robot_that_has_left_at_the_end_of_a_task_rests_as_a_free_one():
    """A reference below zero pulls it off, and it has gone when the last phase ends."""
    pulled = dd.Move({"wall.force": -5.0}, 0.05, over=0.01)
    loop = task_loop([HOLDING, dd.Press(10.0, over=0.1), pulled])
    context = started(loop, distance=0.01)
    run_on(loop, context, 1.5)
    last = loop.changes(loop.record(context))[-1]
    assert (last.phase, last.in_contact) == ("done", False)
    assert_allclose(loop.record(context)["distance"][-1, 1], 0.0, atol=1e-3)


def test_law_may_have_another_wall(whole):
    """It believes the wall 5 mm nearer, and comes as far as its wall is with the wrong distance."""
    loop, _, _ = whole
    context = started(loop)
    own = loop.controller.GetMyMutableContextFromRoot(context)
    loop.controller.set_parameter(own, "wall.position", [1.195, 0.0, 0.0])
    run_on(loop, context, TOUCH + 0.01)
    touch = loop.changes(loop.record(context))[1]
    assert_allclose(touch.time, TOUCH, atol=2e-3)
    assert_allclose(touch.distance, -0.005, atol=1e-4)


def test_fade_begins_as_given_and_ends_at_rest():
    """Rows are derivatives of each other, by CasADi; 0 and 1 to round-off."""
    offset, over, t = np.array([0.7, -2.0, 5.0, 3.0, 1.0, 2.0, 3.0, 4.0, 5.0]), 0.4, ca.SX.sym("t")
    rows = faded(ca.SX(offset), [2, 0, 4], t, ca.SX(over))
    value = ca.Function("value", [t], [rows])
    assert_allclose(value(0.0).full()[:, 0], offset, rtol=1e-14)
    assert_allclose(value(over * (1.0 - 1e-15)).full()[:, 0], 0.0, atol=1e-7)
    for first, last in ((0, 2), (4, 8)):
        derivative = ca.Function("derivative", [t], [ca.jacobian(rows[first:last], t)])
        found = value(0.3).full()[first + 1 : last + 1]
        assert_allclose(derivative(0.3).full(), found, rtol=1e-9, atol=1e-9)
    # Where the law needs no derivatives the fade has two nevertheless.
    slope = ca.jacobian(rows[3], t)
    smooth = ca.Function("smooth", [t], [slope, ca.jacobian(slope, t)])
    assert_allclose([part.full().item() for part in smooth(0.0)], 0.0, atol=1e-12)


def test_free_member_is_the_robot_without_the_wall():
    """v' by MultibodyPlant alone: z'' and phi'' are as the law wants them."""
    law = dd.TrackingLaw(open_contact(arm("two_link").model.dae, "wall.force"), dd.poles(POLE))
    assert [signal.name for signal in law.system.output_signals] == ["tool.z", "wall.distance"]
    q, v = np.array([1.1, -1.5]), np.array([0.4, -0.7])
    reference = np.array([0.2, 0.1, -0.3, 0.05, 0.2, 0.4])
    u = law.control(np.concatenate([q, v]), reference)
    found = numbers("two_link", q, v)
    acceleration = np.linalg.solve(found.mass, u - found.bias)
    moved = found.constraint_jacobian @ acceleration + found.constraint_acceleration
    distance = arm("two_link").plant
    context = distance.CreateDefaultContext()
    distance.SetPositions(context, q)
    tool = distance.GetFrameByName("tool").CalcPoseInWorld(context).translation()
    gap, rate = 1.2 - tool[0], found.constraint_jacobian @ v
    wanted = 0.4 - 16.0 * (rate - 0.2) - 64.0 * (gap - 0.05)
    assert_allclose(moved, wanted, rtol=1e-10)


def controller_of(phases, law, free_law, period=PERIOD):
    return dd.TaskController(dd.Task(phases), law, free_law, sample_period=period)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: dd.Approach(-0.1), "Approach: speed"),
        (lambda: dd.Press(0.0), "Press: force"),
        (lambda: dd.Task([dd.Approach()], contact_force=0.0), "contact_force"),
        (lambda: controller_of([dd.Approach()], laws()[0], laws()[0]), "contact"),
        (lambda: controller_of([dd.Approach()], *laws(), 0.0), "sample_period"),
        (lambda: controller_of([dd.Move({"tool.x": 1.0}, 1.0)], *laws()), r"Move: .*'tool\.x'"),
        (
            lambda: task_loop(
                [dd.Approach(), dd.Move({"wall.distance": dd.ConstantReference(1.0)}, 1.0)]
            ),
            r"'wall\.distance'",
        ),
        (lambda: open_contact(laws()[0].system, "floor.force"), r"'floor\.force'"),
    ],
)
def test_wrong_numbers_and_names_are_refused(make, message):
    with pytest.raises(ModelError, match=message):
        make()


def test_a_task_on_ideal_constraints_is_refused():
    """They neither open nor strike."""
    plant = dd.RobotPlant(arm("two_link").model)
    with pytest.raises(WiringError, match="CompliantPlant"):
        wire_loop(plant, dd.TaskController(dd.Task([dd.Approach()]), *laws(), sample_period=PERIOD))


@pytest.mark.parametrize(
    ("m", "is_taken"), [([0.0, 1.0], True), ([1.0, 1.0], False), ([0.0, 2.0], False)]
)
def test_a_contact_opens_only_where_its_force_is_an_output_by_itself(m, is_taken):
    """z = (l_1 + m_1 lambda, m_2 lambda): no law of the open contact could hold the first."""
    system = replace(arm("two_link").model.dae, m=ca.SX(m))
    if is_taken:
        found = open_contact(system, "wall.force")
        assert [s.name for s in found.output_signals] == ["tool.z", "wall.distance"]
        assert found.num_constraints == 0
    else:
        with pytest.raises(ModelError, match=r"'wall\.force'"):
            open_contact(system, "wall.force")
