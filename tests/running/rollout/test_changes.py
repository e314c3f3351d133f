"""Rollouts of blocks that change at moments which a run finds, against Drake's Simulator."""

import shutil

import numpy as np
import pytest
from falling import ball, box, mass_point, planar_box, rocking_block, standing_on_right
from painleve import rod, sliding
from pegs import peg_of, planar_peg
from polishing import CLIMB, push, run_on, started, task_loop
from pydrake.systems.analysis import SimulatorConfig
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import ConstantVectorSource
from runs import both, first_quick, mostly_compiled, run, scenario, some

from drake_dae import (
    Approach,
    Dwell,
    GuardedMove,
    Hole,
    Move,
    PhaseGuard,
    Plane,
    Plate,
    PointOnSurface,
    Press,
    Release,
    Retreat,
    Sampling,
    UnilateralRobotPlant,
    Wait,
    build_scenario,
    rollout,
    simulate,
    start_values,
)
from drake_dae.errors import InconsistentStateError, ModelError, PainleveError, SimulationError
from drake_dae.running.rollout.program import program_of

FIXED = (
    "use_error_control=false",
    "integration_scheme=runge_kutta3",
    "max_step_size=1e-3",
    "accuracy=1e-10",
)
ACCURATE = ("accuracy=1e-11", "integration_scheme=runge_kutta5")


def settings_of(words):
    return ["compiled=false", *(f"integrator.{word}" for word in words)]


def fixed(step=0.01):
    """Steps whose events Drake finds to within 1e-13 s, a hundredth of the accuracy in steps."""
    return SimulatorConfig(
        integration_scheme="runge_kutta5",
        max_step_size=step,
        use_error_control=False,
        accuracy=1e-9,
    )


def assert_same_events(found, wanted, tolerance):
    assert [one.kind for one in found] == [one.kind for one in wanted]
    assert [one.closed for one in found] == [one.closed for one in wanted]
    for one, other in zip(found, wanted, strict=True):
        np.testing.assert_allclose(one.time, other.time, rtol=0.0, atol=tolerance)
        np.testing.assert_allclose(one.impulses, other.impulses, rtol=1e-9, atol=1e-9)


def assert_same_records(found, wanted, tolerance, before, changes=()):
    """To the tolerance; before the first change that is found, with fixed steps, to `before`.

    At the moment of a change itself two runs may be on either side of it; and what is predicted
    begins anew from there.
    """
    assert list(found.signals) == list(wanted.signals)
    times = np.array([*(event.time for event in wanted.events), *changes])
    count = min(found.time.size, wanted.time.size)
    away = np.abs(wanted.time[:, None] - times).min(axis=1) > 1e-9
    first = wanted.time < times.min() - 1e-9
    for name, recorded in wanted.signals.items():
        if name == "predicted_error":
            continue
        scale = max(1.0, np.max(np.abs(recorded.values), initial=0.0))
        off = np.abs(found[name][:count] - recorded.values[:count]).max(axis=1) / scale
        assert off[away[:count]].max() < tolerance, name
        assert off[first[:count]].max(initial=0.0) < before, name


@pytest.mark.slow
@mostly_compiled
@pytest.mark.parametrize(
    ("words", "settings", "duration"),
    some(
        [
            (FIXED, [], 3.6),
            (ACCURATE, [], 3.6),
            (FIXED, ["sampling={period: 0.004, delay: 0.001}"], 3.302),
            (FIXED, ["constraints.0.friction=0.4", "sampling={period: 0.003}"], 3.301),
            (FIXED, ["actuation=[!FlexibleJoints {stiffness: 8000.0, inertia: 0.5}]"], 3.3),
        ]
    ),
)
def test_a_contact_opens_strikes_and_rests_as_in_drake(words, settings, duration, compiled):
    """To 1e-9; before the first change that is found to 1e-11 with equal steps, as sampled laws."""
    chosen = scenario("wall_bounce", f"duration={duration}", *settings, *settings_of(words))
    loop, context = build_scenario(chosen)
    start, parameters = start_values(loop, context)
    wanted = run(loop, context, duration, chosen.integrator)
    (found,) = rollout(
        loop, start, parameters, wanted.time, config=chosen.integrator, compiled=compiled
    )
    assert found.failure is None
    assert len(wanted.events) > 1
    assert_same_events(found.record.events, wanted.events, 1e-9)
    before = 1e-11 if words is FIXED else 1e-9
    assert_same_records(found.record, wanted, 1e-9, before)


