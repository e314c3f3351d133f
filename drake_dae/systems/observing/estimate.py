"""The estimate of a `StateEstimator` at a sample."""

from dataclasses import dataclass
from typing import Self

import casadi as ca


@dataclass(frozen=True, eq=False)
class Estimate:
    """The estimate at a sample, as columns that are stacked.

    Attributes:
        sample: The index k of the sample t_k = k T; -1 before the first, shape (1,).
        state: The estimated x, shape (n,).
        disturbance: r, shape (k,).
        friction: mu, shape (c,).
        force: The constraint force of the model, shape (m,); none if it is measured.
        slides: The `Slides`, shape (7 c,).
    """

    sample: ca.SX
    state: ca.SX
    disturbance: ca.SX
    friction: ca.SX
    force: ca.SX
    slides: ca.SX

    @classmethod
    def of(cls, states: int, frictions: int, forces: int) -> Self:
        """Symbols for given sizes of x, mu and the force."""
        sizes = (1, states, states // 2, frictions, forces, 7 * frictions)
        return cls(*(ca.SX.sym("estimate", size) for size in sizes))

    @property
    def rates(self) -> ca.SX:
        """The derivatives of r: none."""
        return ca.SX(0, 1)

    @property
    def identified(self) -> ca.SX:
        """Other parameters: none."""
        return ca.SX(0, 1)

    @property
    def column(self) -> ca.SX:
        """The whole estimate as one column."""
        return ca.vertcat(*vars(self).values())
