"""Piecewise polynomials in time."""

from abc import abstractmethod
from bisect import bisect
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import casadi as ca
import numpy as np

from drake_dae.arrays import FloatArray
from drake_dae.dae.references.reference import Reference, check_continuity

UNROLLED = 200
"""The largest number of polynomials that an expression contains one by one; more are looked up in
a table, which runs side by side cannot do."""


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
        inside = ca.fmin(ca.fmax(time, self.breaks[0]), self.breaks[-1])
        chosen = self._selected(time) if count <= UNROLLED else self._looked_up(inside)
        begin, width, factors = chosen[0], chosen[1], ca.SX(rows * size, 1)
        factors[self._places] = chosen[2:]
        monomials = ca.vertcat(*[((inside - begin) / width) ** int(k) for k in self._powers])
        return ca.mtimes(ca.reshape(factors, size, rows).T, monomials)

    def _selected(self, time: ca.SX) -> ca.SX:
        """Returns the row of `_table` at a symbolic time, as the sum of all rows times 0 or 1."""
        passed = [time >= moment for moment in self.breaks[1:-1]]
        chosen = ca.vertcat(1, *passed) - ca.vertcat(*passed, 0)
        return ca.mtimes(ca.DM(self._table.T), chosen)

    def _looked_up(self, inside: ca.SX) -> ca.SX:
        """Returns the row of `_table` at a symbolic time within the breaks."""
        index, begin, row = self._lookups
        found = ca.fmin(ca.floor(index(inside)), len(self._table) - 1)
        # Where round-off has moved a time just before a break past it.
        return row(found - (inside < begin(found)))

    @cached_property
    def _lookups(self) -> tuple[ca.Function, ca.Function, ca.Function]:
        """The piece at a time, with a fraction; the begin and the row of `_table` of a piece."""
        count = len(self._table)
        pieces = np.arange(count + 1.0)
        inside = {"lookup_mode": ["binary"]}
        return (
            ca.interpolant("piece", "linear", [self.breaks], pieces, inside),
            ca.interpolant("begin", "linear", [pieces], self.breaks, {"lookup_mode": ["exact"]}),
            ca.interpolant(
                "row", "linear", [pieces[:-1]], self._table.ravel(), {"lookup_mode": ["exact"]}
            ),
        )

    @cached_property
    def _table(self) -> FloatArray:
        """The begin of each piece, its width, and its factors that are not zero in all pieces."""
        columns = self.breaks[:-1], np.diff(self.breaks), self._columns[:, self._places]
        return np.column_stack(columns)

    @property
    def _columns(self) -> FloatArray:
        return self.factors.reshape(len(self.factors), -1)

    @cached_property
    def _places(self) -> list[int]:
        """The indices of the factors of a piece that are not zero in all pieces."""
        places: list[int] = np.flatnonzero(self._columns.any(axis=0)).tolist()
        return places

    @property
    def _powers(self) -> FloatArray:
        return np.arange(self.factors.shape[2], dtype=float)


class PiecewiseReference(Reference):
    """A piecewise polynomial reference with `order` continuous derivatives."""

    order: int

    @abstractmethod
    def pieces(self, degrees: Sequence[int]) -> PiecewisePolynomials:
        """Returns the polynomials of r_1, ..., r_1^(mu_1), r_2, ..., for degrees mu <= order."""

    def derivatives(self, degrees: Sequence[int]) -> Callable[[float], FloatArray]:
        self._check(degrees)
        return self.pieces(degrees).at

    def expression(self, degrees: Sequence[int], time: ca.SX) -> ca.SX:
        self._check(degrees)
        return self.pieces(degrees).expression(time)

    def _check(self, degrees: Sequence[int]) -> None:
        check_continuity(self, self.order, degrees)
