"""What our LeafSystems share: parameters in the context, and conversion to AutoDiffXd."""

from collections.abc import Callable, Sequence
from functools import cached_property, partial
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike
from pydrake.autodiffutils import AutoDiffXd, ExtractGradient, ExtractValue, InitializeAutoDiff
from pydrake.systems.framework import (
    BasicVector,
    BasicVector_,
    Context,
    ContinuousState,
    LeafSystem,
    LeafSystem_,
    SystemScalarConverter,
)

from drake_dae.arrays import FloatArray
from drake_dae.dae.system import DaeSystem
from drake_dae.errors import ModelError, NonFiniteError
from drake_dae.trace.functions import SINGULAR_PIVOT, TracedFunction


class Formula(Protocol):
    """What an output port, or the time derivative, computes.

    Attributes:
        sources: Where each argument comes from: "time", "state", "parameters", or the name of an
            input port.
    """

    @property
    def sources(self) -> tuple[str, ...]: ...

    def value(self, time: float, *arguments: FloatArray) -> FloatArray:
        """The value, shape (k,)."""

    def slope(self, moving: tuple[int, ...], time: float, *arguments: FloatArray) -> FloatArray:
        """The derivatives with respect to some arguments, side by side, shape (k, their sizes)."""


class TracedFormula:
    """An output of a TracedFunction; its derivatives are traced when they are first needed.

    Args:
        function: If it has an output "pivot", that one tells how far a matrix is from singular.
        output: Which output.
        sources: Of the arguments; their own names if None.
        failure: (time, *arguments) -> the error to raise where the function is not finite or its
            pivot is below `SINGULAR_PIVOT`.
    """

    def __init__(
        self,
        function: TracedFunction,
        output: str,
        sources: Sequence[str] | None = None,
        failure: Callable[..., Exception] | None = None,
    ) -> None:
        self.sources = tuple(function.input_names if sources is None else sources)
        self._function = function
        self._output = function.output_names.index(output)
        self._failure = failure or self._not_finite
        self._slopes: dict[tuple[int, ...], TracedFunction] = {}

    def value(self, time: float, *arguments: FloatArray) -> FloatArray:
        values = self._function.evaluate(*arguments)
        names = self._function.output_names
        regular = "pivot" not in names or values[names.index("pivot")][0] >= SINGULAR_PIVOT
        if not (self._function.is_finite and regular):
            raise self._failure(time, *arguments)
        return values[self._output].copy()

    def slope(self, moving: tuple[int, ...], time: float, *arguments: FloatArray) -> FloatArray:
        if moving not in self._slopes:
            self._slopes[moving] = self._function.derivative(self._output, moving)
        function = self._slopes[moving]
        (slope,) = function.evaluate(*arguments)
        if not function.is_finite:
            raise NonFiniteError(
                f"{function.name} is not finite at t = {time:.6g} s: it is not differentiable "
                "there, or leaves its domain",
                time,
                np.concatenate(arguments),
            )
        return slope.reshape(-1, sum(self._function.sizes[i] for i in moving))

    def _not_finite(self, time: float, *arguments: FloatArray) -> NonFiniteError:
        return NonFiniteError(
            f"{self._function.name} is not finite at t = {time:.6g} s",
            time,
            np.concatenate(arguments),
        )


class DifferentiableSystem(LeafSystem):
    """A LeafSystem with vector ports that converts to AutoDiffXd, alone or in a diagram.

    The converted system has the same ports, continuous state and numeric parameters, and exact
    gradients. It has no events: a converted plant does not project its state onto N*, nor does it
    refuse a start that is off N*.
    """

    def __init__(self) -> None:
        converter = SystemScalarConverter()
        converter._AddConstructor[AutoDiffXd, float](_AutoDiffSystem)
        super().__init__(converter)

    @cached_property
    def formulas(self) -> dict[str, Formula]:
        """Per output port, by its name, and for "derivative" what it computes.

        Raises:
            ModelError: The system does not convert to AutoDiffXd.
        """
        return self._formulas()

    def _formulas(self) -> dict[str, Formula]:
        raise NotImplementedError

    def ToAutoDiffXd(self) -> LeafSystem_[AutoDiffXd]:
        """The converted system. Drake's own method would wrap it and rename its ports.

        Raises:
            ModelError: The system does not convert to AutoDiffXd.
        """
        return _AutoDiffSystem(self)


