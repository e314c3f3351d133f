"""Margins: how far a matrix of the state is from losing its rank, and friction from the paradox."""

from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cached_property, partial

import casadi as ca
import numpy as np

from drake_dae.arrays import Booleans, FloatArray
from drake_dae.dae.contacts import critical_factor
from drake_dae.dae.samples import ConsistentRegion, Samples
from drake_dae.dae.system import DaeSystem
from drake_dae.errors import InconsistentStateError
from drake_dae.trace.functions import TracedFunction
from drake_dae.trace.round_off import SINGULAR, equilibration, smallest_singular_value

MEANINGLESS = 1e6
"""Critical coefficients above this are meaningless: they occur where sliding is only round-off."""

CLOSER = (0.9, 0.99)
"""The fractions of the lowest critical friction so far for which a paradoxical state is sought."""


@dataclass(frozen=True)
class RankMargin:
    """The distance of a matrix from losing its rank.

    Attributes:
        singular_value: The smallest singular value at the examined states.
        relative: The same of the matrix with rows and columns scaled to about length one.
        state: The state where `relative` is, shape (n,).
        matrix: The matrix there.
        vanishing_row: The row that vanishes there, if one does.
        least: The value of `relative` below which the matrix counts as singular.
    """

    singular_value: float
    relative: float
    state: FloatArray
    matrix: FloatArray = field(compare=False, repr=False)
    vanishing_row: int | None = None
    least: float = SINGULAR

    @property
    def is_singular(self) -> bool:
        return self.relative < self.least


def find_margin(
    samples: Samples, matrix: ca.SX, round_off: Booleans | None = None, search: bool = False
) -> RankMargin:
    """Finds the smallest singular values of a matrix at sampled states and between them.

    If the determinant of a square matrix changes its sign on the way from the first state, it is
    zero on that way, unless N* is not connected or the determinant is infinite.
    """
    scaled = _ScaledMatrix(samples, matrix, round_off)
    candidates = list(samples.states)
    if matrix.is_square():
        crossings = (_crossing(samples, scaled, there) for there in samples.states[1:])
        candidates += [state for state in crossings if state is not None]
    distances = [scaled.distance(state) for state in candidates]
    if search:
        box = samples.surroundings()
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
    scaled, least = _ScaledMatrix(samples, matrix, round_off), samples.system.least_margin
    return all(scaled.distance(state) >= least for state in samples.states)


def _crossing(samples: Samples, matrix: "_ScaledMatrix", there: FloatArray) -> FloatArray | None:
    """A state where the determinant changes its sign on the way from the first state."""
    here = samples.states[0]
    start = matrix.sign(here)
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

    def __init__(self, samples: Samples, matrix: ca.SX, round_off: Booleans | None) -> None:
        self._system, whole = samples.system, ca.SX(matrix)
        for i, j in np.argwhere(round_off) if round_off is not None else ():
            whole[int(i), int(j)] = 0.0
        self._matrix = matrix = ca.sparsify(whole)
        self._function = samples.system.trace("margin", {"matrix": matrix}, often=False)
        sizes = np.mean([np.abs(value) for (value,) in samples.values(matrix=matrix)], axis=0)
        self._rows, self._columns = equilibration(sizes)

    def plain(self, state: FloatArray) -> FloatArray:
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


@dataclass(frozen=True, eq=False)
class ContactMargin:
    """The distance of frictional contacts from the Painleve paradox, over some states.

    Attributes:
        reserve: The smallest principal minor of A(x), relative to its value without friction.
        critical_friction: Name of a coefficient -> the lowest value with the paradox.
        state: The state where, shape (n,).
        time: The time in s, along a motion.
    """

    reserve: float
    critical_friction: dict[str, float]
    state: FloatArray
    time: float | None = None

    @property
    def is_paradoxical(self) -> bool:
        """Whether the Painleve paradox occurs with the present friction."""
        return not self.reserve > 0.0

    @property
    def lowest(self) -> float:
        """The lowest critical coefficient of friction."""
        return max(self.critical_friction.values())


class ContactMargins:
    """Computes the contact margins of a system at states."""

    def __init__(self, system: DaeSystem, matrix: ca.SX) -> None:
        self._system, self._contacts = system, system.frictional_contacts
        self._names = [p.name for p in self._contacts.frictions if p is not None]
        self._places = [system.parameter_slice(name).start for name in self._names]
        reserve = self._contacts.reserve(matrix)
        outputs = {"matrix": ca.densify(matrix), "reserve": reserve}
        self._values = system.trace("contact margin", outputs, often=False)
        slope = {"reserve": reserve, "gradient": ca.gradient(reserve, system.state)}
        self._slope = system.trace("slope of a contact margin", slope, often=False)

    def at(
        self, state: FloatArray, parameters: FloatArray, time: float | None = None
    ) -> ContactMargin:
        """Returns the margin at one state, for values of all parameters."""
        unit, size = self._direction(parameters), len(self._system.constraint_input_signals)
        reserve = self._values(state, parameters)[1]
        A_0, A_1 = (
            self._values(state, self._with_friction(parameters, s * unit))[0].reshape(size, size)
            for s in (0.0, 1.0)
        )
        factor = critical_factor(A_0, A_0 - A_1, self._contacts.rows)
        if factor * unit.max() > MEANINGLESS:
            factor = np.inf
        critical = dict(zip(self._names, (factor * unit).tolist(), strict=True))
        return ContactMargin(float(reserve.item()), critical, state, time)

    def over(self, samples: Samples, search: bool) -> ContactMargin:
        """Returns the smallest margin at samples and, downhill from the worst, between them."""
        p = self._system.parameter_values
        margins = sorted((self.at(state, p) for state in samples.states), key=_lowest)
        if search:
            box = samples.surroundings()
            margins += [m for start in margins[:3] for m in self._downhill(box, start, p)]
        return min(margins, key=_lowest)

    def along(self, times: FloatArray, states: FloatArray, parameters: FloatArray) -> ContactMargin:
        """Returns the smallest margin along a motion of at least one state."""
        rows = zip(states, parameters, times.tolist(), strict=True)
        return min((self.at(*row) for row in rows), key=_lowest)

    def _downhill(
        self, box: ConsistentRegion, start: ContactMargin, parameters: FloatArray
    ) -> Iterator[ContactMargin]:
        """States in the Painleve paradox with decreasing friction."""
        unit, best = self._direction(parameters), start
        for part in CLOSER:
            for _ in range(20):
                size = part * best.lowest if np.isfinite(best.lowest) else 1e3
                values = self._with_friction(parameters, size * unit / max(unit))
                lower = self.at(box.descend(partial(self._reserve, values), best.state), parameters)
                if not lower.lowest < best.lowest:
                    break
                best = lower
                yield best

    def _reserve(self, parameters: FloatArray, state: FloatArray) -> tuple[float, FloatArray]:
        """The margin as far as it is positive, and its gradient."""
        margin, gradient = self._slope(state, parameters)
        if not self._slope.is_finite:
            return np.inf, np.zeros(state.size)
        return max(float(margin.item()), 0.0), gradient

    def _direction(self, parameters: FloatArray) -> FloatArray:
        """The coefficients of friction, or ones if all are zero."""
        friction = parameters[self._places]
        return friction if np.any(friction) else np.ones(len(self._places))

    def _with_friction(self, parameters: FloatArray, friction: FloatArray) -> FloatArray:
        values = parameters.copy()
        values[self._places] = friction
        return values


def _lowest(margin: ContactMargin) -> float:
    return margin.lowest
