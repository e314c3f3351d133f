"""Conditions of phases in runs: what ends a phase, when it must, and what follows."""

from dataclasses import replace

import numpy as np
import pytest
from arms import numbers
from members import Rise
from numpy.testing import assert_allclose
from polishing import FAR, OVER, PERIOD, SPEED, run_on, started, task_loop

from drake_dae import Approach, Dwell, Move, PointToPointReference, Press, Record
from drake_dae.diagrams.record import phase_spans
from drake_dae.systems import Condition

PRESS = Press(10.0, over=0.05)


def ended(phases, distance, end):
    """The loop of a task, its context, and its changes up to a time."""
    loop = task_loop(phases)
    context = started(loop, distance)
    run_on(loop, context, end)
    return loop, context, loop.changes(loop.record(context))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("condition", "time"),
    [
        (Condition("travel", above=0.0101), 0.0101 / SPEED + OVER / 2.0),
        (Condition("distance", below=FAR - 0.0101), 0.0101 / SPEED + OVER / 2.0),
        (Condition("time", above=0.1514), 0.1514),
    ],
)
@pytest.mark.parametrize("key", ["until", "guards"])
def test_a_condition_ends_a_move_at_constant_speed_when_it_must(key, condition, time):
    """At the next sample; the arm lags its reference by its integrated steps of 1 ms."""
    move = Approach(SPEED, over=OVER, on_success="hold", on_failure="hold", **{key: [condition]})
    _, _, (_, held) = ended([move], FAR, 0.32)
    assert time <= held.time + 1e-3 * PERIOD
    assert_allclose(held.time, time, atol=2.0 * PERIOD)
    assert (held.phase, held.failed) == ("held", key == "guards")
    assert f"{condition.limit:g}" in held.reason


@pytest.mark.slow
def test_conditions_of_force_and_control_hold_at_their_value():
    """At rest u = H - J' F, by MultibodyPlant; fewer newtons take more of it."""
    most = Condition("force", above=15.0)
    pushed = Move({"wall.force": 20.0}, 1.0, over=0.5, guards=[most])
    held = ended([PRESS, pushed], 0.0, 1.0)[2][-1]
    assert (held.phase, held.failed) == ("held", True)
    assert 15.0 < held.force < 15.1
    loop = task_loop([PRESS])
    q = loop.diagram.GetOutputPort("state").Eval(started(loop, 0.0))[:2]
    found = numbers("two_link", q, np.zeros(2))
    controls = np.abs(found.bias - 5.0 * found.constraint_jacobian[0])
    signals = loop.plant.dae.control_signals
    for name in ("", signals[int(np.argmax(controls))].name):
        most = Condition("control", above=float(controls.max()), name=name)
        eased = Move({"wall.force": 2.0}, 2.0, over=2.0, guards=[most], on_failure="leave")
        loop, _, changes = ended([PRESS, eased], 0.0, 3.0)
        assert [change.phase for change in changes] == ["Press", "Move", "leave", "held"]
        # The wall comes back by 1e-5 m/N, which takes some of it.
        assert_allclose(changes[2].force, 5.0, atol=0.3)
        assert changes[-1].time < 3.0
        assert not changes[-1].in_contact


def test_a_move_feels_a_wall_by_its_force_alone():
    """It touches when it must; where the wall is too far it tries again, and then goes away."""
    travel = Condition("travel", above=0.015)
    feel = Approach(SPEED, over=OVER, guards=[travel], on_failure="feel", name="feel", retries=1)
    _, _, changes = ended([feel, PRESS], FAR, 0.6)
    first, touch = 0.015 / SPEED + OVER / 2.0, FAR / SPEED + OVER / 2.0
    assert [change.phase for change in changes] == ["feel", "feel", "Press", "done"]
    # The second one begins with the speed of the first.
    assert_allclose([change.time for change in changes[:3]], [0.0, first, touch], atol=3.0 * PERIOD)
    way = {"tool.z": 0.4, "wall.distance": PointToPointReference(FAR, -0.1, 0.0, 1.0)}
    slanted = Move(way, over=OVER, until=[Condition("force", above=2.0)])
    _, _, changes = ended([slanted, replace(PRESS, tolerance=3.0)], FAR, 1.2)
    assert [change.phase for change in changes] == ["Move", "Press", "done"]
    assert changes[1].reason == "after a force above 2 N"
    assert changes[1].in_contact


