"""Tasks that open and close latches: an object passes from one hand to another."""

from dataclasses import replace

import numpy as np
import pytest
from latches import MASSES, carts, controller_of, hand_over
from pydrake.systems.analysis import SimulatorConfig

import drake_dae as dd
from drake_dae.errors import AssumptionError, ModelError, SimulationError, WiringError

START = [0.1, 0.1, 0.25, 0.0, 0.0, 0.0]


@pytest.fixture(scope="module")
def model():
    return carts()


def loop_of(model, task=None, **settings):
    task = task or hand_over()
    plant = dd.UnilateralRobotPlant(
        model, {}, latches=task.plan.latches, latch_sets=task.plan.latch_sets
    )
    return dd.wire_loop(plant, controller_of(task, model, **settings))


def started(loop):
    context = loop.diagram.CreateDefaultContext()
    loop.plant.set_state(loop.plant.GetMyMutableContextFromRoot(context), START)
    return context


@pytest.fixture(scope="module")
def run(model):
    loop = loop_of(model)
    context = started(loop)
    config = SimulatorConfig(accuracy=1e-8, integration_scheme="runge_kutta5")
    dd.simulate(loop.diagram, context, 2.2, config)
    return loop, context, loop.record(context)


def test_the_closed_latches_follow_from_the_phases():
    plan = hand_over().plan
    assert plan.latches == ("right_hand", "left_hand")
    assert plan.pairs == (
        ("right_hand", frozenset({"left_hand"})),
        ("left_hand", frozenset({"right_hand"})),
    )
    # Twice the pair, and 1 more while its latch is closed.
    assert [plan.law_of(place) for place in range(4)] == [0, 1, 3, 2]
    assert [sorted(plan.closed_by(law)) for law in range(4)] == [
        ["left_hand"],
        ["left_hand", "right_hand"],
        ["right_hand"],
        ["left_hand", "right_hand"],
    ]
    assert len(plan.latch_sets) == 3


@pytest.mark.slow
def test_an_object_passes_from_hand_to_hand_and_stays_on_its_path(run):
    """The accuracy of a step is 1e-8 m; the whole run leaves less than 1e-7 of the 0.1 m."""
    loop, context, record = run
    changes = loop.changes(context)
    assert [change.phase for change in changes] == ["grasp", "pull", "pass", "retreat", "done"]
    assert [change.law for change in changes] == [0, 1, 3, 2, 2]
    puck = record["state"][:, 1]
    assert np.max(np.abs(puck - 0.1)) < 1e-7
    off = np.abs(record["tracking_error"] - record["predicted_error"])
    assert np.max(off) < 1e-6
    left = [signal.name for signal in record.signals["controlled_output"].signals]
    assert left == ["puck_x", "right_hand.fx", "right_hand.x", "left_hand.fx", "left_hand.x"]
    assert record["controlled_output"][-1, 4] == pytest.approx(0.2, abs=1e-7)


def test_the_forces_of_the_hands_add_up_to_those_of_the_object(run):
    """Newton's law of the puck alone: at rest both hands exert the opposite, -6 and 6 N."""
    loop, context, record = run
    forces = record["constraint_force"]  # On the puck, by the left and by the right hand.
    acceleration = np.gradient(record["state"][:, 4], record.time, edge_order=2)
    inside = np.abs(acceleration) < 1e-3
    assert np.max(np.abs(forces.sum(1))[inside]) < 2e-3
    at_pass = np.searchsorted(record.time, loop.changes(context)[2].time)
    np.testing.assert_allclose(forces[at_pass], [6.0, -6.0], atol=1e-6)
    # The load is led away from the left hand before it opens: less than contact_force is left.
    opened = record.time > loop.changes(context)[3].time + 1e-6
    assert np.all(forces[opened, 0] == 0.0)
    last = np.flatnonzero(~opened)[-2]
    assert abs(forces[last, 0]) < 0.05


