"""The two-link arm and a task on its wall, which gives way: with a hand that can pull it off."""

from collections.abc import Sequence
from functools import cache

import numpy as np
from arms import arm, parse
from pydrake.systems.analysis import SimulatorConfig
from pydrake.systems.framework import Context

from drake_dae import (
    Approach,
    ClosedLoop,
    CompliantPlant,
    Move,
    PointToPointReference,
    Press,
    Release,
    Retreat,
    RobotModel,
    Sampling,
    Task,
    TaskController,
    TrackingLaw,
    poles,
    simulate,
)
from drake_dae.diagrams import LoopSettings, wire_loop
from drake_dae.robots import KnownForce
from drake_dae.running.judgement import RunStatistics
from drake_dae.systems import PointMaterial, open_contact
from drake_dae.systems.phases import Phase

SPEED, OVER, FAR = 0.05, 0.2, 0.02
POLE = -8.0
PERIOD = 1e-3
CLIMB = PointToPointReference(0.3, 0.4, 0.0, 0.4)
WHOLE = (
    Approach(SPEED, over=OVER),
    Press(20.0, over=0.2),
    Move({"tool.z": CLIMB}, 0.5, over=0.2),
    Release(over=0.2),
    Retreat(0.03, over=0.4),
)


@cache
def polisher() -> RobotModel:
    """The arm of `arms.touching`, with a known force "push" on its tool."""
    known = arm("two_link").model
    return RobotModel.from_multibody(
        parse("two_link_arm"),
        known.constraints,
        known.outputs,
        [1.2, -1.6],
        "two_link",
        known_forces=[KnownForce("tool", name="push")],
    )


@cache
def laws() -> tuple[TrackingLaw, TrackingLaw]:
    """In contact, whose constraint the law damps, and of the free arm, soft toward the wall."""
    system = polisher().dae
    law = TrackingLaw(system, poles(-25.0), constraint_damping=poles(-250.0))
    free = open_contact(system, "wall.force")
    return law, TrackingLaw(free, poles({"tool.z": -25.0, "wall.distance": POLE}))


def soft_wall() -> CompliantPlant:
    """The arm at a wall of 1e5 N/m, in steps of PERIOD."""
    return CompliantPlant(polisher(), PointMaterial(PERIOD, stiffness=1e5, radius=1e-5))


def task_loop(
    phases: Sequence[Phase], sampling: Sampling | None = None, **settings: float
) -> ClosedLoop:
    """A wall of 1e5 N/m under a task; the law acts at each step, or as it is sampled."""
    period = PERIOD if sampling is None else sampling.period
    controller = TaskController(Task(phases, **settings), *laws(), sample_period=period)
    return wire_loop(soft_wall(), controller, settings=LoopSettings(sampling=sampling))


def started(loop: ClosedLoop, distance: float = FAR) -> Context:
    """A context of a loop with the arm at rest, off the wall."""
    context = loop.diagram.CreateDefaultContext()
    guess = polisher().dae.nominal_state
    loop.set_state(context, loop.controller.rest_state([0.3, distance], guess))
    return context


def run_on(loop: ClosedLoop, context: Context, end: float) -> RunStatistics:
    """Goes on until a time."""
    config = SimulatorConfig(start_time=context.get_time())
    return simulate(loop.diagram, context, end - context.get_time(), config)


def push(loop: ClosedLoop, context: Context, force: float) -> None:
    """A hand that pushes the tool into the wall, or pulls it off."""
    own = loop.plant.GetMyMutableContextFromRoot(context)
    loop.plant.set_parameter(own, "push.force", np.array([force, 0.0, 0.0]))
