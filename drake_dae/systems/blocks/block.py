"""Base classes of LeafSystems: parameters, checked functions, and conversion to AutoDiffXd."""

from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import ClassVar

import numpy as np
from numpy.typing import ArrayLike
from pydrake.autodiffutils import AutoDiffXd
from pydrake.systems.framework import (
    BasicVector,
    Context,
    DependencyTicket,
    InputPort,
    LeafSystem,
    LeafSystem_,
    OutputPort,
    PortDataType,
    System,
    SystemScalarConverter,
)

from drake_dae.arrays import FloatArray, listed, numbers, vector
from drake_dae.blocks.failures import simulation_error
from drake_dae.blocks.lifetime import SHARED_DICTIONARY
from drake_dae.blocks.trials import StepWatch
from drake_dae.dae.system.layout import DerivativeLayout
from drake_dae.dae.system.signals import Signal
from drake_dae.dae.system.system import DaeSystem
from drake_dae.errors import ModelError, SimulationError
from drake_dae.systems.blocks.autodiff import AutoDiffSystem
from drake_dae.systems.blocks.formulas import Formula
from drake_dae.trace.functions import TracedFunction

NO_TIME_DERIVATIVE = "it samples, and a sample has no derivative by the time"
"""The reason why a sampled block does not convert to AutoDiffXd."""


class DifferentiableSystem(LeafSystem):
    """A LeafSystem with vector ports that converts to AutoDiffXd, alone or in a diagram.

    The converted system has the same ports, continuous state and numeric parameters, and exact
    gradients. It has no events: a converted plant does not project its state onto N*, and accepts
    a start off N*.

    Attributes:
        no_gradient: The reason why it does not convert, for messages; empty if it does.
    """

    __slots__ = SHARED_DICTIONARY
    no_gradient: ClassVar[str] = ""

    def __init__(self) -> None:
        converter = SystemScalarConverter()
        converter._AddConstructor[AutoDiffXd, float](_converted)
        super().__init__(converter)

    def __repr__(self) -> str:
        inputs = [self.get_input_port(i) for i in range(self.num_input_ports())]
        outputs = [self.get_output_port(i) for i in range(self.num_output_ports())]
        ports = [
            f"{kind}={listed([_shown(port) for port in some])}"
            for kind, some in (("inputs", inputs), ("outputs", outputs))
        ]
        return f"{type(self).__name__}('{self.get_name()}', {', '.join(ports)})"

    @cached_property
    def formulas(self) -> dict[str, Formula]:
        """Name of an output port -> its formula; "derivative" -> that of the time derivative.

        Raises:
            ModelError: The system does not convert to AutoDiffXd.
        """
        if self.no_gradient:
            raise ModelError(
                f"{self.get_name()} does not convert to AutoDiffXd: {self.no_gradient}"
            )
        return self._formulas()

    def _formulas(self) -> dict[str, Formula]:
        raise NotImplementedError

    def check_context(self, context: Context) -> None:
        """Refuses the context of another system.

        Raises:
            ModelError: It belongs to another system.
        """
        check_context(self, context)

    def ToAutoDiffXd(self) -> LeafSystem_[AutoDiffXd]:
        """The converted system. Drake's own method would wrap it and rename its ports.

        Raises:
            ModelError: The system does not convert to AutoDiffXd.
        """
        return _converted(self)


