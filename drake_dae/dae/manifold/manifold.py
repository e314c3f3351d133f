"""The manifold N* of consistent states, and the projection onto it.                 (4)"""

from collections.abc import Sequence
from math import isfinite

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from drake_dae.arrays import FloatArray, numbers
from drake_dae.dae.manifold.first_steps import FOUND, STAYS, trace_first_steps
from drake_dae.dae.manifold.residual import Residual
from drake_dae.dae.manifold.search import CONSISTENT, ConsistentStateSearch
from drake_dae.dae.manifold.settling import Settling
from drake_dae.dae.system.system import DaeSystem
from drake_dae.errors import InconsistentStateError, ModelError
from drake_dae.trace.newton import norm
from drake_dae.trace.round_off import positive

PROBE = 1e-4
"""The distance at which poles show, in states over their scale."""

FLOOR = 1e-12
"""A distance from N* that is round-off even if all states are zero."""


class Manifold(Residual):
    """The manifold N* = {x : L_f^k k_i(x) = 0, k = 0, ..., r_i - 1, i = 1, ..., m} (4)."""

    def __init__(self, system: DaeSystem, chains: Sequence[Sequence[ca.SX]]) -> None:
        super().__init__(system, chains)
        self._first_steps = trace_first_steps(self)
        self.searched = ConsistentStateSearch(self, self._first_steps).searched
        self._settling = Settling(system, self)

    @property
    def dimension(self) -> int:
        """The dimension of N*, n - (r_1 + ... + r_m), Theorem 1.1."""
        return self.system.num_states - len(self.residual_signals)

    def residual(self, state: ArrayLike, parameters: ArrayLike | None = None) -> FloatArray:
        """Returns k_1, k_1', ..., constraint-major, shape (sum r_i,)."""
        return self.residual_function(state, self.system.parameter_vector(parameters))[0]

    def is_consistent(self, state: ArrayLike, parameters: ArrayLike | None = None) -> bool:
        """Returns whether a state is on N* up to round-off: whether Newton's step is short.

        The arguments are those of `residual`.
        """
        x, p = self._state(state), self.system.parameter_vector(parameters)
        reach = float(self._first_steps.evaluate(x, p)[0][1])
        if isfinite(reach) and reach > 0.0:
            is_near = reach <= CONSISTENT * norm(x / self.scale) + FLOOR
            return is_near and not self._is_at_pole(x, p)
        # Dependent gradients, a residual of zero, or one that no state changes.
        return self.relative_size(x, p) <= CONSISTENT

    def project(
        self,
        state: ArrayLike,
        parameters: ArrayLike | None = None,
    ) -> FloatArray:
        """Returns the consistent state next to a state, to round-off, by Newton's method."""
        start, p = self._state(state), self.system.parameter_vector(parameters)
        found = self.projected(start, p)
        if self._is_at_pole(found, p):
            left = self.residual_function(found, p)[0]
            worst = int(np.argmax(np.abs(left)))
            raise InconsistentStateError(
                f"{self.system.name}: {self.residual_signals[worst].name} = {left[worst]:.3g} is "
                "left at a pole of the constraint, as where a rotation is half a turn off: start "
                "nearer to the constraint",
                left,
            )
        return found

    @np.errstate(all="ignore")  # Of a state that grew without bound.
    def _is_at_pole(self, x: FloatArray, p: FloatArray) -> bool:
        """Whether the residual is large though Newton's step is short.

        Near a pole the step is the distance to it. The residual then falls along the step, while it
        grows from a consistent state, whose own is round-off.
        """
        step = self._first_steps.evaluate(x, p)[2]
        length = norm(step / self.scale)
        if not (isfinite(length) and length > 0.0):
            return False
        here, there = (
            self.residual_function(state, p)[0] for state in (x, x + PROBE / length * step)
        )
        lengths = positive(np.linalg.norm(self.gradients(x, p) * self.scale, axis=1))
        return bool(norm(there / lengths) < norm(here / lengths))

    def projected(self, start: FloatArray, p: FloatArray) -> FloatArray:
        """Acts as `project`, without checks of arguments; returns the start if it is consistent."""
        moved = self.first_steps(start, p)
        if moved is None:
            return self.searched(start, p)
        return moved if moved is start else moved.copy()

    def first_steps(self, start: FloatArray, p: FloatArray) -> FloatArray | None:
        """Takes the first few Newton steps of `project`, without checks of arguments."""
        function = self._first_steps
        sizes, moved, _ = function.evaluate(start, p)
        outcome = sizes.item(0)
        if function.is_valid and outcome == FOUND:
            return moved
        return start if outcome == STAYS and function.is_finite else None

    def settle(self, state: ArrayLike, parameters: ArrayLike | None = None) -> FloatArray:
        """Returns the consistent state next to a user's start, computed level by level.

        The constraints are met first, by the states that they depend on; then their derivatives, by
        the states that are new in them, and so on: positions first, then velocities, so that no
        velocity moves a position. If this does not converge, `project` is used. Arguments, result
        and exceptions are those of `project`.
        """
        start, p = self._state(state), self.system.parameter_vector(parameters)
        if not self.residual_function.evaluate(start, p)[0].any():
            return start
        near = self.first_steps(start, p)
        if near is not None and 0.0 < self._first_steps.outputs[0][1] <= FLOOR:
            return self.project(start, p)  # It was there up to round-off, which no level moves.
        settled = self._settling.settled(start, p)
        return self.project(start if settled is None else settled, p)

    def _state(self, state: ArrayLike) -> FloatArray:
        """A state as a new array; its numbers need not be finite."""
        x = numbers(f"{self.system.name}: a state", state).reshape(-1)
        if x.size != self.system.num_states:
            raise ModelError(
                f"{self.system.name}: a state has shape ({self.system.num_states},), got {x.shape}"
            )
        return x
