"""Gains of law, observer and estimator for compliant contact and given sensors, as an optimum."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product
from math import inf, prod

import numpy as np

from drake_dae.arguments import checked
from drake_dae.arrays import check_whole_number, positive
from drake_dae.dae.contact_gains import ContactGains, contact_damping, pole_gains
from drake_dae.dae.one_direction import DirectionGains, SampledLoop, SensorNoise, sampled_loop
from drake_dae.errors import GainError, ModelError

_PHASE = 0.3
"""As for `contact_gains`: the loss of phase by sampling and delay at the crossover, in rad; half of
it with an estimator: a force along the contact that it attributes to friction couples the contact
to free directions, and with the full phase an unknown mass of 1 kg made them swing."""

DECAY = 0.05
"""The least rate at which loops settle, relative to w, with half of the stiffness or more."""

FREE_CASES = [(mass, 1.0, DECAY) for mass in (0.5, 1.0, 2.0)]
CONTACT_CASES = [
    (mass, share, DECAY if share >= 0.5 else 0.0)
    for mass, share in product((2.0 / 3.0, 1.0, 1.5), (1e-3, 0.1, 0.5, 1.0, 2.0))
]
"""In free directions and along a contact: what a force accelerates, relative to the model; the
stiffness, relative to the stated one; and the least rate."""

SLOWER = (1.0, 0.5, 0.25)
"""The factors by which the integral and the observer along a contact are slowed, since both reduce
damping; the first one for which there are gains is taken."""

SHAPES = (1.5, 0.5), (0.75, 1.0)
"""p / w and zeta: Butterworth's three poles, and three equal ones, which bear wrong masses with a
slower estimator. Faster equal ones are stiff: an error of 5 cm at the start took off a contact."""

SLOWEST = 10.0
"""The least p of equal poles in 1/s: with slower ones friction leaves a mode that hardly decays."""

MODEL_ERROR, EVERY = 1.0, 2.0
"""An unknown force of 1 N appears or turns every 2 s."""

RAMP = 10.0
"""The reference of a force changes by 10 N/s."""


@checked(ModelError)
@dataclass(frozen=True)
class SensedContact:
    """The numbers of a robot in contact, its sampling and its sensors that decide the gains.

    `period` is T in s, `delay` that of the control in samples, `stiffness` k in N/m, `mobility`
    J M^-1 J^T of the contact in 1/kg, the largest along the motion, and `free_mobility` that of the
    points that follow a path. `lever` and `contact_lever` are the displacements of such a point and
    of the contact per radian of noise of all joints, the lengths of rows of J, in m/rad; `inertia`
    is sqrt(tr M M), the torque per acceleration of all joints, in kg m^2; `noise` that of a joint's
    angle and velocity and of the force, with a `velocity_bandwidth` if velocities are filtered
    differences; `estimates` tells whether the state comes from a `StateEstimator`.

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
        for name in self.__annotations__.keys() - {"delay", "noise", "estimates"}:
            positive(name, getattr(self, name))
        check_whole_number("delay", self.delay, 0)
        for name, value in vars(self.noise).items():
            if not value >= 0.0:
                raise ModelError(f"the noise of the {name} must be 0 or more, got {value:g}")

    def loop(
        self, rates: DirectionGains, contact: bool, mass_error: float = 1.0, share: float = 1.0
    ) -> SampledLoop:
        """That of a joint's free motion, or of the contact with a fraction of its stiffness."""
        noise, timing = self.noise, (self.period, self.delay)
        if not contact:
            return sampled_loop(rates, noise, *timing, mass_error=mass_error)
        moves = [self.contact_lever * each for each in (noise.position, noise.velocity)]
        noise = replace(noise, position=moves[0], velocity=moves[1])
        stiffness = share * self.stiffness
        return sampled_loop(rates, noise, *timing, self.mobility, stiffness, mass_error)

    @cached_property
    def best_damping(self) -> float:
        """`contact_damping` of the contact, in 1/s."""
        return contact_damping(self.stiffness, self.mobility, self.period, self.delay)