@pytest.mark.parametrize("comes", [True, False])
def test_a_phase_waits_for_its_signal(comes):
    """An input of the loop; without a value it never comes."""
    ready = Condition("signal", above=0.5, name="ready")
    loop = task_loop([Dwell(until=[ready], over=0.05, within=0.3), Approach(0.1, over=0.1)])
    context = started(loop)
    run_on(loop, context, 0.1)
    assert len(loop.changes(loop.record(context))) == 1
    if comes:
        loop.diagram.GetInputPort("signal_ready").FixValue(context, [1.0])
        run_on(loop, context, 0.2)
        change = loop.changes(loop.record(context))[1]
        assert (change.phase, change.reason) == ("Approach", "after a signal ready above 0.5")
        assert_allclose(change.time, 0.1, atol=1e-2)
        return
    run_on(loop, context, 0.5)
    change = loop.changes(loop.record(context))[1]
    assert (change.phase, change.failed) == ("held", True)
    assert_allclose(change.time, 0.3, atol=2.0 * PERIOD)


@pytest.mark.slow
def test_a_run_that_is_interrupted_goes_on_as_one_that_is_not(tmp_path):
    """What it has done stands in its context; the record read again knows phases by name."""
    up = Move({"tool.z": PointToPointReference(0.3, 0.4, 0.0, 0.4)}, 0.2, over=0.05, name="slide")
    whole, cut = (task_loop([PRESS, up]) for _ in range(2))
    contexts = [started(loop, 0.0) for loop in (whole, cut)]
    run_on(whole, contexts[0], 0.4)
    for end in (0.1, 0.15, 0.4):
        run_on(cut, contexts[1], end)
    first, second = (
        loop.record(context) for loop, context in zip((whole, cut), contexts, strict=True)
    )
    # A plant in steps makes the one at the cut again, so that it is not quite the same.
    assert_allclose(second["state"][-1], first["state"][-1], rtol=0, atol=1e-3)
    told = [
        [(change.phase, change.time) for change in loop.changes(record)]
        for loop, record in ((whole, first), (cut, second))
    ]
    assert told[0] == told[1]
    second.save(tmp_path / "record.npz")
    spans = phase_spans(Record.load(tmp_path / "record.npz"))
    assert [span.name for span in spans] == ["Press", "slide", "end"]


def test_a_phase_of_a_users_own_has_all_that_the_others_have():
    """It goes up at 0.05 m/s after a ramp, which costs half its time, until a guard at 20 mm."""
    rise = Rise(5.0, over=0.1, guards=[Condition("travel", above=0.02)], on_failure="hold")
    loop, context, changes = ended([rise], FAR, 0.6)
    assert [change.phase for change in changes] == ["Rise", "held"]
    assert_allclose(changes[1].time, 0.02 / 0.05 + 0.05, atol=2.0 * PERIOD)
    record = loop.record(context)
    row = np.searchsorted(record.time, changes[1].time)
    assert_allclose(record["controlled_output"][row, 0], 0.32, atol=2e-4)


@pytest.mark.slow
@pytest.mark.parametrize("on_success", ["next", "hold"])
def test_a_task_that_is_done_in_contact_stays_there(on_success):
    """Also where a phase might have left."""
    press = Press(5.0, over=0.05, on_success=on_success, on_failure="leave")
    phases = [Approach(0.1, over=0.1), press]
    loop, context, changes = ended(phases, 0.005, 0.6)
    last = changes[-1]
    assert (last.phase in ("done", "held"), last.in_contact, last.failed) == (True, True, False)
    record = loop.record(context)
    assert record["constraint_force"][-1, 0] > 4.0
    assert_allclose(record["tracking_error"][-1, 1], 0.0, atol=0.1)
