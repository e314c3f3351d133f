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
    """The indices of p signals and their derivatives in the stacked vectors of section 2.

    A chain holds mu_i derivatives of each signal, and a reference one more:

        chain     = (z_1, z_1', ..., z_1^(mu_1 - 1), z_2, ...)    sum mu_i numbers
        reference = (r_1, r_1', ..., r_1^(mu_1),     r_2, ...)    sum (mu_i + 1) numbers

    The constraint chains of (4) are stacked likewise, with r_i in place of mu_i.
    """

    degrees: tuple[int, ...]
    more: tuple[int, ...] = ()

    @property
    def chain_size(self) -> int:
        """The size of a chain, sum mu_i."""
        return sum(self.degrees)

    @cached_property
    def reference_size(self) -> int:
        """The size of a reference, sum (mu_i + 1), and further derivatives."""
        return sum(self.reference_degrees) + len(self.degrees)

    @cached_property
    def reference_degrees(self) -> tuple[int, ...]:
        """The number of derivatives of each r_i in a reference, mu_i without further ones."""
        more = self.more or (0,) * len(self.degrees)
        return tuple(degree + added for degree, added in zip(self.degrees, more, strict=True))

    @cached_property
    def lowest(self) -> Indices:
        """The indices of r_1, ..., r_p in a reference vector, shape (p,)."""
        return np.cumsum([0, *[d + 1 for d in self.reference_degrees]], dtype=np.intp)[:-1]

    @cached_property
    def highest(self) -> Indices:
        """The indices of r_1^(mu_1), ..., r_p^(mu_p) in a reference vector, shape (p,)."""
        return self.lowest + np.array(self.degrees, dtype=np.intp)

    @cached_property
    def chained(self) -> Indices:
        """The index in a reference vector of the target of each chain entry, shape (sum mu_i,)."""
        return np.repeat(self.lowest, self.degrees) + self.orders

    @cached_property
    def owners(self) -> Indices:
        """The index of the signal of each chain entry, shape (sum mu_i,)."""
        return np.repeat(np.arange(len(self.degrees)), self.degrees)

    @cached_property
    def orders(self) -> Indices:
        """The order of the derivative of each chain entry, shape (sum mu_i,)."""
        return np.concatenate(
            [np.zeros(0, dtype=np.intp), *[np.arange(degree) for degree in self.degrees]]
        )

    @cached_property
    def starts(self) -> Indices:
        """The index of the first chain entry of each signal, shape (p,)."""
        return np.cumsum([0, *self.degrees], dtype=np.intp)[:-1]

    @cached_property
    def heads(self) -> Indices:
        """The chain index of the zeroth derivative of each signal with mu_i >= 1."""
        return np.flatnonzero(self.orders == 0)

    @cached_property
    def ends(self) -> Indices:
        """The chain index of the highest derivative of each signal with mu_i >= 1."""
        dynamic = np.array([degree for degree in self.degrees if degree], dtype=np.intp)
        return self.heads + dynamic - 1

    @cached_property
    def dynamic(self) -> Indices:
        """The indices of the signals with mu_i >= 1."""
        return np.flatnonzero(self.degrees)

    @cached_property
    def direct(self) -> Indices:
        """The indices of the signals with mu_i = 0, which have no chain."""
        return np.flatnonzero(np.array(self.degrees) == 0)

    def chain_signals(self, signals: Sequence[Signal]) -> tuple[Signal, ...]:
        """Returns names and units of the entries of a chain."""
        return _derivatives(signals, self.degrees)

    def reference_signals(self, signals: Sequence[Signal]) -> tuple[Signal, ...]:
        """Returns names and units of the entries of a reference vector."""
        return _derivatives(signals, [degree + 1 for degree in self.reference_degrees])

    def values(self, reference: ArrayLike) -> FloatArray:
        """Returns the values r_1, ..., r_p of a reference vector, shape (p,)."""
        return np.asarray(reference, dtype=float).reshape(-1)[self.lowest]

    def constant(self, values: ArrayLike) -> FloatArray:
        """Returns the reference vector of constant values of shape (p,); its derivatives are 0."""
        reference = np.zeros(self.reference_size)
        reference[self.lowest] = values
        return reference


def _derivatives(signals: Sequence[Signal], counts: Sequence[int]) -> tuple[Signal, ...]:
    """Returns each signal with its derivatives; the counts include the signal itself."""
    return tuple(
        signal.derivative(order)
        for signal, count in zip(signals, counts, strict=True)
        for order in range(count)
    )
