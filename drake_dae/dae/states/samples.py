"""Numbers at consistent states: what is zero there, what is dependent, what is singular."""

from collections.abc import Callable, Sequence
from functools import cached_property

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from drake_dae.arrays import Booleans, FloatArray, numbers, show
from drake_dae.dae.manifold import Manifold
from drake_dae.dae.states.margins import SINGULAR, Margin
from drake_dae.dae.states.region import ConsistentRegion, Region
from drake_dae.dae.system import DaeSystem
from drake_dae.errors import InconsistentStateError, ModelError
from drake_dae.trace.functions import TracedFunction
from drake_dae.trace.newton import are_dependent
from drake_dae.trace.round_off import (
    Sized,
    equilibration,
    multiply,
    positive,
    smallest_singular_value,
    without_round_off,
)


class Fields:
    """f, g, h, l and m of (1)-(3) as numbers, with the default parameters.

    Args:
        system: (1)-(3).
    """

    def __init__(self, system: DaeSystem) -> None:
        self.system = system
        self._function = traced(system, f=system.f, g=system.g, h=system.h, l=system.l, m=system.m)

    def __call__(self, state: FloatArray) -> dict[str, FloatArray]:
        """The matrices at a state, by letter."""
        values = self._function(state, self.system.parameter_values)
        return dict(zip(self._function.output_names, map(_matrix, values), strict=True))


