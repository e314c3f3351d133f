"""Exogenous signals w(t), and how they enter time derivatives."""

from collections.abc import Sequence
from dataclasses import dataclass

import casadi as ca

from drake_dae.dae.system.signals import Parameter, Signal
from drake_dae.errors import ModelError


@dataclass(frozen=True, eq=False)
class Exogenous:
    """The exogenous parameters w of a system, with symbols for their time derivatives."""

    owner: str
    parameters: tuple[Parameter, ...]

    @property
    def moving(self) -> tuple[Parameter, ...]:
        """The exogenous parameters."""
        return tuple(p for p in self.parameters if p.exogenous)

    def __bool__(self) -> bool:
        return bool(self.moving)

    @property
    def signals(self) -> tuple[Signal, ...]:
        """Names and units of the entries of w."""
        return tuple(signal for p in self.moving for signal in p.signals)

    def rate(self, expression: ca.SX) -> ca.SX:
        """Returns the part sum_j (d/dw^(j)) w^(j+1) of a time derivative, shape (k, 1)."""
        rate = ca.SX(expression.numel(), 1)
        for p in self.moving:
            levels = (p.symbol, *p.derivatives)
            if ca.depends_on(expression, levels[-1]):
                raise ModelError(
                    f"{self.owner}: more than {len(p.derivatives)} derivatives of '{p.name}' are "
                    "needed"
                )
            rate += ca.jtimes(expression, ca.vertcat(*levels[:-1]), ca.vertcat(*levels[1:]))
        return rate

    def degrees(self, *expressions: ca.SX) -> tuple[int, ...]:
        """Returns the number of derivatives of each entry of w on which expressions depend."""
        every = ca.veccat(*expressions)
        degrees: list[int] = []
        for p in self.moving:
            for i in range(p.value.size):
                orders = [k for k, d in enumerate(p.derivatives, 1) if ca.depends_on(every, d[i])]
                degrees.append(max(orders, default=0))
        return tuple(degrees)

    def rates(self) -> dict[str, slice]:
        """Name of an exogenous parameter -> the place of its derivatives in the parameter vector.

        The entries of the first derivative come first, then those of the second one.
        """
        first, rates = sum(p.value.size for p in self.parameters), dict[str, slice]()
        for p in self.moving:
            rates[p.name] = slice(first, first + p.value.size * len(p.derivatives))
            first = rates[p.name].stop
        return rates

    def places(self, degrees: Sequence[int]) -> list[int]:
        """Returns the indices of w_1, w_1', ..., w_1^(d_1), w_2, ... among the parameters."""
        start, following = 0, sum(p.value.size for p in self.parameters)
        places, remaining = [], iter(degrees)
        for p in self.parameters:
            size = p.value.size
            if p.exogenous:
                for i in range(size):
                    rates = range(next(remaining))
                    places += [start + i, *(following + order * size + i for order in rates)]
                following += size * len(p.derivatives)
            start += size
        return places
