"""The manifold N* of consistent states, and the projection onto it.                 (4)"""

from collections.abc import Callable, Sequence
from math import isfinite

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from drake_dae.arrays import FloatArray, numbers
from drake_dae.dae.layout import Indices, Layout
from drake_dae.dae.system import DaeSystem
from drake_dae.errors import InconsistentStateError, ModelError
from drake_dae.trace.factorization import smallest_sine
from drake_dae.trace.newton import (
    ROUND_OFF,
    ROUNDING,
    Linearization,
    are_dependent,
    newton,
    norm,
    shortest_steps,
)
from drake_dae.trace.round_off import equilibration, positive

CONSISTENT = 1e-8
"""A state is taken as consistent, and mended silently, if it is this near to N*, relative to its
size; or, where gradients depend on each other, if its residual is at most this."""

FLOOR = 1e-12
"""A distance from N* that is round-off of states that are zero."""


NEARLY = 3e-3
"""Gradients of constraints that are this near to dependent, as the sine of an angle, are left out
of a projection from a state that is all but on N*."""

DOUBT = 0.03
"""Where a gradient, less its part along those before it, is this much shorter than usual it is
worth while to look whether they are nearly dependent."""

SMALL = 1e-3
"""A state is all but on N* if its residual, in lengths of gradients, is at most this, relative to
its size."""

ITERATIONS = 10
"""After so many steps such a projection is given up; quadratic convergence takes three."""


