"""Piecewise polynomials in time."""

from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass

import casadi as ca
import numpy as np

from drake_dae.arrays import FloatArray
from drake_dae.references.reference import Reference, check_continuity

UNROLLED = 200
"""The largest number of polynomials that an expression contains one by one; more are looked up in
a table, which runs side by side cannot do."""


@dataclass(frozen=True, eq=False)
class PiecewisePolynomials:
    """Piecewise polynomials in time: factors[i] @ (1, x, x^2, ...) in piece i.

    Here x = (t - breaks[i]) / (breaks[i + 1] - breaks[i]), breaks in s, shape (n + 1,), and factors
    has shape (n, rows, degree + 1). Before and after, the value is constant.
    """

    breaks: FloatArray
    factors: FloatArray

    def at(self, times: FloatArray) -> FloatArray:
        """Returns the values at times in s, shape (len(times), rows)."""
        inside = np.clip(times, self.breaks[0], self.breaks[-1])
        piece = np.searchsorted(self.breaks[1:-1], inside, "right")
        x = (inside - self.breaks[piece]) / np.diff(self.breaks)[piece]
        powers = np.arange(self.factors.shape[2], dtype=float)
        return np.einsum("trp,tp->tr", self.factors[piece], x[:, None] ** powers)

    def expression(self, time: ca.SX) -> ca.SX:
        """Returns the values at a symbolic time, shape (rows, 1)."""
        count, rows, size = self.factors.shape
        # The begin of each piece, its width, and its factors that are not zero in all pieces.
        columns = self.factors.reshape(count, -1)
        places: list[int] = np.flatnonzero(columns.any(axis=0)).tolist()
        table = np.column_stack([self.breaks[:-1], np.diff(self.breaks), columns[:, places]])
        inside = ca.fmin(ca.fmax(time, self.breaks[0]), self.breaks[-1])
        if count <= UNROLLED:
            # The row of this time: the sum of all rows times 0 or 1.
            passed = [time >= moment for moment in self.breaks[1:-1]]
            row = ca.mtimes(ca.DM(table.T), ca.vertcat(1, *passed) - ca.vertcat(*passed, 0))
        else:
            row = self._looked_up(table, inside)
        factors = ca.SX(rows * size, 1)
        factors[places] = row[2:]
        monomials = ca.vertcat(*[((inside - row[0]) / row[1]) ** k for k in range(size)])
        return ca.mtimes(ca.reshape(factors, size, rows).T, monomials)

    def _looked_up(self, table: FloatArray, inside: ca.SX) -> ca.SX:
        """Returns the row of a table at a symbolic time within the breaks."""
        pieces = np.arange(len(table) + 1.0)
        exact = {"lookup_mode": ["exact"]}
        index = ca.interpolant(
            "piece", "linear", [self.breaks], pieces, {"lookup_mode": ["binary"]}
        )
        begin = ca.interpolant("begin", "linear", [pieces], self.breaks, exact)
        row = ca.interpolant("row", "linear", [pieces[:-1]], table.ravel(), exact)
        found = ca.fmin(ca.floor(index(inside)), len(table) - 1)
        # Where round-off has moved a time just before a break past it.
        return row(found - (inside < begin(found)))


class PiecewiseReference(Reference):
    """A piecewise polynomial reference with `order` continuous derivatives."""

    order: int

    @abstractmethod
    def pieces(self, degrees: Sequence[int]) -> PiecewisePolynomials:
        """Returns the polynomials of r_1, ..., r_1^(mu_1), r_2, ..., for degrees mu <= order."""

    def expression(self, degrees: Sequence[int], time: ca.SX) -> ca.SX:
        check_continuity(self, self.order, degrees)
        return self.pieces(degrees).expression(time)