def alone(plant):
    """A plant without controls in a diagram, and its context."""
    builder = DiagramBuilder()
    builder.AddSystem(plant)
    for name in ("state", *plant.further_signals, "constraint_force"):
        builder.ExportOutput(plant.GetOutputPort(name), name)
    diagram = builder.Build()
    return diagram, diagram.CreateDefaultContext()


def pulled(*phases, pull=0.0, sampling=None):
    """The two-link arm under a task, pulled by a hand."""
    loop = task_loop(phases, sampling, patience=0.02)
    context = started(loop, distance=0.005)
    push(loop, context, pull)
    return loop, context


HOLDING = Approach(0.1, over=0.1), Press(10.0, over=0.1)
LEAVING = Move({"tool.z": CLIMB}, 0.2, over=0.1), Release(over=0.1), Retreat(0.01, over=0.1)
TASKS = {
    "whole": lambda: pulled(*HOLDING, *LEAVING),
    "sampled": lambda: pulled(*HOLDING, *LEAVING, sampling=Sampling(0.002)),
    "sampled and late": lambda: pulled(*HOLDING, *LEAVING, sampling=Sampling(0.004, 0.001)),
    "sampled and pulled off": lambda: pulled(
        Approach(0.1, over=0.1),
        Press(10.0, over=0.2, if_lost="hold"),
        pull=-8.0,
        sampling=Sampling(0.002, 0.002),
    ),
    "feels, tries again and is stopped by guards": lambda: pulled(
        GuardedMove(0.004, 0.1, over=0.05, on_failure="feel", name="feel", retries=1),
        Press(10.0, over=0.1, guards=[PhaseGuard("time", 0.5)]),
        Move({"tool.z": CLIMB}, 0.5, guards=[PhaseGuard("force", 25.0)], if_lost="Release"),
        Release(over=0.1, guards=[PhaseGuard("control", 300.0), PhaseGuard("travel", 0.1)]),
        pull=-8.0,
    ),
    "counts in samples, waits and leaves": lambda: pulled(
        *HOLDING,
        Wait("ready", duration=0.1, over=0.05),
        Move(
            {"tool.z": CLIMB},
            0.5,
            over=0.1,
            guards=[
                PhaseGuard("work", 0.3),
                PhaseGuard("speed", 1.0, samples=2),
                PhaseGuard("control", 200.0, samples=3),
            ],
            on_failure="leave",
        ),
        sampling=Sampling(0.002),
    ),
    "begins in contact": lambda: pulled(Press(5.0, over=0.05), Dwell(0.1), Release(over=0.05)),
    "waits in vain": lambda: pulled(Approach(0.01, within=0.1, if_late="hold")),
    **{
        f"is pulled off: {reaction}": lambda reaction=reaction: pulled(
            Approach(0.1, over=0.1), Press(10.0, over=0.2, if_lost=reaction), pull=-8.0
        )
        for reaction in ("hold", "stop", "fail", "approach")
    },
}


@pytest.mark.slow
@mostly_compiled
@pytest.mark.parametrize("name", some(TASKS, of=5))
def test_tasks_are_those_of_drake(name, compiled):
    """To 1e-9: when each phase begins and why, and all signals; or why the run fails."""
    loop, context = TASKS[name]()
    start, parameters = start_values(loop, context)
    config = SimulatorConfig(
        integration_scheme="runge_kutta3",
        max_step_size=1e-3,
        use_error_control=False,
        accuracy=1e-10,
    )
    failure = None
    try:
        simulate(loop.diagram, context, 0.8, config)
    except SimulationError as error:
        failure = error
    wanted = loop.record(context)
    # A run that ends at a change has its last row there, and the change just after it.
    more = [wanted.time[-1] + 1e-3] if wanted.time[-1] < 0.8 - 1e-6 else []
    times = np.append(wanted.time, more)
    (found,) = rollout(loop, start, parameters, times, config=config, compiled=compiled)
    assert type(found.failure) is type(failure)
    if failure is not None:
        assert found.failure.time == pytest.approx(failure.time, abs=1e-9)
        assert str(found.failure)[:40] == str(failure)[:40]
    changes = loop.changes(context)
    assert len(changes) > 1
    told = loop.changes(found.context)
    assert [(one.phase, one.reason) for one in told] == [(one.phase, one.reason) for one in changes]
    times = [one.time for one in changes]
    np.testing.assert_allclose([one.time for one in told], times, rtol=0.0, atol=1e-9)
    assert_same_events(found.record.events, wanted.events, 1e-9)
    assert_same_records(found.record, wanted, 1e-9, 1e-11, times[1:])


