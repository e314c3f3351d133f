"""The start of the runs of a scenario."""

from collections.abc import Callable
from contextlib import suppress

import numpy as np
from numpy.typing import ArrayLike
from pydrake.systems.framework import Context

from drake_dae.arrays import FloatArray
from drake_dae.dae import ZeroDynamics, places_of
from drake_dae.diagrams.closed_loop import ClosedLoop
from drake_dae.errors import InconsistentStateError, ModelError, ScenarioError
from drake_dae.robots import Constraint, Links, RobotModel
from drake_dae.scenario.form import at
from drake_dae.scenario.postures import unwound
from drake_dae.scenario.scenario import Scenario

_SLACK = 1e-6
"""The allowed excess over a joint limit at the start, rad or m: references may start at the
limit. Also the allowed depth behind a surface, in m."""


def start_scenario(scenario: Scenario, loop: ClosedLoop) -> Context:
    """A context of a closed loop at a scenario's start; see `Start`.

    start, plant.parameters, integrator, numbers of gains and seeds may differ from the loop's.
    """
    context, plant, controller = loop.diagram.CreateDefaultContext(), loop.plant, loop.controller
    at_plant, of_plant = plant.GetMyMutableContextFromRoot(context), scenario.plant

    # The numbers that `start` does not give.
    begin = scenario.integrator.start_time
    if begin < 0.0 and (plant.time_step or scenario.sampling):
        text = "steps and samples begin at 0 s in Drake, and a run with them no earlier"
        raise ScenarioError(("integrator.start_time", f"{text}, got {begin:g} s"))
    context.SetTime(begin)
    numbers = dict[str, dict[str, ArrayLike]]()
    if not of_plant.carries:
        pushes = enumerate(of_plant.disturbances)
        numbers["plant.parameters"] = dict(of_plant.parameters)
        numbers["plant.payloads"] = {f"{p.name}.mass": p.mass for p in of_plant.payloads}
        numbers["plant.disturbances"] = {f"plant_disturbance_{i}.force": d.force for i, d in pushes}
    parameters = plant.parameters(at_plant)
    for key, values in numbers.items():
        with at(key):
            for name, value in values.items():
                # A user's own plant may not let numbers be set, and has been made with these.
                if not np.array_equal(parameters[plant.dae.parameter_slice(name)], np.ravel(value)):
                    plant.set_parameter(at_plant, name, value)
    with at("plant"):
        of_plant.begin(plant, at_plant)
    force, encoders, gains = scenario.sensors.force, scenario.sensors.encoders, scenario.law.gains
    if loop.sensor is not None and force is not None:
        with at("sensors.force"):
            at_sensor = loop.sensor.GetMyMutableContextFromRoot(context)
            loop.sensor.set_errors(at_sensor, force.bias, force.noise_deviation, force.drift)
    if gains is not None and not controller.takes_over:
        with at("law.gains"):
            controller.set_gains(controller.GetMyMutableContextFromRoot(context), gains.design())
    loop.set_seed(context, force.seed if force else 0, encoders.seed if encoders else None)

    # The state.
    model = plant.robot("a scenario")
    parameters, count = plant.current_parameters(at_plant), len(model.position_signals)
    forces, nq = np.zeros(model.dae.num_outputs - count), model.links.q.numel()
    is_steered = not controller.takes_over and model.dae.num_controls > 0
    with at("start"):
        if is_steered:
            goal, law = loop.reference.reference(context.get_time()), controller.law
            outputs = law.layout.values(goal)
            for name, error in scenario.start.errors.items():
                with at("start.errors"):
                    (index,) = places_of("output", [name], plant.dae.output_signals)
                    if law.degrees[index] == 0:
                        text = "has degree 0: the law meets it at once and it has no start error"
                        raise ModelError(f"'{name}' {text}")
                outputs[index] += error
            # The law assumes its own values of parameters; exogenous ones are measured.
            sizes, of_law = {p.name: p.value.size for p in law.system.parameters}, parameters.copy()
            for p in plant.dae.parameters:
                if not p.exogenous and sizes.get(p.name) == p.value.size:
                    assumed = law.system.parameter_values[law.system.parameter_slice(p.name)]
                    of_law[plant.dae.parameter_slice(p.name)] = assumed
            forces = outputs[count:]
            state = start_state(scenario, model, outputs, parameters, of_law)
        else:
            state = _at_rest(scenario, loop, model, forces, parameters)
            plant.set_state(at_plant, state)
        if not controller.takes_over:
            moving = state.copy()
            if scenario.exogenous:  # The state with these outputs and the rates of the references.
                goal[law.layout.lowest] = outputs
                own = controller.current_parameters(controller.GetMyContextFromRoot(context))
                zeros = ZeroDynamics(law.system, structure=law.structure)
                moving = zeros.state(goal, state, own).copy()
            for name, value in scenario.start.velocities.items():
                with at("start.velocities"):
                    (index,) = places_of("velocity", [name], model.links.velocity_signals)
                    moving[nq + index] = value
            plant.set_consistent_state(at_plant, moving, [*scenario.start.velocities])
    if loop.sensor is not None:
        _, rest, _ = model.balance.rest(state[:nq], forces, parameters)
        loop.sensor.set_force(loop.sensor.GetMyMutableContextFromRoot(context), rest)
    return context


