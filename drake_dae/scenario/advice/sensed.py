"""The data on robot, contact and sensors for the choice of gains, and its prediction."""

from dataclasses import replace
from itertools import chain

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from drake_dae.dae.beyond.advised_gains import (
    EVERY,
    MODEL_ERROR,
    AdvisedGains,
    SensedContact,
    advised_gains,
)
from drake_dae.dae.beyond.one_direction import SensorNoise
from drake_dae.dae.structure.structure import Structure
from drake_dae.errors import GainError
from drake_dae.robots.links.links import velocities_are_rates
from drake_dae.robots.model import RobotModel
from drake_dae.scenario.scenario import Scenario

_SHARE = 0.003
"""The default of the largest roughness, as a fraction of the largest effort limit."""

_FACTORS = (2.0**0.5, 2.0, 2.0**1.5, 4.0, 2.0**2.5, 8.0)
"""Bandwidths of differences that are tried, over the given one or its inverse."""

_MUCH = 2.0
"""The message names another bandwidth if the product of both errors is smaller by this factor."""


def _largest(deviation: ArrayLike) -> float:
    return float(np.max(np.asarray(deviation)))


def sensed_contact(
    scenario: Scenario,
    model: RobotModel,
    structure: Structure,
    timing: tuple[float, int],
    stiffness: float,
) -> SensedContact:
    """Collects the data on a robot, its contact and its sensors for the choice of gains.

    Args:
        scenario: The scenario, with encoders.
        model, structure: Its robot.
        timing: The period in s and the delay in samples.
        stiffness: The stiffness of the contact in N/m.
    """
    system, state, encoders = model.dae, structure.states[0], scenario.sensors.encoders
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
    estimator = scenario.estimator
    may_estimate = estimator is None or estimator.rate is None or estimator.state_rate is not None
    has_rates = encoders.velocity_bandwidth is None and velocities_are_rates(model.links)
    period, delay = timing
    return SensedContact(
        period=period,
        delay=delay,
        stiffness=stiffness,
        mobility=float(np.max(moves[contact])),
        free_mobility=float(np.max(moves[free], initial=np.max(moves[contact]))),
        lever=float(np.max(levers[free], initial=np.max(levers[contact]))),
        contact_lever=float(np.max(levers[contact])),
        inertia=float(np.linalg.norm(inertia)),
        noise=SensorNoise(
            position=_largest(encoders.position_deviation),
            velocity=_largest(encoders.velocity_noise),
            force=_largest(scenario.sensors.force_noise),
            velocity_bandwidth=encoders.velocity_bandwidth or 0.0,
        ),
        estimates=may_estimate and has_rates,
    )


def chosen_gains(
    situation: SensedContact, roughness: float, errors: dict[str, float]
) -> tuple[AdvisedGains, str]:
    """The gains of `advised_gains`, and whether differences of angles should be filtered otherwise.

    With a wide filter, velocities from differences are so rough that gains have to be slow; the lag
    of a narrow one makes a stiff contact unstable. The bandwidth is the user's choice, so the
    sentence names a better one.

    Args:
        situation, roughness, errors: The arguments of `advised_gains`.

    Returns:
        The gains, and a sentence, empty if no bandwidth is much better.

    Raises:
        GainError: There are none; the message ends with a bandwidth with gains, if there is one.
    """
    given = situation.noise.velocity_bandwidth
    narrower, wider = ([float(f"{given * f**k:.2g}") for f in _FACTORS] for k in (-1, 1))

    def found(bandwidth: float) -> AdvisedGains | None:
        noise = replace(situation.noise, velocity_bandwidth=bandwidth)
        try:
            return advised_gains(replace(situation, noise=noise), roughness, **errors)
        except GainError:
            return None

    try:
        best = advised_gains(situation, roughness, **errors)
    except GainError as error:
        both = chain(*zip(narrower, wider, strict=True)) if given else ()
        for bandwidth in both:
            if found(bandwidth) is not None:
                text = f"{error}; or let velocity_bandwidth be {bandwidth:g} rad/s"
                raise GainError(text) from None
        raise
    better, at = best, given
    for bandwidth in narrower if given and not errors else ():
        if (other := found(bandwidth)) is None or _error(other) > _error(better):
            break
        better, at = other, bandwidth
    if _error(best) < _MUCH * _error(better):
        return best, ""
    return best, (
        f". With a velocity_bandwidth of {at:g} rad/s in place of {given:g} the errors of one "
        f"direction are {1e3 * better.position_error:.2g} mm and {better.force_error:.2g} N"
    )


def _error(gains: AdvisedGains) -> float:
    """What is least for the best gains."""
    return gains.position_error * gains.force_error


def predicted(best: AdvisedGains) -> str:
    """The errors from which gains were chosen, as sentences."""
    by_noise = f"{1e3 * best.noise_error:.2g} mm and {best.noise_force:.2g} N"
    return (
        "These gains are the best for one direction alone: "
        f"{1e3 * best.position_error:.2g} mm and {best.force_error:.2g} N rms "
        f"if an unknown force of {MODEL_ERROR:g} N appears every {EVERY:g} s, {by_noise} of it by "
        f"noise, and a change of the controls of {best.roughness:.2g} N m from sample to sample"
    )


def largest_roughness(scenario: Scenario, model: RobotModel) -> float:
    """The largest permitted change of the controls from sample to sample by noise, in N m.

    Args:
        scenario: The scenario.
        model: Its robot, for the limits of its drives.
    """
    if scenario.law.largest_roughness is not None:
        return scenario.law.largest_roughness
    finite = model.control_limits[np.isfinite(model.control_limits)]
    return _SHARE * float(np.max(finite, initial=1.0 / _SHARE if not finite.size else 0.0))


def largest_errors(scenario: Scenario) -> dict[str, float]:
    """The bounds of errors, by the names that `advised_gains` has for them."""
    errors = scenario.law.largest_errors
    given = {} if errors is None else vars(errors)
    return {f"{name}_error": most for name, most in given.items() if most is not None}


def moved_points(model: RobotModel) -> list[str]:
    """The names of outputs that are coordinates of points."""
    return [
        signal.name
        for output in model.outputs
        for signal in output.signals(model.links)
        if signal.unit == "m"
    ]
