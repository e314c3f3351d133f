"""Default gains of a scenario with Drake's own contact."""

from dataclasses import replace

import casadi as ca
import numpy as np

from drake_dae.dae.beyond.contact_advice import (
    EVERY,
    MODEL_ERROR,
    AdvisedGains,
    SensedContact,
    advised_gains,
)
from drake_dae.dae.beyond.contact_gains import contact_gains
from drake_dae.dae.beyond.one_direction import SensorNoise
from drake_dae.dae.structure.structure import Structure
from drake_dae.errors import ScenarioError
from drake_dae.robots.model import RobotModel
from drake_dae.scenario.completion.completion import Completed
from drake_dae.scenario.forms.keys import at
from drake_dae.scenario.parts import parts as parts
from drake_dae.scenario.scenario import Scenario

_FORCE = 10.0
"""The force in N at which the stiffness of a hydroelastic patch is evaluated."""

_NOISE = 1e-3
"""The default standard deviation of velocity noise in rad/s, without encoders."""

_SHARE = 0.003
"""The default of the largest roughness, as a share of the largest effort limit."""

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
        ScenarioError: There are no default gains with a task, or with stages of actuation, or none
            are smooth and stable enough; or a roughness is given that nothing uses.
    """
    material = scenario.plant.material
    is_advised = material is not None and scenario.is_advised
    if scenario.largest_roughness is not None:
        if not is_advised or scenario.encoders is None:
            raise ScenarioError(
                (
                    "largest_roughness",
                    "it limits gains that are computed for the noise of encoders in Drake's "
                    "contact; leave it out, or leave the gains out and give encoders",
                )
            )
        if not scenario.largest_roughness > 0.0:
            value = f"must be positive, got {scenario.largest_roughness:g} N m"
            raise ScenarioError(("largest_roughness", value))
    if material is None or not is_advised:
        return Completed(scenario)
    if scenario.task is not None:
        raise ScenarioError(
            ("gains", ("no gains are recommended for a task in Drake's contact: give some"))
        )
    if model.stages:
        raise ScenarioError(
            (
                "gains",
                "for Drake's own contact with springs, motors or valves no gains are "
                "recommended; give them, with integral and observer, as in the scenario "
                "wall_flexible_contact",
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
    fast, known_by = None, f"velocities within {_NOISE:g} rad/s"
    if scenario.encoders is None:
        found = contact_gains(stiffness, mobility, period, late, _NOISE)
    else:
        sensed = sensed_contact(scenario, model, structure, (period, late), stiffness)
        with at("gains"):
            best = advised_gains(sensed, _roughness(scenario, model))
        found, fast = best.gains, best.state_rate
        known_by = predicted(best)
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
            state_rate=None if fast is None else _rounded(fast),
        )
    chosen = replace(
        scenario,
        gains=gains,
        integral=integral,
        constraint_damping=damping,
        observer=observer,
        force_feedback=force,
        largest_roughness=None,
    )
    known = ", ".join(observer.identify_friction) or "none"
    note = (
        f"recommended for a contact of {stiffness:.2g} N/m and {mobility:.2g} 1/kg, samples of "
        f"{period:g} s and {known_by}: Butterworth's poles of positions "
        f"at {_rounded(found.position_rate):g} 1/s, and of forces one at "
        f"{-_rounded(found.force_gain):g} 1/s, with integrals of {', '.join(integral)}, damping "
        f"of the constraint {_rounded(found.constraint_damping):g} 1/s, an observer of "
        f"{observer.rate:g} 1/s that identifies the friction of: {known}"
    )
    return Completed(chosen, (note,))


def sensed_contact(
    scenario: Scenario,
    model: RobotModel,
    structure: Structure,
    timing: tuple[float, int],
    stiffness: float,
) -> SensedContact:
    """What the choice of gains needs of a robot, its contact and its sensors.

    Args:
        scenario: The scenario, with encoders.
        model, structure: Its robot.
        timing: The period in s and the delay in samples.
        stiffness: That of the contact in N/m.
    """
    system, state, encoders = model.dae, structure.states[0], scenario.encoders
    assert encoders is not None
    velocities = slice(model.links.q.numel(), 2 * model.links.q.numel())
    rows, moved = system.l.numel(), _moved(model)
    points = [i for i in range(rows) if system.output_signals[i].name in moved]
    x, mass = system.state, system.mass_matrix[velocities, velocities]
    reads = ca.vertcat(system.l[points], system.k)
    slopes = ca.jacobian(reads, x)[:, : model.links.q.numel()]
    function = system.trace("levers", {"slopes": slopes, "mass": mass}, often=False)
    values = function(state, system.parameter_values)
    jacobian, inertia = values[0].reshape(reads.numel(), -1), values[1]
    moves = np.einsum("ij,ji->i", jacobian, np.linalg.solve(inertia, jacobian.T))
    levers = np.linalg.norm(jacobian, axis=1)
    free, contact = slice(len(points)), slice(len(points), None)
    forces = scenario.force_feedback
    deviation = float(np.max(getattr(forces, "noise_deviation", 0.0)))
    given = scenario.observer is None or scenario.observer.state_rate is not None
    estimates = given and encoders.velocity_bandwidth is None
    position, velocity = np.max(encoders.position_deviation), np.max(encoders.velocity_noise)
    return SensedContact(
        *timing,
        stiffness,
        float(np.max(moves[contact])),
        float(np.max(moves[free], initial=np.max(moves[contact]))),
        float(np.max(levers[free], initial=np.max(levers[contact]))),
        float(np.max(levers[contact])),
        float(np.linalg.norm(inertia)),
        SensorNoise(
            float(position), float(velocity), deviation, encoders.velocity_bandwidth or 0.0
        ),
        estimates,
    )


def predicted(best: AdvisedGains) -> str:
    """What gains are predicted to come to, in words."""
    fast = (
        ""
        if best.state_rate is None
        else f" of an estimate of the state at {best.state_rate:.3g} 1/s"
    )
    by_noise = f"{1e3 * best.noise_error:.2g} mm and {best.noise_force:.2g} N"
    return (
        f"these sensors, for which the law{fast} is predicted to be "
        f"{1e3 * best.position_error:.2g} mm and {best.force_error:.2g} N off in rms, {by_noise} "
        f"by noise alone and the rest by an unknown force of {MODEL_ERROR:g} N that appears every "
        f"{EVERY:g} s, with controls that change by {best.roughness:.2g} N m from sample to sample"
    )


def _roughness(scenario: Scenario, model: RobotModel) -> float:
    """The largest change of controls from sample to sample, in N m."""
    if scenario.largest_roughness is not None:
        return scenario.largest_roughness
    finite = model.control_limits[np.isfinite(model.control_limits)]
    return _SHARE * float(np.max(finite, initial=1.0 / _SHARE if not finite.size else 0.0))


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
