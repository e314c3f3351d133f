"""A law as the value of a port, with which a plant computes its control itself."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, Self

import casadi as ca
from pydrake.common.value import AbstractValue

from drake_dae.arrays import FloatArray
from drake_dae.dae.system.signals import Signal
from drake_dae.errors import SimulationError
from drake_dae.systems.blocks.failures import simulation_error
from drake_dae.trace.compiled import Compiled
from drake_dae.trace.functions import TracedFunction


class Immutable:
    """The value of an abstract port that never changes, so that contexts may share it."""

    def __deepcopy__(self, memo: dict[int, Any]) -> Self:
        return self


def nothing() -> AbstractValue:
    """The value of such a port before it is computed."""
    return AbstractValue.Make(Immutable())


class Feedback(Immutable):
    """A law with its references and parameters: the control as a function of time and state.

    Attributes:
        function: The law of state, reference and parameters; its first output is the control.
        reference: R as a function of the time in s.
        parameters: The parameters of the law; the array must not be changed.

    Args:
        function, reference, parameters: The attributes.
        signals: Name of an input of the law -> names of its entries, for messages.
    """

    def __init__(
        self,
        function: TracedFunction,
        reference: Callable[[float], FloatArray],
        parameters: FloatArray,
        signals: Mapping[str, Sequence[Signal]],
    ) -> None:
        self.function, self.reference = function, reference
        self.parameters, self._signals = parameters, signals

    def control(self, time: float, state: FloatArray) -> FloatArray | None:
        """u, shape (p,), overwritten by the next call; None without a value.

        Args:
            time: The time, in s.
            state: x, shape (n,).

        Raises:
            NonFiniteError: The reference is not finite.
        """
        control, *_ = self.function.evaluate(state, self.reference(time), self.parameters)
        return control if self.function.is_valid else None

    def motion(
        self, function: TracedFunction, parameters: FloatArray
    ) -> Callable[[float, FloatArray], FloatArray | None]:
        """x' as a function of time and state, overwritten by the next call; None without a value.

        Args:
            function: Law and plant, by `motion_under`.
            parameters: The parameters of the plant; an array of this motion alone, which must not
                be changed.
        """
        reference, of_this_law = self.reference, self.parameters

        def motion(time: float, state: FloatArray) -> FloatArray | None:
            rate = function.evaluate(state, reference(time), of_this_law, parameters)[1]
            return rate if function.is_valid else None

        return motion

    def error(self, time: float, state: FloatArray) -> SimulationError:
        """The error of the last call, at its time and state."""
        return simulation_error(self.function.failure(), time, state, self._signals)


def motion_under(
    law: TracedFunction, dynamics: TracedFunction, compiled: Compiled
) -> TracedFunction:
    """Law and plant as one function, with their common subexpressions computed once.

    Args:
        law: The law, of state, reference and its parameters.
        dynamics: x', of state, control and the plant's parameters.
        compiled: Whether it becomes machine code.

    Returns:
        A function of "state", "reference", and the parameters of "law" and "plant"; it returns the
        control, x', and a number that is finite if both are valid.
    """
    names = ("state", "reference", "law", "plant")
    sizes = (*law.sizes, dynamics.sizes[-1])
    inputs = {name: ca.SX.sym(name, size) for name, size in zip(names, sizes, strict=True)}
    state, reference, of_law, of_plant = inputs.values()
    control, *_, law_holds = law.function(state, reference, of_law)
    rate, *_, plant_holds = dynamics.function(state, control, of_plant)
    outputs = {"control": control, "rate": rate, "valid": law_holds + plant_holds}
    return TracedFunction("motion under the law", inputs, outputs, compiled=compiled)
