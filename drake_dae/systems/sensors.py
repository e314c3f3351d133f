"""Sensors: encoders of the state, and of constraint forces.           (59), (71), (81)"""

from dataclasses import dataclass, replace

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike
from pydrake.systems.framework import Context

from drake_dae.arguments import checked
from drake_dae.arrays import FloatArray, brief, check_whole_number, numbers, positive, vector
from drake_dae.blocks.block import TIME, Block, Held
from drake_dae.blocks.lifetime import SHARED_DICTIONARY
from drake_dae.blocks.traced_system import TracedSystem
from drake_dae.dae import Signal
from drake_dae.errors import ModelError

_SAME = 1e-9  # Times that differ by less than this, in periods, count as equal.


def one_each(what: str, given: ArrayLike, size: int, least: float = 0.0) -> FloatArray:
    """The numbers of so many things, from one for all of them or one for each."""
    values = numbers(what, given)
    if values.shape not in ((), (size,)):
        text = f"{what} has shape {values.shape}; it must be one number, or have shape ({size},)"
        raise ModelError(text)
    if not np.all(np.isfinite(values) & (values >= least)):
        right = "finite" if least < 0.0 else "finite, 0 or more"
        raise ModelError(f"{what} must be {right}, got {brief(given)}")
    return np.broadcast_to(values, (size,))


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
            given, least = getattr(self, name), -np.inf if name == "position_bias" else 0.0
            one_each(f"the {name} of encoders", given, np.size(given), least)
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
    are not changed. The output has the name of the input of Drake's controllers that it goes to,
    `estimated_state`, although nothing is estimated here: a StateEstimator has the same port.
    """

    __slots__ = SHARED_DICTIONARY
    measures = True  # It is part of the machine, not of a controller that is exported alone.

    def __init__(self, size: int, num_positions: int, encoders: Encoders, period: float) -> None:
        check_whole_number("size", size, 2 * num_positions)
        self.encoders, self.sample_period = encoders, positive("period", period)
        count = num_positions
        resolution, bias, position_noise, velocity_noise = (
            one_each(f"the {name} of encoders", getattr(encoders, name), count, -np.inf)
            for name in ("resolution", "position_bias", "position_noise", "velocity_noise")
        )
        state, held = ca.SX.sym("state", size), ca.SX.sym("held", 1 + 2 * count)
        q, v = state[:count] + bias, state[count : 2 * count]
        inputs = {"state": state}
        if encoders.has_noise:
            inputs["noise"] = noise = ca.SX.sym("noise", 2 * count)
            q, v = q + position_noise * noise[:count], v + velocity_noise * noise[count:]
        for i in np.flatnonzero(resolution).tolist():
            q[i] = resolution[i] * ca.floor(q[i] / resolution[i] + 0.5)
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


@checked(ModelError)
class ForceSensor(TracedSystem):
    """A force sensor with state, so that it can close a loop around a rigid robot:

        time_constant * y' = force - y,
        measured_force = y + bias + drift * t + noise_deviation * noise,

    and, if it samples, measured_force is held between samples. With rigid joints the constraint
    force has direct feedthrough from the control; reading it directly would close an algebraic
    loop. Without sampling it converts to AutoDiffXd.

    Input ports:
        force: The constraint force in N (N m), shape (m,).
        noise: Noise of deviation 1, shape (m,), as of Drake's RandomSource; with a noise_deviation.

    Output port:
        measured_force: The measured force, shape (m,); no direct feedthrough from `force`.

    The context has bias, noise_deviation and drift as numeric parameters; see `set_errors`.

    Args:
        size: The number of forces, m.
        time_constant: The time constant of the lag in s; 0 for none, then it must sample.
        sample_period: The time between samples in s; 0 for none, then it must lag.
        bias: A constant error in N, a number or shape (m,), as the next two.
        noise_deviation: The standard deviation of the noise in N.
        drift: The rate at which the bias changes in N/s.

    Raises:
        ModelError: A number is negative, or there is neither lag nor sampling.
    """

    __slots__ = SHARED_DICTIONARY
    measures = True  # It is part of the machine, not of a controller that is exported alone.

    def __init__(
        self,
        size: int,
        time_constant: float = 0.0,
        sample_period: float = 0.0,
        bias: ArrayLike = 0.0,
        noise_deviation: ArrayLike = 0.0,
        drift: ArrayLike = 0.0,
    ) -> None:
        self.time_constant, self.sample_period = time_constant, sample_period
        check_whole_number("the size of a ForceSensor", size, 1)
        errors = _errors(size, bias, noise_deviation, drift)
        for name, value in (("time_constant", time_constant), ("sample_period", sample_period)):
            if not 0.0 <= value < np.inf:
                raise ModelError(f"a ForceSensor's {name} must be 0 or more, got {value:g}")
        if not (time_constant or sample_period):
            raise ModelError(
                "a ForceSensor needs a time_constant or a sample_period: without state it would "
                "close an algebraic loop"
            )
        force, y, sampled, noise = (
            ca.SX.sym(name, size) for name in ("force", "y", "sampled", "noise")
        )
        names = [Signal(f"{p}[{i}]") for p in ("bias", "noise", "drift") for i in range(size)]
        parameters = ca.SX.sym("errors", 3 * size)
        of_bias, deviation, of_drift = ca.vertsplit(parameters, size)
        inputs = {"force": force}
        measured = (y if time_constant else force) + of_bias + of_drift * TIME
        if errors[size : 2 * size].any():
            inputs["noise"] = noise
            measured = measured + deviation * noise
        block = Block(
            "force_sensor",
            inputs,
            {"measured_force": sampled if sample_period else measured},
            parameters=parameters,
            start={"parameters": errors},
            signals={"parameters": names},
        )
        if time_constant:
            block = replace(block, state=y, derivative=(force - y) / time_constant)
        if sample_period:
            start = np.zeros(size)
            held = Held(sampled, measured, start, sample_period, is_unrestricted=False)
            block = replace(block, held={"measured_force": held})
        super().__init__(block)

    def set_errors(
        self, context: Context, bias: ArrayLike, noise_deviation: ArrayLike, drift: ArrayLike = 0.0
    ) -> None:
        """Sets bias, noise_deviation and drift in a context, numbers or shape (m,).

        Raises:
            ModelError: They do not fit, or there is noise and the sensor was made without.
        """
        self.check_context(context)
        size = self.block.inputs["force"].numel()
        errors = _errors(size, bias, noise_deviation, drift)
        if errors[size : 2 * size].any() and "noise" not in self.block.inputs:
            raise ModelError("a ForceSensor that was made without noise has no port for it")
        context.get_mutable_numeric_parameter(0).SetFromVector(errors)

    def set_force(self, context: Context, force: ArrayLike) -> None:
        """Sets the state of the sensor for a constant force, shape (m,), without noise and lag."""
        self.check_context(context)
        value = vector("force", force, self.block.inputs["force"].numel())
        if self.time_constant:
            context.SetContinuousState(value)
        if self.sample_period:
            bias, _, drift = np.split(context.get_numeric_parameter(0).value(), 3)
            context.SetDiscreteState(0, value + bias + drift * context.get_time())


def _errors(size: int, *errors: ArrayLike) -> FloatArray:
    """The bias, noise_deviation and drift of all forces, shape (3 m,)."""
    named = zip(("bias", "noise_deviation", "drift"), errors, (-np.inf, 0.0, -np.inf), strict=True)
    return np.concatenate(
        [one_each(f"a ForceSensor's {name}", given, size, least) for name, given, least in named]
    )
