"""Damped Newton's method from a guess, used everywhere in the library."""

from collections.abc import Callable
from math import sqrt
from typing import NamedTuple, TypeVar

import numpy as np
import scipy.linalg
from scipy.linalg.lapack import dgeqrf, dorgqr, dpotrs, dtrtrs

from drake_dae.arrays import FloatArray
from drake_dae.trace.round_off import DEPENDENT

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
    measure: Callable[[FloatArray], float] | None = None


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
        step_from, regular, measure = linearization
        step = step_from(x)
        size = length_of(step)
        if size <= ROUNDING:
            return _polished(x, step, step_from), regular
        value = size if measure is None else measure(x)
        for length in LENGTHS:
            trial = x + (step if length == 1.0 else length * step)
            if measure is None:
                following = step_from(trial)
                left = length_of(following)
                if left * left <= PRECISION * size:
                    # The next step would be left / size times as long.
                    return _polished(trial, following, step_from), regular
            else:
                left = measure(trial)
            if left <= (1.0 - 0.25 * length) * value:
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


def _polished(
    state: FloatArray, step: FloatArray, step_from: Callable[[FloatArray], FloatArray]
) -> FloatArray:
    """Returns the state after a step and all following ones, until they are round-off."""
    length = norm(step)
    while length > 0.0:
        state = state + step
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


def steps_along(
    gradients: FloatArray, directions: FloatArray, residual: Callable[[FloatArray], FloatArray]
) -> NewtonModel | None:
    """Returns the Newton model of steps D y, C D y = -residual(x), if y is determined."""
    matrix = gradients @ directions
    size = np.sqrt(np.abs(np.diag(matrix)))
    if not (np.all(np.isfinite(matrix)) and np.all(size > 0.0)):
        return None
    try:
        factors = scipy.linalg.cho_factor(matrix / size / size[:, None])
    except np.linalg.LinAlgError:
        return None
    if np.min(np.diag(factors[0])) <= DEPENDENT:
        return None
    along = directions / size
    return NewtonModel(
        lambda x: -along @ dpotrs(factors[0], residual(x) / size, lower=factors[1])[0], True
    )
