"""The start of the runs of a scenario."""

from collections.abc import Callable
from contextlib import suppress
from typing import cast

import numpy as np
from pydrake.systems.framework import Context

from drake_dae.arrays import FloatArray
from drake_dae.dae.tracking.gains import FeedbackGains
from drake_dae.dae.zero_dynamics.zero_dynamics import ZeroDynamics
from drake_dae.diagrams.closed_loop import ClosedLoop
from drake_dae.errors import InconsistentStateError, ModelError
from drake_dae.robots.model import RobotModel
from drake_dae.scenario.controllers.task_controller import opening_contact
from drake_dae.scenario.forms.keys import at
from drake_dae.scenario.model import index_of, start_guess
from drake_dae.scenario.own_model import begin_own_model
from drake_dae.scenario.parts.parts import Gains
from drake_dae.scenario.scenario import Scenario

_SLACK = 1e-6
"""The allowed excess over a joint limit at the start, rad or m: references may start at the
limit. Also the allowed depth behind a surface, in m."""

_TURNS = np.array([0.0, -1.0, 1.0])
"""The whole turns that are tried, relative to the number of turns nearest to a guess."""


def start_scenario(scenario: Scenario, loop: ClosedLoop) -> Context:
    """A context of a closed loop at a scenario's start.

    The robot is at rest or, with exogenous motion, moves with the references. A law starts at its
    references plus the errors, with outputs as in its model, where `plant.parameters` may differ,
    and on the plant's constraints; a task at start.positions, in contact if its first phase needs
    it.

    Args:
        scenario: The scenario of the loop; start, plant.parameters, integrator, the numbers of
            uncoupled gains, and the seed of the sensor may be others than those it was built with.
        loop: What `build_completed` made.

    Raises:
        ScenarioError: There is no such start, or something does not fit; the message names the key.
    """
    context = loop.diagram.CreateDefaultContext()
    _set_numbers(scenario, loop, context)
    if loop.controller.takes_over:
        _begin_at_rest(scenario, loop, context)
    else:
        _begin_with_references(scenario, loop, context)
    return context


def _set_numbers(scenario: Scenario, loop: ClosedLoop, context: Context) -> None:
    """Sets all numbers of a context of a closed loop but those that `start` gives."""
    if scenario.integrator.start_time < 0.0 and (loop.plant.time_step or scenario.sampling):
        with at("integrator.start_time"):
            raise ModelError(
                "steps and samples begin at 0 s in Drake, and a run with them no earlier, got "
                f"{scenario.integrator.start_time:g} s"
            )
    context.SetTime(scenario.integrator.start_time)
    plant, controller = loop.plant, loop.controller
    at_plant = plant.GetMyMutableContextFromRoot(context)
    if not scenario.plant.carries:
        with at("plant.parameters"):
            for name, numbers in scenario.plant.parameters.items():
                plant.set_parameter(at_plant, name, numbers)
    begin_own_model(scenario, plant, at_plant)
    with at("plant"):
        scenario.plant.begin(plant, at_plant)
    force, encoders = scenario.sensors.force, scenario.sensors.encoders
    if loop.sensor is not None and force is not None:
        with at("sensors.force"):
            at_sensor = loop.sensor.GetMyMutableContextFromRoot(context)
            loop.sensor.set_errors(at_sensor, force.bias, force.noise_deviation, force.drift)
    gains = scenario.law.gains
    if gains is not None and not controller.takes_over:  # Advised gains are in the law.
        with at("law.gains"):
            at_controller = controller.GetMyMutableContextFromRoot(context)
            controller.set_gains(at_controller, _designed(gains, loop))
    loop.set_seed(context, 0 if force is None else force.seed)
    if loop.encoders is not None and encoders is not None:
        loop.encoders.set_seed(context, encoders.seed)


