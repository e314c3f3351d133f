"""What our LeafSystems share: parameters, checked functions, and conversion to AutoDiffXd.

Drake's Linearize, FirstOrderTaylorApproximation, DirectCollocation and DirectTranscription convert
a system to AutoDiffXd and read gradients. CasADi has the derivatives already: a converted block
evaluates the same traced functions as before, and multiplies their traced Jacobians with the
gradients of its inputs, state and parameters.
"""

from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike
from pydrake.autodiffutils import AutoDiffXd, ExtractGradient, ExtractValue, InitializeAutoDiff
from pydrake.systems.framework import (
    BasicVector,
    BasicVector_,
    Context,
    ContinuousState,
    DependencyTicket,
    InputPort,
    LeafSystem,
    LeafSystem_,
    SystemScalarConverter,
)

from drake_dae.arguments import checked
from drake_dae.arrays import FloatArray, numbers
from drake_dae.dae.layout import Layout
from drake_dae.dae.signals import Signal
from drake_dae.dae.system import DaeSystem
from drake_dae.errors import ModelError
from drake_dae.systems.failures import simulation_error
from drake_dae.systems.lifetime import SHARED_DICTIONARY, weakly
from drake_dae.systems.trials import StepWatch
from drake_dae.trace.functions import TracedFunction

STATES = ("state", "estimated_state")
"""The names of the argument of a formula that says where the system is."""


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
        function: The function.
        output: Which of its outputs.
        sources: Where its arguments come from, as in `Formula`; their own names if None.
        signals: Name of an argument -> names of its entries, for messages.
    """

    def __init__(
        self,
        function: TracedFunction,
        output: str = "value",
        sources: Sequence[str] | None = None,
        signals: Mapping[str, Sequence[Signal]] | None = None,
    ) -> None:
        self.sources = tuple(function.input_names if sources is None else sources)
        self._function = function
        self._signals = signals or {}
        self._output = function.output_names.index(output)
        places = [i for i, source in enumerate(self.sources) if source in STATES]
        self._state = places[0] if places else 0
        self._slopes: dict[tuple[int, ...], TracedFunction] = {}

    def value(self, time: float, *arguments: FloatArray) -> FloatArray:
        return self._checked(self._function, time, arguments)[self._output].copy()

    def slope(self, moving: tuple[int, ...], time: float, *arguments: FloatArray) -> FloatArray:
        if moving not in self._slopes:
            self._slopes[moving] = self._function.derivative(self._output, moving)
        (slope,) = self._checked(self._slopes[moving], time, arguments)
        return slope.reshape(-1, sum(self._function.sizes[i] for i in moving))

    def _checked(
        self, function: TracedFunction, time: float, arguments: tuple[FloatArray, ...]
    ) -> tuple[FloatArray, ...]:
        values = function.evaluate(*arguments)
        if not function.is_valid:
            state = arguments[self._state]
            raise simulation_error(function.failure(), time, state, self._signals)
        return values


@checked(ModelError)
class DifferentiableSystem(LeafSystem):
    """A LeafSystem with vector ports that converts to AutoDiffXd, alone or in a diagram.

    The converted system has the same ports, continuous state and numeric parameters, and exact
    gradients. It has no events: a converted plant does not project its state onto N*, nor does it
    refuse a start that is off N*.

    """

    __slots__ = SHARED_DICTIONARY

    def __init__(self) -> None:
        converter = SystemScalarConverter()
        converter._AddConstructor[AutoDiffXd, float](_AutoDiffSystem)
        super().__init__(converter)

    @cached_property
    def formulas(self) -> dict[str, Formula]:
        """Name of an output port -> what it computes; "derivative" -> the time derivative.

        Raises:
            ModelError: The system does not convert to AutoDiffXd.
        """
        return self._formulas()

    def _formulas(self) -> dict[str, Formula]:
        raise NotImplementedError

    def check_context(self, context: Context) -> None:
        """Refuses the context of another system.

        Raises:
            ModelError: It is none of this system.
        """
        try:
            self.ValidateContext(context)
        except RuntimeError:
            raise ModelError(
                f"the context is not that of '{self.get_name()}'; of a diagram's context take "
                "system.GetMyMutableContextFromRoot(context)"
            ) from None

    def ToAutoDiffXd(self) -> LeafSystem_[AutoDiffXd]:
        """The converted system. Drake's own method would wrap it and rename its ports.

        Raises:
            ModelError: The system does not convert to AutoDiffXd.
        """
        return _AutoDiffSystem(self)


@checked(ModelError)
class ParameterizedSystem(DifferentiableSystem):
    """A LeafSystem whose numeric parameter 0 begins with all parameters of a DaeSystem.

    So a study changes numbers in a context without tracing again, and a controller can be given
    other numbers than its plant. Those parameters that move, the exogenous signals w, come through
    an input port `exogenous` with the derivatives that the block needs, stacked as references are:
    w_1, w_1', ..., w_2, ...; `exogenous_layout` tells how many. Without a wire they stand still at
    their parameters' values.

    Attributes:
        exogenous_layout: How the port's entries are stacked.
        exogenous_places: Where they stand among the parameters.

    Args:
        dae: The system.
        values: The default: `dae.parameter_values`, and what else the block appends.
        signals: Name of an input of the block's functions -> names of its entries, for messages.
    """

    __slots__ = SHARED_DICTIONARY

    def __init__(
        self, dae: DaeSystem, values: FloatArray, signals: Mapping[str, Sequence[Signal]]
    ) -> None:
        super().__init__()
        self.dae = dae
        self._signals = signals
        self._exogenous: InputPort | None = None
        self.exogenous_layout = Layout(())
        self.exogenous_places: list[int] = []
        self._steps = StepWatch(self)
        self.DeclareNumericParameter(BasicVector(values))

    def _declare_exogenous(self, degrees: Sequence[int]) -> set[DependencyTicket]:
        """Declares the input port of the exogenous signals, if there are any.

        Args:
            degrees: How many derivatives of each entry of w the block's functions need.

        Returns:
            What all parameters depend on.
        """
        tickets = {self.all_parameters_ticket()}
        if degrees:
            self.exogenous_layout = Layout(tuple(degrees))
            self.exogenous_places = self.dae.exogenous_places(degrees)
            size = self.exogenous_layout.reference_size
            self._exogenous = self.DeclareVectorInputPort("exogenous", size)
            tickets.add(self.input_port_ticket(self._exogenous.get_index()))
        return tickets

    def _values(self, context: Context) -> FloatArray:
        """All parameters, those that move as the input port says; not to be changed."""
        values = context.get_numeric_parameter(0).value()
        if self._exogenous is not None and self._exogenous.HasValue(context):
            values = values.copy()
            values[self.exogenous_places] = self._exogenous.Eval(context)
        return values

    def _checked(
        self, function: TracedFunction, context: Context, state: FloatArray, *inputs: FloatArray
    ) -> tuple[FloatArray, ...]:
        """The values of a function of (state, inputs, parameters); nan where a trial fails.

        Raises:
            SingularityError: A matrix in it is singular; the exception has time and state.
            NonFiniteError: A value is not finite, likewise.
        """
        if self._exogenous is None:  # Without a call more, in each evaluation.
            parameters = context.get_numeric_parameter(0).CopyToVector()
        else:
            parameters = self._values(context)
        values = function.evaluate(state, *inputs, parameters)
        if function.is_valid:
            return values
        failure, time = function.failure(), context.get_time()
        self._steps.tolerate(context, simulation_error(failure, time, state, self._signals))
        return function.nowhere()

    def parameters(self, context: Context) -> FloatArray:
        """All parameters in the order of `dae.parameters`, shape (k,)."""
        self.check_context(context)
        values = context.get_numeric_parameter(0).value()
        return np.array(values[: self.dae.parameter_values.size])

    def current_parameters(self, context: Context) -> FloatArray:
        """All parameters as `parameters`, those that move as they are at the context's time."""
        self.check_context(context)
        return np.array(self._values(context)[: self.dae.parameter_values.size])

    def get_parameter(self, context: Context, name: str) -> FloatArray:
        """A parameter by name, shape (k,).

        Raises:
            ModelError: No parameter has that name.
        """
        return self.parameters(context)[self.dae.parameter_slice(name)]

    def set_parameter(self, context: Context, name: str, value: ArrayLike) -> None:
        """Changes a parameter in a context.

        Args:
            context: The context of this system.
            name: The name of the parameter in `dae.parameters`.
            value: The new value, shape (k,), or a number for all entries.

        Raises:
            ModelError: No parameter has that name, or the value does not fit.
        """
        self.check_context(context)
        values = context.get_numeric_parameter(0).CopyToVector()
        place = self.dae.parameter_slice(name)
        given = numbers(f"parameter '{name}'", value)
        size = place.stop - place.start
        if given.shape not in ((), (size,)):
            raise ModelError(f"parameter '{name}' has {size} entries, got {value!r}")
        values[place] = given
        for parameter in self.dae.parameters:
            if parameter.name == name:
                parameter.check(values[place])
        context.get_mutable_numeric_parameter(0).SetFromVector(values)


