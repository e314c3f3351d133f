"""What the choice of gains needs of the sensors of a scenario, and what it predicts."""

import casadi as ca
import numpy as np

from drake_dae.dae.beyond.contact_advice import EVERY, MODEL_ERROR, AdvisedGains, SensedContact
from drake_dae.dae.beyond.one_direction import SensorNoise
from drake_dae.dae.structure.structure import Structure
from drake_dae.robots.model import RobotModel
from drake_dae.scenario.scenario import Scenario

_SHARE = 0.003
"""The default of the largest roughness, as a share of the largest effort limit."""


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
    rows, moved = system.l.numel(), moved_points(model)
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


def largest_roughness(scenario: Scenario, model: RobotModel) -> float:
    """The largest change of controls from sample to sample that computed gains may make, in N m.

    Args:
        scenario: The scenario.
        model: Its robot, for the limits of its drives.
    """
    if scenario.largest_roughness is not None:
        return scenario.largest_roughness
    finite = model.control_limits[np.isfinite(model.control_limits)]
    return _SHARE * float(np.max(finite, initial=1.0 / _SHARE if not finite.size else 0.0))


def moved_points(model: RobotModel) -> list[str]:
    """The names of outputs that are coordinates of points."""
    return [
        signal.name
        for output in model.outputs
        for signal in output.signals(model.links)
        if signal.unit == "m"
    ]