@pytest.mark.slow
def test_a_rollout_and_a_sampled_task_do_the_same(model, run):
    """Samples of 1 ms end phases up to 1 ms later, and the held control leaves 1e-5 m."""
    loop, context, record = run
    config = SimulatorConfig(accuracy=1e-8, integration_scheme="runge_kutta5")
    again = loop_of(model)
    (rolled,) = dd.rollout(
        again, *dd.start_values(again, started(again)), [0.0, 2.2], config=config
    )
    np.testing.assert_allclose(rolled.record["state"][-1], record["state"][-1], atol=1e-6)
    sampled = loop_of(model, sample_period=1e-3)
    at_start = started(sampled)
    config = SimulatorConfig(accuracy=1e-6, integration_scheme="runge_kutta5")
    (found,) = dd.rollout(sampled, *dd.start_values(sampled, at_start), [0.0, 2.2], config=config)
    late = [
        after.time - before.time
        for before, after in zip(loop.changes(context), sampled.changes(found.context), strict=True)
    ]
    assert max(late) < 5e-3
    np.testing.assert_allclose(found.record["state"][-1], record["state"][-1], atol=1e-4)


def test_a_grasp_that_fails_is_late_with_its_distance(model):
    """A latch that is closed only within 0, which round-off does not reach."""
    task = hand_over(tolerance=1e-30, within=0.6)
    loop = loop_of(model, task)
    with pytest.raises(SimulationError, match=r"grasp has waited 0\.6 s for a latch within"):
        dd.simulate(loop.diagram, started(loop), 1.0, SimulatorConfig(accuracy=1e-6))


def phases(*changed):
    return [*hand_over().phases[:3], *changed]


@pytest.mark.parametrize(
    ("wrong", "text"),
    [
        (
            [dd.Press(20.0)],
            "phase 4 of the task, Press: it serves a contact that pushes, and 'left_hand' is",
        ),
        (
            [dd.Close(contact="left_hand"), dd.Release(contact="left_hand", on_failure="leave")],
            "leave does not say which latch",
        ),
        (
            [dd.Release(contact="right_hand"), dd.Release(contact="left_hand")],
            "these latches closed: left_hand; but then closed: none",
        ),
        (
            [dd.Move({}, 1.0, contact="left_hand", on_success="grasp", retries=1)],
            "these latches closed: left_hand; but then closed: right_hand",
        ),
    ],
)
def test_phases_that_do_not_fit_their_latch_are_refused(wrong, text):
    with pytest.raises(ModelError, match=text):
        dd.Task(phases(*wrong))


def test_a_latch_has_a_name():
    with pytest.raises(ModelError, match="phase 1 of the task, Close: contact: needed, the name"):
        dd.Task([dd.Close()])
    with pytest.raises(
        ModelError, match="phase 1 of the task, Dwell: contact: needed, since later"
    ):
        dd.Task([dd.Dwell(1.0), dd.Close(contact="left_hand")])
    task = dd.Task([dd.Close(contact="hook")])
    with pytest.raises(ModelError, match="no latch 'hook'"):
        dd.laws_of_latches(task.plan, carts().dae, dd.poles(-8.0))


def test_a_plant_and_a_task_have_the_same_latches(model):
    plant = dd.UnilateralRobotPlant(model, {}, latches=["left_hand", "right_hand"])
    with pytest.raises(WiringError, match="the latches right_hand, left_hand, and the plant has"):
        dd.wire_loop(plant, controller_of(hand_over(), model))


def test_laws_are_as_many_as_pairs(model):
    task = hand_over()
    first, *_ = dd.laws_of_latches(task.plan, model.dae, dd.poles(-8.0))
    with pytest.raises(ModelError, match="laws of 2 contacts"):
        dd.TaskController(task, *first, whole=model.dae)
    with pytest.raises(ModelError, match="tare_time: a task with latches finds no bias"):
        replace(task, tare_time=0.1)


def test_an_output_that_a_latch_already_fixes_is_refused(model):
    """While both hands are open nothing moves the puck."""
    task = dd.Task([dd.Close(contact="right_hand")])
    free = model.dae
    laws = dd.laws_of_latches(task.plan, free, dd.poles(-8.0))  # The left hand stays closed.
    assert [s.name for s in laws[0][1].system.force_signals] == ["left_hand.fx"]
    both = dd.Task([dd.Close(contact="right_hand"), dd.Dwell(0.1), dd.Close(contact="left_hand")])
    with pytest.raises(AssumptionError):
        dd.laws_of_latches(both.plan, free, dd.poles(-8.0))


def test_the_masses_are_those_of_the_file(model):
    values = {p.name: p.value for p in model.dae.parameters}
    assert {name: values[f"{name}.mass"].item() for name in MASSES} == MASSES
