"""The output ports of a block as functions with derivatives."""

from collections.abc import Mapping, Sequence
from typing import Protocol

from drake_dae.arrays import FloatArray
from drake_dae.blocks.failures import simulation_error
from drake_dae.dae.system.signals import Signal
from drake_dae.trace.functions import TracedFunction

STATES = ("state", "estimated_state")
"""The names of the argument of a formula that is the state."""


class Formula(Protocol):
    """The computation of an output port, or of the time derivative.

    Attributes:
        sources: The source of each argument: "time", "state", "parameters", or the name of an
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
        output: The name of the output.
        sources: The sources of its arguments, as in `Formula`; their own names if None.
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
        if not function.is_regular:
            state = arguments[self._state]
            raise simulation_error(function.failure(), time, state, self._signals)
        return values
