"""The loops of a free direction and of a contact, for the choice of gains."""

from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product

import numpy as np

from drake_dae.arguments import checked
from drake_dae.arrays import check_whole_number, positive
from drake_dae.dae.beyond.one_direction import (
    Direction,
    DirectionGains,
    SampledLoop,
    SensorNoise,
    sampled_loop,
)
from drake_dae.dae.tracking.constraint_damping import best_damping
from drake_dae.errors import ModelError

MASSES = (0.5, 1.0, 2.0)
"""Free directions are stable if a force accelerates by these factors more than in the model."""

CONTACT_MASSES = (2.0 / 3.0, 1.0, 1.5)
STIFFNESSES = (1e-3, 0.1, 0.5, 1.0, 2.0)
"""The same along a contact, each with these stiffnesses relative to the stated one."""

DECAY = 0.05
"""The least rate at which these loops settle, relative to w, with half of the stiffness or more."""

SLOWER = (1.0, 0.5, 0.25)
"""The factors by which the integral and the observer along a contact are slowed, since both reduce
damping; the first one for which there are gains is taken."""

MODEL_ERROR, EVERY = 1.0, 2.0
"""An unknown force of 1 N appears or turns every 2 s."""

RAMP = 10.0
"""The reference of a force changes by 10 N/s."""


@checked(ModelError)
@dataclass(frozen=True)
class SensedContact:
    """The numbers of a robot in contact, its sampling and its sensors that decide the gains.

    Attributes:
        period: T in s.
        delay: The delay of the control in samples.
        stiffness: k of the contact in N/m.
        mobility: J M^-1 J^T of the contact in 1/kg, the largest along the motion.
        free_mobility: The mobility of the points that follow a path, in 1/kg.
        lever, contact_lever: The displacement of a point that follows a path, and of the contact,
            per radian of noise of all joints: the length of a row of J, in m/rad.
        inertia: sqrt(tr M M): the torque per acceleration of all joints, in kg m^2.
        noise: The noise of a joint's angle and velocity, in rad and rad/s, and of the force in N;
            with a `velocity_bandwidth` if velocities are filtered finite differences.
        estimates: Whether the state comes from a `StateEstimator`.

    Raises:
        ModelError: A number is not positive, or a noise is negative.
    """

    period: float
    delay: int
    stiffness: float
    mobility: float
    free_mobility: float
    lever: float
    contact_lever: float
    inertia: float
    noise: SensorNoise
    estimates: bool

    def __post_init__(self) -> None:
        names = ("period", "stiffness", "mobility", "free_mobility", "lever", "contact_lever")
        for name in (*names, "inertia"):
            positive(name, getattr(self, name))
        check_whole_number("delay", self.delay, 0)
        for name, value in vars(self.noise).items():
            if not value >= 0.0:
                raise ModelError(f"the noise of the {name} must be 0 or more, got {value:g}")

    def free(self, mass_error: float = 1.0) -> Direction:
        """Returns a free direction."""
        return Direction(self.period, self.delay, mass_error=mass_error)

    def contact(self, mass_error: float = 1.0, share: float = 1.0) -> Direction:
        """Returns the direction of the contact, with a fraction of its stiffness."""
        stiffness = share * self.stiffness
        return Direction(self.period, self.delay, self.mobility, stiffness, mass_error)

    def noise_of(self, lever: float) -> SensorNoise:
        """Returns the noise of a distance that is computed from noisy angles."""
        noise = self.noise
        position, velocity = lever * noise.position, lever * noise.velocity
        return replace(noise, position=position, velocity=velocity)

    @cached_property
    def best_damping(self) -> float:
        """`contact_damping` of the contact, in 1/s."""
        return best_damping(self.stiffness, self.mobility, self.period, self.delay)

    @property
    def quiet(self) -> SensorNoise:
        """Measurements without noise, with the lag of differentiated velocities."""
        return SensorNoise(velocity_bandwidth=self.noise.velocity_bandwidth)


@dataclass(frozen=True)
class Part:
    """The prediction for one direction: the error, its part by noise, and the roughness in N m."""

    rate: float
    rates: DirectionGains
    is_contact: bool
    error: float
    by_noise: float
    roughness: float


def is_stable(situation: SensedContact, part: Part) -> bool:
    """Whether a loop settles for all masses and stiffnesses for which it must be stable."""
    cases = [(situation.free(mass), DECAY) for mass in MASSES]
    if part.is_contact:
        cases = [
            (situation.contact(mass, share), DECAY if share >= 0.5 else 0.0)
            for mass, share in product(CONTACT_MASSES, STIFFNESSES)
        ]
    for direction, decay in cases:
        loop = sampled_loop(direction, part.rates, situation.quiet)
        if not loop.radius < 1.0 - decay * part.rate * loop.period:
            return False
    return True


def _free_rates(w: float, fast: float | None) -> DirectionGains:
    p = 1.5 * w
    return DirectionGains((p**3, 2.0 * p**2, 2.0 * p), 0.0, 2.0 * w, fast)


def _contact_rates(
    situation: SensedContact, w: float, fast: float | None, share: float
) -> DirectionGains:
    damping = min(2.3 * w, situation.best_damping)
    return DirectionGains((0.0, 0.0, damping), share * 0.4 * (damping or w / 2.0), share * w, fast)


def free_part(situation: SensedContact, w: float, fast: float | None) -> Part:
    """The prediction for free directions with the rates w and that of an estimator, in 1/s."""
    rates = _free_rates(w, fast)
    loop = sampled_loop(situation.free(), rates, situation.noise_of(situation.lever))
    error, _ = loop.deviations()
    _, jump = sampled_loop(situation.free(), rates, situation.noise_of(1.0)).deviations()
    step = MODEL_ERROR * situation.free_mobility * _rms(loop)
    return Part(w, rates, False, float(np.hypot(error, step)), error, situation.inertia * jump)


def contact_part(situation: SensedContact, w: float, fast: float | None, share: float) -> Part:
    """The same along the contact, with a factor by which integral and observer are slowed."""
    rates = _contact_rates(situation, w, fast, share)
    loop = sampled_loop(situation.contact(), rates, situation.noise_of(situation.contact_lever))
    error, jump = loop.deviations()
    step = MODEL_ERROR * situation.mobility * _rms(loop)
    ramp = rates.gains[2] * RAMP / (situation.mobility * situation.stiffness)
    whole = float(np.linalg.norm([error, step, ramp]))
    return Part(w, rates, True, whole, error, situation.contact_lever * jump / situation.mobility)


def _rms(loop: SampledLoop) -> float:
    """The rms error per disturbing acceleration that appears every `EVERY` seconds."""
    return loop.after_step() * float(np.sqrt(loop.period / EVERY))


def noisiest_sensor(situation: SensedContact, part: Part, deviation: int) -> str:
    """The sensor whose noise causes most of an error (deviation 0), or of a roughness (1)."""
    direction = situation.contact() if part.is_contact else situation.free()
    lever = situation.contact_lever if part.is_contact else situation.lever

    def without(name: str) -> float:
        quiet = replace(situation, noise=replace(situation.noise, **{name: 0.0}))
        return sampled_loop(direction, part.rates, quiet.noise_of(lever)).deviations()[deviation]

    return min(("position", "velocity", "force")[: 2 + part.is_contact], key=without)
