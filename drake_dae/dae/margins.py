"""Margins: how far a matrix of the state is from losing its rank, and friction from the paradox."""

from collections.abc import Callable
from dataclasses import dataclass
from operator import attrgetter

import casadi as ca
import numpy as np

from drake_dae.arrays import Booleans, FloatArray
from drake_dae.dae.contacts import critical_factor
from drake_dae.dae.samples import Samples
from drake_dae.dae.system import DaeSystem
from drake_dae.errors import InconsistentStateError
from drake_dae.trace.numerics import equilibration, smallest_singular_value

# Critical coefficients above this are meaningless: they occur where sliding is only round-off.
MEANINGLESS = 1e6
LOWEST = attrgetter("lowest")
# The fractions of the lowest critical friction so far for which a paradoxical state is sought.
CLOSER = (0.9, 0.99)


@dataclass(frozen=True, eq=False)
class RankMargin:
    """The distance of a matrix from losing its rank."""

    singular_value: float  # The smallest one at the examined states.
    relative: float  # The same of the matrix with rows and columns scaled to about length one.
    state: FloatArray  # Where `relative` is, shape (n,).
    matrix: FloatArray  # There.
    vanishing_row: int | None  # The row that vanishes there, if one does.
    least: float  # The value of `relative` below which the matrix counts as singular.
    at_samples: float  # The least `relative` at the samples themselves.

    @property
    def is_singular(self) -> bool:
        return self.relative < self.least

    @property
    def is_regular_at_samples(self) -> bool:
        return self.at_samples >= self.least


def find_margin(
    samples: Samples, matrix: ca.SX, round_off: Booleans | None = None, search: bool = False
) -> RankMargin:
    """Finds the smallest singular values of a matrix at sampled states and between them.

    Between them: where the determinant of a square matrix changes its sign on the way from the
    first state; and with `search` downhill from the worst states.
    """
    system, whole = samples.system, ca.SX(matrix)
    for i, j in np.argwhere(round_off) if round_off is not None else ():
        whole[int(i), int(j)] = 0.0
    whole = ca.sparsify(whole)
    value_of = system.matrix("margin", whole)
    sizes = np.mean([np.abs(value) for (value,) in samples.values(matrix=whole)], axis=0)
    rows, columns = equilibration(sizes)

    def plain(state: FloatArray) -> FloatArray:
        return value_of(state, system.parameter_values)

    def scaled(state: FloatArray) -> FloatArray:
        return plain(state) / rows[:, None] / columns

    def distance(state: FloatArray) -> float:
        value = scaled(state)
        return smallest_singular_value(value) if np.all(np.isfinite(value)) else np.inf

    candidates = list(samples.states)
    if matrix.is_square():
        crossings = (_crossing(samples, scaled, there) for there in samples.states[1:])
        candidates += [state for state in crossings if state is not None]
    distances = [distance(state) for state in candidates]
    if search:
        a, b = ca.SX.sym("a", matrix.shape[0]), ca.SX.sym("b", matrix.shape[1])
        outputs = {"gradient": ca.gradient(ca.bilin(whole, a, b), system.state)}
        gradient = system.trace("slope of a margin", outputs, {"a": a, "b": b}, often=False)

        def slope(state: FloatArray) -> tuple[float, FloatArray]:
            """The smallest singular value s and its gradient d(a' M b)/dx, where M b = s a."""
            value = scaled(state)
            if not np.all(np.isfinite(value)):
                return np.inf, np.zeros(state.size)
            left, values, right = np.linalg.svd(value, full_matrices=False)
            pair = left[:, -1] / rows, right[-1] / columns
            along = gradient(state, *pair, system.parameter_values)[0]
            return float(values[-1]), np.where(np.isfinite(along), along, 0.0)

        starts = np.argsort(distances, kind="stable")[:3]
        lowest = [samples.descend(slope, candidates[start]) for start in starts]
        candidates += lowest
        distances += [distance(state) for state in lowest]
    state = candidates[int(np.argmin(distances))]
    length, least = np.linalg.norm(scaled(state), axis=1), system.least_margin
    return RankMargin(
        singular_value=min(smallest_singular_value(plain(x)) for x in candidates),
        relative=min(distances),
        state=state,
        matrix=plain(state),
        vanishing_row=int(np.argmin(length)) if length.min() < least else None,
        least=least,
        at_samples=min(distances[: len(samples.states)]),
    )


def _crossing(
    samples: Samples, matrix: Callable[[FloatArray], FloatArray], there: FloatArray
) -> FloatArray | None:
    """A state where the determinant changes its sign on the way from the first state."""
    here = samples.states[0]
    start = np.linalg.slogdet(matrix(here))[0]
    if np.linalg.slogdet(matrix(there))[0] == start:
        return None
    for _ in range(60):
        try:
            middle = samples.manifold.project((here + there) / 2.0)
        except InconsistentStateError:
            return None
        value = matrix(middle)
        if not np.all(np.isfinite(value)):
            return None
        if np.linalg.slogdet(value)[0] == start:
            here = middle
        else:
            there = middle
    return here


@dataclass(frozen=True, eq=False)
class ContactMargin:
    """The distance of frictional contacts from the Painleve paradox, over some states."""

    reserve: float  # The smallest principal minor of A(x), relative to that without friction.
    critical_friction: dict[str, float]  # Coefficient -> the lowest value with the paradox.
    state: FloatArray  # Where, shape (n,).
    time: float | None = None  # In s, along a motion.

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
        unit, size = self._direction(parameters), self._system.num_constraints
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

    def over(self, samples: Samples) -> ContactMargin:
        """Returns the smallest margin at samples and, downhill from the worst, between them."""
        p = self._system.parameter_values
        margins = sorted((self.at(state, p) for state in samples.states), key=LOWEST)
        lower = [self._downhill(samples, m, p) for m in margins[:3]]
        return min([margins[0], *lower], key=LOWEST)

    def along(self, times: FloatArray, states: FloatArray, parameters: FloatArray) -> ContactMargin:
        """Returns the smallest margin along a motion of at least one state."""
        rows = zip(states, parameters, times.tolist(), strict=True)
        return min((self.at(*row) for row in rows), key=LOWEST)

    def _downhill(
        self, samples: Samples, best: ContactMargin, parameters: FloatArray
    ) -> ContactMargin:
        """The margin at a state in the Painleve paradox with as little friction as can be found."""
        unit = self._direction(parameters)

        def reserve(state: FloatArray) -> tuple[float, FloatArray]:
            """The margin as far as it is positive, and its gradient."""
            margin, gradient = self._slope(state, values)
            if not self._slope.is_finite:
                return np.inf, np.zeros(state.size)
            return max(float(margin.item()), 0.0), gradient

        for part in CLOSER:
            for _ in range(20):
                size = part * best.lowest if np.isfinite(best.lowest) else 1e3
                values = self._with_friction(parameters, size * unit / max(unit))
                state = samples.descend(reserve, best.state)
                lower = self.at(state, parameters)
                if not lower.lowest < best.lowest:
                    break
                best = lower
        return best

    def _direction(self, parameters: FloatArray) -> FloatArray:
        """The coefficients of friction, or ones if all are zero."""
        friction = parameters[self._places]
        return friction if np.any(friction) else np.ones(len(self._places))

    def _with_friction(self, parameters: FloatArray, friction: FloatArray) -> FloatArray:
        values = parameters.copy()
        values[self._places] = friction
        return values
