"""Sensors of constraint forces, for laws with measured force.              (59), (71), (81)"""

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike
from pydrake.systems.framework import BasicVector, Context, ContinuousState

from drake_dae.arguments import checked
from drake_dae.arrays import FloatArray, vector
from drake_dae.blocks.computations import (
    DERIVATIVE,
    HELD,
    PARAMETERS,
    STATE,
    TIME,
    Block,
    Computation,
    Update,
)
from drake_dae.blocks.lifetime import SHARED_DICTIONARY, port_value, weakly
from drake_dae.blocks.trials import StepWatch, state_tickets
from drake_dae.errors import ModelError, NonFiniteError
from drake_dae.systems.blocks.block import DifferentiableSystem
from drake_dae.systems.blocks.formulas import Formula, TracedFormula
from drake_dae.trace.functions import TracedFunction


@checked(ModelError)
class ForceSensor(DifferentiableSystem):
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
        super().__init__()
        self.set_name("force_sensor")
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
        errors = [self.bias, self.noise_deviation, self.drift]
        self.DeclareNumericParameter(BasicVector(np.concatenate(errors)))
        self._force_port = self.DeclareVectorInputPort("force", size)
        self._noise_port = None
        if self.noise_deviation.any():
            self._noise_port = self.DeclareVectorInputPort("noise", size)
        if self.time_constant:
            self.DeclareContinuousState(size)
            self._steps = StepWatch(self)
        if self.sample_period:
            self._held = self.DeclareDiscreteState(size)
            self.DeclarePeriodicDiscreteUpdateEvent(self.sample_period, 0.0, weakly(self._sample))
            sources = {self.xd_ticket()}
        else:
            sources = state_tickets(self) | {self.all_parameters_ticket(), self.time_ticket()}
            if self._noise_port is not None:
                sources.add(self.input_port_ticket(self._noise_port.get_index()))
        self.DeclareVectorOutputPort("measured_force", size, port_value(self._output), sources)

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
        size = self._force_port.size()
        lags = self.time_constant, self.sample_period
        other = ForceSensor(size, *lags, bias, noise_deviation, drift)
        if other.noise_deviation.any() and self._noise_port is None:
            raise ModelError("a ForceSensor that was made without noise has no port for it")
        errors = np.concatenate([other.bias, other.noise_deviation, other.drift])
        context.get_mutable_numeric_parameter(0).SetFromVector(errors)

    def set_force(self, context: Context, force: ArrayLike) -> None:
        """Sets the state of the sensor for a constant force, shape (m,), without noise and lag."""
        self.check_context(context)
        value = vector("force", force, self._force_port.size())
        if self.time_constant:
            context.SetContinuousState(value)
        if self.sample_period:
            bias, _, drift = np.split(context.get_numeric_parameter(0).value(), 3)
            context.SetDiscreteState(self._held, value + bias + drift * context.get_time())

    def largest_stable_gain(self) -> float:
        """The largest gain Gbar of (59) for which a rigid robot's force error decays.

        With the lag alone it is infinite: the error decays at (1 + Gbar) / time_constant. A sampled
        sensor multiplies it by a - (1 - a) Gbar a step, a = exp(-sample_period / time_constant).
        """
        if not self.sample_period:
            return np.inf
        a = np.exp(-self.sample_period / self.time_constant) if self.time_constant else 0.0
        return float((1.0 + a) / (1.0 - a))

    def DoCalcTimeDerivatives(self, context: Context, derivatives: ContinuousState) -> None:
        if self.time_constant:
            y = context.get_continuous_state_vector().CopyToVector()
            force = self._force_port.Eval(context)
            with np.errstate(over="ignore"):
                rate = (force - y) / self.time_constant
            if not np.isfinite(rate).all():
                time = context.get_time()
                error = NonFiniteError(
                    f"{self.get_name()}: the rate of the measured force is not finite at "
                    f"t = {time:.6g} s; its time_constant is {self.time_constant:g} s",
                    time,
                    y,
                )
                self._steps.tolerate(context, error)
            derivatives.get_mutable_vector().SetFromVector(rate)

    def _measured(self, context: Context) -> FloatArray:
        if self.time_constant:
            value = context.get_continuous_state_vector().CopyToVector()
        else:
            value = self._force_port.Eval(context)
        bias, deviation, drift = np.split(context.get_numeric_parameter(0).value(), 3)
        if self._noise_port is not None:
            value = value + deviation * self._noise_port.Eval(context)
        return value + bias + drift * context.get_time()

    def _sample(self, context: Context, state: object) -> None:
        state.set_value(self._held, self._measured(context))  # type: ignore[attr-defined]

    def _output(self, context: Context) -> FloatArray:
        if self.sample_period:
            return context.get_discrete_state(self._held).value()
        return self._measured(context)

    def traced(self) -> Block:
        size = self._force_port.size()
        force, y, noise = (ca.SX.sym(name, size) for name in ("force", "y", "noise"))
        errors, time = ca.SX.sym("errors", 3 * size), ca.SX.sym("time")
        sources = [STATE if self.time_constant else "force", PARAMETERS, TIME]
        inputs, measured = [force, errors, time], force
        if self._noise_port is not None:
            sources, inputs = [*sources, "noise"], [*inputs, noise]
            measured = measured + errors[size : 2 * size] * noise
        measured = measured + errors[:size] + errors[2 * size :] * time
        measurement = ca.Function("measured_force", inputs, [measured])
        computations, updates = [], []
        if self.time_constant:
            rate = ca.Function("rate", [force, y], [(force - y) / self.time_constant])
            computations.append(Computation(rate, ("force", STATE), (DERIVATIVE,)))
        if self.sample_period:
            held = ca.Function("held", [y], [y])
            computations.append(Computation(held, (HELD,), ("measured_force",)))
            sampled = Computation(measurement, tuple(sources), (HELD,))
            updates.append(Update(sampled, self.sample_period))
        else:
            computations.append(Computation(measurement, tuple(sources), ("measured_force",)))
        return Block(self, tuple(computations), tuple(updates))

    def _formulas(self) -> dict[str, Formula]:
        if self.sample_period:
            raise ModelError(
                f"{self.get_name()} does not convert to AutoDiffXd: it samples, and a sample has "
                "no derivative by the time. Give it a time_constant alone"
            )
        size = self._force_port.size()
        force, y, noise = (ca.SX.sym(name, size) for name in ("force", "state", "noise"))
        errors, time = ca.SX.sym("errors", 3 * size), ca.SX.sym("time")
        rate = TracedFunction(
            "force sensor",
            {"force": force, "state": y},
            {"value": (force - y) / self.time_constant},
        )
        inputs, measured = {"state": y}, y
        if self._noise_port is not None:
            inputs["noise"] = noise
            measured = measured + errors[size : 2 * size] * noise
        inputs |= {"parameters": errors, "time": time}
        measured = measured + errors[:size] + errors[2 * size :] * time
        output = TracedFunction("measured force", inputs, {"value": measured})
        return {"derivative": TracedFormula(rate), "measured_force": TracedFormula(output)}
