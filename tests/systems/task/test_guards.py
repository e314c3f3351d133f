"""Guards, guarded moves and signals in runs, against closed forms."""

from dataclasses import replace

import numpy as np
import pytest
from arms import numbers
from members import Rise
from numpy.testing import assert_allclose
from polishing import FAR, OVER, SPEED, run_on, started, task_loop

from drake_dae import (
    Approach,
    Dwell,
    GuardedMove,
    Move,
    PhaseGuard,
    PointToPointReference,
    Press,
    Record,
    Release,
    Retreat,
    Sampling,
    Wait,
)
from drake_dae.errors import SimulationError
from drake_dae.simulation.records.phases import phase_spans
from drake_dae.systems.task.phases import Moment
from drake_dae.systems.task.phases.tally import GuardMemory

PERIOD = 0.003
PRESS = Press(10.0, over=0.05)


def ended(phases, distance, end, period=0.0, accuracy=1e-7):
    """The loop of a task, and its changes up to a time."""
    loop = task_loop(phases, Sampling(period) if period else None)
    context = started(loop, distance)
    run_on(loop, context, end, accuracy)
    return loop, context, loop.changes(context)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("of", "most", "time"),
    [
        ("travel", 0.0101, 0.0101 / SPEED + OVER / 2.0),
        ("speed", SPEED / 2.0, OVER / 2.0),  # A quintic, whose speed is even about its middle.
        ("time", 0.151, 0.151),
    ],
)
def test_a_guard_of_a_move_at_constant_speed_trips_when_it_must(of, most, time):
    """Steps of 1e-7 leave 1e-5 s; in samples it is the third one from there on."""
    for period, samples in ((0.0, 1), (PERIOD, 3)):
        guard = PhaseGuard(of, most, samples)
        move = GuardedMove(0.05, SPEED, over=OVER, guards=[guard], on_failure="hold")
        _, _, (_, held) = ended([move], FAR, 0.32, period)
        wanted = time
        if period:
            wanted = (np.ceil(time / period - 1e-3) + samples - 1) * period
        assert_allclose(held.time, wanted, atol=1e-5)
        assert (held.phase, held.failed, held.chosen) == ("held", True, "hold")
        assert held.reason.startswith(f"GuardedMove is ended by a {of} of ")
        assert f", where its guard has {most:g} " in held.reason


def test_work_is_force_times_way():
    """10 N along z: W = 10 N (z - 0.3 m), within the way of two samples, 0.5 m/s for 6 ms."""
    way = PointToPointReference(0.3, 0.4, 0.0, 0.4)
    move = Move({"tool.z": way}, 0.5, over=0.01, guards=[PhaseGuard("work", 0.4)])
    phases = [PRESS, Dwell(0.1), move]
    loop = task_loop(phases, Sampling(PERIOD))
    context = started(loop, 0.0)
    with pytest.raises(SimulationError, match="Move is ended by a work of 0") as caught:
        run_on(loop, context, 1.0)
    record = loop.record(context)
    heights = record["controlled_output"][:, 0]
    assert caught.value.time == pytest.approx(record.time[-1])
    assert_allclose(10.0 * (heights[-1] - heights[0]), 0.4, atol=10.0 * 0.5 * 2.0 * PERIOD)


@pytest.mark.slow
def test_guards_of_force_and_control_trip_at_their_value():
    """At rest u = H - J' F, by MultibodyPlant; fewer newtons take more of it."""
    pushed = Move({"wall.force": 20.0}, 1.0, over=0.5, guards=[PhaseGuard("force", 15.0)])
    with pytest.raises(SimulationError, match="Move is ended by a force of 15 N, where its guard"):
        ended([PRESS, pushed], 0.0, 1.0, accuracy=1e-6)
    loop = task_loop([PRESS])
    q = loop.diagram.GetOutputPort("state").Eval(started(loop, 0.0))[:2]
    found = numbers("two_link", q, np.zeros(2))
    most = float(np.abs(found.bias - 5.0 * found.constraint_jacobian[0]).max())
    eased = Move({"wall.force": 2.0}, 0.3, over=0.3, guards=[PhaseGuard("control", most)])
    phases = [PRESS, replace(eased, on_failure="leave")]
    loop, context, changes = ended(phases, 0.0, 2.0, accuracy=1e-6)
    assert [change.phase for change in changes] == ["Press", "Move", "leave", "held"]
    assert_allclose(changes[2].force, 5.0, atol=1e-4)
    # It has let go, and the run has ended.
    assert changes[-1].time == pytest.approx(loop.record(context).time[-1], abs=1e-6)
    assert changes[-1].time < 2.0
    assert not changes[-1].in_contact


def test_a_move_feels_a_wall_by_its_force_alone():
    """It touches when it must; where the wall is too far it tries again, and then goes away."""
    feel = GuardedMove(0.015, SPEED, over=OVER, on_failure="feel", name="feel", retries=1)
    _, _, changes = ended([feel, PRESS], FAR, 0.6)
    first = 0.015 / SPEED + OVER / 2.0
    # The second one begins with the speed of the first.
    touch = FAR / SPEED + OVER / 2.0
    assert [change.phase for change in changes] == ["feel", "feel", "Press", "done"]
    assert_allclose([change.time for change in changes[:3]], [0.0, first, touch], atol=1e-5)
    assert changes[1].reason == "feel has moved 0.015 m without a force of 0.5 N, retry 1 of 1"
    slanted = {"tool.z": 3.0, "wall.distance": -0.4}
    up = GuardedMove(0.03, SPEED, direction=slanted, over=OVER, on_failure="Retreat")
    loop, context, changes = ended(
        [up, PRESS, Release(over=0.1), Retreat(0.02, over=0.1)], FAR, 1.0
    )
    assert [change.phase for change in changes] == ["GuardedMove", "Retreat", "done"]
    record = loop.record(context)
    row = np.searchsorted(record.time, changes[1].time)
    share = 0.03 / np.hypot(3.0, 0.4)
    moved = [0.3 + 3.0 * share, FAR - 0.4 * share]
    assert_allclose(record["controlled_output"][row, [0, 2]], moved, atol=1e-6)


