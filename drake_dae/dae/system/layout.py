"""How references and chains are stacked: output by output, lowest derivative first."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from drake_dae.arrays import FloatArray
from drake_dae.dae.system.signals import Signal

Indices = np.typing.NDArray[np.intp]


@dataclass(frozen=True)
class DerivativeLayout:
    """Where the derivatives of p signals stand in the vectors of section 2.

    A chain holds mu_i derivatives of each signal, and a reference one more:

        chain     = (z_1, z_1', ..., z_1^(mu_1 - 1), z_2, ...)    sum mu_i numbers
        reference = (r_1, r_1', ..., r_1^(mu_1),     r_2, ...)    sum (mu_i + 1) numbers

    The constraint chains of (4) are stacked likewise, with r_i in place of mu_i.

    Attributes:
        degrees: mu_1, ..., mu_p, not negative.
    """

    degrees: tuple[int, ...]

    @property
    def chain_size(self) -> int:
        """The size of a chain, sum mu_i."""
        return sum(self.degrees)

    @property
    def reference_size(self) -> int:
        """The size of a reference, sum (mu_i + 1)."""
        return sum(self.degrees) + len(self.degrees)

    @cached_property
    def lowest(self) -> Indices:
        """Where r_1, ..., r_p stand in a reference, shape (p,)."""
        return np.cumsum([0, *[degree + 1 for degree in self.degrees]], dtype=np.intp)[:-1]

    @cached_property
    def highest(self) -> Indices:
        """Where r_1^(mu_1), ..., r_p^(mu_p) stand in a reference, shape (p,)."""
        return self.lowest + np.array(self.degrees, dtype=np.intp)

    @cached_property
    def chained(self) -> Indices:
        """Where a reference holds the goal of each element of a chain, shape (sum mu_i,)."""
        return np.setdiff1d(np.arange(self.reference_size), self.highest)

    @cached_property
    def owners(self) -> Indices:
        """The signal that each element of a chain is a derivative of, shape (sum mu_i,)."""
        return np.repeat(np.arange(len(self.degrees)), self.degrees)

    @cached_property
    def orders(self) -> Indices:
        """The order of the derivative that each element of a chain is, shape (sum mu_i,)."""
        return np.concatenate(
            [np.zeros(0, dtype=np.intp), *[np.arange(degree) for degree in self.degrees]]
        )

    @cached_property
    def starts(self) -> Indices:
        """Where the chain of each signal begins, or would if it had one, shape (p,)."""
        return np.cumsum([0, *self.degrees], dtype=np.intp)[:-1]

    @cached_property
    def heads(self) -> Indices:
        """Where the chains of the signals with mu_i >= 1 begin."""
        return np.flatnonzero(self.orders == 0)

    @cached_property
    def ends(self) -> Indices:
        """Where the chains of the signals with mu_i >= 1 end."""
        dynamic = np.array([degree for degree in self.degrees if degree], dtype=np.intp)
        return self.heads + dynamic - 1

    @cached_property
    def dynamic(self) -> Indices:
        """The signals with mu_i >= 1."""
        return np.flatnonzero(self.degrees)

    @cached_property
    def direct(self) -> Indices:
        """The signals with mu_i = 0, which have no chain."""
        return np.flatnonzero(np.array(self.degrees) == 0)

    def chain_signals(self, signals: Sequence[Signal]) -> tuple[Signal, ...]:
        """Names and units of a chain's elements."""
        return _derivatives(signals, self.degrees)

    def reference_signals(self, signals: Sequence[Signal]) -> tuple[Signal, ...]:
        """Names and units of a reference's elements."""
        return _derivatives(signals, [degree + 1 for degree in self.degrees])

    def values(self, reference: ArrayLike) -> FloatArray:
        """The values r_1, ..., r_p of a reference, shape (p,)."""
        return np.asarray(reference, dtype=float).reshape(-1)[self.lowest]

    def constant(self, values: ArrayLike) -> FloatArray:
        """The reference that stays at given values of shape (p,)."""
        reference = np.zeros(self.reference_size)
        reference[self.lowest] = values
        return reference


def _derivatives(signals: Sequence[Signal], counts: Sequence[int]) -> tuple[Signal, ...]:
    """The first derivatives of signals, the signals included, as many as counted."""
    return tuple(
        signal.derivative(order)
        for signal, count in zip(signals, counts, strict=True)
        for order in range(count)
    )
