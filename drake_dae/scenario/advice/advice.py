"""Default gains of a scenario with Drake's own contact."""

from dataclasses import replace

import numpy as np

from drake_dae.dae.beyond.contact_gains import ContactGains, contact_gains
from drake_dae.dae.structure.structure import Structure
from drake_dae.dae.tracking.model_of_law import damping_gains
from drake_dae.errors import ScenarioError
from drake_dae.robots.model import RobotModel
from drake_dae.scenario.advice.sensed import (
    chosen_gains,
    largest_errors,
    largest_roughness,
    moved_points,
    predicted,
    sensed_contact,
)
from drake_dae.scenario.advice.touch import Touching, reaction_time, rounded
from drake_dae.scenario.completion import Completed
from drake_dae.scenario.controllers.task_controller import opening_contact
from drake_dae.scenario.forms.keys import at
from drake_dae.scenario.parts import parts as parts
from drake_dae.scenario.scenario import Scenario

_SOFTER = 5.0
"""The ratio of the poles of positions to those of the distance, of a robot without contact."""

NOISE = 1e-3
"""The standard deviation of velocity noise in rad/s, without encoders."""

_FORCE = 10.0
"""The force in N at which the stiffness of a hydroelastic patch is evaluated."""


def _free_gains(scenario: Scenario, model: RobotModel, contact: ContactGains) -> parts.Coefficients:
    """The gains of a task without contact, soft along the distance: see `TaskController`."""
    rate = contact.position_rate / _SOFTER
    gains = {signal.name: contact.position_gains(2) for signal in model.position_signals}
    for point in opening_contact(scenario, model):
        gains[point.residual_signals[0].name] = [rate**2, 2.0 * rate]
    return parts.Coefficients(
        outputs={name: [rounded(gain) for gain in values] for name, values in gains.items()}
    )


def least_damping(structure: Structure, damping: parts.Gains) -> float:
    """The least damping of a constraint, in 1/s."""
    with at("law.constraint_damping"):
        return float(np.min(np.diag(damping_gains(structure, damping.design()).matrix)))