def _at_rest(
    scenario: Scenario,
    loop: ClosedLoop,
    model: RobotModel,
    forces: FloatArray,
    parameters: FloatArray,
) -> FloatArray:
    """The state at rest at start.positions, or next to them on the constraints."""
    structure = loop.controller.start_structure
    of_law = structure.system.parameters_of(loop.plant.dae, parameters)

    def settled(near: FloatArray) -> FloatArray:
        rest = model.rest_state(near, forces, parameters)
        return structure.manifold.settle(rest, of_law)[: near.size]

    q = _within_limits(model, settled, start_guess(scenario, model.links))
    state = model.rest_state(q, forces, parameters)
    if scenario.exogenous and not structure.manifold.is_consistent(state, of_law):
        raise ModelError(
            "a task begins at rest, and its first phase in contact with a surface that moves "
            "then; begin with a phase without contact, such as Approach"
        )
    # A task that begins without contact does not begin behind its surface, or only as deep as the
    # force that counts as none presses it.
    task, material = scenario.task, scenario.plant.material
    if task is None or material is None or task.make().contacts[0]:
        return state
    touch = opening_contact(scenario, model).touch(model.links)
    if touch is None:
        return state
    place = model.links.position(touch.frame, touch.point)
    above = model.dae.trace("start", {"above": touch.clearance(place)}, often=False)
    depth = -above(state, model.dae.parameters_of(loop.plant.dae, parameters))[0].item()
    if depth * material.stiffness_on(model, task.contact_force) > task.contact_force:
        raise ModelError(
            f"start.positions put the point of {touch.frame} {depth:.3g} m behind its surface, and "
            "the task begins in front of it; start outside, or turn the normal of the surface "
            "around if its free side is the other one"
        )
    return state


def opening_contact(scenario: Scenario, model: RobotModel) -> Constraint:
    """The constraint of the contact of a task."""
    assert scenario.task is not None
    fitting = {c.name: c for c in model.constraints if c.is_unilateral == (True,)}
    name = scenario.task.contact or (next(iter(fitting)) if len(fitting) == 1 else "")
    if name not in fitting:
        there = ", ".join(fitting) or "none"
        text = f"'{name}': expected one of the unilateral constraints with one force, {there}"
        raise ScenarioError(("task.contact", text))
    return fitting[name]


def start_state(
    scenario: Scenario,
    model: RobotModel,
    outputs: FloatArray,
    parameters: FloatArray,
    of_law: FloatArray,
) -> FloatArray:
    """The state at rest near start.positions, within limits, with given outputs z, shape (p,)."""
    count = len(model.position_signals)

    def solve(near: FloatArray) -> FloatArray:
        return model.configuration(outputs[:count], near, parameters, of_law)

    # By default near the start of the completion.
    guess = start_guess(scenario, model.links, model.nominal_positions)
    try:
        q = _within_limits(model, solve, guess)
    except InconsistentStateError as error:
        goal = ", ".join(
            f"{signal.name} = {value:.4g} {signal.unit}".rstrip()
            for signal, value in zip(model.position_signals, outputs[:count], strict=True)
        )
        raise ModelError(
            f"found no configuration near start.positions with {goal} (the references and "
            f"start.errors at the start) on the constraints: {error}"
        ) from error
    return model.rest_state(q, outputs[count:], parameters)


def _within_limits(
    model: RobotModel, solve: Callable[[FloatArray], FloatArray], guess: FloatArray
) -> FloatArray:
    """A solution near a guess without the whole turns that Newton's method may add to joints."""
    signals, (low, high) = model.links.position_signals, model.links.position_limits
    q, turns = solve(guess), np.array([signal.unit == "rad" for signal in signals])
    near = unwound(q, guess, (low - _SLACK, high + _SLACK), turns)
    trial = np.where(np.abs(near - q) < 1.0, q, near)
    if np.any(trial != q):
        with suppress(InconsistentStateError):
            settled = solve(trial)
            q = settled if np.max(np.abs(settled - trial)) < 1e-6 else q
    outside = [
        f"{signal.name} = {value:.4g} {signal.unit}, and its limits are {least:g} to {most:g}"
        for signal, value, least, most in zip(signals, q, low, high, strict=True)
        if not least - _SLACK <= value <= most + _SLACK
    ]
    if outside:
        raise ModelError(
            f"the robot cannot start outside of its limits, but near start.positions is "
            f"{'; '.join(outside)}. Give start.positions of all joints near where they shall be, "
            "or change the first values of the references"
        )
    return q


@at("start.positions")
def start_guess(scenario: Scenario, links: Links, others: FloatArray | None = None) -> FloatArray:
    """The initial guess of q: start.positions, and other joints at `others` or their defaults."""
    guess = (links.default_positions if others is None else others).copy()
    for name, value in scenario.start.positions.items():
        (index,) = places_of("joint position", [name], links.position_signals)
        low, high = (limits[index] for limits in links.position_limits)
        if not low <= value <= high:
            unit = links.position_signals[index].unit
            raise ModelError(
                f"{name} = {value:g} {unit} is outside its limits, {low:g} to {high:g} {unit}"
            )
        guess[index] = value
    return guess