class ParameterizedSystem(DifferentiableSystem):
    """A LeafSystem whose numeric parameter 0 begins with all parameters of a DaeSystem.

    So a study changes numbers in a context without tracing again, and a controller can have other
    numbers than its plant. Varying parameters, the exogenous signals w, come through an input port
    `exogenous` with the derivatives that the block needs, stacked like references: w_1, w_1', ...,
    w_2, ...; see `exogenous_layout`. Without a wire they keep the values of the parameters.

    Attributes:
        exogenous_layout: The layout of the port's entries.
        exogenous_places: Their indices among the parameters.

    Args:
        dae: The system.
        values: The defaults: `dae.parameter_values`, followed by further numbers of the block.
        signals: Name of an input of the block's functions -> names of its entries, for messages.
        sees_steps: Whether it distinguishes trial states from accepted ones; see `StepWatch`.
    """

    __slots__ = SHARED_DICTIONARY

    def __init__(
        self,
        dae: DaeSystem,
        values: FloatArray,
        signals: Mapping[str, Sequence[Signal]],
        sees_steps: bool = True,
    ) -> None:
        super().__init__()
        self.dae = dae
        self._signals = signals
        self._exogenous: InputPort | None = None
        self.exogenous_layout = DerivativeLayout(())
        self.exogenous_places: list[int] = []
        self._steps = StepWatch(self, sees_steps)
        self.DeclareNumericParameter(BasicVector(values))

    def _declare_exogenous(self, degrees: Sequence[int]) -> set[DependencyTicket]:
        """Declares the input port of the exogenous signals, if there are any.

        Args:
            degrees: The number of derivatives of each entry of w in the block's functions.

        Returns:
            The dependencies of all parameters.
        """
        tickets = {self.all_parameters_ticket()}
        if degrees:
            self.exogenous_layout = DerivativeLayout(tuple(degrees))
            self.exogenous_places = self.dae.exogenous.places(degrees)
            size = self.exogenous_layout.reference_size
            self._exogenous = self.DeclareVectorInputPort("exogenous", size)
            tickets.add(self.input_port_ticket(self._exogenous.get_index()))
        return tickets

    def _values(self, context: Context) -> FloatArray:
        """All parameters, exogenous ones from the input port; the array must not be changed."""
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
        if self._exogenous is None:  # Called in each evaluation, so without another call.
            parameters = context.get_numeric_parameter(0).value()
        else:
            parameters = self._values(context)
        values = function.evaluate(state, *inputs, parameters)
        if function.is_valid:
            return values
        time, state = context.get_time(), state.copy()
        error = simulation_error(function.failure(), time, state, self._signals)
        self._steps.tolerate(context, self.explained(error, parameters, *inputs))
        return function.nowhere()

    def explained(
        self,
        error: SimulationError,
        parameters: FloatArray,
        *inputs: FloatArray,
    ) -> SimulationError:
        """Returns the error of a function without a value, or a more precise one.

        Args:
            error: The error, with time and state.
            parameters: Values of all parameters.
            inputs: The other inputs of the function, such as the control.
        """
        return error

    def parameters(self, context: Context) -> FloatArray:
        """All parameters in the order of `dae.parameters`, shape (k,)."""
        self.check_context(context)
        values = context.get_numeric_parameter(0).value()
        return np.array(values[: self.dae.parameter_values.size])

    def current_parameters(self, context: Context) -> FloatArray:
        """All parameters as `parameters`, with exogenous ones at the context's time."""
        self.check_context(context)
        return np.array(self._values(context)[: self.dae.parameter_values.size])

    def parameters_along(self, context: Context, times: ArrayLike) -> FloatArray:
        """The parameters of the block's functions at accepted times of a run.

        Exogenous ones have their values in the context; see `exogenous_places`.

        Args:
            context: The context of the run.
            times: The times, in s, shape (k,), increasing.

        Returns:
            One row for each time.
        """
        self.check_context(context)
        return self._steps.parameters_along(context, vector("times", times, None))

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


def check_context(system: System, context: Context) -> None:
    """Refuses the context of another system.

    Raises:
        ModelError: It belongs to another system.
    """
    try:
        system.ValidateContext(context)
    except RuntimeError:
        raise ModelError(
            f"the context is not that of '{system.get_name()}'; of a diagram's context take "
            "system.GetMyMutableContextFromRoot(context)"
        ) from None


def _shown(port: InputPort | OutputPort) -> str:
    """A port with its size, if it has vectors."""
    is_vector = port.get_data_type() == PortDataType.kVectorValued
    return f"{port.get_name()} ({port.size()})" if is_vector else port.get_name()


def _converted(original: DifferentiableSystem) -> AutoDiffSystem:
    """A block on AutoDiffXd."""
    places = original.exogenous_places if isinstance(original, ParameterizedSystem) else []
    return AutoDiffSystem(original, original.formulas, places)