class Samples:
    """Consistent states near given ones, with the default parameters.

    A state that does not get onto N*, or is outside the domain of (1)-(3), is left out.

    Args:
        manifold: N*, or what is known of it.
        fields: Of the system.
        guesses: The nominal state first, shape (count, n).
        region: Where the states must be; None for anywhere.

    Attributes:
        states: Shape (samples, n).
        fields: f, g, h, l and m at each state, by letter.
        scale: How large each state is over all of them and the guesses, shape (n,).

    Raises:
        InconsistentStateError: No guess gets onto N*.
        ModelError: A function is not finite at the nominal state.
    """

    def __init__(
        self,
        manifold: Manifold,
        fields: Fields,
        guesses: FloatArray,
        region: Region | None = None,
    ) -> None:
        self.manifold = manifold
        self.system = manifold.system
        self._consistent = ConsistentRegion(manifold, region)
        self.fields: list[dict[str, FloatArray]] = []
        states: list[FloatArray] = []
        failure = None
        for number, guess in enumerate(guesses):
            try:
                state = self._consistent.draw(guess)
            except InconsistentStateError as error:
                failure = failure or error
                continue
            values = fields(state)
            bad = [key for key, value in values.items() if not np.all(np.isfinite(value))]
            if not bad:
                states.append(state)
                self.fields.append(values)
            elif number == 0:
                raise ModelError(
                    f"{self.system.name}: {', '.join(bad)} of (1)-(3) is not finite at the "
                    f"consistent state x = {show(state)}; give a nominal_state inside the domain"
                )
        if failure and not states:
            raise failure
        self.states = np.array(states)
        self.scale = positive(np.abs(np.vstack([guesses, self.states])).max(axis=0))

    def values(self, **expressions: ca.SX) -> list[tuple[FloatArray, ...]]:
        """Expressions of the state, as matrices, at each state.

        Raises:
            ModelError: One is not finite.
        """
        function = traced(self.system, **expressions)
        result = []
        for state in self.states:
            values = function(state, self.system.parameter_values)
            if not function.is_finite:
                raise ModelError(
                    f"{self.system.name}: {', '.join(expressions)} is not finite at the consistent "
                    f"state x = {show(state)}; give a nominal_state inside the domain of the "
                    "functions and of their derivatives"
                )
            result.append(tuple(_matrix(value) for value in values))
        return result

    def field(self, key: str) -> list[Sized]:
        """g or h at each state."""
        return [(values[key], np.abs(values[key])) for values in self.fields]

    def eliminated(
        self, constraint_gradient: ca.SX, constraint_matrix: ca.SX
    ) -> tuple[list[Sized], list[Sized]]:
        """h* (10) and n* (12) at each state, from the factors of beta (14).

        Where they are zero but for round-off, they are zero here.

        Args:
            constraint_gradient: Of the last derivatives of the constraints, shape (m, n).
            constraint_matrix: A(x), shape (m, m).
        """
        h_star, n_star = [], []
        values = self.values(gradient=constraint_gradient, matrix=constraint_matrix)
        for fields, (gradient, matrix) in zip(self.fields, values, strict=True):
            h, size = fields["h"], np.abs(fields["h"])
            by_control = multiply(gradient, (h, size), self.scale)
            # Units of the constraints' derivatives, and of the constraint inputs.
            rows, columns = equilibration(np.abs(matrix))
            inverse = np.linalg.inv(matrix / rows[:, None] / columns) / columns[:, None] / rows
            beta = multiply(-inverse, by_control, rows)
            added, added_size = multiply(fields["g"], beta, 1.0 / columns)
            h_star.append(without_round_off(h + added, size + added_size))
            n_star.append(multiply(fields["m"], beta, 1.0 / columns))
        return h_star, n_star

    def derivatives(self, rows: ca.SX, functions: ca.SX, field: Sequence[Sized]) -> FloatArray:
        """The derivatives of functions along fields; what is nothing but round-off is zero.

        Args:
            rows: The derivatives, shape (a, k), whose structure may decide.
            functions: Shape (a, 1).
            field: Shape (n, k), at each state.

        Returns:
            Shape (samples, a, k).
        """
        if not rows.nnz():
            return np.zeros((len(self.states), *rows.shape))
        gradients = self.values(gradient=ca.jacobian(functions, self.system.state))
        return np.array(
            [
                multiply(gradient, value, self.scale)[0]
                for (gradient,), value in zip(gradients, field, strict=True)
            ]
        )

    def dependent(self, functions: ca.SX) -> bool:
        """Whether the differentials of functions are linearly dependent at every state."""
        gradients = self.values(gradient=ca.jacobian(functions, self.system.state))
        return all(are_dependent(gradient) for (gradient,) in gradients)

    def margin(
        self, matrix: ca.SX, round_off: Booleans | None = None, search: bool = False
    ) -> Margin:
        """The smallest singular values of a matrix at the states and at what lies between.

        The determinant of a square matrix that changes its sign on the way from the first state is
        zero there, unless N* has no way, or the determinant is infinite on it.

        Args:
            matrix: Shape (k, l), k <= l.
            round_off: Which entries are taken as zero; none if None.
            search: Also go downhill from the worst states, in the box that the states span and the
                region.
        """
        scaled = _ScaledMatrix(self, _masked(matrix, round_off))
        candidates = list(self.states)
        if matrix.is_square():
            crossings = (self._crossing(scaled, there) for there in self.states[1:])
            candidates += [state for state in crossings if state is not None]
        if search:
            low, high = self.states.min(axis=0), self.states.max(axis=0)
            given = self._consistent.region
            if given is not None:
                # The edge of what is not named may lie a little beyond the random states.
                more = 0.5 * (high - low)
                low = np.where(np.isfinite(given.low), given.low, low - more)
                high = np.where(np.isfinite(given.high), given.high, high + more)
            consistent = ConsistentRegion(self.manifold, Region(low, high))
            starts = sorted(candidates, key=scaled.distance)[:3]
            candidates += [consistent.descend(scaled.slope, start) for start in starts]
        state = min(candidates, key=scaled.distance)
        length = np.linalg.norm(scaled(state), axis=1)
        return Margin(
            singular_value=min(smallest_singular_value(scaled.plain(x)) for x in candidates),
            relative=scaled.distance(state),
            state=state,
            vanishing_row=int(np.argmin(length)) if length.min() < SINGULAR else None,
        )

    def is_regular(self, matrix: ca.SX, round_off: Booleans | None = None) -> bool:
        """Whether a square matrix is regular at every state; as for `margin`."""
        scaled = _ScaledMatrix(self, _masked(matrix, round_off))
        return all(scaled.distance(state) >= SINGULAR for state in self.states)

    def _crossing(
        self, matrix: Callable[[FloatArray], FloatArray], there: FloatArray
    ) -> FloatArray | None:
        """Where the determinant changes its sign on the way from the first state, if it does."""
        here = self.states[0]

        def sign(state: FloatArray) -> float:
            return float(np.linalg.slogdet(matrix(state))[0])

        start, end = sign(here), sign(there)
        if start == end:
            return None
        for _ in range(60):
            try:
                middle = self.manifold.project((here + there) / 2.0)
            except InconsistentStateError:
                return None
            if not np.all(np.isfinite(matrix(middle))):
                return None
            if sign(middle) == start:
                here = middle
            else:
                there = middle
        return here


