"""Rollouts of tasks against Drake's Simulator."""

import pytest
from golden.cases import FIXTURE
from polishing import CLIMB, push, started, task_loop
from pydrake.systems.analysis import ApplySimulatorConfig, Simulator, SimulatorConfig
from runs import close_records, mostly_compiled, some

from drake_dae import (
    Approach,
    Dwell,
    Move,
    Press,
    Release,
    Retreat,
    Sampling,
    build_scenario,
    load_scenario,
    rollout,
    simulate,
)
from drake_dae.running import start_values
from drake_dae.systems import Condition


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
    "sampled and late": lambda: pulled(*HOLDING, *LEAVING, sampling=Sampling(0.004, 0.002)),
    "feels, tries again and is stopped by guards": lambda: pulled(
        Approach(
            0.1,
            over=0.05,
            until=[Condition("force", above=2.0)],
            guards=[Condition("travel", above=0.004)],
            on_failure="feel",
            name="feel",
            retries=1,
        ),
        Press(10.0, over=0.1, guards=[Condition("time", above=0.5)]),
        Move({"tool.z": CLIMB}, 0.5, guards=[Condition("force", above=25.0)], if_lost="Release"),
        Release(over=0.1, guards=[Condition("control", above=300.0)]),
        pull=-8.0,
    ),
    "waits and leaves": lambda: pulled(
        *HOLDING,
        Dwell(
            until=[Condition("signal", above=0.5, name="ready"), Condition("time", above=0.1)],
            over=0.05,
        ),
        Move(
            {"tool.z": CLIMB},
            0.5,
            over=0.1,
            guards=[Condition("time", above=0.2)],
            on_failure="leave",
        ),
    ),
    "begins in contact": lambda: pulled(Press(5.0, over=0.05), Dwell(0.1), Release(over=0.05)),
    "is pulled off": lambda: pulled(
        Approach(0.1, over=0.1), Press(10.0, over=0.2, if_lost="approach"), pull=-8.0
    ),
}


def assert_same_records(found, wanted, tolerance):
    assert list(found.signals) == list(wanted.signals)
    count = min(found.time.size, wanted.time.size)
    close_records(found, wanted, tolerance, slice(count))


@pytest.mark.slow
@mostly_compiled
@pytest.mark.parametrize("name", some(TASKS, of=3))
def test_tasks_are_those_of_drake(name, compiled):
    """To 1e-9: when each phase begins and why, and all signals."""
    loop, context = TASKS[name]()
    start, parameters = start_values(loop, context)
    simulate(loop.diagram, context, 0.8)
    wanted = loop.record(context)
    config = SimulatorConfig()
    (found,) = rollout(loop, start, parameters, wanted.time, config=config, compiled=compiled)
    assert found.failure is None
    changes = loop.changes(wanted)
    assert len(changes) > 1
    told = [(one.phase, one.reason, one.time) for one in loop.changes(found.record)]
    assert told == [(one.phase, one.reason, pytest.approx(one.time, abs=1e-9)) for one in changes]
    assert_same_records(found.record, wanted, 1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("plant", ["!CompliantContact", "!MultibodyPlant"])
def test_wall_polish_is_the_same_in_the_simulator(plant):
    """To 1e-9, through touch, press and slide, on contact that is traced and on Drake's own."""
    settings = [
        f"plant={plant} {{radius: 1.0e-5}}",
        "sampling={period: 0.001, delay: 0.001}",
        "integrator.use_error_control=false",
        "integrator.max_step_size=0.001",
        "task.phases.0.duration=0.3",
        "task.phases.0.over=0.3",
        "task.phases.1.speed=0.05",
        "duration=3",
    ]
    chosen = load_scenario(FIXTURE.with_name("wall_polish.yaml"), settings)
    loop, context = build_scenario(chosen)
    start, parameters = start_values(loop, context)
    simulator = Simulator(loop.diagram, context)
    ApplySimulatorConfig(chosen.integrator, simulator)
    simulator.AdvanceTo(chosen.duration)
    wanted = loop.record(context)
    (found,) = rollout(loop, start, parameters, wanted.time, config=chosen.integrator)
    assert found.failure is None
    changes = loop.changes(found.record)
    assert [change.phase for change in changes] == ["Move", "Approach", "Press", "Move 2"]
    assert loop.changes(wanted)[-1].reason == changes[-1].reason
    assert_same_records(found.record, wanted, 1e-9)
