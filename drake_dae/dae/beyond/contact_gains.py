"""Gains for a contact that gives way: one advice for all numbers of a law."""

from dataclasses import dataclass

from drake_dae.arguments import checked
from drake_dae.arrays import check_whole_number
from drake_dae.dae.tracking.constraint_damping import best_damping, unstable_from, warn_of
from drake_dae.errors import ModelError

_PHASE = 0.15
"""The phase in rad that a law may lose by sampling and delay where it crosses over."""

_JITTER = 0.04
"""The deviation of acceleration in rad/s^2 that noise of velocities may make, sample by sample:
0.04 N m at a body of 1 kg m^2."""


@checked(ModelError)
@dataclass(frozen=True)
class ContactGains:
    """The numbers of a law that presses and moves on a contact that gives way, in 1/s.

    Attributes:
        position_rate: p, the distance of the poles of position outputs from 0.
        force_gain: Of the integral of the force's error.
        constraint_damping: The poles of the constraint's rate; 0 for none.
        observer_rate: k_o of the `DisturbanceObserver`.
        observer_force_rate: Its k_n, in the directions of the constraint's reaction.
        friction_rate: At which that identifies friction.
    """

    position_rate: float
    force_gain: float
    constraint_damping: float
    observer_rate: float
    observer_force_rate: float
    friction_rate: float

    def position_gains(self, poles: int) -> list[float]:
        """The gains of a position output with 2 poles, or with 3: then its error is integrated.

        As `gain_coefficients` takes them, lowest derivative first: Butterworth's polynomials,
        s^2 + sqrt(2) p s + p^2 and s^3 + 2 p s^2 + 2 p^2 s + p^3.
        """
        p = self.position_rate
        return [p**2, 2.0**0.5 * p] if poles == 2 else [p**3, 2.0 * p**2, 2.0 * p]


@checked(ModelError)
def contact_gains(
    stiffness: float,
    mobility: float,
    sample_time: float,
    delay: int = 1,
    velocity_noise: float = 1e-3,
) -> ContactGains:
    """The gains of a law with integrals, damping and observer, for a contact of some stiffness.

    One rate w stands for all. Positions have Butterworth's poles at the distance p = 1.5 w, so that
    3 w is the gain of the velocity where they are integrated: a triple pole at -w has that too, but
    slow errors of a model are left as their rate / p^3, 3.4 times less, and a swing of the complex
    pair is damped by 1/2.

    w is the smaller of two. What is late by tau = (delay + 1/2) sample_time loses the
    phase 3 w tau where the loop crosses over, of which 0.15 rad are allowed. And noise n of the
    velocities, independent from sample to sample, makes accelerations jump: by 3 w n_k of the law,
    and k_o n_(k-1) of the observer, one sample later, so together from sample to sample by

        n sqrt((3 w)^2 + (k_o - 3 w)^2 + k_o^2),

    which is sqrt(14) w n for k_o = w and for k_o = 2 w: that is the faster one for nothing. Of it
    0.04 rad/s^2 are allowed; so that 1 kHz, one sample of delay and 1e-3 rad/s make w = 10.7 1/s.
    What the observer finds moving, it finds with k_o = 2 w. Friction is identified by k_o / 4, so
    that what r has is the observer's before it is friction's.

    The force hears of noise by the damping c and by the observer's rate k_n in its own direction,
    both of which brake phi', and the contact rings with what damping the integral K_i leaves,
    s^3 + c s^2 + A k s + A k K_i = (s + K_i) (s^2 + (c - K_i) s + A k) nearly, so that

        deviation of the force = (c + k_n) n_phi sqrt(k T / (2 A (c - K_i))),

    with the noise n_phi of phi'. What the model lacks, delta N, is left as delta'' / (k_n K_i), and
    a force that changes as c lambda' / (A k). For a given k_n K_i the noise is least where
    k_n = K_i = c / 3; a lower c serves the contact that is soft. So k_n = w, c = 2.3 w, or what
    `contact_damping` bears where that is less, and K_i = 0.4 c, which is stable (Routh: K_i < c).

    Args:
        stiffness: k of the contact in N/m, positive.
        mobility: A(x) = J M^-1 J^T of the contact in 1/kg, positive; the largest on the way.
        sample_time: T in s, positive.
        delay: How many samples a control is late.
        velocity_noise: The deviation of measured velocities in rad/s; 0 for none.

    The advice is right, and nothing is said, where the contact comes to rest with the damping and
    the integral also if it is softer, or stiffer by a factor of two: with one sample of delay up to
    w T = 0.6 at least, for the w = sqrt(A k) of the contact, see `contact_damping`.

    Warns:
        AdviceWarning: The contact is outside of the range in which the advice is right.

    Raises:
        ModelError: A number is not positive, or is negative.
    """
    best = best_damping(stiffness, mobility, sample_time, delay)
    if not sample_time > 0.0:
        raise ModelError(f"sample_time must be positive, got {sample_time:g}")
    if not velocity_noise >= 0.0:
        raise ModelError(f"velocity_noise must be 0 or more, got {velocity_noise:g}")
    check_whole_number("delay", delay, 0)
    rate = _PHASE / (3.0 * (delay + 0.5) * sample_time)
    if velocity_noise:
        rate = min(rate, _JITTER / (14.0**0.5 * velocity_noise))
    damping = min(2.3 * rate, best)
    # Where samples cannot damp, the contact itself must: then the force is changed slowly.
    force_gain = 0.4 * (damping or rate / 2.0)
    frequency = (stiffness * mobility) ** 0.5
    lost = unstable_from(frequency, sample_time, delay, damping, force_gain)
    advice = f"a damping of {damping:.4g} 1/s with an integral of {force_gain:.4g} 1/s"
    warn_of(lost, stiffness, frequency * sample_time, advice)
    return ContactGains(1.5 * rate, force_gain, damping, 2.0 * rate, rate, rate / 2.0)
