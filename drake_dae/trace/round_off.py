"""What counts as zero, as dependent and as singular, where numbers have round-off: one rule.

Rows and columns are scaled, since their units are arbitrary; before that, what is round-off
relative to the whole matrix is zero, since scaled to length one it would count as any other row.
Products are compared with the sizes of their terms, before these cancel.
"""

import numpy as np

from drake_dae.arrays import FloatArray

ZERO = 1e-9  # A sum of products below this, relative to the sizes of its terms, is zero.
VISIBLE = 1e-6  # One above this is not round-off, whatever the parameters are.
MANY = 10  # A function that is only round-off at this many random states is zero.
# A factor below this, relative to the other factors in its row or column, is zero.
NEGLIGIBLE = 1e-11
# An entry or row below this, relative to the largest of its whole matrix, is round-off.
FLOOR = 1e-14
DEPENDENT = 1e-9  # Rows of length one with a smallest singular value below this are dependent.
# A matrix with a singular value below this, its rows and columns scaled, is singular.
SINGULAR = 1e-6
# A matrix without its round-off, and the sizes of its entries before cancellation.
Sized = tuple[FloatArray, FloatArray]


def multiply(left: FloatArray, right: Sized, scale: FloatArray) -> Sized:
    """Multiplies matrices; entries that are only round-off are set to zero."""
    value, size = right
    row, column = np.abs(left) * scale, size / scale[:, None]
    row_noise = NEGLIGIBLE * np.max(row, axis=1, keepdims=True, initial=0.0)
    column_noise = NEGLIGIBLE * np.max(column, axis=0, keepdims=True, initial=0.0)
    left = np.where(row > row_noise, left, 0.0)
    significant = np.abs(value) / scale[:, None] > column_noise
    value, size = np.where(significant, value, 0.0), np.where(column > column_noise, size, 0.0)
    return without_round_off(left @ value, np.abs(left) @ size)


def without_round_off(value: FloatArray, size: FloatArray) -> Sized:
    """Sets those entries of a sum of products to zero that are only round-off."""
    return np.where(np.abs(value) > ZERO * size, value, 0.0), size


def positive(sizes: FloatArray) -> FloatArray:
    """Returns sizes as divisors: 1 in place of 0."""
    return np.where(sizes > 0.0, sizes, 1.0)


def unit_rows(matrix: FloatArray) -> FloatArray:
    """Scales the rows of a matrix to length one; rows of zeros do not change."""
    return matrix / positive(np.linalg.norm(matrix, axis=-1, keepdims=True))


def significant(matrix: FloatArray) -> FloatArray:
    """Returns a matrix in which entries below FLOOR, relative to its largest, are zero."""
    sizes = np.abs(matrix)
    return np.where(sizes > FLOOR * np.max(sizes, initial=0.0), matrix, 0.0)


def row_lengths(matrix: FloatArray) -> FloatArray:
    """Returns the lengths of rows; one that is round-off of the whole counts as the longest."""
    length = np.linalg.norm(matrix, axis=1)
    largest = float(np.max(length, initial=0.0))
    return positive(np.where(length > FLOOR * largest, length, largest))


def rank_of(matrix: FloatArray) -> int:
    """Returns the rank of a matrix, its rows and columns scaled, above its round-off."""
    return int(np.linalg.matrix_rank(equilibrated(matrix), DEPENDENT)) if matrix.size else 0


def are_dependent(gradients: FloatArray) -> bool:
    """Whether rows, whose lengths do not matter, are linearly dependent, or not finite."""
    if not np.all(np.isfinite(gradients)):
        return True
    # By their largest entries first: their squares may be too large for a number.
    gradients = significant(gradients)
    largest = np.abs(gradients).max(axis=1, keepdims=True, initial=0.0)
    rows = unit_rows(gradients / positive(largest))
    if rows.shape[0] > rows.shape[1] or not rows.any(axis=1).all():
        return True
    return smallest_singular_value(rows) < DEPENDENT


def smallest_singular_value(matrix: FloatArray) -> float:
    """Returns the smallest singular value of a matrix with no more rows than columns."""
    return float(np.linalg.svd(matrix, compute_uv=False)[-1])


def equilibrated(matrix: FloatArray) -> FloatArray:
    """Divides the rows and columns of a matrix, without its round-off, by `equilibration`."""
    matrix = significant(matrix)
    rows, columns = equilibration(matrix)
    return matrix / rows[:, None] / columns


def equilibration(matrix: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Returns divisors of rows and columns that scale all to about length one (Ruiz)."""
    rows, columns = np.ones(matrix.shape[0]), np.ones(matrix.shape[1])
    for _ in range(10):
        scaled = matrix / rows[:, None] / columns
        for divisor, axis in ((rows, 1), (columns, 0)):
            length = np.linalg.norm(scaled, axis=axis)
            divisor *= np.sqrt(np.where(length > 0.0, length, 1.0))
    return rows, columns
