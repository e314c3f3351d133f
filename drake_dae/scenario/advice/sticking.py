"""The longest fixed steps with which a continuous compliant contact sticks."""

from typing import NamedTuple

import casadi as ca
import numpy as np

from drake_dae.arrays import FloatArray
from drake_dae.dae.structure.structure import Structure
from drake_dae.references.by_name import references_by_name
from drake_dae.references.reference import stack_references
from drake_dae.robots.model import RobotModel
from drake_dae.scenario.plants import CompliantContact
from drake_dae.scenario.scenario import Scenario
from drake_dae.systems.plants.contact.point_contact import touching
from drake_dae.trace.factorization import PositiveDefiniteFactorization

_IMPLICIT = ("implicit", "velocity_implicit", "radau")
"""How the names of schemes begin whose fixed steps may be longer."""

_TIMES = 101
"""The number of times that are examined along a reference."""


class _Sticking(NamedTuple):
    """The longest fixed step of a contact at one time.

    Attributes:
        step: m v_s / (mu f_n), in s.
        contact: The name of the contact.
        mass: m, the least mass of the robot along the surface, in kg.
        friction: mu.
        force: f_n, in N.
    """

    step: float
    contact: str
    mass: float
    friction: float
    force: float


def sticking_before(scenario: Scenario, model: RobotModel, structure: Structure) -> str:
    """The sentence of `sticking_note` for the start, and the largest force that is wanted.

    Args:
        scenario: A completed scenario with gains.
        model: Its robot.
        structure: The structure of the model's system.
    """
    if not _fixed_step(scenario):
        return ""
    contacts = [constraint.force_signals[0].name for constraint in model.constraints]
    if scenario.task is not None:
        task = scenario.task
        largest = max(phase.felt(task.contact_force) for phase in task.make().phases)
        forces = np.full((1, len(contacts)), largest)
    else:
        names = [signal.name for signal in model.dae.output_signals]
        references = references_by_name(scenario.references, names, structure.output_degrees)
        wanted = stack_references(references, [0] * len(names))
        begin = scenario.integrator.start_time
        times = begin + np.linspace(0.0, scenario.duration, _TIMES)
        values = np.array([wanted(time) for time in times])
        forces = np.array(
            [[np.abs(values[:, names.index(n)]).max() if n in names else 0.0 for n in contacts]]
        )
    return sticking_note(scenario, model, structure.states[:1], forces)


def sticking_note(
    scenario: Scenario, model: RobotModel, states: FloatArray, forces: FloatArray
) -> str:
    """A sentence if fixed steps are too long for a continuous compliant contact to stick.

    The slope of friction over the velocity v along the surface is at most 15/8 mu f_n / v_s, see
    `PointMaterial.stiction_tolerance`. With longer steps than m v_s / (mu f_n) of an explicit
    scheme, v would alternate from step to step while it is below v_s.

    Args:
        scenario: A completed scenario.
        model: Its robot, of rigid joints or with stages.
        states: x, shape (k, n); some of them are examined.
        forces: The normal force of each contact at them, in N, shape (k, m).

    Returns:
        The sentence; empty if the steps are short enough, are not fixed or are implicit, or the
        plant is another one.
    """
    given = _fixed_step(scenario)
    found = _longest(scenario, model, states, forces) if given else None
    if found is None or given <= found.step:
        return ""
    return (
        f"Fixed steps of {given:.3g} s are longer than those with which '{found.contact}' sticks, "
        f"m v_s / (mu f_n) = {found.step:.2g} s for {found.mass:.3g} kg along the surface, "
        f"{found.friction:.3g} and {found.force:.3g} N: while it slides more slowly than "
        "plant.stiction_tolerance, friction alternates from step to step. Take a shorter "
        "integrator.max_step_size, integrator.use_error_control: true, a larger "
        "plant.stiction_tolerance, or a plant.time_step, whose friction is implicit"
    )


def _fixed_step(scenario: Scenario) -> float:
    """The fixed steps of an explicit scheme with a continuous compliant contact in s, else 0."""
    plant, integrator = scenario.plant, scenario.integrator
    if not isinstance(plant, CompliantContact) or plant.time_step or integrator.use_error_control:
        return 0.0
    if integrator.integration_scheme.startswith(_IMPLICIT):
        return 0.0
    period = np.inf if scenario.sampling is None else scenario.sampling.period
    return float(min(integrator.max_step_size, period))


def _longest(
    scenario: Scenario, model: RobotModel, states: FloatArray, forces: FloatArray
) -> _Sticking | None:
    """The contact and the state with the shortest of these steps; None without friction."""
    dae, links, material = model.dae, model.links, scenario.plant.material
    assert material is not None  # _fixed_step.
    part = slice(links.q.numel(), links.q.numel() + links.v.numel())
    factors = PositiveDefiniteFactorization(dae.mass_matrix[part, part])
    parameters, known = dae.parameter_values, {parameter.name for parameter in dae.parameters}
    for name in known.intersection(scenario.plant.parameters):
        parameters[dae.parameter_slice(name)] = scenario.plant.parameters[name]
    kinematics, mobilities, names, coefficients = links.kinematics(), [], [], []
    for constraint, touch in touching(model):
        moving = kinematics.value(kinematics.velocity(touch.frame, touch.point))
        jacobian = ca.jacobian(moving, links.v)
        along = jacobian - touch.normal @ (touch.normal.T @ jacobian)
        mobilities.append(along @ factors.solve(along.T))
        friction = material.friction
        if friction is None and constraint.friction_parameter:
            friction = float(parameters[dae.parameter_slice(constraint.friction_parameter)][0])
        names.append(constraint.name)
        coefficients.append(friction or 0.0)
    function = dae.trace("mobility along surfaces", {"mobility": ca.vertcat(*mobilities)})
    found: list[_Sticking] = []
    every = max(1, len(states) // _TIMES)
    for state, pressing in zip(states[::every], forces[::every], strict=True):
        values = function(state, parameters)[0].reshape(-1, 3, 3)
        each = zip(names, coefficients, values, np.abs(pressing).tolist(), strict=True)
        for name, friction, mobility, force in each:
            slope = friction * force * float(np.linalg.eigvalsh(mobility)[-1])
            if slope > 0.0:
                mass, step = friction * force / slope, material.stiction_tolerance / slope
                found.append(_Sticking(step, name, mass, friction, force))
    return min(found, default=None)
