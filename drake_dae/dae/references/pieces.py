"""Piecewise polynomials in time."""

from abc import abstractmethod
from bisect import bisect
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar

import casadi as ca
import numpy as np

from drake_dae.arguments import checked
from drake_dae.arrays import FloatArray
from drake_dae.dae.references.reference import Reference, check_continuity
from drake_dae.errors import ReferenceSignalError

MOST_IN_EXPRESSION = 200
"""The largest number of polynomials in the expression of most references."""


@dataclass(frozen=True, eq=False)
class PiecewisePolynomials:
    """Piecewise polynomials in time: factors[i] @ (1, x, x^2, ...) in piece i.

    Here x = (t - breaks[i]) / (breaks[i + 1] - breaks[i]); before and after, the value is constant.

    Attributes:
        breaks: The start of each piece and the end of the last one, in s, shape (n + 1,).
        factors: The factors, shape (n, rows, degree + 1).
    """

    breaks: FloatArray
    factors: FloatArray

    @cached_property
    def at(self) -> Callable[[float], FloatArray]:
        """The function that maps a time in s to the values, shape (rows,)."""
        breaks, factors, powers = self.breaks.tolist(), self.factors, self._powers
        first, last = breaks[0], breaks[-1]

        def evaluate(time: float) -> FloatArray:
            piece = bisect(breaks, time, 1, len(factors)) - 1
            x = (min(max(time, first), last) - breaks[piece]) / (breaks[piece + 1] - breaks[piece])
            return factors[piece] @ x**powers

        return evaluate

    def at_all(self, times: FloatArray) -> FloatArray:
        """Returns the values at times in s, shape (len(times), rows)."""
        inside = np.clip(times, self.breaks[0], self.breaks[-1])
        piece = np.searchsorted(self.breaks[1:-1], inside, "right")
        x = (inside - self.breaks[piece]) / np.diff(self.breaks)[piece]
        return np.einsum("trp,tp->tr", self.factors[piece], x[:, None] ** self._powers)

    def expression(self, time: ca.SX) -> ca.SX:
        """Returns the values at a symbolic time, shape (rows, 1)."""
        count, rows, size = self.factors.shape
        passed = [time >= moment for moment in self.breaks[1:-1]]
        chosen = ca.vertcat(1, *passed) - ca.vertcat(*passed, 0)
        inside = ca.fmin(ca.fmax(time, self.breaks[0]), self.breaks[-1])
        begin, width = (
            ca.dot(ca.DM(values), chosen) for values in (self.breaks[:-1], np.diff(self.breaks))
        )
        monomials = ca.vertcat(*[((inside - begin) / width) ** int(k) for k in self._powers])
        table = ca.mtimes(ca.DM(self.factors.reshape(count, -1).T), chosen)
        return ca.mtimes(ca.reshape(table, size, rows).T, monomials)

    @property
    def _powers(self) -> FloatArray:
        return np.arange(self.factors.shape[2], dtype=float)


@checked(ReferenceSignalError)
class PiecewiseReference(Reference):
    """A piecewise polynomial reference with `order` continuous derivatives.

    One with many pieces is a table and not an expression.
    """

    order: int

    most_in_expression: ClassVar[int] = MOST_IN_EXPRESSION
    """The largest number of polynomials in a symbolic expression; longer references are tables."""

    @abstractmethod
    def pieces(self, degrees: Sequence[int]) -> PiecewisePolynomials:
        """Returns the polynomials of r_1, ..., r_1^(mu_1), r_2, ..., for degrees mu <= order."""

    def derivatives(self, degrees: Sequence[int]) -> Callable[[float], FloatArray]:
        self._check(degrees)
        return self.pieces(degrees).at

    def expression(self, degrees: Sequence[int], time: ca.SX) -> ca.SX | None:
        self._check(degrees)
        pieces = self.pieces(degrees)
        return pieces.expression(time) if len(pieces.factors) <= self.most_in_expression else None

    def _check(self, degrees: Sequence[int]) -> None:
        check_continuity(self, self.order, degrees)