@pytest.mark.slow
def test_at_each_moment_of_a_task_its_functions_are_what_its_blocks_show():
    """Rule 2 of traced blocks, to 1e-12 of the largest value, before and after its changes."""
    loop, context = TASKS["whole"]()
    compiled = program_of(loop).compiled
    phases = set()
    for end in (0.05, 0.12, 0.21, 0.3, 0.5, 0.62, 0.7, 0.9):
        run_on(loop, context, end)
        values = compiled.values(context)
        row, valid = compiled.row(context.get_time(), *compiled.start(context), values)
        assert np.isfinite(float(valid))
        wanted = [loop.diagram.GetOutputPort(name).Eval(context) for name in compiled.outputs]
        column = np.concatenate(wanted)
        scale = np.abs(column).max()
        np.testing.assert_allclose(row.full()[:, 0], column, rtol=0.0, atol=1e-12 * scale)
        phases.add(float(loop.diagram.GetOutputPort("phase").Eval(context)[0]))
    assert len(phases) >= 4


def test_a_task_that_has_begun_does_not_begin_again():
    loop, context = TASKS["begins in contact"]()
    run_on(loop, context, 0.05)
    start, parameters = start_values(loop, context)
    (found,) = rollout(loop, start, parameters, [0.05, 0.1])
    assert "a task begins when its run does" in str(found.failure)


TABLE = Plate((0.0, 0.0, 0.0), (0.0, 0.0, 1.0), (0.3, 0.2), hole=Hole(0.005, chamfer=0.001))
FALLING = {
    "a ball that bounces": (lambda: ball(0.6), [0.5, -1.0], 1.5),
    "a box that lands on two feet": (
        lambda: box({"left": 0.3, "right": 0.3}, driven=False),
        [0.0, 0.7, 0.1, 0.2, 0.0, 0.0],
        0.7,
    ),
    "a block that rocks": (rocking_block, standing_on_right(0.2), 3.0),
    "a box that slides over an edge": (
        lambda: box({"left": 0.3, "right": 0.3}, driven=False, floor=TABLE),
        [0.0, 0.55, 0.0, 0.4, 0.0, 0.0],
        0.6,
    ),
    "a point that bounces over a hole and an edge": (
        lambda: mass_point({"floor": TABLE}, 0.7),
        [-0.28, 0.004, 0.02, 0.5, 0.0, 0.0],
        1.3,
    ),
    "a peg that slides down a chamfer into its hole": (
        lambda: UnilateralRobotPlant(
            planar_peg(driven=False, friction=0.2), {"wall": 0.3}, pegs=[peg_of(1e-4)]
        ),
        [0.0005, 0.052, 0.0, 0.0, 0.0, 0.0],
        0.05,
    ),
}


@pytest.mark.slow
@mostly_compiled
@pytest.mark.parametrize("name", some(first_quick(FALLING), dear=("a block that rocks",)))
def test_bodies_fall_as_in_drake(name, compiled):
    """To 1e-9 at the end, of a plant without a law and without a loop."""
    make, state, duration = FALLING[name]
    plant = make()
    diagram, context = alone(plant)
    plant.set_state(plant.GetMyMutableContextFromRoot(context), np.array(state))
    start, parameters = start_values(diagram, context)
    times = np.linspace(0.0, duration, 101)
    (found,) = rollout(
        diagram, start, parameters, times, config=fixed(duration / 100), compiled=compiled
    )
    assert found.failure is None
    simulate(diagram, context, duration, fixed(duration / 100))
    own = plant.GetMyContextFromRoot(context)
    assert len(plant.events(own)) > 1
    for port in ("state", *plant.further_signals):
        wanted = plant.GetOutputPort(port).Eval(own)
        np.testing.assert_allclose(found.record[port][-1], wanted, rtol=0.0, atol=1e-9)


