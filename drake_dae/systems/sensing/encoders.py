"""The state measured by encoders."""

from dataclasses import dataclass

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from drake_dae.arguments import checked
from drake_dae.arrays import FloatArray, brief, check_whole_number, numbers, positive
from drake_dae.blocks.block import TIME, Block, Held
from drake_dae.blocks.lifetime import SHARED_DICTIONARY
from drake_dae.blocks.traced_system import TracedSystem
from drake_dae.errors import ModelError

_SAME = 1e-9  # Times that differ by less than this, in periods, count as equal.


@checked(ModelError)
@dataclass(frozen=True)
class Encoders:
    """The measurement of a robot's positions and velocities at samples t_k = k T.

    A position is rounded to a multiple of the resolution delta, after bias and noise are added:

        qm_k = delta round((q(t_k) + b + sigma_q n_k) / delta).

    A velocity is measured with noise of its own, vm_k = v(t_k) + sigma_v n_k; or it is the filtered
    difference of the measured positions, with the bandwidth w,

        vm_k = a vm_(k-1) + (1 - a) (qm_k - qm_(k-1)) / T,    a = exp(-w T),

    which starts at the robot's velocity. An observer with a `state_rate` estimates velocities from
    positions: it takes measured ones only if their noise is given, and no differences.

    Attributes:
        resolution: delta in rad or m, one number for all positions or one each, as for the others;
            0 for none.
        velocity_bandwidth: w in rad/s; None for directly measured velocities.
        position_bias, position_noise: b and sigma_q in rad or m.
        velocity_noise: sigma_v in rad/s or m/s; only without a velocity_bandwidth.
        seed: The seed of the noise.

    Raises:
        ModelError: A number is negative or not finite, or there are both velocity_bandwidth and
            velocity_noise.
    """

    resolution: ArrayLike = 0.0
    velocity_bandwidth: float | None = None
    position_noise: ArrayLike = 0.0
    velocity_noise: ArrayLike = 0.0
    seed: int = 0
    position_bias: ArrayLike = 0.0

    def __post_init__(self) -> None:
        for name in ("resolution", "position_noise", "velocity_noise", "position_bias"):
            given, is_bias = numbers(name, getattr(self, name)), name == "position_bias"
            if given.ndim > 1 or not (np.isfinite(given).all() and (is_bias or np.all(given >= 0))):
                right = "finite" if is_bias else "0 or more"
                raise ModelError(
                    f"the {name} of encoders must be {right}, one number or one for each position, "
                    f"got {brief(getattr(self, name))}"
                )
        if self.velocity_bandwidth is not None:
            positive("the velocity_bandwidth of encoders", self.velocity_bandwidth)
            if np.any(self.velocity_noise):
                raise ModelError(
                    "velocities from differences have the noise of the positions; give encoders "
                    "either a velocity_bandwidth or a velocity_noise"
                )
        check_whole_number("the seed of encoders", self.seed, 0)
        if self.seed >= 2**32:
            raise ModelError(f"the seed of encoders must be below 2^32, got {self.seed}")

    @property
    def has_noise(self) -> bool:
        """Whether the measurement has noise."""
        return bool(np.any(self.position_noise) or np.any(self.velocity_noise))

    @property
    def position_deviation(self) -> FloatArray:
        """The standard deviation of qm - q - b, sqrt(delta^2 / 12 + sigma_q^2), rad or m.

        Between samples a position passes many multiples of delta, so that rounding is white noise.
        """
        return np.sqrt(np.square(self.resolution) / 12.0 + np.square(self.position_noise))


@checked(ModelError)
class StateSensor(TracedSystem):
    """The state x = (q, v, ...) of a robot, measured by `Encoders`, for a law.

    The measurement of t_k = k period is held until the next sample; at t_k itself the output is a
    function of the state at that instant, which a law sampled then uses. Entries of x after q and v
    are not changed.
    """

    __slots__ = SHARED_DICTIONARY
    measures = True  # It is part of the machine, not of a controller that is exported alone.

    def __init__(self, size: int, num_positions: int, encoders: Encoders, period: float) -> None:
        check_whole_number("num_positions", num_positions, 1)
        check_whole_number("size", size, 2 * num_positions)
        self.encoders, self.sample_period = encoders, positive("period", period)
        count = num_positions
        resolution, bias, position_noise, velocity_noise = (
            _each(name, getattr(encoders, name), count)
            for name in ("resolution", "position_bias", "position_noise", "velocity_noise")
        )
        state, held = ca.SX.sym("state", size), ca.SX.sym("held", 1 + 2 * count)
        q, v = state[:count] + bias, state[count : 2 * count]
        inputs = {"state": state}
        if encoders.has_noise:
            inputs["noise"] = noise = ca.SX.sym("noise", 2 * count)
            q, v = q + position_noise * noise[:count], v + velocity_noise * noise[count:]
        for i in np.flatnonzero(resolution).tolist():
            q[i] = resolution[i] * _rounded(q[i] / resolution[i])
        sample, first = ca.floor(TIME / period + _SAME), ca.vertcat(q, v)
        later = first
        if encoders.velocity_bandwidth is not None:
            a = np.exp(-encoders.velocity_bandwidth * period)
            before, q_before = held[1 + count :], held[1 : 1 + count]
            later = ca.vertcat(q, a * before + (1.0 - a) * (q - q_before) / period)
        # Before the first sample it is nan.
        fresh = ca.if_else(ca.fabs(held[0]) < np.inf, later, first)
        current = ca.if_else(ca.eq(held[0], sample), held, ca.vertcat(sample, fresh))
        # The last sample with its index.
        unknown, begin = np.full(1 + 2 * count, np.nan), ca.vertcat(sample, first)
        block = Block(
            "state_sensor",
            inputs,
            {"estimated_state": ca.vertcat(current[1:], state[2 * count :])},
            held={"sample": Held(held, current, unknown, period, begin=begin)},
        )
        super().__init__(block)


def _rounded(number: ca.SX) -> ca.SX:
    """The nearest integer, halves to even as `numpy.round`."""
    up = ca.floor(number + 0.5)
    is_tie = ca.eq(up, number + 0.5)
    is_odd = ca.eq(2.0 * ca.floor(up / 2.0) + 1.0, up)
    return up - ca.logic_and(is_tie, is_odd)


def _each(name: str, given: ArrayLike, count: int) -> FloatArray:
    """One number for each position."""
    values = np.asarray(given, dtype=float)
    if values.shape not in ((), (count,)):
        raise ModelError(
            f"the {name} of encoders has {values.size} entries, the robot has {count} positions"
        )
    return np.broadcast_to(values, (count,))
