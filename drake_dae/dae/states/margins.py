"""Margins: the distance of a state-dependent matrix from losing its rank."""

from dataclasses import dataclass, field
from functools import cached_property

import casadi as ca
import numpy as np

from drake_dae.arrays import Booleans, FloatArray
from drake_dae.dae.states.region import ConsistentRegion, Region
from drake_dae.dae.states.samples import Samples
from drake_dae.errors import InconsistentStateError
from drake_dae.trace.functions import TracedFunction
from drake_dae.trace.round_off import SINGULAR, equilibration, smallest_singular_value


@dataclass(frozen=True)
class RankMargin:
    """The distance of a matrix from losing its rank."""

    singular_value: float
    relative: float
    state: FloatArray
    matrix: FloatArray = field(compare=False, repr=False)
    vanishing_row: int | None = None
    least: float = SINGULAR

    @property
    def is_singular(self) -> bool:
        """Whether the rank is lost at `state`."""
        return self.relative < self.least


def find_margin(
    samples: Samples, matrix: ca.SX, round_off: Booleans | None = None, search: bool = False
) -> RankMargin:
    """Finds the smallest singular values of a matrix at sampled states and between them.

    If the determinant of a square matrix changes its sign on the way from the first state, it is
    zero on that way, unless N* is not connected or the determinant is infinite.
    """
    scaled = _ScaledMatrix(samples, _masked(matrix, round_off))
    candidates = list(samples.states)
    if matrix.is_square():
        start = scaled.sign(samples.states[0])
        crossings = (_crossing(samples, scaled, start, there) for there in samples.states[1:])
        candidates += [state for state in crossings if state is not None]
    distances = [scaled.distance(state) for state in candidates]
    if search:
        box = ConsistentRegion(samples.manifold, surroundings(samples))
        starts = np.argsort(distances, kind="stable")[:3]
        lowest = [box.descend(scaled.slope, candidates[start]) for start in starts]
        candidates += lowest
        distances += [scaled.distance(state) for state in lowest]
    relative = min(distances)
    state = candidates[distances.index(relative)]
    length = np.linalg.norm(scaled(state), axis=1)
    least = samples.system.least_margin
    return RankMargin(
        singular_value=min(smallest_singular_value(scaled.plain(x)) for x in candidates),
        relative=relative,
        state=state,
        matrix=scaled.plain(state),
        vanishing_row=int(np.argmin(length)) if length.min() < least else None,
        least=least,
    )


def is_regular(samples: Samples, matrix: ca.SX, round_off: Booleans | None = None) -> bool:
    """Returns whether a square matrix is regular at every sampled state."""
    scaled = _ScaledMatrix(samples, _masked(matrix, round_off))
    least = samples.system.least_margin
    return all(scaled.distance(state) >= least for state in samples.states)


def surroundings(samples: Samples) -> Region:
    """Returns the box that the states span, within the region from which they were drawn."""
    low, high = samples.states.min(axis=0), samples.states.max(axis=0)
    region = samples.consistent.region
    if region is not None:
        # States without bounds may lie slightly beyond the random ones.
        more = 0.5 * (high - low)
        low = np.where(np.isfinite(region.low), region.low, low - more)
        high = np.where(np.isfinite(region.high), region.high, high + more)
    return Region(low, high)


def _crossing(
    samples: Samples, matrix: "_ScaledMatrix", start: float, there: FloatArray
) -> FloatArray | None:
    """Returns a state where the determinant changes its sign on the way from the first state."""
    here = samples.states[0]
    if matrix.sign(there) == start:
        return None
    for _ in range(60):
        try:
            middle = samples.manifold.project((here + there) / 2.0)
        except InconsistentStateError:
            return None
        if not np.all(np.isfinite(matrix(middle))):
            return None
        if matrix.sign(middle) == start:
            here = middle
        else:
            there = middle
    return here


class _ScaledMatrix:
    """A matrix of the state, rows and columns scaled to about length one over all samples."""

    def __init__(self, samples: Samples, matrix: ca.SX) -> None:
        self._matrix, self._system = matrix, samples.system
        self._function = samples.system.trace("margin", {"matrix": matrix}, often=False)
        sizes = np.mean([np.abs(value) for (value,) in samples.values(matrix=matrix)], axis=0)
        self._rows, self._columns = equilibration(sizes)

    def plain(self, state: FloatArray) -> FloatArray:
        """The unscaled matrix."""
        value = self._function(state, self._system.parameter_values)[0]
        return value.reshape(self._matrix.shape)

    def __call__(self, state: FloatArray) -> FloatArray:
        return self.plain(state) / self._rows[:, None] / self._columns

    def sign(self, state: FloatArray) -> float:
        """The sign of the determinant."""
        return float(np.linalg.slogdet(self(state))[0])

    def distance(self, state: FloatArray) -> float:
        """The smallest singular value; infinite where the matrix is not finite."""
        value = self(state)
        return smallest_singular_value(value) if np.all(np.isfinite(value)) else np.inf

    def slope(self, state: FloatArray) -> tuple[float, FloatArray]:
        """The smallest singular value s and its gradient d(a' M b)/dx, where M b = s a."""
        value = self(state)
        if not np.all(np.isfinite(value)):
            return np.inf, np.zeros(state.size)
        left, values, right = np.linalg.svd(value, full_matrices=False)
        a, b = left[:, -1] / self._rows, right[-1] / self._columns
        gradient = self._gradient(state, a, b, self._system.parameter_values)[0]
        return float(values[-1]), np.where(np.isfinite(gradient), gradient, 0.0)

    @cached_property
    def _gradient(self) -> TracedFunction:
        rows, columns = self._matrix.shape
        a, b = ca.SX.sym("a", rows), ca.SX.sym("b", columns)
        product = ca.gradient(ca.bilin(self._matrix, a, b), self._system.state)
        outputs, inputs = {"gradient": product}, {"a": a, "b": b}
        return self._system.trace("slope of a margin", outputs, inputs, often=False)


def _masked(matrix: ca.SX, zero: Booleans | None) -> ca.SX:
    result = ca.SX(matrix)
    for i, j in np.argwhere(zero) if zero is not None else ():
        result[int(i), int(j)] = 0.0
    return ca.sparsify(result)
