"""Recommended gains of a law for compliant contact."""

from dataclasses import dataclass

from drake_dae.arguments import checked
from drake_dae.arrays import check_whole_number
from drake_dae.dae.tracking.constraint_damping import best_damping, unstable_from, warn_of
from drake_dae.errors import ModelError

_PHASE = 0.3
"""The allowed loss of phase by sampling and delay at the crossover frequency, in rad."""

_JITTER = 0.08
"""The allowed standard deviation of accelerations from velocity noise, from sample to sample, in
rad/s^2: 0.08 N m for a body of 1 kg m^2."""


@checked(ModelError)
@dataclass(frozen=True)
class ContactGains:
    """The gains of a law for motion and force on a compliant contact, in 1/s.

    Attributes:
        position_rate: p, the distance of the poles of position outputs from 0.
        force_gain: The gain of the integral of the force's error.
        constraint_damping: The poles of the constraint's rate; 0 for none.
        observer_rate: k_o of the `DisturbanceObserver`.
        observer_force_rate: The rate k_n of this observer in the directions of the constraint's
            reaction.
        friction_rate: The rate at which the observer identifies friction.
    """

    position_rate: float
    force_gain: float
    constraint_damping: float
    observer_rate: float
    observer_force_rate: float
    friction_rate: float

    def position_gains(self, poles: int) -> list[float]:
        """Returns the gains of a position output with 2 poles, or with 3 and an integral.

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
    """Returns gains of a law with integrals, damping and observer for a contact.

    All gains follow from one rate w. Positions have Butterworth's poles at the distance p = 1.5 w,
    so that 3 w is the gain of the velocity where they are integrated: a triple pole at -w has the
    same gain, but here slow model errors leave rate / p^3, which is 3.4 times less, and the complex
    pair has a damping ratio of 1/2.

    w is the smaller of two. First, a delay tau = (delay + 1/2) sample_time costs the phase 3 w tau
    at the crossover frequency, of which 0.3 rad are allowed. Second, white velocity noise n makes
    the acceleration jump by 3 w n_k through the law, and by k_o n_(k-1) through the observer, one
    sample later. From sample to sample the standard deviation is

        n sqrt((3 w)^2 + (k_o - 3 w)^2 + k_o^2),

    which is sqrt(14) w n for both k_o = w and k_o = 2 w, so k_o = 2 w is taken. 0.08 rad/s^2 are
    allowed. At 1 kHz, one sample of delay and 1e-3 rad/s this gives w = 21.4 1/s. Friction is
    identified at the rate k_o / 4, so that the observer reacts to a change first.

    Noise reaches the force through the damping c and the observer's rate k_n in the normal
    direction, since both act on phi'. The integral K_i reduces the damping of the contact, s^3 + c
    s^2 + A k s + A k K_i = (s + K_i) (s^2 + (c - K_i) s + A k) nearly, so that

        standard deviation of the force = (c + k_n) n_phi sqrt(k T / (2 A (c - K_i))),

    with the noise n_phi of phi'. A model error delta in N leaves the error delta'' / (k_n K_i), and
    a changing reference leaves c lambda' / (A k). For a given k_n K_i the noise is least at k_n =
    K_i = c / 3; soft contacts need a smaller c. So k_n = w, c = 2.3 w or the value of
    `contact_damping` if that is smaller, and K_i = 0.4 c, which is stable (Routh: K_i < c).

    Args:
        stiffness: k of the contact in N/m, positive.
        mobility: A(x) = J M^-1 J^T of the contact in 1/kg, positive; the largest on the way.
        sample_time: T in s, positive.
        delay: The delay of the control in samples.
        velocity_noise: The deviation of measured velocities in rad/s; 0 for none.

    The gains are valid if the contact is stable for all lower stiffnesses and up to twice the given
    one. With one sample of delay this holds at least up to sqrt(A k) T = 0.6, see
    `contact_damping`.

    Warns:
        AdviceWarning: The contact is outside the range in which the gains are valid.

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
    # Where the sampled law cannot damp the contact, its own damping must suffice and the force is
    # changed slowly.
    force_gain = 0.4 * (damping or rate / 2.0)
    frequency = (stiffness * mobility) ** 0.5
    lost = unstable_from(frequency, sample_time, delay, damping, force_gain)
    advice = f"a damping of {damping:.4g} 1/s with an integral of {force_gain:.4g} 1/s"
    warn_of(lost, stiffness, frequency * sample_time, advice)
    return ContactGains(1.5 * rate, force_gain, damping, 2.0 * rate, rate, rate / 2.0)
