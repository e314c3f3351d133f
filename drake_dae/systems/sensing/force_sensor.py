"""Sensors of constraint forces, for laws with measured force.              (59), (71), (81)"""

from dataclasses import replace

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike
from pydrake.systems.framework import Context

from drake_dae.arguments import checked
from drake_dae.arrays import vector
from drake_dae.blocks.block import TIME, Block, Held
from drake_dae.blocks.lifetime import SHARED_DICTIONARY
from drake_dae.blocks.traced_system import TracedSystem
from drake_dae.dae import Signal
from drake_dae.errors import ModelError


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
        noise: Noise of deviation 1, shape (m,), for example from Drake's RandomSource; only with a
            noise_deviation.

    Output port:
        measured_force: The measured force, shape (m,); no direct feedthrough from `force`.

    The context has bias, noise_deviation and drift as numeric parameters; see `set_errors`.

    Args:
        size: The number of forces, m.
        time_constant: The time constant of the lag in s; 0 for none, then it must sample.
        sample_period: The time between samples in s; 0 for none, then it must lag.
        bias: A constant error in N, a number or shape (m,).
        noise_deviation: The standard deviation of the noise in N, a number or shape (m,).
        drift: The rate at which the bias changes in N/s, a number or shape (m,).

    Attributes:
        time_constant, sample_period, bias, noise_deviation, drift: The arguments, the last three as
            arrays of shape (m,).

    Raises:
        ModelError: A number is negative, or there is neither lag nor sampling.
    """

    __slots__ = SHARED_DICTIONARY
    measures = True
    """It is part of the machine, not of a controller that is exported alone."""

    def __init__(
        self,
        size: int,
        time_constant: float = 0.0,
        sample_period: float = 0.0,
        bias: ArrayLike = 0.0,
        noise_deviation: ArrayLike = 0.0,
        drift: ArrayLike = 0.0,
    ) -> None:
        self.time_constant = float(time_constant)
        self.sample_period = float(sample_period)
        try:
            errors = [np.asarray(value, dtype=float) for value in (bias, noise_deviation, drift)]
            self.bias, self.noise_deviation, self.drift = (
                np.broadcast_to(value, (size,)) for value in errors
            )
        except ValueError:
            raise ModelError(
                f"a ForceSensor's bias, noise_deviation and drift are numbers or shape ({size},), "
                f"got {bias!r}, {noise_deviation!r} and {drift!r}"
            ) from None
        positive = [self.time_constant, self.sample_period, *self.noise_deviation]
        numbers = [*positive, *self.bias, *self.drift]
        if min(positive) < 0 or not np.all(np.isfinite(numbers)):
            raise ModelError(
                "a ForceSensor's time_constant, sample_period and noise_deviation must be finite "
                f"and not negative, got {time_constant}, {sample_period}, {noise_deviation!r}; its "
                f"bias and drift must be finite, got {bias!r}, {drift!r}"
            )
        if not (self.time_constant or self.sample_period):
            raise ModelError(
                "a ForceSensor needs a time_constant or a sample_period: without state it would "
                "close an algebraic loop"
            )
        force, y, sampled, noise = (
            ca.SX.sym(name, size) for name in ("force", "y", "sampled", "noise")
        )
        parts = self.bias, self.noise_deviation, self.drift
        names = [Signal(f"{p}[{i}]") for p in ("bias", "noise", "drift") for i in range(size)]
        bias, deviation, drift = (ca.SX.sym(name, size) for name in ("bias", "deviation", "drift"))
        inputs = {"force": force}
        measured = (y if self.time_constant else force) + bias + drift * TIME
        if self.noise_deviation.any():
            inputs["noise"] = noise
            measured = measured + deviation * noise
        block = Block(
            "force_sensor",
            inputs,
            {"measured_force": sampled if self.sample_period else measured},
            parameters=ca.vertcat(bias, deviation, drift),
            start={"parameters": np.concatenate(parts)},
            signals={"parameters": names},
        )
        if self.time_constant:
            rate = (force - y) / self.time_constant
            block = replace(block, state=y, derivative=rate)
        if self.sample_period:
            start, period = np.zeros(size), self.sample_period
            held = Held(sampled, measured, start, period, is_unrestricted=False)
            block = replace(block, held={"measured_force": held})
        super().__init__(block)

    def set_errors(
        self,
        context: Context,
        bias: ArrayLike,
        noise_deviation: ArrayLike,
        drift: ArrayLike = 0.0,
    ) -> None:
        """Sets bias, noise_deviation and drift in a context, numbers or shape (m,).

        Raises:
            ModelError: They do not fit, or there is noise and the sensor was made without.
        """
        self.check_context(context)
        size = self.block.inputs["force"].numel()
        lags = self.time_constant, self.sample_period
        other = ForceSensor(size, *lags, bias, noise_deviation, drift)
        if other.noise_deviation.any() and "noise" not in self.block.inputs:
            raise ModelError("a ForceSensor that was made without noise has no port for it")
        errors = np.concatenate([other.bias, other.noise_deviation, other.drift])
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

    def largest_stable_gain(self) -> float:
        """The largest gain Gbar of (59) for which a rigid robot's force error decays.

        With the lag alone it is infinite: the error decays at (1 + Gbar) / time_constant. A sampled
        sensor multiplies it by a - (1 - a) Gbar a step, a = exp(-sample_period / time_constant).
        """
        if not self.sample_period:
            return np.inf
        a = np.exp(-self.sample_period / self.time_constant) if self.time_constant else 0.0
        return float((1.0 + a) / (1.0 - a))
