"""Sensors of constraint forces, for laws with measured force.              (59), (71), (81)"""

from dataclasses import replace

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike
from pydrake.systems.framework import Context

from drake_dae.arguments import checked
from drake_dae.arrays import FloatArray, brief, check_whole_number, numbers, vector
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
        check_whole_number("the size of a ForceSensor", size, 1)
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

    def largest_stable_gain(self) -> float:
        """The largest gain Gbar of (59) for which a rigid robot's force error decays.

        With the lag alone it is infinite: the error decays at (1 + Gbar) / time_constant. A sampled
        sensor multiplies it by a - (1 - a) Gbar a step, a = exp(-sample_period / time_constant).
        """
        if not self.sample_period:
            return np.inf
        a = np.exp(-self.sample_period / self.time_constant) if self.time_constant else 0.0
        return float((1.0 + a) / (1.0 - a))


def _errors(size: int, *errors: ArrayLike) -> FloatArray:
    """The bias, noise_deviation and drift of all forces, shape (3 m,)."""
    found = []
    for name, given in zip(("bias", "noise_deviation", "drift"), errors, strict=True):
        values = numbers(name, given)
        least = 0.0 if name == "noise_deviation" else -np.inf
        if values.shape not in ((), (size,)) or not np.all(np.isfinite(values) & (values >= least)):
            right = "finite, 0 or more" if least == 0.0 else "finite"
            raise ModelError(
                f"a ForceSensor's {name} must be {right}, a number or shape ({size},), got "
                f"{brief(given)}"
            )
        found.append(np.broadcast_to(values, size))
    return np.concatenate(found)
