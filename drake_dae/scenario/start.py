"""Where the runs of a scenario start."""

from contextlib import suppress
from typing import cast

import numpy as np
from pydrake.systems.framework import Context

from drake_dae.arrays import FloatArray
from drake_dae.dae.zero_dynamics.zero_dynamics import ZeroDynamics
from drake_dae.diagrams.closed_loop import ClosedLoop
from drake_dae.diagrams.task_loop import TaskLoop
from drake_dae.errors import InconsistentStateError, ModelError
from drake_dae.robots.model import RobotModel
from drake_dae.scenario.keys import at
from drake_dae.scenario.model import index_of, start_guess
from drake_dae.scenario.scenario import Scenario
from drake_dae.systems.plants.contact.contact_plant import ContactPlant
from drake_dae.systems.plants.robot_plant import RobotPlant

_SLACK = 1e-6
"""How far beyond a limit a joint may start, rad or m: references may begin at the limit."""

_NEAREST = np.array([0.0, -1.0, 1.0])
"""The turns that are tried beside that which is nearest to a guess."""


def new_context(scenario: Scenario, loop: ClosedLoop | TaskLoop) -> Context:
    """A new context of a loop, at a scenario's start_time and with its plant_parameters.

    Raises:
        ScenarioError: A parameter does not fit; the message names its key.
    """
    context = loop.diagram.CreateDefaultContext()
    context.SetTime(scenario.integrator.start_time)
    plant = loop.plant
    if not isinstance(plant, ContactPlant):
        own = plant.GetMyMutableContextFromRoot(context)
        with at("plant_parameters"):
            for name, numbers in scenario.plant_parameters.items():
                plant.set_parameter(own, name, numbers)
    return context


def start_closed_loop(scenario: Scenario, loop: ClosedLoop) -> Context:
    """A new context of a closed loop: at rest, where the references begin, plus the errors.

    The arguments and errors are those of `start_scenario`.
    """
    context, plant = new_context(scenario, loop), loop.plant
    model = cast(RobotPlant, plant).model
    if scenario.gains is not None:  # Those that were advised are in the law.
        with at("gains"):
            of_law = loop.controller.GetMyMutableContextFromRoot(context)
            loop.controller.set_gains(of_law, scenario.gains.design())
    own = plant.GetMyMutableContextFromRoot(context)
    parameters = plant.current_parameters(own)
    wanted = _wanted(scenario.start.errors, loop, context.get_time())
    positions, forces = np.split(wanted, [len(model.position_signals)])
    with at("start"):
        guess = start_guess(scenario.start.positions, model.links)
        q = _configuration(model, positions, guess, parameters)
        state = model.rest_state(q, forces, parameters)
        if scenario.exogenous:
            state = _in_motion(loop, context, wanted, state)
        plant.set_consistent_state(own, state)
    if loop.sensor is not None:
        force = model.rest_forces(q, forces, parameters)
        loop.sensor.set_force(loop.sensor.GetMyMutableContextFromRoot(context), force)
        loop.set_seed(context, scenario.force.seed)
    if loop.encoders is not None and scenario.encoders is not None:
        loop.encoders.set_seed(context, scenario.encoders.seed)
    return context


def _in_motion(
    loop: ClosedLoop, context: Context, wanted: FloatArray, guess: FloatArray
) -> FloatArray:
    """The state whose outputs move as their references do, but for their errors.

    Where something moves, nothing that touches it is at rest.
    """
    law, controller = loop.controller.law, loop.controller
    goal = loop.reference.reference(context.get_time())
    goal[law.layout.lowest] = wanted
    parameters = controller.current_parameters(controller.GetMyContextFromRoot(context))
    return ZeroDynamics(law.system, structure=law.structure).state(goal, guess, parameters)


@at("start.errors")
def _wanted(errors: dict[str, float], loop: ClosedLoop, time: float) -> FloatArray:
    """z at the start: the references plus the errors, shape (p,)."""
    degrees = loop.controller.law.degrees
    wanted = loop.controller.law.layout.values(loop.reference.reference(time))
    for name, error in errors.items():
        index = index_of(name, loop.plant.dae.output_signals, "output")
        if degrees[index] == 0:
            raise ModelError(
                f"'{name}' has degree 0: the law meets it at once and it has no start error"
            )
        wanted[index] += error
    return wanted


def _configuration(
    model: RobotModel, positions: FloatArray, guess: FloatArray, parameters: FloatArray
) -> FloatArray:
    """q with given position outputs, on the constraints, without whole turns and within limits."""
    try:
        found = model.configuration(positions, guess, parameters)
        q = _unwound(model, positions, found, guess, parameters)
    except InconsistentStateError as error:
        goal = ", ".join(
            f"{signal.name} = {value:.4g} {signal.unit}".rstrip()
            for signal, value in zip(model.position_signals, positions, strict=True)
        )
        raise ModelError(
            f"found no configuration near start.positions with {goal} (the references and "
            f"start.errors at the start) on the constraints: {error}"
        ) from error
    low, high = model.links.position_limits
    outside = [
        f"{signal.name} = {value:.4g} {signal.unit}, and its limits are {least:g} to {most:g}"
        for signal, value, least, most in zip(
            model.links.position_signals, q, low, high, strict=True
        )
        if not least - _SLACK <= value <= most + _SLACK
    ]
    if outside:
        raise ModelError(
            f"the robot cannot start outside of its limits, and the start near start.positions has "
            f"{'; '.join(outside)}. Change the first values of the references, or give "
            "start.positions of all joints near where they shall be"
        )
    return q


def _unwound(
    model: RobotModel,
    positions: FloatArray,
    found: FloatArray,
    guess: FloatArray,
    parameters: FloatArray,
) -> FloatArray:
    """A configuration whose joints are whole turns nearer to a guess, or within their limits.

    Newton's method may turn a joint often. A turn stays where an output, a constraint or a limit
    asks for it.
    """
    q, turn = found, 2 * np.pi
    for index, signal in enumerate(model.links.position_signals):
        if signal.unit != "rad":
            continue
        low, high = (limits[index] for limits in model.links.position_limits)
        turns = q[index] - turn * np.round((q[index] - guess[index]) / turn) + turn * _NEAREST
        inside = [value for value in turns if low - _SLACK <= value <= high + _SLACK]
        nearest = min(inside, key=lambda value: abs(value - guess[index]), default=q[index])
        if abs(nearest - q[index]) < 1.0:
            continue
        trial = q.copy()
        trial[index] = nearest
        with suppress(InconsistentStateError):
            settled = model.configuration(positions, trial, parameters)
            q = settled if np.max(np.abs(settled - trial)) < 1e-6 else q
    return q
