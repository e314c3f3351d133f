"""Default gains of a scenario with Drake's own contact."""

from dataclasses import replace

import numpy as np

from drake_dae.dae.beyond.contact_gains import contact_gains
from drake_dae.dae.beyond.spring_loop import SpringLoop, contact_gains_behind, spring_loop
from drake_dae.dae.structure.structure import Structure
from drake_dae.errors import ScenarioError
from drake_dae.robots.model import RobotModel
from drake_dae.scenario.completion.completion import Completed
from drake_dae.scenario.observed import law_robot
from drake_dae.scenario.parts import parts as parts
from drake_dae.scenario.scenario import Scenario

_FORCE = 10.0
"""The force in N at which the stiffness of a hydroelastic patch is evaluated."""

_NOISE = 1e-3
"""The default standard deviation of velocity noise in rad/s, without encoders."""

_DIGITS = 3
"""The number of digits of recommended gains."""


def advised(scenario: Scenario, model: RobotModel, structure: Structure) -> Completed:
    """The scenario with gains by `contact_gains` where they are left out.

    Applies if `gains` are left out and the plant is Drake's own contact: gains, integrals of forces
    and of points, constraint damping, an observer of disturbance and friction, and measured force
    are set, each if it is left out.

    Args:
        scenario: The scenario, with all of its outputs.
        model: Its robot.
        structure: The structure of the model's system.

    Returns:
        The scenario, unchanged if nothing is left out, and the choices in words.

    Raises:
        ScenarioError: There are no default gains with a task, or with stages of actuation.
    """
    material = scenario.plant.material
    is_left_out = scenario.is_advised
    if scenario.is_cascade:
        scenario = _with_loop(scenario)
        model, structure = law_robot(scenario, model, structure)
    if material is None or not is_left_out:
        return Completed(scenario)
    if scenario.task is not None:
        raise ScenarioError(
            ("gains", ("no gains are recommended for a task in Drake's contact: give some"))
        )
    if model.stages:
        raise ScenarioError(
            (
                "gains",
                "for Drake's own contact no gains are recommended with motors or valves, or with "
                "the tracking law and springs; give them, with integral and observer, as in the "
                "scenario wall_flexible_contact, or for springs leave `law` out",
            )
        )
    sampling = scenario.sampling
    period = material.time_step if sampling is None else sampling.period
    if not period:
        raise ScenarioError(
            (
                "gains",
                "for a continuous compliant plant without `sampling` no gains are recommended; "
                "give some, or a sampling",
            )
        )
    late = 0 if sampling is None else sampling.late_samples
    mobility = float(np.max(np.diag(structure.constraint_matrix(structure.states[0]))))
    stiffness = material.stiffness_at(_FORCE)
    noise = velocity_noise(scenario, period)
    loop = None if scenario.law is None else scenario.law.loop()
    if loop is not None:
        found = contact_gains_behind(loop, stiffness, mobility, period, late, noise)
    else:
        found = contact_gains(stiffness, mobility, period, late, noise)
    names = [signal.name for signal in model.dae.output_signals]
    positions, forces = np.split(np.array(names), [len(model.position_signals)])
    points = _moved(model)
    integral = scenario.integral
    if integral is None:
        integral = [name for name in positions if name in points] + forces.tolist()
    force = scenario.force_feedback
    if not force.is_measured:
        force = parts.MeasuredForce(sample_period=period)
    # A force of degree 0 has a gain only if it is integrated.
    of_forces = {name: [_rounded(found.force_gain)] for name in forces.tolist() if name in integral}
    of_positions = {
        name: [_rounded(gain) for gain in found.position_gains(3 if name in integral else 2)]
        for name in positions.tolist()
    }
    gains = parts.Coefficients(outputs=of_positions | of_forces)
    damping = scenario.constraint_damping
    if damping is None and found.constraint_damping:
        damping = parts.Poles(all=[-_rounded(found.constraint_damping)])
    observer = scenario.observer
    if observer is None:
        frictional = [c.name for c in model.constraints if c.friction_parameter]
        observer = parts.Observer(
            rate=_rounded(found.observer_rate),
            force_rate=_rounded(found.observer_force_rate),
            friction_rate=_rounded(found.friction_rate),
            identify_friction=frictional,
        )
    chosen = replace(
        scenario,
        gains=gains,
        integral=integral,
        constraint_damping=damping,
        observer=observer,
        force_feedback=force,
    )
    known = ", ".join(observer.identify_friction) or "none"
    note = (
        f"recommended for a contact of {stiffness:.2g} N/m and {mobility:.2g} 1/kg, samples of "
        f"{period:g} s and velocities within {noise:.2g} rad/s: Butterworth's poles of positions "
        f"at {_rounded(found.position_rate):g} 1/s, and of forces one at "
        f"{-_rounded(found.force_gain):g} 1/s, with integrals of {', '.join(integral)}, damping "
        f"of the constraint {_rounded(found.constraint_damping):g} 1/s, an observer of "
        f"{observer.rate:g} 1/s that identifies the friction of: {known}{_loop_note(scenario)}"
    )
    return Completed(chosen, (note,))


def velocity_noise(scenario: Scenario, period: float) -> float:
    """The standard deviation of measured velocities, in rad/s.

    Args:
        scenario: The scenario.
        period: The time between samples, in s.
    """
    if scenario.encoders is None:
        return _NOISE
    return float(np.max(scenario.encoders.velocity_deviation(period))) or _NOISE


def _loop_note(scenario: Scenario) -> str:
    """The numbers of a cascade in words; empty without one."""
    loop = None if scenario.law is None else scenario.law.loop()
    if loop is None:
        return ""
    return f"; a cascade with a loop of {loop.rate:g} rad/s around the springs"


def _with_loop(scenario: Scenario) -> Scenario:
    """The scenario with all numbers of the loop around its springs."""
    law, sampling = scenario.law, scenario.sampling
    if not isinstance(law, parts.SpringCascade):
        law = parts.SpringCascade()
    if sampling is None:
        return replace(scenario, law=law.filled(SpringLoop(1.0)))  # law_robot refuses it.
    found = spring_loop(sampling.period, sampling.late_samples, law.damping)
    numbers = (_rounded(each) for each in (found.rate, found.current_rate))
    rate, current_rate = numbers
    return replace(scenario, law=law.filled(SpringLoop(rate, law.damping, rate, current_rate)))


def _rounded(value: float) -> float:
    return float(f"{value:.{_DIGITS}g}")


def _moved(model: RobotModel) -> list[str]:
    """The names of outputs that are coordinates of points."""
    return [
        signal.name
        for output in model.outputs
        for signal in output.signals(model.links)
        if signal.unit == "m"
    ]