@dataclass(frozen=True)
class Part:
    """The prediction for one direction.

    The error is the rms one of a point in m, or of the contact force in N: by noise, by an unknown
    force of `MODEL_ERROR` that appears every `EVERY` seconds and, of the force, by a reference that
    changes by `RAMP`, in squares; `by_noise` is the part by noise. The roughness is the rms change
    of the controls from sample to sample in N m.
    """

    rate: float
    rates: DirectionGains
    is_contact: bool
    error: float
    by_noise: float
    roughness: float

    @classmethod
    def of(cls, situation: SensedContact, w: float, rates: DirectionGains, contact: bool) -> "Part":
        """Of the linear loop with these gains, which belong to the rate w in 1/s."""
        loop = situation.loop(rates, contact)
        error, jump = loop.deviations()
        mobility = situation.mobility if contact else situation.free_mobility
        step = MODEL_ERROR * mobility * loop.after_step() * (loop.period / EVERY) ** 0.5
        if contact:
            ramp = rates.gains[2] * RAMP / (mobility * situation.stiffness)
            roughness = situation.contact_lever * jump / mobility
            whole = float(np.linalg.norm([error, step, ramp]))
        else:  # The loop is that of a joint; a point moves by its lever.
            error, roughness = situation.lever * error, situation.inertia * jump
            whole = float(np.hypot(error, step))
        return cls(w, rates, contact, whole, error, roughness)


def is_stable(situation: SensedContact, part: Part) -> bool:
    """Whether a loop settles for all masses and stiffnesses for which it must be stable."""
    return all(
        situation.loop(part.rates, part.is_contact, mass, share).radius
        < 1.0 - decay * part.rate * situation.period
        for mass, share, decay in (CONTACT_CASES if part.is_contact else FREE_CASES)
    )


def _groups(situation: SensedContact, fast: float | None, contact: bool) -> Iterator[list[Part]]:
    """The predictions for all rates w, and that of an estimator, in free directions or a contact.

    Of a contact there is a group for each of `SLOWER`; the first one that has gains is taken.
    """
    if not contact:
        free = []
        for w, (shape, damping) in product(_rates(situation), SHAPES):
            if damping < 1.0 or shape * w >= SLOWEST:
                low, middle, high = pole_gains(shape * w, damping, 3)
                rates = DirectionGains((low, middle, high), 0.0, shape * w / 0.75, fast)
                free.append(Part.of(situation, w, rates, False))
        yield free
        return
    for share in SLOWER:
        along = []
        for w in _rates(situation):
            c = min(2.3 * w, situation.best_damping)
            rates = DirectionGains((0.0, 0.0, c), share * 0.4 * (c or w / 2.0), share * w, fast)
            along.append(Part.of(situation, w, rates, True))
        yield along


@dataclass(frozen=True)
class AdvisedGains:
    """Gains with the rate of the estimator in 1/s, if there is one, and what is predicted for them.

    The roughness is that of both directions, in N m.
    """

    gains: ContactGains
    state_rate: float | None
    free: Part
    contact: Part
    roughness: float


def _roughness(pair: Sequence[Part]) -> float:
    """That of both directions, in N m."""
    return float(np.hypot(pair[0].roughness, pair[1].roughness))


@checked(ModelError)
def advised_gains(
    situation: SensedContact,
    roughness: float,
    *,
    position_error: float = inf,
    force_error: float = inf,
) -> AdvisedGains:
    """Returns the gains with the least predicted errors that are smooth and stable enough.

    The gains are those of `contact_gains`, as functions of its rate w, for which free directions
    and contacts have a value of their own, in free directions also with three equal poles in place
    of Butterworth's; and the rate of a `StateEstimator`, if there is one.
    For each of them the loop of one direction is a linear system with samples, delay, law,
    observer and contact; its errors and its roughness follow from Lyapunov's equation, its
    stability from eigenvalues; see `sampled_loop`. The product of the errors of position and force
    is least among those gains that

    - change the controls by at most `roughness` N m from sample to sample, in rms,
    - are stable, and settle at least at the rate `DECAY` w, if a force accelerates 1/2 to 2 times
      as in the model of the law in free directions, and 2/3 to 3/2 times along a contact whose
      stiffness is up to 2 times the stated one,
    - lose at most 0.3 rad of phase to samples and delay, with an estimator half of it.

    Where an error in m or N is bounded, the gains of its direction are the smoothest ones within
    the bound.

    Raises:
        GainError: No gains do so; the message names what prevents it.
        ModelError: The roughness or an error is not positive.
    """
    positive("roughness", roughness)
    for name, bound in (("position_error", position_error), ("force_error", force_error)):
        if not bound > 0.0:
            raise ModelError(f"{name} must be positive, got {bound:g}")
    most = position_error, force_error
    tried = ((_pair(situation, fast, roughness, most), fast) for fast in _state_rates(situation))
    candidates = [(pair, fast) for pair, fast in tried if pair is not None]
    if not candidates:
        raise GainError(_reason(situation, roughness, most))

    def order(candidate: tuple[tuple[Part, Part], float | None]) -> tuple[float, float]:
        """The errors without a bound, then the roughness."""
        pair, _ = candidate
        errors = (part.error for part, bound in zip(pair, most, strict=True) if bound == inf)
        return prod(errors), _roughness(pair)

    (free, contact), fast = min(candidates, key=order)
    own, along, p = free.rates, contact.rates, free.rates.gains[0] ** (1.0 / 3.0)
    return AdvisedGains(
        gains=ContactGains(
            position_rate=p,
            force_gain=along.force_gain,
            constraint_damping=along.gains[2],
            observer_rate=own.observer_rate,
            observer_force_rate=along.observer_rate,
            friction_rate=own.observer_rate / 4.0,
            position_damping=(own.gains[2] / p - 1.0) / 2.0,
        ),
        state_rate=fast,
        free=free,
        contact=contact,
        roughness=_roughness((free, contact)),
    )


