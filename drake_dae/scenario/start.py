"""Where the runs of a scenario start."""

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
        # Where nothing is said, near what the robot was completed with: that is told nowhere else.
        guess = start_guess(scenario.start.positions, model.links, model.nominal_positions)
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
    """q with given position outputs, on the constraints."""
    try:
        return model.configuration(positions, guess, parameters)
    except InconsistentStateError as error:
        goal = ", ".join(
            f"{signal.name} = {value:.4g} {signal.unit}".rstrip()
            for signal, value in zip(model.position_signals, positions, strict=True)
        )
        raise ModelError(
            f"found no configuration near start.positions with {goal} (the references and "
            f"start.errors at the start) on the constraints: {error}"
        ) from error