class _AutoDiffSystem(LeafSystem_[AutoDiffXd]):
    """A DifferentiableSystem on AutoDiffXd."""

    def __init__(self, original: DifferentiableSystem) -> None:
        super().__init__()
        self.set_name(original.get_name())
        formulas = original.formulas
        context = original.CreateDefaultContext()
        for i in range(context.num_numeric_parameter_groups()):
            values = context.get_numeric_parameter(i).CopyToVector()
            self.DeclareNumericParameter(BasicVector_[AutoDiffXd](values))
        if context.num_continuous_states():
            state = context.get_continuous_state_vector().CopyToVector()
            self.DeclareContinuousState(BasicVector_[AutoDiffXd](state))
            self._rate = formulas["derivative"]
        tickets = {
            "time": self.time_ticket(),
            "state": self.xc_ticket(),
            "parameters": self.all_parameters_ticket(),
        }
        for i in range(original.num_input_ports()):
            port = original.get_input_port(i)
            self.DeclareVectorInputPort(port.get_name(), port.size())
            tickets[port.get_name()] = self.input_port_ticket(port.get_index())
        for i in range(original.num_output_ports()):
            port = original.get_output_port(i)
            name = port.get_name()
            if name not in formulas:
                raise ModelError(
                    f"{original.get_name()} does not convert to AutoDiffXd: nothing tells how to "
                    f"differentiate its output port '{name}'; add it to _formulas()"
                )
            self.DeclareVectorOutputPort(
                name,
                port.size(),
                partial(self._calc_output, formulas[name]),
                {tickets[source] for source in formulas[name].sources},
            )

    def DoCalcTimeDerivatives(self, context: Context, derivatives: ContinuousState) -> None:
        if context.num_continuous_states():
            derivatives.get_mutable_vector().SetFromVector(self._evaluate(self._rate, context))

    def _calc_output(self, formula: Formula, context: Context, output: Any) -> None:
        output.SetFromVector(self._evaluate(formula, context))

    def _source(self, name: str, context: Context) -> Any:
        match name:
            case "time":
                return np.array([context.get_time()])
            case "state":
                return context.get_continuous_state_vector().CopyToVector()
            case "parameters":
                return context.get_numeric_parameter(0).CopyToVector()
            case _:
                return self.GetInputPort(name).Eval(context)

    def _evaluate(self, formula: Formula, context: Context) -> Any:
        """The value with its gradient, by the chain rule; an array of AutoDiffXd."""
        given = [self._source(name, context) for name in formula.sources]
        time = context.get_time().value()
        arguments = [ExtractValue(values).reshape(-1) for values in given]
        gradients = [ExtractGradient(values) for values in given]
        value = formula.value(time, *arguments)
        moving = tuple(i for i, gradient in enumerate(gradients) if gradient.size)
        total = np.zeros((value.size, 0))
        if moving:
            slope = formula.slope(moving, time, *arguments)
            total = slope @ np.vstack([gradients[i] for i in moving])
        return InitializeAutoDiff(value, total).reshape(-1)


class ParameterizedSystem(DifferentiableSystem):
    """A LeafSystem whose numeric parameter 0 starts with all parameters of a DaeSystem.

    So a study changes numbers in a context without tracing again, and a controller can be given
    other numbers than its plant.

    Args:
        dae: The system.
        values: The default: `dae.parameter_values`, and what else the system appends.
    """

    def __init__(self, dae: DaeSystem, values: FloatArray) -> None:
        super().__init__()
        self.dae = dae
        self.DeclareNumericParameter(BasicVector(values))

    def parameters(self, context: Context) -> FloatArray:
        """All parameters in the order of `dae.parameters`, shape (k,)."""
        values = context.get_numeric_parameter(0).value()
        return np.array(values[: self.dae.parameter_values.size])

    def get_parameter(self, context: Context, name: str) -> FloatArray:
        """A parameter by name, shape (k,).

        Raises:
            ModelError: No parameter has that name.
        """
        return self.parameters(context)[self.dae.parameter_slice(name)]

    def set_parameter(self, context: Context, name: str, value: ArrayLike) -> None:
        """Changes a parameter in a context.

        Args:
            context: Of this system.
            name: As in `dae.parameters`.
            value: Shape (k,), or a number for all entries.

        Raises:
            ModelError: No parameter has that name, or a value that does not fit.
        """
        values = context.get_numeric_parameter(0).CopyToVector()
        place = self.dae.parameter_slice(name)
        try:
            values[place] = np.asarray(value, dtype=float)
        except ValueError:
            size = place.stop - place.start
            raise ModelError(f"parameter '{name}' has {size} entries, got {value!r}") from None
        for parameter in self.dae.parameters:
            if parameter.name == name:
                parameter.check(values[place])
        context.get_mutable_numeric_parameter(0).SetFromVector(values)