@pytest.mark.parametrize("comes", [True, False])
def test_a_phase_waits_for_its_signal(comes):
    """An input of the loop; without a value it never comes."""
    loop = task_loop([Wait("ready", over=0.05, within=0.3), Approach(0.1, over=0.1)])
    context = started(loop)
    run_on(loop, context, 0.1)
    assert len(loop.changes(context)) == 1
    if comes:
        loop.diagram.GetInputPort("signal_ready").FixValue(context, [1.0])
        run_on(loop, context, 0.2)
        change = loop.changes(context)[1]
        assert (change.phase, change.reason) == ("Approach", "after the signal ready")
        assert_allclose(change.time, 0.1, atol=1e-2)
        return
    with pytest.raises(SimulationError, match=r"Wait has waited 0\.3 s for the signal ready, at t"):
        run_on(loop, context, 0.5)


@pytest.mark.slow
def test_a_run_that_is_interrupted_goes_on_as_one_that_is_not(tmp_path):
    """What it has counted stands in its context; the record read again knows phases by name."""
    guards = [PhaseGuard("work", 0.3), PhaseGuard("force", 30.0, samples=20)]
    slide = Move({"tool.z": PointToPointReference(0.3, 0.4, 0.0, 0.4)}, 0.5, over=0.05)
    slide = Move(slide.references, 0.5, over=0.05, guards=guards, name="slide", on_failure="hold")
    told = []
    for stops in ((0.5,), (0.12, 0.231, 0.2315, 0.5)):
        loop = task_loop([PRESS, slide], Sampling(PERIOD))
        context = started(loop, 0.0)
        for end in stops:
            run_on(loop, context, end)
        told.append([(one.phase, one.reason, one.time) for one in loop.changes(context)])
    assert [one[:2] for one in told[0]] == [one[:2] for one in told[1]]
    assert_allclose([one[2] for one in told[1]], [one[2] for one in told[0]], atol=1e-9)
    loop.record(context).save(tmp_path / "record.npz")
    spans = phase_spans(Record.load(tmp_path / "record.npz"))
    assert [span.name for span in spans] == ["Press", "slide", "end"]


def test_a_phase_of_a_users_own_has_all_that_the_others_have():
    """It goes up at 0.05 m/s after a ramp, which costs half its time, until a guard at 20 mm."""
    rise = Rise(5.0, over=0.1, guards=[PhaseGuard("travel", 0.02)], on_failure="hold")
    loop, context, changes = ended([rise], FAR, 0.6)
    assert [change.phase for change in changes] == ["Rise", "held"]
    assert_allclose(changes[1].time, 0.02 / 0.05 + 0.05, atol=2e-5)
    record = loop.record(context)
    row = np.searchsorted(record.time, changes[1].time)
    assert_allclose(record["controlled_output"][row, 0], 0.32, atol=1e-5)


@pytest.mark.slow
def test_who_holds_keeps_contact_and_force():
    """The force has no rate in this law: it stays what it was, to the accuracy of steps."""
    pushed = Move({"wall.force": 20.0}, 1.0, over=0.5, guards=[PhaseGuard("force", 15.0)])
    loop, context, changes = ended([PRESS, replace(pushed, on_failure="hold")], 0.0, 0.8)
    assert [change.phase for change in changes] == ["Press", "Move", "held"]
    record = loop.record(context)
    after = record.time > changes[-1].time + 1e-6
    assert_allclose(record["constraint_force"][after, 0], 15.0, atol=1e-6)
    assert changes[-1].in_contact


@pytest.mark.slow
@pytest.mark.parametrize(
    "phases",
    [
        [Approach(0.1, over=0.1, on_success="done", on_failure="leave")],
        [Approach(0.1, over=0.1), Press(5.0, over=0.05, on_failure="leave")],
        [Approach(0.1, over=0.1), Press(5.0, over=0.05, on_success="hold", on_failure="leave")],
    ],
)
def test_a_task_that_is_done_in_contact_stays_there(phases):
    """Also where a phase might have left."""
    loop, context, changes = ended(phases, 0.005, 0.3, accuracy=1e-5)
    last = changes[-1]
    assert (last.phase in ("done", "held"), last.in_contact, last.failed) == (True, True, False)
    record = loop.record(context)
    assert_allclose(record["constraint_force"][-1, 0], last.force, atol=1e-3)


def test_a_guard_counts_consecutive_samples():
    """A force above its limit in every second sample, as of noise, never trips a guard of two."""
    phase = Dwell(1.0, guards=[PhaseGuard("force", 10.0, samples=2)])
    tally, margins = GuardMemory([phase], 1e-3), []
    counted = [0.0] * tally.size
    for force in (11.0, 9.0, 11.0, 9.0, 11.0, 12.0):
        now = Moment(0.1, force, 0.0, 0.0, 5.0)
        margins.append(float(tally.margins(phase, counted, now)[0]))
        counted = [float(one) for one in tally.after(phase, counted, now)]
    assert [margin <= 0.0 for margin in margins] == [False, False, False, False, False, True]