def test_what_dips_below_the_floor_within_a_step_is_found():
    """A ball that is thrown at the floor from 1 mm, with steps of 0.3 s."""
    plant = ball(1.0)
    diagram, context = alone(plant)
    plant.set_state(plant.GetMyMutableContextFromRoot(context), np.array([0.001, -1.0]))
    start, parameters = start_values(diagram, context)
    times = np.linspace(0.0, 0.3, 2)
    for compiled in (False, True) if shutil.which("cc") else (False,):
        (found,) = rollout(diagram, start, parameters, times, config=fixed(0.3), compiled=compiled)
        # It returns to the floor with the speed that it left it with.
        energy = 9.81 * 0.001 + 0.5
        z, v = found.record["state"][-1]
        assert z > 0.0
        np.testing.assert_allclose(9.81 * z + v * v / 2.0, energy, rtol=1e-9)


@both
def test_runs_of_many_starts_are_those_of_one_each(compiled):
    plant = ball(0.5)
    diagram, context = alone(plant)
    start, parameters = start_values(diagram, context)
    starts = np.tile(start, (5, 1))
    starts[:, 0] = np.linspace(0.1, 0.5, 5)
    times = np.linspace(0.0, 0.5, 51)
    settings = {"config": fixed(), "compiled": compiled}
    many = rollout(diagram, starts, parameters, times, **settings)
    for begun, run_of_it in zip(starts, many, strict=True):
        (one,) = rollout(diagram, begun, parameters, times, **settings)
        np.testing.assert_array_equal(one.record["state"], run_of_it.record["state"])


def test_a_start_inside_and_too_many_contacts_are_refused():
    plant = ball(0.5)
    diagram, context = alone(plant)
    start, parameters = start_values(diagram, context)
    start[0] = -0.1
    with pytest.raises(InconsistentStateError, match="inside the surface"):
        rollout(diagram, start, parameters, [0.0, 0.1])
    floor = Plane((0.0, 0.0, 0.0), (0.0, 0.0, 1.0))
    feet = [
        PointOnSurface("box", floor, (x, 0.0, -0.5), name=f"foot {i}")
        for i, x in enumerate((-0.2, -0.1, 0.1, 0.2))
    ]
    model = planar_box(feet, driven=False)
    many = UnilateralRobotPlant(model, {foot.name: 0.0 for foot in feet})
    with pytest.raises(ModelError, match="16 modes of its contacts, more than 8, cannot be traced"):
        rollout(alone(many)[0], start, parameters, [0.0, 0.1])


def test_what_a_block_raises_ends_the_run_with_its_record():
    """A rod that jams cannot start; one that lands so fails there, as in Drake."""
    plant = UnilateralRobotPlant(rod(1.5, 1.1), {"floor": 0.0})
    builder = DiagramBuilder()
    builder.AddSystem(plant)
    builder.ExportOutput(plant.GetOutputPort("state"), "state")
    still = builder.AddSystem(ConstantVectorSource(np.zeros(3)))
    builder.Connect(still.get_output_port(), plant.GetInputPort("control"))
    diagram = builder.Build()
    context = diagram.CreateDefaultContext()
    plant.set_state(plant.GetMyMutableContextFromRoot(context), sliding(1.1))
    (found,) = rollout(diagram, *start_values(diagram, context), [0.0, 0.1])
    assert isinstance(found.failure, PainleveError)
    assert found.record.time.size == 0
    above = sliding(1.1) + np.eye(6)[1] * 0.05
    plant.set_state(plant.GetMyMutableContextFromRoot(context), above)
    given = *start_values(diagram, context), np.linspace(0.0, 0.5, 51)
    (found,) = rollout(diagram, *given, config=fixed())
    with pytest.raises(SimulationError) as raised:
        simulate(diagram, context, 0.5, fixed())
    assert type(found.failure) is type(raised.value)
    assert found.failure.time == pytest.approx(raised.value.time, abs=1e-6)
    assert found.failure.time - 0.01 < found.record.time[-1] <= found.failure.time


@pytest.mark.slow
def test_an_opening_at_round_off_of_the_located_time_is_not_missed():
    """At the located time the margin of the wall's force was -1e-15, and the plant kept closed."""
    chosen = scenario("wall_bounce", *settings_of([]))
    loop, context = build_scenario(chosen)
    start, parameters = start_values(loop, context)
    times, config = np.linspace(0.0, 2.4, 151), SimulatorConfig(accuracy=1e-5)
    (fast,) = rollout(loop, start, parameters, times, config=config)
    accurate = SimulatorConfig(accuracy=1e-7)
    (wanted,) = rollout(loop, start, parameters, times, config=accurate)
    # Steps of another length and round-off: 0.1 s of a missed opening are 1e-3.
    np.testing.assert_allclose(fast.record["state"], wanted.record["state"], rtol=0.0, atol=1e-5)
