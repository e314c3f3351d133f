"""Gains for a contact that gives way: one advice for all numbers of a law."""

from dataclasses import dataclass

from drake_dae.arguments import checked
from drake_dae.arrays import check_whole_number
from drake_dae.dae.constraint_damping import contact_damping
from drake_dae.errors import ModelError

_PHASE = 0.15
"""The phase in rad that a law may lose by sampling and delay where it crosses over."""

_JITTER = 0.05
"""The deviation of acceleration in rad/s^2 that noise of the velocities may make, sample by sample:
0.05 N m at a body of 1 kg m^2."""


@checked(ModelError)
@dataclass(frozen=True)
class ContactGains:
    """The numbers of a law that presses and moves on a contact that gives way, in 1/s.

    Attributes:
        position_pole: The poles of position outputs, whose errors are integrated.
        force_pole: The pole of the force, whose error is integrated.
        constraint_damping: The poles of the constraint's rate; 0 for none.
        observer_rate: Of the `DisturbanceObserver`.
        friction_rate: At which that identifies friction.
    """

    position_pole: float
    force_pole: float
    constraint_damping: float
    observer_rate: float
    friction_rate: float


@checked(ModelError)
def contact_gains(
    stiffness: float,
    mobility: float,
    sample_time: float,
    delay: int = 1,
    velocity_noise: float = 1e-3,
) -> ContactGains:
    """The gains of a law with integrals, damping and observer, for a contact of some stiffness.

    One rate w stands for all: triple poles at -w for positions, of which 3 w is the gain of the
    velocity. It is the smaller of two. What is late by tau = (delay + 1/2) sample_time loses the
    phase 3 w tau where the loop crosses over, of which 0.15 rad are allowed. And noise of the
    velocities, independent from sample to sample, makes accelerations jump by about
    sqrt(2) 3 w times it, of which 0.05 rad/s^2 are allowed; so that 1 kHz, one sample of delay and
    1e-3 rad/s make w = 12 1/s.

    The constraint is damped by c = 1.7 w, or by what `contact_damping` bears where that is less:
    noise of the force grows as sqrt(c), by c n sqrt(k T / (2 A c)), and the error of a force that
    changes as c lambda' / (A k). The integral of the force leaves the contact
    s^3 + c s^2 + A k s + A k K_i, which is stable for K_i < c (Routh): K_i = 0.4 c. The observer
    has the rate w, so that it adds a third to the noise of the gains, and friction is identified by
    w / 4, slower than the direction of a motion changes.

    Args:
        stiffness: k of the contact in N/m, positive.
        mobility: A(x) = J M^-1 J^T of the contact in 1/kg, positive; the largest on the way.
        sample_time: T in s, positive.
        delay: How many samples a control is late.
        velocity_noise: The deviation of measured velocities in rad/s; 0 for none.

    Raises:
        ModelError: A number is not positive, or is negative.
    """
    best = contact_damping(stiffness, mobility, sample_time, delay)
    if not sample_time > 0.0:
        raise ModelError(f"sample_time must be positive, got {sample_time:g}")
    if not velocity_noise >= 0.0:
        raise ModelError(f"velocity_noise must be 0 or more, got {velocity_noise:g}")
    check_whole_number("delay", delay, 0)
    rate = _PHASE / (3.0 * (delay + 0.5) * sample_time)
    if velocity_noise:
        rate = min(rate, _JITTER / (3.0 * 2.0**0.5 * velocity_noise))
    damping = min(1.7 * rate, best)
    # Where samples cannot damp, the contact itself must: then the force is changed slowly.
    return ContactGains(-rate, -0.4 * (damping or rate / 2.0), damping, rate, rate / 4.0)