def _begin_at_rest(scenario: Scenario, loop: ClosedLoop, context: Context) -> None:
    """Starts plant and sensor at rest at start.positions, or next to them on the constraints."""
    plant = loop.plant
    model, at_plant = plant.robot("a scenario"), plant.GetMyMutableContextFromRoot(context)
    parameters = plant.current_parameters(at_plant)
    forces = np.zeros(model.dae.num_outputs - len(model.position_signals))
    with at("start"):
        guess = start_guess(scenario.start.positions, model.links)
        near = model.rest_state(guess, forces, parameters)
        structure = loop.controller.start_structure
        of_law = structure.system.parameters_of(plant.dae, parameters)
        q = structure.manifold.settle(near, of_law)[: guess.size]
        _check_limits(model, q, "Give")
        at_rest = model.rest_state(q, forces, parameters)
        if scenario.exogenous and not structure.manifold.is_consistent(at_rest, of_law):
            raise ModelError(
                "a task begins at rest, and its first phase in contact with a surface that moves "
                "then; begin with a phase without contact, such as Approach"
            )
        _check_outside(scenario, model, at_rest, model.dae.parameters_of(plant.dae, parameters))
        plant.set_state(at_plant, at_rest)
    _begin_sensor(loop, context, q, forces)


def _check_outside(
    scenario: Scenario, model: RobotModel, state: FloatArray, parameters: FloatArray
) -> None:
    """Refuses a start behind a surface of a task that begins without contact.

    On a contact that gives way it may be as deep as the force that counts as none presses it.
    """
    task, material = scenario.task, scenario.plant.material
    if task is None or (plan := task.make().plan).contacts[0]:
        return
    for contact in opening_contact(scenario, model):
        if (touch := contact.touch(model.links)) is None:
            continue
        place = model.links.position(touch.frame, touch.point)
        above = model.dae.trace("start", {"above": touch.clearance(place)}, often=False)
        depth = -above(state, parameters)[0].item()
        if depth > _SLACK and (
            material is None
            or depth * material.stiffness_on(model, task.contact_force) > task.contact_force
        ):
            raise ModelError(
                f"start.positions put the point of '{contact.name}' {depth:.3g} m behind its "
                f"surface, and {plan.phases[0].name} begins in front of it; start outside, or turn "
                "the normal of the surface around if its free side is the other one"
            )


def _begin_sensor(loop: ClosedLoop, context: Context, q: FloatArray, forces: FloatArray) -> None:
    """Starts the force sensor, if there is one, at the constraint forces at rest."""
    if loop.sensor is not None:
        plant = loop.plant
        parameters = plant.current_parameters(plant.GetMyContextFromRoot(context))
        force = plant.robot("a scenario").rest_forces(q, forces, parameters)
        loop.sensor.set_force(loop.sensor.GetMyMutableContextFromRoot(context), force)


def _begin_with_references(scenario: Scenario, loop: ClosedLoop, context: Context) -> None:
    """Starts plant and sensor at the references plus the errors."""
    plant = loop.plant
    model, at_plant = plant.robot("a scenario"), plant.GetMyMutableContextFromRoot(context)
    parameters = plant.current_parameters(at_plant)
    outputs = _outputs_at_start(scenario.start.errors, loop, context.get_time())
    count = len(model.position_signals)
    positions, forces = outputs[:count], outputs[count:]
    with at("start"):
        # By default near the start of the completion, which is not reported elsewhere.
        guess = start_guess(scenario.start.positions, model.links, model.nominal_positions)
        q = _configuration(model, positions, guess, parameters, _of_law(loop, parameters))
        state = model.balance.state(q, forces, parameters)
        if scenario.exogenous:
            state = _in_motion(loop, context, outputs, state)
        plant.set_consistent_state(at_plant, state)
    _begin_sensor(loop, context, q, forces)


def _of_law(loop: ClosedLoop, parameters: FloatArray) -> FloatArray:
    """The parameters of the plant's system as the law assumes them, shape (k,).

    Exogenous ones are measured: law and plant have the same.
    """
    dae, system = loop.plant.dae, loop.controller.law.system
    moving = {p.name for p in dae.exogenous.moving}
    sizes, assumed = {p.name: p.value.size for p in system.parameters}, system.parameter_values
    of_law = parameters.copy()
    for p in dae.parameters:
        if p.name not in moving and sizes.get(p.name) == p.value.size:
            of_law[dae.parameter_slice(p.name)] = assumed[system.parameter_slice(p.name)]
    return of_law