class _AutoDiffSystem(LeafSystem_[AutoDiffXd]):
    """A DifferentiableSystem on AutoDiffXd."""

    __slots__ = SHARED_DICTIONARY

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
        self._places = getattr(original, "exogenous_places", [])
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
                weakly(self._calc_output, formulas[name]),
                {tickets[source] for source in _read(formulas[name].sources, self._places)},
            )

    def DoCalcTimeDerivatives(self, context: Context, derivatives: ContinuousState) -> None:
        if context.num_continuous_states():
            derivatives.get_mutable_vector().SetFromVector(self._evaluate(self._rate, context))

    def _calc_output(self, formula: Formula, context: Context, output: Any) -> None:
        output.SetFromVector(self._evaluate(formula, context))

    def _source(self, name: str, context: Context) -> Any:
        if name == "time":
            return np.array([context.get_time()])
        if name == "state":
            return context.get_continuous_state_vector().CopyToVector()
        if name == "parameters":
            values = context.get_numeric_parameter(0).CopyToVector()
            if self._places and self.GetInputPort("exogenous").HasValue(context):
                values[self._places] = self.GetInputPort("exogenous").Eval(context)
            return values
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


def _read(sources: Sequence[str], places: Sequence[int]) -> set[str]:
    """What a formula's sources read: where parameters move, they come from a port as well."""
    return {*sources, *(["exogenous"] if places and "parameters" in sources else [])}