class Manifold:
    """N* = {x : L_f^k k_i(x) = 0, k = 0, ..., r_i - 1, i = 1, ..., m}, equation (4).

    Args:
        system: The system (1)-(3).
        chains: The chain k_i, L_f k_i, ..., L_f^(r_i - 1) k_i of each constraint.

    Attributes:
        residual_expression: What is zero on N*, shape (sum r_i, 1), constraint-major.
        residual_signals: Its names and units.
    """

    def __init__(self, system: DaeSystem, chains: Sequence[Sequence[ca.SX]]) -> None:
        self.system = system
        residual = ca.vertcat(ca.SX(0, 1), *[ca.vertcat(*chain) for chain in chains])
        self.residual_expression = residual
        layout = Layout(tuple(len(chain) for chain in chains))
        self.residual_signals = layout.chain_signals(system.constraint_output_signals)
        gradient = ca.jacobian(residual, system.state)
        self._levels = _levels(layout, gradient)
        self._residual = system.trace("manifold", {"residual": residual})
        self._gradient = system.trace("manifold gradient", {"gradient": gradient}, often=False)
        lengths, self._rows, self._columns = self._usual_sizes()
        # The Newton step of least norm from a state, by the gradients at another one: from
        # C' = Q R, dx = -Q R^-T r.
        other, step = ca.SX.sym("other", system.num_states), ca.SX(system.num_states, 1)
        doubt = None
        if residual.numel():
            q, r = ca.qr(ca.substitute(gradient, system.state, other).T)
            step = -ca.mtimes(q, ca.solve(r.T, residual))
            heads = layout.heads.tolist()
            # For next to nothing, like the sines, which are looked at where this fails.
            doubt = ca.mmin(ca.vertcat(1, *[ca.fabs(r[i, i]) / lengths[i] for i in heads])) - DOUBT
            units = ca.diag(ca.SX(ca.DM(self._columns)))
            first = ca.mtimes(ca.jacobian(residual[heads], system.state), units)
            sines = {"sine": smallest_sine(first, self._rows[heads])}
            self._sine = system.trace("independence", sines, often=False)
        outputs, inputs = {"step": step}, {"other": other}
        self._newton = system.trace("step to the manifold", outputs, inputs, doubt=doubt)

    def _usual_sizes(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """How long gradients are at the nominal state: as they are, and in units of the states.

        The units, which are the third, even out what states do to them. In some configurations
        gradients vanish; what has no length at the nominal state has 1, and 0 in these units.
        """
        gradients = self.gradients(self.system.nominal_state)
        if not np.all(np.isfinite(gradients)):
            gradients = np.zeros_like(gradients)
        columns = 1.0 / equilibration(gradients)[1]
        rows = np.linalg.norm(gradients * columns, axis=1)
        return positive(np.linalg.norm(gradients, axis=1)), rows, columns

    @property
    def dimension(self) -> int:
        """The dimension of N*, n - (r_1 + ... + r_m), Theorem 1.1."""
        return self.system.num_states - len(self.residual_signals)

    def residual(self, state: ArrayLike, parameters: ArrayLike | None = None) -> FloatArray:
        """The constraint outputs and their derivatives, shape (sum r_i,), constraint-major.

        Args:
            state: x, shape (n,).
            parameters: Values of all parameters; the defaults if None.
        """
        return self._residual(state, self.system.parameter_vector(parameters))[0]

    def gradients(self, state: ArrayLike, parameters: ArrayLike | None = None) -> FloatArray:
        """C = d(residual)/dx, shape (sum r_i, n); the arguments are those of `residual`."""
        values = self._gradient(state, self.system.parameter_vector(parameters))[0]
        return values.reshape(-1, self.system.num_states)

    def is_consistent(self, state: ArrayLike, parameters: ArrayLike | None = None) -> bool:
        """Whether a state is on N* up to round-off: Newton's step to it is short, in any unit.

        The arguments are those of `residual`.
        """
        x, p = self._state(state), self.system.parameter_vector(parameters)
        reach = norm(self._newton.evaluate(x, x, p)[0])
        if isfinite(reach) and reach > 0.0:
            return reach <= CONSISTENT * norm(x) + FLOOR
        # Gradients that depend on each other; or nothing is left, or what no state changes.
        return self._residual_size(x, p) <= CONSISTENT

    def project(
        self,
        state: ArrayLike,
        parameters: ArrayLike | None = None,
        crosses: Callable[[FloatArray], bool] | None = None,
    ) -> FloatArray:
        """The consistent state next to a given one, to round-off, by Newton's method.

        Args:
            state: A state near N*, shape (n,).
            parameters: Values of all parameters; the defaults if None.
            crosses: Whether a system crosses a singular configuration at a state next to one: what
                it loses there is then left out of the projection; None if it crosses none.

        Returns:
            The consistent state, shape (n,).

        Raises:
            InconsistentStateError: Newton's method does not reach N* from there.
            ModelError: The state has a wrong shape.
        """
        start, p = self._state(state), self.system.parameter_vector(parameters)
        reach = norm(self._newton.evaluate(start, start, p)[0])
        if 0.0 < reach <= ROUNDING or (reach == 0.0 and self._residual_size(start, p) == 0.0):
            return start  # As in most steps of a simulation.
        if crosses is not None and not self._newton.is_valid and self._is_near(start, p, crosses):
            found = self._nearly(start, p)
            if found is not None:
                return found
        found, converged = newton(start, lambda x: self._linearize(x, p))
        if not converged:
            # Gradients that depend on each other, or steps that mislead: least squares, downhill.
            found, converged = newton(start, lambda x: self._downhill(x, p))
        if converged and found is not start:
            return found
        residual = self._residual.evaluate(found, p)[0].copy()
        # Else it is round-off, in units in which that is much, or no state changes what is left.
        if np.linalg.norm(residual) <= CONSISTENT:
            return found
        if converged and self._newton.evaluate(found, found, p)[0].any():
            return found
        raise InconsistentStateError(self._why(found, p, residual), residual)

    def settle(self, state: ArrayLike, parameters: ArrayLike | None = None) -> FloatArray:
        """The consistent state next to a given one, level by level: for a start that someone gave.

        The constraints are met first, by the states that they depend on; then their derivatives, by
        the states that are new in them, and so on: positions first, then velocities, so that no
        velocity moves a position. Where that leads nowhere it is `project`, whose arguments, result
        and exceptions it has.
        """
        start, p = self._state(state), self.system.parameter_vector(parameters)
        found = start.copy()
        for rows, columns in self._levels:
            if not self._settle_level(found, rows, columns, p):
                return self.project(start, p)
        return self.project(found, p)

    def _settle_level(
        self, state: FloatArray, rows: Indices, columns: Indices, parameters: FloatArray
    ) -> bool:
        """Moves some states so that some rows of the residual vanish, and says whether they do."""

        def filled(values: FloatArray) -> FloatArray:
            x = state.copy()
            x[columns] = values
            return x

        def linearize(values: FloatArray) -> Linearization | None:
            gradients = self.gradients(filled(values), parameters)[np.ix_(rows, columns)]
            return shortest_steps(
                gradients, lambda x: self._residual(filled(x), parameters)[0][rows]
            )

        state[columns], converged = newton(state[columns], linearize)
        return converged

    def _state(self, state: ArrayLike) -> FloatArray:
        """A state as a new array; its numbers need not be finite."""
        x = numbers(f"{self.system.name}: a state", state).reshape(-1)
        if x.size != self.system.num_states:
            raise ModelError(
                f"{self.system.name}: a state has shape ({self.system.num_states},), got {x.shape}"
            )
        return x

    def _residual_size(self, state: FloatArray, parameters: FloatArray) -> float:
        return norm(self._residual.evaluate(state, parameters)[0])

    def _linearize(self, state: FloatArray, parameters: FloatArray) -> Linearization:
        """Newton steps of least norm by the gradients at a state."""
        return Linearization(
            lambda x: self._newton.evaluate(x, state, parameters)[0].copy(), is_regular=True
        )

    def _is_near(
        self, state: FloatArray, parameters: FloatArray, crosses: Callable[[FloatArray], bool]
    ) -> bool:
        """Whether a system crosses a singular configuration next to a state."""
        return bool(self._sine(state, parameters)[0][0] < NEARLY) and crosses(state)

    def _nearly(self, start: FloatArray, parameters: FloatArray) -> FloatArray | None:
        """The state next to one that is all but on N*, where gradients nearly depend on each other.

        Across a singular configuration a regular step would magnify round-off. What gradients that
        are left out there say of N* is left, which is little so near to it; None if it is more.
        """
        x = start / self._columns
        size = max(norm(x), norm(self.system.nominal_state / self._columns))
        for _ in range(ITERATIONS):
            state = x * self._columns
            gradients = self.gradients(state, parameters) * self._columns
            left = self._residual(state, parameters)[0]
            if not (np.all(np.isfinite(gradients)) and np.all(np.isfinite(left))):
                return None
            length = positive(np.maximum(np.linalg.norm(gradients, axis=1), self._rows))
            if norm(left / length) > SMALL * size:
                return None
            step = np.linalg.pinv(gradients / length[:, None], NEARLY) @ (left / length)
            x = x - step
            if norm(step) <= ROUND_OFF * size:
                return x * self._columns
        return None

    def _downhill(self, state: FloatArray, parameters: FloatArray) -> Linearization | None:
        """Steps of least squares that make the residual smaller, its rows scaled to length one."""
        gradients = self.gradients(state, parameters)
        length = positive(np.linalg.norm(gradients, axis=1))

        def residual(x: FloatArray) -> FloatArray:
            return self._residual(x, parameters)[0]

        def measure(x: FloatArray) -> float:
            return float(np.linalg.norm(residual(x) / length))

        steps = shortest_steps(gradients, residual)
        return None if steps is None else steps._replace(measure=measure)

    def _why(self, state: FloatArray, parameters: FloatArray, residual: FloatArray) -> str:
        """Why a Newton iteration that ended at a state failed, in words."""
        name = self.system.name
        values = zip(self.residual_signals, residual, strict=True)
        bad = [signal.name for signal, value in values if not np.isfinite(value)]
        if bad:
            return (
                f"{name}: {', '.join(bad)} is not finite at the given state; start inside the "
                "domain of the constraints"
            )
        worst = int(np.argmax(np.abs(residual)))
        left = (
            f"{name}: no consistent state found near the given one; "
            f"{self.residual_signals[worst].name} = {residual[worst]:.3g} is left where Newton's "
            "method ends. "
        )
        if are_dependent(self.gradients(state, parameters)):
            return left + (
                "The gradients of the constraints depend on each other there: the constraints "
                "contradict each other, or start away from this state"
            )
        return left + "Start nearer to the constraint, away from its singular states"


def _levels(layout: Layout, gradient: ca.SX) -> list[tuple[Indices, Indices]]:
    """The rows of each order of derivatives, and the states that are new in them."""
    used = np.zeros(gradient.shape, dtype=bool)
    rows, columns = gradient.sparsity().get_triplet()
    used[rows, columns] = True
    known = np.zeros(gradient.shape[1], dtype=bool)
    levels = []
    for order in range(max(layout.degrees, default=0)):
        own = np.flatnonzero(layout.orders == order)
        new = used[own].any(axis=0) & ~known
        known |= new
        levels.append((own, np.flatnonzero(new)))
    return levels
