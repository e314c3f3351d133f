"""Rollouts of tasks against Drake's Simulator."""

import numpy as np
import pytest
from polishing import CLIMB, PERIOD, push, run_on, started, task_loop
from pydrake.systems.analysis import SimulatorConfig
from runs import mostly_compiled, some

from drake_dae import (
    Approach,
    Condition,
    Dwell,
    Move,
    Press,
    Release,
    Retreat,
    Sampling,
    rollout,
    simulate,
    start_values,
)
from drake_dae.errors import SimulationError
from drake_dae.running.rollout.program import program_of


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
    "sampled and pulled off": lambda: pulled(
        Approach(0.1, over=0.1),
        Press(10.0, over=0.2, if_lost="hold"),
        pull=-8.0,
        sampling=Sampling(0.002, 0.002),
    ),
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
    "waits in vain": lambda: pulled(Approach(0.01, within=0.1, if_late="hold")),
    **{
        f"is pulled off: {reaction}": lambda reaction=reaction: pulled(
            Approach(0.1, over=0.1), Press(10.0, over=0.2, if_lost=reaction), pull=-8.0
        )
        for reaction in ("hold", "stop", "fail", "approach")
    },
}


def assert_same_records(found, wanted, tolerance):
    assert list(found.signals) == list(wanted.signals)
    count = min(found.time.size, wanted.time.size)
    for name, recorded in wanted.signals.items():
        scale = max(1.0, np.max(np.abs(recorded.values), initial=0.0))
        off = np.abs(found[name][:count] - recorded.values[:count]).max(axis=1) / scale
        assert off.max() < tolerance, name


@pytest.mark.slow
@mostly_compiled
@pytest.mark.parametrize("name", some(TASKS, of=4))
def test_tasks_are_those_of_drake(name, compiled):
    """To 1e-9: when each phase begins and why, and all signals; or why the run fails."""
    loop, context = TASKS[name]()
    start, parameters = start_values(loop, context)
    failure, end = None, 0.8
    try:
        simulate(loop.diagram, context, end)
    except SimulationError as error:
        failure = error
    wanted = loop.record(context)
    # A run that ends at a change has its last row there.
    more = [wanted.time[-1] + PERIOD] if wanted.time[-1] < end - 1e-6 else []
    times = np.append(wanted.time, more)
    config = SimulatorConfig()
    (found,) = rollout(loop, start, parameters, times, config=config, compiled=compiled)
    assert type(found.failure) is type(failure)
    if failure is not None:
        assert found.failure.time == pytest.approx(failure.time, abs=1e-9)
        assert str(found.failure)[:40] == str(failure)[:40]
    changes, told = loop.changes(context), loop.changes(found.context)
    assert len(changes) > 1
    assert [(one.phase, one.reason) for one in told] == [(one.phase, one.reason) for one in changes]
    np.testing.assert_allclose(
        [one.time for one in told], [one.time for one in changes], rtol=0.0, atol=1e-9
    )
    assert_same_records(found.record, wanted, 1e-9)


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
