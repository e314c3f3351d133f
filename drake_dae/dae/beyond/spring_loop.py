"""The loop around the springs of a robot's joints: its numbers."""

from dataclasses import dataclass, replace

from drake_dae.arguments import checked
from drake_dae.arrays import check_whole_number, positive
from drake_dae.dae.beyond.contact_gains import ContactGains, contact_gains
from drake_dae.errors import ModelError

_PHASE = 0.2
"""The allowed loss of phase by sampling and delay at the rate 2 zeta w of the shafts, in rad."""

_SLOWER = 9.0
"""The rate of the loop relative to the outer rate, at least."""

_JITTER = 0.04
"""As in `contact_gains`: the noise of accelerations, from sample to sample, in rad/s^2."""

DAMPING = 0.7
"""The default damping ratio of a loop around springs."""


@checked(ModelError)
@dataclass(frozen=True)
class SpringLoop:
    """The parameters of a loop around springs, which makes their torque tau follow tau_d,

        tau'' + 2 zeta w tau' + w^2 tau = 2 zeta w tau_d' + w^2 tau_d + ...;    see `TorqueLoop`.

    Attributes:
        rate: w in rad/s, the same for all joints, however stiff their springs are.
        damping: zeta.
        motor_rate: k_m in 1/s, the rate at which disturbances of the motors, such as their
            friction, are observed and compensated; 0 for no such observer.
        current_rate: k_i in 1/s, the rate of currents behind the springs, if there are any.
        slope: The largest tau_d' that is fed ahead, in effort limits per second. A jump, as of
            friction that is compensated ahead at a reversal, is then followed without overshoot:
            a torque that comes late finds the joint held by friction, an early one moves it.
    """

    rate: float
    damping: float = DAMPING
    motor_rate: float = 0.0
    current_rate: float = 0.0
    slope: float = 0.2

    def __post_init__(self) -> None:
        for name in ("rate", "damping"):
            positive(name, getattr(self, name))
        for name in ("motor_rate", "current_rate", "slope"):
            if not getattr(self, name) >= 0.0:
                raise ModelError(f"{name} must be 0 or more, got {getattr(self, name):g}")


def spring_loop(period: float, delay: int, damping: float = DAMPING) -> SpringLoop:
    """Returns the recommended parameters of a loop around springs.

    The velocity of a shaft is controlled with the gain 2 zeta w, which is the crossover frequency
    of its loop. A delay t = (delay + 1/2) period costs the phase 2 zeta w t there, of which 0.2 rad
    are allowed.

    Args:
        period: T in s, positive.
        delay: The delay of the control in samples.
        damping: zeta.

    Raises:
        ModelError: A number is not positive, or is negative.
    """
    check_whole_number("delay", delay, 0)
    late = (delay + 0.5) * positive("period", period)
    rate = _PHASE / (2.0 * positive("damping", damping) * late)
    return SpringLoop(rate, damping, rate, 2.0 * _PHASE / late)


def contact_gains_behind(
    loop: SpringLoop,
    stiffness: float,
    mobility: float,
    sample_time: float,
    delay: int,
    velocity_noise: float,
) -> ContactGains:
    """Returns `contact_gains` of the rigid law of a cascade with a loop around springs.

    The torque of the springs follows at the rate of the loop. So the outer rate is a ninth of it at
    most, and the gain of the velocity, three times the outer rate, a third. The observer takes the
    measured torque of the springs, so that the loop is not between what it observes and what it
    takes as control; its rate k_o is not bound by that of positions, but by noise: it is 3.75 times
    that of `contact_gains`, 0.8 times that of the loop at most, with k_o / 2 in the direction of
    the constraint's reaction and k_o / 4 for friction.

    Args:
        loop: The loop.
        stiffness, mobility, sample_time, delay, velocity_noise: As for `contact_gains`.

    Warns:
        AdviceWarning: As `contact_gains`.

    Raises:
        ModelError: A number is not positive, or is negative.
    """
    # The noise for which `contact_gains` chooses a ninth of the loop's rate.
    least = _JITTER * _SLOWER / (14.0**0.5 * loop.rate)
    noise = max(velocity_noise, least)
    gains = contact_gains(stiffness, mobility, sample_time, delay, noise)
    observer = min(0.8 * loop.rate, 3.75 * gains.observer_rate)
    return replace(
        gains,
        observer_rate=observer,
        observer_force_rate=observer / 2.0,
        friction_rate=observer / 4.0,
    )
