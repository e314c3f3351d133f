"""Numbers with round-off: what counts as zero, dependent and singular, and Newton's method.

Rows and columns are scaled, since their units are arbitrary; before that, what is round-off
relative to the whole matrix is zero, since scaled to length one it would count as any other row.
Products are compared with the sizes of their terms, before these cancel.
"""

from collections.abc import Callable
from math import sqrt
from typing import NamedTuple, TypeVar

import numpy as np
from scipy.linalg.lapack import dgeqrf, dorgqr, dtrtrs

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
    """Returns the smallest singular value: infinity if there is none, nan if one is not finite."""
    if not np.isfinite(matrix).all():
        return np.nan
    return float(np.min(np.linalg.svd(matrix, compute_uv=False), initial=np.inf))


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


# Damped Newton's method from a guess, used everywhere in the library.

T = TypeVar("T")

# A Newton step below this, relative to the state, is within the round-off of the residual.
ROUND_OFF = 1e-12
# A Newton step below this, relative to the state, that stops decreasing is round-off.
CONVERGED = 1e-8
PRECISION = 1e-16  # The accuracy of a search, relative to the state.
ROUNDING = 1e-15  # After a Newton step below this, relative to the state, the error is round-off.
ITERATIONS = 200  # The largest number of steps; quadratic convergence takes a handful.
LENGTHS = tuple(0.5**k for k in range(30))  # The fractions of a Newton step that are tried.


class NewtonModel(NamedTuple):
    """Equations that are linearized at an iterate."""

    step: Callable[[FloatArray], FloatArray]
    is_regular: bool


@np.errstate(all="ignore")  # Iterates outside the domain are tried and rejected.
def newton(
    start: FloatArray,
    linearize: Callable[[FloatArray], NewtonModel | None],
    iterations: int = ITERATIONS,
) -> tuple[FloatArray, bool]:
    """Solves equations by damped Newton's method.

    A step is shortened until the step after it, by the same matrix, is shorter. This test does not
    depend on the units of the equations (Deuflhard, 2004, section 3.3). Steps are measured relative
    to the start, or to 1 if that is larger. A solution is improved as long as steps decrease.
    """
    x, unit = start, np.maximum(1.0, np.abs(start))

    def length_of(step: FloatArray) -> float:
        return norm(step / unit)

    regular, size = False, np.inf
    for _ in range(iterations):
        linearization = linearize(x)
        if linearization is None:
            return x, False
        step_from, regular = linearization
        step = step_from(x)
        size = length_of(step)
        if size <= ROUNDING:
            return polished(x, step, step_from), regular
        for length in LENGTHS:
            trial = x + (step if length == 1.0 else length * step)
            following = step_from(trial)
            left = length_of(following)
            if left * left <= PRECISION * size:
                # The next step would be left / size times as long.
                return polished(trial, following, step_from), regular
            if left <= (1.0 - 0.25 * length) * size:
                break
        else:
            return x, regular and bool(size <= CONVERGED)
        x = trial
    # Steps within round-off do not decrease either.
    return x, regular and bool(size <= CONVERGED)


def once(function: Callable[[FloatArray], T]) -> Callable[[FloatArray], T]:
    """Returns a function with a memory of its last value, since `newton` calls it repeatedly."""
    last: list[tuple[FloatArray, T]] = []

    def evaluated(x: FloatArray) -> T:
        if not last or x is not last[0][0]:
            last[:] = [(x, function(x))]
        return last[0][1]

    return evaluated


def polished(
    state: FloatArray,
    step: FloatArray,
    step_from: Callable[[FloatArray], FloatArray],
    scale: FloatArray | float = 1.0,
) -> FloatArray:
    """Returns the state after a step and all following ones, over a scale, until round-off."""
    length = norm(step)
    while length > 0.0:
        state = state + scale * step
        step = step_from(state)
        following = norm(step)
        if not following < 0.5 * length:
            break
        length = following
    return state


def norm(vector: FloatArray) -> float:
    """Returns the Euclidean norm, in a fifth of the time of `np.linalg.norm`."""
    return sqrt(vector.dot(vector))


def shortest_steps(
    gradients: FloatArray, residual: Callable[[FloatArray], FloatArray]
) -> NewtonModel | None:
    """Returns the Newton model of shortest steps dx with C dx = -residual(x).

    The rows are scaled to length one. If they are dependent, for example at the start of a search,
    dx is the least-squares solution.
    """
    # Methods of arrays and sums of squares: NumPy's functions of the same name take twice as long.
    if not np.isfinite(gradients).all():
        return None
    if not len(gradients):
        return NewtonModel(np.zeros_like, True)
    length = np.sqrt((gradients * gradients).sum(axis=1))
    length[length == 0.0] = 1.0
    rows = gradients / length[:, None]
    # LAPACK itself: SciPy's functions take several times as long around the same calls. Below the
    # diagonal of R entries are not zero; nothing reads them.
    least = min(rows.shape)
    factors, tau, *_ = dgeqrf(rows.T)
    q, r = dorgqr(factors[:, :least], tau)[0], factors[:least]
    if len(rows) > len(q) or np.abs(r.diagonal()).min(initial=1.0) <= DEPENDENT:
        inverse = np.linalg.pinv(rows, DEPENDENT)
        return NewtonModel(lambda x: -inverse @ (residual(x) / length), False)
    return NewtonModel(lambda x: -q @ dtrtrs(r, residual(x) / length, trans=1)[0], True)
