"""The manifold N* of consistent states, and the projection onto it.                 (4)"""

from collections.abc import Callable, Iterator, Sequence
from functools import cached_property
from math import isfinite

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from drake_dae.arrays import FloatArray, numbers
from drake_dae.dae.kinetic_metric import KineticMetric
from drake_dae.dae.layout import Indices, Layout
from drake_dae.dae.system import DaeSystem
from drake_dae.errors import InconsistentStateError, ModelError
from drake_dae.trace.factorization import nonzeros, smallest_sine
from drake_dae.trace.functions import TracedFunction
from drake_dae.trace.newton import (
    PRECISION,
    ROUND_OFF,
    ROUNDING,
    Linearization,
    are_dependent,
    newton,
    norm,
    shortest_steps,
    steps_along,
)
from drake_dae.trace.round_off import positive

CONSISTENT = 1e-8
"""A state is taken as consistent, and mended silently, if it is this near to N*, relative to its
size; or, where gradients depend on each other, if its residual is at most this."""

STEPS = 6
"""So many Newton steps are one function: one or two to N* from where a step of a simulation ends,
the others polish; one projection in a thousand takes more."""

STAYS, FOUND, NOT_FOUND = 0.0, 1.0, 2.0
"""What a projection's first steps lead to: the state itself, another one, or not yet to one."""

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
        residual_function: The same as a function of state and parameters.
    """

    def __init__(self, system: DaeSystem, chains: Sequence[Sequence[ca.SX]]) -> None:
        self.system = system
        residual = ca.vertcat(ca.SX(0, 1), *[ca.vertcat(*chain) for chain in chains])
        self.residual_expression = residual
        layout = Layout(tuple(len(chain) for chain in chains))
        self.residual_signals = layout.chain_signals(system.constraint_output_signals)
        gradient = ca.jacobian(residual, system.state)
        self._layout, self._levels = layout, _levels(layout, gradient)
        self.residual_function = system.trace("manifold", {"residual": residual})
        self._gradient = system.trace("manifold gradient", {"gradient": gradient}, often=False)
        self._scale = system.scale
        lengths, self._rows = self._usual_sizes()
        heads = layout.heads.tolist()
        self._projection = self._trace_projection(gradient, heads, lengths)
        if heads:
            first = ca.mtimes(gradient[heads, :], ca.diag(ca.SX(self._scale)))
            sines = {"sine": smallest_sine(first, self._rows[heads])}
            self._sine = system.trace("independence", sines, often=False)

    def _usual_sizes(self) -> tuple[FloatArray, FloatArray]:
        """How long gradients are at the nominal state, over the scale of the states.

        In some configurations gradients vanish; what has no length at the nominal state has 1, and
        0 in the second array.
        """
        gradients = self.gradients(self.system.nominal_state) * self._scale
        if not np.all(np.isfinite(gradients)):
            gradients = np.zeros_like(gradients)
        rows = np.linalg.norm(gradients, axis=1)
        return positive(rows), rows

    def _trace_projection(
        self, gradient: ca.SX, heads: Sequence[int], usual: FloatArray
    ) -> TracedFunction:
        """Where the first Newton steps from a state lead, all by the gradients there.

        First stand their lengths, in states over their scale, and what `_followed` says; then the
        first step. They are doubted where gradients nearly depend on each other.
        """
        state, p, scale = self.system.state, self.system.parameter_symbol, ca.SX(self._scale)
        # The steps hold them often: what is common goes once, and not from all of it.
        left, gradient = ca.cse([self.residual_expression, gradient])
        residual = ca.Function("residual", [state, p], [left], {"cse": False})
        (step_for, pivots), steps = _shortest_step(gradient, scale), []
        for _ in range(STEPS):
            steps.append(scale * step_for(residual(state, p)))
            state += steps[-1]
        start = self.system.state
        unit = ca.fmax(scale, ca.fabs(start))
        lengths = [ca.norm_2(step / scale) for step in steps]
        sizes = [ca.norm_2(step / unit) for step in steps[:2]]
        found, outcome = _followed(start, steps, lengths, *sizes)
        outputs = {"sizes": ca.vertcat(outcome, *lengths), "found": found, "step": steps[0]}
        # For next to nothing, like the sines, which are looked at where this fails.
        doubt = ca.mmin(ca.vertcat(1, *[ca.fabs(pivots[i]) / usual[i] for i in heads])) - DOUBT
        return self.system.trace("projection onto the manifold", outputs, doubt=doubt, lean=True)

    @cached_property
    def _newton(self) -> TracedFunction:
        """The Newton step from a state, over its scale, by the gradients at another one."""
        other, state = ca.SX.sym("other", self.system.num_states), self.system.state
        gradient = ca.substitute(ca.jacobian(self.residual_expression, state), state, other)
        scale = ca.SX(self._scale)
        step = _shortest_step(gradient, scale)[0](self.residual_expression)
        inputs = {"other": other}
        return self.system.trace("step to the manifold", {"step": step}, inputs, often=False)

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
        return self.residual_function(state, self.system.parameter_vector(parameters))[0]

    def gradients(self, state: ArrayLike, parameters: ArrayLike | None = None) -> FloatArray:
        """C = d(residual)/dx, shape (sum r_i, n); the arguments are those of `residual`."""
        values = self._gradient(state, self.system.parameter_vector(parameters))[0]
        return values.reshape(-1, self.system.num_states)

    @property
    def newton_step(self) -> TracedFunction:
        """The Newton step of least norm from a state, over its scale, by the gradients at another.

        A function of state, the other state and parameters.
        """
        return self._newton

    def is_consistent(self, state: ArrayLike, parameters: ArrayLike | None = None) -> bool:
        """Whether a state is on N* up to round-off: Newton's step to it is short, in any unit.

        The arguments are those of `residual`.
        """
        x, p = self._state(state), self.system.parameter_vector(parameters)
        reach = float(self._projection.evaluate(x, p)[0][1])
        if isfinite(reach) and reach > 0.0:
            return reach <= CONSISTENT * norm(x / self._scale) + FLOOR
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
        return self.projected(start, p, crosses)

    def projected(
        self,
        start: FloatArray,
        p: FloatArray,
        crosses: Callable[[FloatArray], bool] | None = None,
    ) -> FloatArray:
        """`project` without checks of its arguments; the state itself if it is consistent."""
        found = self.first_steps(start, p)
        if found is None:
            return self.searched(start, p, crosses)
        return found if found is start else found.copy()

    def first_steps(self, start: FloatArray, p: FloatArray) -> FloatArray | None:
        """`project` by its first few steps, without checks of its arguments: for a simulation.

        Args:
            start: The state, shape (n,).
            p: Values of all parameters, shape (k,).

        Returns:
            The consistent state, overwritten by the next call; `start` itself if that is one; None
            where `searched` finds more.
        """
        function = self._projection
        state, parameters = function.arguments
        state[...] = start
        parameters[...] = p
        is_valid = function.run()
        sizes, found, _ = function.outputs
        outcome = sizes.item(0)
        if is_valid and outcome == FOUND:
            return found
        return start if outcome == STAYS and function.is_finite else None

    def searched(
        self,
        start: FloatArray,
        p: FloatArray,
        crosses: Callable[[FloatArray], bool] | None = None,
    ) -> FloatArray:
        """`project` where `first_steps` has found nothing.

        Args:
            start: The state, shape (n,).
            p: Values of all parameters, shape (k,).
            crosses: As for `project`.
        """
        function = self._projection
        sizes, found, _ = function.evaluate(start, p)
        is_finite = function.is_finite
        if (
            is_finite
            and sizes.item(1) == 0.0
            and not self.residual_function.evaluate(start, p)[0].any()
        ):
            return start
        known = found.copy() if is_finite and sizes.item(0) == FOUND else None
        if crosses is not None and not function.is_valid and self._is_near(start, p, crosses):
            known = self._nearly(start, p)
        return self._searched(start, p) if known is None else known

    def _searched(self, start: FloatArray, p: FloatArray) -> FloatArray:
        """The consistent state next to one, where the first few steps do not lead to it."""
        scale = self._scale
        z, converged = newton(start / scale, lambda z: self._linearize(scale * z, p))
        if not converged:
            # Gradients that depend on each other, or steps that mislead: least squares, downhill.
            z, converged = newton(start / scale, lambda z: self._downhill(scale * z, p))
        found = scale * z
        if converged and not np.array_equal(found, start):
            return found
        # Else it is round-off, in units in which that is much, or no state changes what is left.
        if self._residual_size(found, p) <= CONSISTENT:
            return found
        residual = self.residual_function.evaluate(found, p)[0].copy()
        if converged and self._projection.evaluate(found, p)[1].any():
            return found
        raise InconsistentStateError(self._why(found, p, residual), residual)

    def settle(self, state: ArrayLike, parameters: ArrayLike | None = None) -> FloatArray:
        """The consistent state next to a given one, level by level: for a start that someone gave.

        The constraints are met first, by the states that they depend on; then their derivatives, by
        the states that are new in them, and so on: positions first, then velocities, so that no
        velocity moves a position. Where constraint forces do no work, as in a mechanism, that takes
        the least kinetic energy, see `KineticMetric`; else steps are shortest relative to the scale
        of the states. Where that leads nowhere it is `project`, whose arguments, result and
        exceptions it has.
        """
        start, p = self._state(state), self.system.parameter_vector(parameters)
        for found in self._settled(start, p):
            if found is not None:
                return self.project(found, p)
        return self.project(start, p)

    def _settled(self, start: FloatArray, p: FloatArray) -> Iterator[FloatArray | None]:
        """A start settled in the metric of kinetic energy, where it is known, and in the plain one.

        None where that leads nowhere.
        """
        kinetic = self._kinetic
        if kinetic.does_no_work(start, p, self.gradients(start, p)):
            found = start.copy()
            moves = (
                self._settle_level(found, rows, columns, p, depth)
                for rows, columns, depth in kinetic.levels
            )
            yield found if all(moves) else None
        found = start.copy()
        moves = (self._settle_level(found, *level, p) for level in self._levels)
        yield found if all(moves) else None

    @cached_property
    def _kinetic(self) -> KineticMetric:
        return KineticMetric(self.system, self._layout)

    def _settle_level(
        self,
        state: FloatArray,
        rows: Indices,
        columns: Indices,
        parameters: FloatArray,
        depth: int | None = None,
    ) -> bool:
        """Moves some states so that some rows of the residual vanish, and says whether they do.

        Args:
            state: The state, which is changed.
            rows, columns: The rows and the states.
            parameters: Values of all parameters.
            depth: How many derivatives are left until the constraint inputs act, for steps in the
                metric of kinetic energy; None for those of least norm.
        """
        scale = self._scale[columns]

        def filled(z: FloatArray) -> FloatArray:
            x = state.copy()
            x[columns] = scale * z
            return x

        def left(z: FloatArray) -> FloatArray:
            return self.residual_function(filled(z), parameters)[0][rows]

        def linearize(z: FloatArray) -> Linearization | None:
            x = filled(z)
            gradients = self.gradients(x, parameters)[np.ix_(rows, columns)]
            if depth is None:
                return shortest_steps(gradients * scale, left)
            directions = self._kinetic.directions(x, parameters, gradients, depth)
            return steps_along(gradients * scale, directions / scale[:, None], left)

        z, converged = newton(state[columns] / scale, linearize)
        state[columns] = scale * z
        return converged

    def _state(self, state: ArrayLike) -> FloatArray:
        """A state as a new array; its numbers need not be finite."""
        x = numbers(f"{self.system.name}: a state", state).reshape(-1)
        if x.size != self.system.num_states:
            raise ModelError(
                f"{self.system.name}: a state has shape ({self.system.num_states},), got {x.shape}"
            )
        return x

    @np.errstate(all="ignore")  # Iterates out of the domain are tried, and refused.
    def _residual_size(self, state: FloatArray, parameters: FloatArray) -> float:
        """The residual relative to how it changes over the scale of the states, if it does."""
        residual = self.residual_function.evaluate(state, parameters)[0]
        if not residual.any():
            return 0.0
        length = np.linalg.norm(self.gradients(state, parameters) * self._scale, axis=1)
        return norm(residual / positive(length))

    def _linearize(self, state: FloatArray, parameters: FloatArray) -> Linearization:
        """Newton steps of least norm by the gradients at a state, in states over their scale."""
        scale = self._scale
        return Linearization(
            lambda z: self._newton.evaluate(scale * z, state, parameters)[0].copy(),
            is_regular=True,
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
        x = start / self._scale
        size = max(norm(x), norm(self.system.nominal_state / self._scale))
        for _ in range(ITERATIONS):
            state = x * self._scale
            gradients = self.gradients(state, parameters) * self._scale
            left = self.residual_function(state, parameters)[0]
            if not (np.all(np.isfinite(gradients)) and np.all(np.isfinite(left))):
                return None
            length = positive(np.maximum(np.linalg.norm(gradients, axis=1), self._rows))
            if norm(left / length) > SMALL * size:
                return None
            step = np.linalg.pinv(gradients / length[:, None], NEARLY) @ (left / length)
            x = x - step
            if norm(step) <= ROUND_OFF * size:
                return x * self._scale
        return None

    def _downhill(self, state: FloatArray, parameters: FloatArray) -> Linearization | None:
        """Steps of least squares that make the residual smaller, its rows scaled to length one."""
        scale = self._scale
        gradients = self.gradients(state, parameters) * scale
        length = positive(np.linalg.norm(gradients, axis=1))

        def residual(z: FloatArray) -> FloatArray:
            return self.residual_function(scale * z, parameters)[0]

        def measure(z: FloatArray) -> float:
            return float(np.linalg.norm(residual(z) / length))

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
        if are_dependent(self.gradients(state, parameters) * self._scale):
            return left + (
                "The gradients of the constraints depend on each other there: the constraints "
                "contradict each other, or start away from this state"
            )
        return left + "Start nearer to the constraint, away from its singular states"


def _shortest_step(
    gradient: ca.SX, scale: ca.SX
) -> tuple[Callable[[ca.SX], ca.SX], Sequence[ca.SX]]:
    """residual -> the shortest dz with C S dz = -residual, where dx = S dz and S is the scale.

    From (C S)' = Q R it is -Q R^-T residual; the diagonal of R comes with it.
    """
    if not gradient.shape[0]:
        return (lambda residual: ca.SX(gradient.shape[1], 1)), ()
    q, r = ca.qr(ca.mtimes(gradient, ca.diag(scale)).T)
    pivots = [r[i, i] for i in range(r.shape[0])]
    return (lambda residual: -ca.mtimes(q, ca.solve(r.T, residual))), pivots


def _followed(
    start: ca.SX, steps: Sequence[ca.SX], lengths: Sequence[ca.SX], size: ca.SX, left: ca.SX
) -> tuple[ca.SX, ca.SX]:
    """What `newton` finds from a start by these first steps, and STAYS, FOUND or NOT_FOUND.

    Args:
        start: The state, shape (n, 1).
        steps: The Newton steps that follow each other from there.
        lengths: Their lengths, in states over their scale.
        size, left: The sizes of the first two, relative to the state.
    """
    # Newton's method ends at the start, or after its first step; then it is polished.
    at_start = size <= ROUNDING
    after_one = ca.logic_and(ca.logic_not(at_start), left * left <= PRECISION * size)
    goes_on = ca.logic_and(at_start, lengths[0] > 0)
    found = start + ca.if_else(ca.logic_or(after_one, goes_on), steps[0], 0)
    for number in range(1, len(steps)):
        shorter = ca.logic_and(goes_on, lengths[number] < 0.5 * lengths[number - 1])
        goes_on = shorter if number > 1 else ca.logic_or(after_one, shorter)
        goes_on = ca.logic_and(goes_on, lengths[number] > 0)
        found += ca.if_else(goes_on, steps[number], 0)
    ends = ca.logic_and(ca.logic_or(at_start, after_one), ca.logic_not(goes_on))
    # What is at the start and has no length may be there, or nowhere.
    moves = ca.logic_or(after_one, lengths[0] > 0)
    outcome = ca.if_else(ca.logic_and(ends, moves), FOUND, NOT_FOUND)
    stays = ca.logic_and(lengths[0] > 0, lengths[0] <= ROUNDING)
    return found, ca.if_else(stays, STAYS, outcome)


def _levels(layout: Layout, gradient: ca.SX) -> list[tuple[Indices, Indices]]:
    """The rows of each order of derivatives, and the states that are new in them."""
    used = nonzeros(gradient.sparsity())
    known = np.zeros(gradient.shape[1], dtype=bool)
    levels = []
    for order in range(max(layout.degrees, default=0)):
        own = np.flatnonzero(layout.orders == order)
        new = used[own].any(axis=0) & ~known
        known |= new
        levels.append((own, np.flatnonzero(new)))
    return levels
