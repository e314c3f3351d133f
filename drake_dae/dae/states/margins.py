"""How far a matrix of the state is from losing its rank."""

from dataclasses import dataclass

from drake_dae.arrays import FloatArray

SINGULAR = 1e-6
"""A matrix with a singular value below this, its rows and columns scaled, is singular."""


@dataclass(frozen=True)
class Margin:
    """How far a matrix is from losing its rank.

    Attributes:
        singular_value: The smallest singular value over all examined states.
        relative: The same after rows and columns are scaled to about length one, by factors that
            are common to all states, so that units do not matter.
        state: Where `relative` is smallest, shape (n,).
        vanishing_row: The row that is zero there; None if none is.
    """

    singular_value: float
    relative: float
    state: FloatArray
    vanishing_row: int | None = None

    @property
    def is_singular(self) -> bool:
        """Whether the rank is lost at `state`."""
        return self.relative < SINGULAR
