"""Recommended gains of a law for compliant contact."""

import warnings
from dataclasses import dataclass

import numpy as np
from scipy.linalg import expm

from drake_dae.arguments import checked
from drake_dae.arrays import FloatArray, check_whole_number, positive
from drake_dae.errors import AdviceWarning, ModelError

INTERVALS = 200
"""The number of steps of an interval in the search for the best damping, which is refined once."""

STIFFNESSES = np.concatenate([np.geomspace(1e-3, 0.5, 10), np.linspace(0.5, 2.0, 31)[1:]])
"""The stiffnesses for which gains must be stable, relative to the given one."""

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
        constraint_damping: c, of the constraint's rate, whose pole is at -c; 0 for none.
        observer_rate: k_o of the `StateEstimator`.
        observer_force_rate: The rate k_n of this observer in the directions of the constraint's
            reaction.
        friction_rate: The rate at which the observer identifies friction.
        position_damping: zeta of the pair of these poles: 1/2 are Butterworth's, 1 equal ones.
    """

    position_rate: float
    force_gain: float
    constraint_damping: float
    observer_rate: float
    observer_force_rate: float
    friction_rate: float
    position_damping: float = 0.5

    def position_gains(self, poles: int) -> list[float]:
        """Returns the gains of a position output with 2 poles, or with 3 and an integral.

        As `gain_coefficients` takes them, lowest derivative first; see `pole_gains`.
        """
        return pole_gains(self.position_rate, self.position_damping, poles)


def pole_gains(p: float, zeta: float, poles: int) -> list[float]:
    """The coefficients of (s + p) (s^2 + 2 zeta p s + p^2), or s^2 + 2 sqrt(zeta) p s + p^2.

    With zeta = 1/2 both are Butterworth's polynomials, with 1 they have equal poles.
    """
    if poles == 2:
        return [p**2, 2.0 * zeta**0.5 * p]
    return [p**3, (1.0 + 2.0 * zeta) * p**2, (1.0 + 2.0 * zeta) * p]


@checked(ModelError)
def contact_gains(
    stiffness: float,
    mobility: float,
    sample_time: float,
    delay: int = 1,
    velocity_noise: float = 1e-3,
) -> ContactGains:
    """Returns gains of a law with integrals, damping and observer for a contact.

    All gains follow from one rate w, the smaller of two. A delay tau = (delay + 1/2) sample_time
    costs the phase 3 w tau at the crossover frequency, of which 0.3 rad are allowed. White velocity
    noise n makes the acceleration jump, through law and observer, by the standard deviation

        n sqrt((3 w)^2 + (k_o - 3 w)^2 + k_o^2)

    from sample to sample, sqrt(14) w n for k_o = 2 w; 0.08 rad/s^2 are allowed. Positions have
    Butterworth's poles at p = 1.5 w. Friction is identified at the rate k_o / 4, so that the
    observer reacts to a change first.

    Noise n_phi of phi' reaches the force through the damping c and the observer's rate k_n:

        standard deviation of the force = (c + k_n) n_phi sqrt(k T / (2 A (c - K_i))),

    where the integral K_i reduces the damping. A model error delta in N leaves delta'' / (k_n K_i),
    and a changing reference c lambda' / (A k). For given k_n K_i the noise is least at k_n = K_i =
    c / 3. So k_n = w, c = 2.3 w or `contact_damping` if that is smaller, and K_i = 0.4 c, which is
    stable (Routh: K_i < c); 0.2 w without c.

    Args:
        stiffness: k of the contact in N/m, positive.
        mobility: A(x) = J M^-1 J^T of the contact in 1/kg, positive; the largest on the way.
        sample_time: T in s, positive.
        delay: The delay of the control in samples.
        velocity_noise: The deviation of measured velocities in rad/s; 0 for none.

    The gains are valid if the contact is stable for all lower stiffnesses and up to twice the given
    one: sqrt(A k) T at most 0.6 with one sample of delay, 1.3 with none, 0.36 with two.

    Warns:
        AdviceWarning: The contact is outside the range in which the gains are valid.

    Raises:
        ModelError: A number is not positive, or is negative.
    """
    positive("sample_time", sample_time)
    if not velocity_noise >= 0.0:
        raise ModelError(f"velocity_noise must be 0 or more, got {velocity_noise:g}")
    best = contact_damping(stiffness, mobility, sample_time, delay)
    rate = _PHASE / (3.0 * (delay + 0.5) * sample_time)
    if velocity_noise:
        rate = min(rate, _JITTER / (14.0**0.5 * velocity_noise))
    damping = min(2.3 * rate, best)
    # Where the sampled law cannot damp the contact, its own damping must suffice and the force is
    # changed slowly.
    force_gain = 0.4 * (damping or rate / 2.0)

    def is_stable(share: float) -> bool:
        swing = (share * stiffness * mobility) ** 0.5 * sample_time
        step = _step(swing / sample_time, sample_time)
        return swing < np.pi and _radius(step, damping, delay, force_gain * swing) < 1.0

    lost = next((share for share in STIFFNESSES.tolist() if not is_stable(share)), None)
    if lost is not None:
        swing = (stiffness * mobility) ** 0.5 * sample_time
        warnings.warn(
            f"a damping of {damping:.4g} 1/s with an integral of {force_gain:.4g} 1/s is outside "
            "of the range in which the recommendation is valid: a contact of "
            f"{lost * stiffness:.3g} N/m, which is {lost:.3g} times the given {stiffness:.3g} N/m, "
            f"is unstable with it. The contact oscillates by {swing:.3g} rad in a sample: sample "
            "more often, make it softer, or choose the gains yourself",
            AdviceWarning,
            stacklevel=3,
        )
    return ContactGains(1.5 * rate, force_gain, damping, 2.0 * rate, rate, rate / 2.0)


@checked(ModelError)
def contact_damping(
    stiffness: float, mobility: float, sample_time: float = 0.0, delay: int = 1
) -> float:
    """Returns the damping c for which a contact of the stated stiffness settles fastest.

    It is the optimum, without a margin. On a compliant contact, F = -k phi, a law with
    `constraint_damping=poles(-c)` leaves

        phi'' + c phi' = A (F - lambda_d),    so    phi'' + c phi' + A k phi = -A lambda_d,

    which is critically damped at c = 2 sqrt(A k). A changing reference force leaves an error of
    about c lambda_d' / (A k).

    A sampled law holds -c phi' for a sample time T, from a measurement `delay` samples before, so
    that (phi, phi', the held value) follow from the previous sample by a matrix. c minimizes its
    spectral radius. For a slow contact c is 2 w, with w = sqrt(A k). At w T of about 1 the held
    value lags by a quarter of a period and does not damp any more; then c is 0, and the contact
    needs damping of its own or a shorter sample time.

    The stiffness is k in N/m, the mobility A = J M^-1 J^T in 1/kg, the largest along the motion;
    sample_time is T in s, 0 for a law that runs continuously, and c is in 1/s.

    Raises:
        ModelError: A number is not positive, or is negative.
    """
    frequency = (positive("mobility", mobility) * positive("stiffness", stiffness)) ** 0.5
    check_whole_number("delay", delay, 0)
    if sample_time == 0.0:
        return 2.0 * frequency
    step = _step(frequency, positive("sample_time", sample_time))
    low, high = 0.0, 2.0 * frequency
    for _ in range(2):
        tried = np.linspace(low, high, INTERVALS + 1)
        best = int(np.argmin([_radius(step, c, delay) for c in tried]))
        low, high = tried[max(best - 1, 0)], tried[min(best + 1, INTERVALS)]
    return float(tried[best])


def _step(frequency: float, sample_time: float) -> FloatArray:
    """The matrix of (phi, phi', held value) over a sample, phi in units of 1 / frequency."""
    swing = np.zeros((3, 3))
    swing[0, 1], swing[1, 0], swing[1, 2] = frequency, -frequency, 1.0
    return np.asarray(expm(swing * sample_time)[:2])


def _radius(step: FloatArray, damping: float, delay: int, integral: float = 0.0) -> float:
    """The spectral radius of a contact whose damping is sampled, held and delayed."""
    # (phi, phi', the integral, the held values from next to last).
    matrix = np.zeros((3 + delay, 3 + delay))
    matrix[:2, :2] = step[:, :2]
    matrix[2, 0], matrix[2, 2] = integral, 1.0 if integral else 0.0
    if delay == 0:
        matrix[:2, 1] -= damping * step[:, 2]
        matrix[:2, 2] -= step[:, 2]
    else:
        matrix[:2, 3] = step[:, 2]
        matrix[3:-1, 4:] = np.eye(delay - 1)
        matrix[-1, 1:3] = -damping, -1.0
    return float(np.abs(np.linalg.eigvals(matrix)).max())