class _ScaledMatrix:
    """A matrix of the state, rows and columns scaled to about length one over all samples."""

    def __init__(self, samples: Samples, matrix: ca.SX) -> None:
        self._matrix, self._system = matrix, samples.system
        self._function = traced(samples.system, matrix=matrix)
        sizes = np.mean([np.abs(value) for (value,) in samples.values(matrix=matrix)], axis=0)
        self._rows, self._columns = equilibration(sizes)

    def plain(self, state: FloatArray) -> FloatArray:
        """Not scaled."""
        value = self._function(state, self._system.parameter_values)[0]
        return value.reshape(self._matrix.shape)

    def __call__(self, state: FloatArray) -> FloatArray:
        return self.plain(state) / self._rows[:, None] / self._columns

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
        x, (rows, columns) = self._system.state, self._matrix.shape
        a, b = ca.SX.sym("a", rows), ca.SX.sym("b", columns)
        inputs = {"x": x, "a": a, "b": b, "p": self._system.parameter_symbol}
        product = ca.gradient(ca.bilin(self._matrix, a, b), x)
        return TracedFunction(self._system.name, inputs, {"gradient": product}, often=False)


def default_spread(nominal: FloatArray) -> FloatArray:
    """How far states are drawn from the nominal one, shape (n,): 0.1.

    In unusual units a hundredth of the nominal value where that is above 10, and a tenth where it
    is below 1e-3 and not round-off.
    """
    size = np.abs(nominal)
    small = (size < 1e-3) & (size > 1e-12 * size.max())
    return np.where(size > 10.0, 0.01 * size, np.where(small, 0.1 * size, 0.1))


def spread_of(system: DaeSystem, spread: ArrayLike | None) -> FloatArray:
    """A spread as shape (n,): one that is given, a number for all, or the default.

    Raises:
        ModelError: A wrong shape, or a number that is not finite.
    """
    if spread is None:
        return default_spread(system.nominal_state)
    given = numbers(f"{system.name}: spread", spread)
    if given.shape not in ((), (system.num_states,)) or not np.all(np.isfinite(given)):
        raise ModelError(
            f"{system.name}: spread must be a number or have shape ({system.num_states},), got "
            f"{spread!r}"
        )
    return np.full(system.num_states, given)


def traced(system: DaeSystem, **expressions: ca.SX) -> TracedFunction:
    """A function of the state and of all parameters."""
    inputs = {"x": system.state, "p": system.parameter_symbol}
    return TracedFunction(system.name, inputs, expressions, often=False)


def _masked(matrix: ca.SX, zero: Booleans | None) -> ca.SX:
    result = ca.SX(matrix)
    for i, j in np.argwhere(zero) if zero is not None else ():
        result[int(i), int(j)] = 0.0
    return ca.sparsify(result)


def _matrix(value: FloatArray) -> FloatArray:
    """Columns come back as vectors."""
    return value[:, None].copy() if value.ndim == 1 else value
