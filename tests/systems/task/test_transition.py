"""Phases that change within a traced update, against the supervisor in Drake's Simulator."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from polishing import CLIMB, FAR, OVER, PERIOD, SPEED, push, started, task_loop
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Context
from runs import some

from drake_dae import (
    Approach,
    ClosedLoop,
    Condition,
    Dwell,
    Move,
    Press,
    Release,
    Retreat,
)
from drake_dae.blocks.computations import HELD as NUMBERS
from drake_dae.blocks.computations import PARAMETERS, TIME, Computation
from drake_dae.errors import SimulationError

TOUCH, PRESS = Approach(SPEED, over=OVER, name="touch"), Press(10.0, over=0.05)
GENTLE = Condition("force", above=8.0)
CLOSER = Move(
    {"wall.distance": -0.1},
    until=[Condition("force", above=2.0)],
    guards=[Condition("travel", above=0.004)],
    over=0.5,
    name="feel",
)
AWAY = Retreat(0.01, over=0.2, tolerance=0.005)


TASKS = {
    "all succeed": [TOUCH, PRESS, Move({"tool.z": CLIMB}, 0.3, over=0.1), Release(over=0.1), AWAY],
    "rest in contact": [TOUCH, PRESS, Dwell(0.1)],
    "a guard of force": [
        TOUCH,
        Press(10.0, 3.0, over=0.1, guards=[GENTLE], on_failure="leave"),
    ],
    "a guard of control": [
        TOUCH,
        Press(30.0, guards=[Condition("control", above=31.0)], on_failure="stop"),
    ],
    "a guard of travel, twice again, then stop": [
        replace(CLOSER, on_failure="feel", retries=2, if_spent="stop")
    ],
    "a guard of travel, then another phase": [
        replace(CLOSER, on_failure="feel", retries=1, if_spent="Retreat", on_success="Press"),
        PRESS,
        Dwell(0.1, on_success="done"),
        AWAY,
    ],
    "late": [Approach(0.01, within=0.1, if_late="stop")],
    "lost, once back": [TOUCH, PRESS, Dwell(2.0, if_lost="approach")],
    "lost, to another phase": [
        TOUCH,
        PRESS,
        Dwell(2.0, if_lost="back", on_success="done"),
        Retreat(0.03, over=0.2, name="back"),
    ],
    "lost, at rest": [TOUCH, PRESS],
    "until a distance": [
        Move({"wall.distance": 0.01}, over=0.3, until=[Condition("distance", below=0.015)]),
        TOUCH,
    ],
    "a signal that never comes": [
        Dwell(until=[Condition("signal", above=0.5, name="ready")], within=0.1, if_late="hold")
    ],
    "fails": [CLOSER],
}
"""Phases; those whose contact is lost have a hand that pulls from 0.9 s to 1.3 s."""


def numbers(loop: ClosedLoop, root: Context, computation: Computation) -> np.ndarray:
    """The results of a computation of the supervisor, from the values of its ports in Drake."""
    supervisor = loop.controller.supervisor
    context = supervisor.GetMyContextFromRoot(root)
    own = {
        TIME: context.get_time(),
        NUMBERS: context.get_discrete_state_vector().value(),
        PARAMETERS: context.get_numeric_parameter(0).value(),
    }
    arguments = []
    for source in computation.sources:
        if source not in own:
            port = supervisor.GetInputPort(source)
            own[source] = port.Eval(context) if port.HasValue(context) else np.zeros(port.size())
        arguments.append(own[source])
    return computation.function(*arguments).full()[:, 0]


def state(loop: ClosedLoop, root: Context) -> np.ndarray:
    context = loop.controller.supervisor.GetMyContextFromRoot(root)
    return context.get_discrete_state_vector().CopyToVector()


@pytest.mark.parametrize("name", some(TASKS, of=3))
def test_each_sample_has_the_numbers_of_the_supervisor(name):
    """Also at changes of phases: the same formulas, so that only the order of sums differs."""
    tare_time = 0.05 * (name == "all succeed")
    loop = task_loop(TASKS[name], tare_time=tare_time, retries=1)
    context = started(loop, FAR)
    reaction = loop.controller.supervisor.traced().guard.reaction()
    simulator = Simulator(loop.diagram, context)
    begun = numbers(loop, context, reaction.begin)
    simulator.Initialize()
    assert_allclose(begun, state(loop, context), rtol=0, atol=1e-12)
    places = set[float]()
    for tick in range(1, 1600):
        pulls = "lost" in name and 0.9 < tick * PERIOD < 1.3
        push(loop, context, -60.0 if pulls else 0.0)
        simulator.AdvanceTo(tick * PERIOD)
        after = numbers(loop, context, reaction.update.computation)
        try:
            status = simulator.AdvancePendingEvents()
        except SimulationError:
            assert name == "fails"
            assert after[9] == 4.0
            return
        assert_allclose(after, state(loop, context), rtol=1e-9, atol=1e-9)
        places.add(after[0])
        if status.reason() != status.ReturnReason.kReachedBoundaryTime:
            break
    changes = loop.changes(context)
    assert len(changes) > 1
    assert places >= {change.place for change in changes[1:]}
    port = loop.controller.GetOutputPort("ending")
    (ending,) = port.Eval(loop.controller.GetMyContextFromRoot(context))
    assert ending == after[9]