def advised(scenario: Scenario, model: RobotModel, structure: Structure) -> Completed:
    """Computes gains and other settings that a scenario in Drake's own contact leaves out.

    It computes gains, integrals of forces and of points, constraint damping, an estimator of
    disturbance and friction, and measured force, each if it is left out; and for a task the gains
    without contact, soft along the distance. With encoders and rigid joints the gains are those of
    `advised_gains` for the noise of the encoders; otherwise those of `contact_gains`. A scenario
    with `gains`, or with ideal contact, is unchanged.

    Args:
        scenario: The scenario, with all of its outputs.
        model: Its robot.
        structure: The structure of the model's system.

    Returns:
        The scenario, and the choices in words.

    Raises:
        ScenarioError: There are no default gains for such a scenario, or none are smooth and stable
            enough; or `largest_roughness` or `largest_errors` is given and not used.
    """
    material = scenario.plant.material
    law, sensors = scenario.law, scenario.sensors
    _check_bounds(scenario)
    if material is None or not scenario.is_advised:
        return Completed(scenario)
    if model.stages:
        text = (
            "no gains are computed if the robot has springs, motors or valves. Give gains, "
            "integral and estimator, as in the scenario wall_flexible_contact"
        )
        raise ScenarioError(("law.gains", text))
    sampling = scenario.sampling
    period = material.time_step if sampling is None else sampling.period
    if not period:
        text = (
            "for a continuous compliant plant without `sampling` no gains are computed; give some, "
            "or a sampling"
        )
        raise ScenarioError(("law.gains", text))
    late = 0 if sampling is None else sampling.late_samples
    mobility = float(np.max(np.diag(structure.constraint_matrix(structure.states[0]))))
    stiffness = material.stiffness_on(model, _FORCE)
    fast = None
    known_by, outlook = f"velocities within {NOISE:.2g} rad/s", ""
    if sensors.encoders is None:
        contact = contact_gains(stiffness, mobility, period, late, NOISE)
    else:
        sensed = sensed_contact(scenario, model, structure, (period, late), stiffness)
        with at("law.gains"):
            errors = largest_errors(scenario)
            best, hint = chosen_gains(sensed, largest_roughness(scenario, model), errors)
        contact, fast = best.gains, best.state_rate
        known_by, outlook = "these encoders", f". {predicted(best)}{hint}"
    names = [signal.name for signal in model.dae.output_signals]
    positions, forces = np.split(np.array(names), [len(model.position_signals)])
    points = moved_points(model)
    integral = law.integral
    if integral is None:
        integral = [name for name in positions if name in points] + forces.tolist()
    force = sensors.force or parts.MeasuredForce(sample_period=period)
    # A force of degree 0 has a gain only if it is integrated.
    of_forces = {
        name: [rounded(contact.force_gain)] for name in forces.tolist() if name in integral
    }
    of_positions = {
        name: [rounded(gain) for gain in contact.position_gains(3 if name in integral else 2)]
        for name in positions.tolist()
    }
    gains = parts.Coefficients(outputs=of_positions | of_forces)
    damping = law.constraint_damping
    if damping is None and contact.constraint_damping:
        damping = parts.Poles(all=[-rounded(contact.constraint_damping)])
    estimator = scenario.estimator or parts.Estimator()
    frictional = [c.friction_parameter for c in model.constraints if c.friction_parameter]
    if estimator.rate is None:
        estimator = replace(
            estimator,
            rate=rounded(contact.observer_rate),
            force_rate=rounded(contact.observer_force_rate),
            friction_rate=rounded(contact.friction_rate),
            identify=list(dict.fromkeys([*frictional, *estimator.identify])),
            state_rate=None if fast is None else rounded(fast),
        )
    task = scenario.task
    if task is not None and task.gains is None:
        task = replace(task, gains=_free_gains(scenario, model, contact))
    touch_note = ""
    if task is not None:
        touching = Touching(
            stiffness,
            mobility,
            contact.constraint_damping if damping is None else least_damping(structure, damping),
            contact.force_gain,
            period,
            reaction_time(sampling, period),
        )
        task = touching.slowed(task)
        touch_note = touching.note(task)
    chosen = replace(
        scenario,
        task=task,
        law=replace(
            law,
            gains=gains,
            integral=integral,
            constraint_damping=damping,
            largest_roughness=None,
            largest_errors=None,
        ),
        estimator=estimator,
        sensors=replace(sensors, force=force),
    )
    identified = ", ".join(name for name in estimator.identify if name in frictional) or "none"
    estimated = "" if fast is None else f", and an estimate of the state of {rounded(fast):g} 1/s"
    note = (
        f"recommended for a contact of {stiffness:.2g} N/m and {mobility:.2g} 1/kg, samples of "
        f"{period:g} s and {known_by}: Butterworth's poles of positions "
        f"at {rounded(contact.position_rate):g} 1/s, and of forces one at "
        f"{-rounded(contact.force_gain):g} 1/s, with integrals of {', '.join(integral)}, damping "
        f"of the constraint {rounded(contact.constraint_damping):g} 1/s, an estimator of "
        f"{estimator.rate:g} 1/s that identifies: {identified}{estimated}"
        f"{outlook}"
        f"{touch_note}"
    )
    return Completed(chosen, (note,))


def _check_bounds(scenario: Scenario) -> None:
    """Checks that bounds for computed gains are used.

    Raises:
        ScenarioError: One is not, or is not positive.
    """
    is_used, law = scenario.is_advised and scenario.sensors.encoders is not None, scenario.law
    for name in ("largest_roughness", "largest_errors"):
        if getattr(law, name) is not None and not is_used:
            text = (
                "it is used only for gains that are computed for rigid joints with encoders in "
                "Drake's contact; leave it out, or leave `law.gains` out and give encoders"
            )
            raise ScenarioError((f"law.{name}", text))
    if law.largest_roughness is not None and not law.largest_roughness > 0.0:
        value = f"must be positive, got {law.largest_roughness:g} N m"
        raise ScenarioError(("law.largest_roughness", value))
