"""A state with its outputs pinned, and whether its motion is determined."""

from dataclasses import dataclass
from enum import Enum
from functools import cached_property

import numpy as np

from drake_dae.arrays import FloatArray


class Regularity(Enum):
    """Whether the motion is determined at a point; the enum value describes the problem."""

    REGULAR = ""
    MATRIX_NOT_FINITE = "A(x) or B(x) is not finite"
    SINGULAR = "A(x) or B(x) is singular"
    RATE_NOT_FINITE = "x' is not finite"


@dataclass(frozen=True, eq=False)
class PinnedPoint:
    """A state on Z(R) with its rate, inputs and matrices, which may be infinite.

    Attributes:
        state: x, shape (n,).
        rate: x', shape (n,).
        control: u, shape (p,).
        constraint_input: v, shape (m,).
        A, B: The matrices of Assumptions (2) and (5).
        pivot: A number that is 0 exactly where one of them is singular, shape (1,).
        unrest: |E x'| relative to the sizes of its terms, shape (n,).
    """

    state: FloatArray
    rate: FloatArray
    control: FloatArray
    constraint_input: FloatArray
    A: FloatArray
    B: FloatArray
    pivot: FloatArray
    unrest: FloatArray

    @cached_property
    def margins(self) -> tuple[float, float]:
        """The smallest singular values of A and B."""
        return _margin(self.A), _margin(self.B)

    @cached_property
    def signs(self) -> tuple[float, ...]:
        """The signs of det A and det B; a matrix that is not square has none."""
        matrices = (_matrix(value) for value in (self.A, self.B))
        return tuple(_sign(matrix) for matrix in matrices if len(matrix) == matrix.shape[1])


def _matrix(value: FloatArray) -> FloatArray:
    """A matrix of two dimensions; one with one column comes as a vector."""
    return value if value.ndim == 2 else value.reshape(-1, 1)


def _margin(matrix: FloatArray) -> float:
    """The smallest singular value; that of a matrix without columns is infinite."""
    if matrix.size == 1:  # A(x) of one contact; LAPACK takes twenty times as long.
        return abs(matrix.item())
    values = np.linalg.svd(_matrix(matrix), compute_uv=False)
    return float(np.min(values, initial=np.inf))


def _sign(matrix: FloatArray) -> float:
    """The sign of the determinant of a square matrix."""
    if matrix.size == 1:
        return float(np.sign(matrix.item()))
    return float(np.linalg.slogdet(matrix)[0])
