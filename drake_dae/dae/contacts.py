"""Frictional contacts: whether a unique nonnegative force exists.

A contact that can only push keeps phi >= 0 with lambda >= 0 and phi'' lambda = 0, where

    phi'' = A(x) lambda + b(x, u).

Without friction A = J M^-1 J^T is positive definite, and exactly one lambda fits. With friction it
is A = J M^-1 (J^T - mu J_t^T s), not symmetric; one lambda fits for every b exactly where all
principal minors of A are positive (a P-matrix: Samelson, Thrall and Wesler 1958). A minor that
reaches zero is the Painleve paradox (1895).
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from itertools import chain, combinations

import casadi as ca
import numpy as np

from drake_dae.arrays import FloatArray
from drake_dae.dae.signals import Parameter, Signal
from drake_dae.errors import ModelError

MOST = 8  # The largest number of unilateral forces with friction: every subset of them is examined.


@dataclass(frozen=True)
class UnilateralInput:
    """A constraint input that must not be negative: a contact force that can only push."""

    force: str
    friction: str | None = None
    sliding: ca.SX | None = field(default=None, repr=False, compare=False)


class Contacts:
    """The unilateral contacts of a system in which at least one contact has friction."""

    def __init__(
        self,
        owner: str,
        inputs: Sequence[Signal],
        parameters: Sequence[Parameter],
        contacts: Sequence[UnilateralInput],
    ) -> None:
        names = [signal.name for signal in inputs]
        by_name = {parameter.name: parameter for parameter in parameters}
        chosen = [contact for contact in contacts if contact.force in names]
        self.rows = [names.index(contact.force) for contact in chosen]
        self.frictions = [by_name[c.friction] if c.friction else None for c in chosen]
        if len(self.rows) > MOST:
            raise ModelError(
                f"{owner}: with friction at most {MOST} unilateral forces are possible, got "
                f"{len(self.rows)}. Remove the friction, or some contacts"
            )

    def __bool__(self) -> bool:
        return any(self.frictions)

    def without_friction(self, matrix: ca.SX) -> ca.SX:
        """Returns an expression with all coefficients of friction set to zero."""
        if not self:
            return matrix
        # Contacts may share a coefficient.
        symbols = ca.vertcat(*{p.name: p.symbol for p in self.frictions if p}.values())
        return ca.substitute(matrix, symbols, ca.SX.zeros(symbols.numel()))

    def reserve(self, matrix: ca.SX) -> ca.SX:
        """Returns the smallest principal minor of A(x), relative to its value without friction."""
        smallest = ca.SX(1)
        others = [i for i in range(matrix.shape[0]) if i not in self.rows]
        both = [matrix, self.without_friction(matrix)]
        for i in others:  # These constraints have no friction, so their pivots are positive.
            both = [_eliminated(part, i) for part in both]
        for minor, without in zip(*(_minors(part, self.rows) for part in both), strict=True):
            smallest = ca.fmin(smallest, minor / without)
        return smallest


def _eliminated(matrix: ca.SX, i: int) -> ca.SX:
    """The Schur complement of entry (i, i), in the shape of the matrix."""
    return matrix - ca.mtimes(matrix[:, i], matrix[i, :]) / matrix[i, i]


def _minors(matrix: ca.SX, rows: Sequence[int], before: ca.SX | float = 1.0) -> Iterator[ca.SX]:
    """All principal minors of some rows, one for each set of them."""
    if rows:
        first, *others = rows
        with_first = before * matrix[first, first]
        yield with_first
        yield from _minors(matrix, others, before)
        if others:
            yield from _minors(_eliminated(matrix, first), others, with_first)


def critical_factor(without: FloatArray, per_unit: FloatArray, rows: Sequence[int]) -> float:
    """Returns the smallest s > 0 at which a principal minor of A_0 - s D is zero; else infinity."""
    largest, always = 0.0, [i for i in range(len(without)) if i not in rows]
    for chosen in chain.from_iterable(combinations(rows, n + 1) for n in range(len(rows))):
        part = np.ix_([*always, *chosen], [*always, *chosen])
        values = np.linalg.eigvals(np.linalg.solve(without[part], per_unit[part]))
        real = values.real[np.abs(values.imag) <= 1e-9 * np.abs(values).max(initial=0.0)]
        largest = max(largest, float(real.max(initial=0.0)))
    return 1.0 / largest if largest > 0.0 else np.inf