def _rates(situation: SensedContact) -> list[float]:
    """The rates w that are tried, from the largest one by the loss of phase on."""
    phase = _PHASE / 2.0 if situation.estimates else _PHASE
    highest = phase / (3.0 * (situation.delay + 0.5) * situation.period)
    return np.geomspace(highest, highest / 60.0, 17).tolist()


def _state_rates(situation: SensedContact) -> list[float | None]:
    """The rates of an estimator that are tried."""
    if not situation.estimates:
        return [None]
    rates = [share * _rates(situation)[0] for share in (2.0, 2.8, 4.0, 7.0, 12.0, 20.0)]
    return [rate for rate in rates if rate * situation.period <= 0.5]


def _pair(
    situation: SensedContact, fast: float | None, roughness: float, most: tuple[float, float]
) -> tuple[Part, Part] | None:
    """The best gains of free directions and of the contact, if there are any.

    The part of each has the least error, or the least roughness where its error is bounded, of
    those that are smooth and stable enough.
    """
    found, left = dict[bool, Part](), roughness
    # The contact comes first, with at most its share of the roughness; but free directions do where
    # their error is bounded, since their smoothest gains leave the most.
    for contact in (True, False) if most[0] == inf else (False, True):
        allowed = min(left, roughness / 2.0**0.5) if contact else left
        for group in _groups(situation, fast, contact):
            bound = most[contact]
            within = [part for part in group if part.roughness <= allowed and part.error <= bound]
            within.sort(key=lambda part: part.error if bound == inf else part.roughness)
            best = next((part for part in within if is_stable(situation, part)), None)
            if best is not None:
                found[contact], left = best, (roughness**2 - best.roughness**2) ** 0.5
                break
        else:
            return None
    return found[False], found[True]


def _stable(situation: SensedContact, contact: bool) -> Iterator[Part]:
    """All stable gains of free directions, or of the contact."""
    for fast in _state_rates(situation):
        for group in _groups(situation, fast, contact):
            yield from (part for part in group if is_stable(situation, part))


def settles_along(situation: SensedContact) -> bool:
    """Whether any gains are stable along the contact with a margin."""
    return any(_stable(situation, True))


def _reason(situation: SensedContact, roughness: float, most: tuple[float, float]) -> str:
    """Why no gains are found."""
    smoothest = []
    for contact in (False, True):
        where, unit = ("along the contact", "N") if contact else ("in free directions", "m")
        stable, bound = list(_stable(situation, contact)), most[contact]
        if not stable:
            return (
                f"no gains are stable {where} with a margin, for a contact of "
                f"{situation.stiffness:.3g} N/m sampled each {situation.period:g} s with "
                f"{situation.delay} samples of delay: sample more often, or make it softer"
            )
        least = min(stable, key=lambda part: part.error)
        if least.error > bound:
            return (
                f"the error {where} is {least.error:.3g} {unit} rms with the best gains that are "
                f"stable, {least.by_noise:.3g} {unit} of it by noise, and {bound:.3g} {unit} are "
                "allowed: allow more, sample more often, or use better sensors"
            )
        smoothest.append(min(part.roughness for part in stable if part.error <= bound))
    return (
        f"the noise of the sensors changes the controls by {smoothest[0]:.3g} N m in free "
        f"directions and {smoothest[1]:.3g} N m along the contact from sample to sample with the "
        f"smoothest gains that are stable and keep the errors; {roughness:.3g} N m are allowed, of "
        f"which the contact has at most {roughness / 2.0**0.5:.3g}: allow more roughness or larger "
        "errors, or use better sensors"
    )