def _designed(gains: Gains, loop: ClosedLoop) -> FeedbackGains:
    """The gains of a scenario; those of the last run are reused if the design is the same."""
    key, design = loop.memory.get("gains", ("", None))
    if key != repr(gains):
        design = loop.controller.law.design(gains.design())
        loop.memory["gains"] = repr(gains), design
    return cast(FeedbackGains, design)


def _in_motion(
    loop: ClosedLoop, context: Context, outputs: FloatArray, guess: FloatArray
) -> FloatArray:
    """The state with these outputs, whose rates are those of the references.

    With exogenous motion the robot cannot start at rest.
    """
    law, controller = loop.controller.law, loop.controller
    goal = loop.reference.reference(context.get_time())
    goal[law.layout.lowest] = outputs
    parameters = controller.current_parameters(controller.GetMyContextFromRoot(context))
    return ZeroDynamics(law.system, structure=law.structure).state(goal, guess, parameters)


@at("start.errors")
def _outputs_at_start(errors: dict[str, float], loop: ClosedLoop, time: float) -> FloatArray:
    """z at the start: the references plus the errors, shape (p,)."""
    degrees = loop.controller.law.degrees
    outputs = loop.controller.law.layout.values(loop.reference.reference(time))
    for name, error in errors.items():
        index = index_of(name, loop.plant.dae.output_signals, "output")
        if degrees[index] == 0:
            raise ModelError(
                f"'{name}' has degree 0: the law meets it at once and it has no start error"
            )
        outputs[index] += error
    return outputs


def _configuration(
    model: RobotModel,
    positions: FloatArray,
    guess: FloatArray,
    parameters: FloatArray,
    of_law: FloatArray,
) -> FloatArray:
    """q with the position outputs of the law, on the plant's constraints, within limits.

    Whole turns are removed.
    """

    def solve(start: FloatArray) -> FloatArray:
        return model.placing.solve(positions, start, parameters, of_law)

    try:
        q = _unwound(model, solve, solve(guess), guess)
    except InconsistentStateError as error:
        goal = ", ".join(
            f"{signal.name} = {value:.4g} {signal.unit}".rstrip()
            for signal, value in zip(model.position_signals, positions, strict=True)
        )
        raise ModelError(
            f"found no configuration near start.positions with {goal} (the references and "
            f"start.errors at the start) on the constraints: {error}"
        ) from error
    _check_limits(model, q, "Change the first values of the references, or give")
    return q


def _check_limits(model: RobotModel, q: FloatArray, remedy: str) -> None:
    """Checks that all joints of a configuration are within their limits."""
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
            f"{'; '.join(outside)}. {remedy} start.positions of all joints near where they shall be"
        )


def _unwound(
    model: RobotModel,
    solve: Callable[[FloatArray], FloatArray],
    solution: FloatArray,
    guess: FloatArray,
) -> FloatArray:
    """Removes whole turns of joints from a configuration, as far as limits and outputs permit.

    Newton's method may add whole turns to a joint. `solve` returns a configuration near a guess.
    """
    q, turn = solution, 2 * np.pi
    limits = model.links.position_limits
    is_inside = (limits[0] - _SLACK <= q) & (q <= limits[1] + _SLACK)
    is_wound = ~is_inside | (np.abs(q - guess) >= np.pi)
    if not is_wound.any():
        return q
    for index in np.flatnonzero(is_wound):
        if model.links.position_signals[index].unit != "rad":
            continue
        low, high = limits[0][index], limits[1][index]
        turns = q[index] - turn * np.round((q[index] - guess[index]) / turn) + turn * _TURNS
        inside = [value for value in turns if low - _SLACK <= value <= high + _SLACK]
        nearest = min(inside, key=lambda value: abs(value - guess[index]), default=q[index])
        if abs(nearest - q[index]) < 1.0:
            continue
        trial = q.copy()
        trial[index] = nearest
        with suppress(InconsistentStateError):
            settled = solve(trial)
            q = settled if np.max(np.abs(settled - trial)) < 1e-6 else q
    return q
