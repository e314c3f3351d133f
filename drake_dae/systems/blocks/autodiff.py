"""A block on AutoDiffXd.

Drake's Linearize, FirstOrderTaylorApproximation, DirectCollocation and DirectTranscription convert
a system to AutoDiffXd and read gradients. A converted block evaluates the same traced functions,
and multiplies their traced Jacobians with the gradients of its inputs, state and parameters.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from pydrake.autodiffutils import AutoDiffXd, ExtractGradient, ExtractValue, InitializeAutoDiff
from pydrake.systems.framework import (
    BasicVector_,
    Context,
    ContinuousState,
    LeafSystem,
    LeafSystem_,
)

from drake_dae.blocks.lifetime import SHARED_DICTIONARY, weakly
from drake_dae.errors import ModelError
from drake_dae.systems.blocks.formulas import Formula


class AutoDiffSystem(LeafSystem_[AutoDiffXd]):
    """A block on AutoDiffXd, with the same ports, state and parameters.

    Args:
        original: The block.
        formulas: Name of an output port -> its formula; "derivative" -> that of the time
            derivative.
        places: The indices of parameters that come from an input port `exogenous`.
    """

    __slots__ = SHARED_DICTIONARY

    def __init__(
        self,
        original: LeafSystem,
        formulas: Mapping[str, Formula],
        places: Sequence[int] = (),
    ) -> None:
        super().__init__()
        self.set_name(original.get_name())
        context = original.CreateDefaultContext()
        for i in range(context.num_numeric_parameter_groups()):
            values = context.get_numeric_parameter(i).CopyToVector()
            self.DeclareNumericParameter(BasicVector_[AutoDiffXd](values))
        if context.num_continuous_states():
            state = context.get_continuous_state_vector().CopyToVector()
            self.DeclareContinuousState(BasicVector_[AutoDiffXd](state))
            self._rate = formulas["derivative"]
        self._places = list(places)
        tickets = {
            "time": {self.time_ticket()},
            "state": {self.xc_ticket()},
            "parameters": {self.all_parameters_ticket()},
        }
        for i in range(original.num_input_ports()):
            port = original.get_input_port(i)
            name = port.get_name()
            self.DeclareVectorInputPort(name, port.size())
            tickets[name] = {self.input_port_ticket(port.get_index())}
        for i in range(original.num_output_ports()):
            port = original.get_output_port(i)
            name = port.get_name()
            if name not in formulas:
                raise ModelError(
                    f"{original.get_name()} does not convert to AutoDiffXd: its output port "
                    f"'{name}' has no formula; add it to _formulas()"
                )
            self.DeclareVectorOutputPort(
                name,
                port.size(),
                weakly(self._calc_output, formulas[name]),
                set().union(*(tickets[s] for s in _read(formulas[name].sources, self._places))),
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
        """The value with its gradient, an array of AutoDiffXd."""
        arguments = [self._source(name, context) for name in formula.sources]
        return _chained(formula, context.get_time(), arguments)


def _chained(formula: Formula, time: AutoDiffXd, arguments: Sequence[Any]) -> Any:
    """A formula's value with its gradient, by the chain rule; an array of AutoDiffXd.

    Args:
        formula: The formula.
        time: The time, in s.
        arguments: Its arguments, arrays of AutoDiffXd.
    """
    values = [ExtractValue(argument).reshape(-1) for argument in arguments]
    gradients = [ExtractGradient(argument) for argument in arguments]
    value = formula.value(time.value(), *values)
    moving = tuple(i for i, gradient in enumerate(gradients) if gradient.size)
    total = np.zeros((value.size, 0))
    if moving:
        slope = formula.slope(moving, time.value(), *values)
        total = slope @ np.vstack([gradients[i] for i in moving])
    return InitializeAutoDiff(value, total).reshape(-1)


def _read(sources: Sequence[str], places: Sequence[int]) -> set[str]:
    """The sources of a formula, and the port of exogenous parameters if it takes them."""
    return {*sources, *(["exogenous"] if places and "parameters" in sources else [])}
