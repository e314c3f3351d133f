"""The manifold N* of consistent states, and the projection onto it.                 (4)"""

from collections.abc import Sequence
from math import isfinite

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from drake_dae.arrays import FloatArray
from drake_dae.dae.system import DaeSystem
from drake_dae.errors import InconsistentStateError
from drake_dae.trace.functions import TracedFunction
from drake_dae.trace.newton import DEPENDENT, ROUND_OFF, are_dependent

CONSISTENT = 1e-8
"""A state is taken as consistent, and mended silently, if it is this near to N*, relative to its
size; or, where gradients depend on each other, if its residual is at most this."""


FLOOR = 1e-12
"""A distance from N* that is round-off of states that are zero."""


class Manifold:
    """N* = {x : L_f^k k_i(x) = 0, k = 0, ..., r_i - 1, i = 1, ..., m}, equation (4).

    Args:
        system: (1)-(3).
        chains: Per constraint k_i, L_f k_i, ..., L_f^(r_i - 1) k_i, so that the residual is
            constraint-major.
    """

    def __init__(self, system: DaeSystem, chains: Sequence[Sequence[ca.SX]]) -> None:
        self.system = system
        self.residual_expression = ca.vertcat(ca.SX(0, 1), *[ca.vertcat(*c) for c in chains])
        self.residual_signals = tuple(
            signal.derivative(order)
            for signal, chain in zip(system.constraint_output_signals, chains, strict=True)
            for order in range(len(chain))
        )
        residual = self.residual_expression
        gradient = ca.jacobian(residual, system.state)
        if residual.numel():
            # The Newton step of least norm, from C' = Q R: dx = -Q R^-T r.
            q, r = ca.qr(gradient.T)
            step = -ca.mtimes(q, ca.solve(r.T, residual))
        else:
            step = ca.SX(system.num_states, 1)
        inputs = {"state": system.state, "parameters": system.parameter_symbol}
        self._newton = TracedFunction(
            f"{system.name} manifold",
            inputs,
            {
                "residual": residual,
                "step": step,
                "sizes": ca.vertcat(ca.norm_2(residual), ca.norm_2(step)),
            },
        )
        self._gradient = TracedFunction(
            f"{system.name} manifold gradient", inputs, {"gradient": gradient}, often=False
        )
        self._defaults = system.parameter_values

    @property
    def dimension(self) -> int:
        """n - (r_1 + ... + r_m), Theorem 1.1."""
        return self.system.num_states - int(self.residual_expression.numel())

    def residual(self, state: ArrayLike, parameters: ArrayLike | None = None) -> FloatArray:
        """The constraint outputs and their derivatives, shape (sum r_i,), constraint-major."""
        return self._newton(state, self._defaults if parameters is None else parameters)[0]

    def is_consistent(self, state: ArrayLike, parameters: ArrayLike | None = None) -> bool:
        """Whether a state is on N* up to round-off: Newton's step to it is short, in any unit.

        Args:
            state: Shape (n,).
            parameters: Values of all parameters; the defaults if None.
        """
        p = self._defaults if parameters is None else parameters
        _, _, (norm, reach) = self._newton(state, p)
        # A step of exactly zero with something left: no state changes it.
        if isfinite(reach) and (reach > 0.0 or norm == 0.0):
            return bool(reach <= CONSISTENT * float(np.linalg.norm(state)) + FLOOR)
        return bool(norm <= CONSISTENT)

    def project(
        self, state: ArrayLike, parameters: ArrayLike | None = None, iterations: int = 100
    ) -> FloatArray:
        """The consistent state next to a given one, to round-off, by Newton's method.

        Args:
            state: Shape (n,), near N*.
            parameters: Values of all parameters; the defaults if None.
            iterations: How many Newton steps to try.

        Returns:
            Shape (n,).

        Raises:
            InconsistentStateError: Newton's method does not reach N* from there.
        """
        x = np.array(state, dtype=float).reshape(-1)
        p = self._defaults if parameters is None else np.asarray(parameters, dtype=float)
        residual, step, (norm, reach) = self._newton(x, p)
        length, mended = 1.0, False
        for _ in range(iterations):
            if norm == 0.0 or not isfinite(norm):
                break
            trial = x + length * step
            new_residual, new_step, (new_norm, new_reach) = self._newton.evaluate(trial, p)
            if new_norm < norm:
                x, norm, reach, length, mended = trial, new_norm, new_reach, 1.0, False
                residual[:], step[:] = new_residual, new_step
            elif mended and norm <= CONSISTENT:
                break
            elif mended:
                length /= 2.0
            elif 0.0 < reach <= ROUND_OFF * max(1.0, float(np.linalg.norm(x))):
                return x
            else:
                # Where gradients depend on each other, QR gives no step, but least squares do.
                step[:] = _least_squares_step(self._gradients(x, p), residual)
                mended = True
        if norm <= CONSISTENT:
            return x
        raise InconsistentStateError(self._why(x, p, residual, iterations), residual)

    def _gradients(self, state: FloatArray, parameters: FloatArray) -> FloatArray:
        """C = d(residual)/dx, shape (sum r_i, n)."""
        return self._gradient(state, parameters)[0].reshape(-1, self.system.num_states)

    def _why(
        self, state: FloatArray, parameters: FloatArray, residual: FloatArray, iterations: int
    ) -> str:
        """What a Newton iteration that ended at a state failed on."""
        name = self.system.name
        bad = [
            signal.name
            for signal, value in zip(self.residual_signals, residual, strict=True)
            if not np.isfinite(value)
        ]
        if bad:
            return (
                f"{name}: {', '.join(bad)} is not finite at the given state; start inside the "
                "domain of the constraints"
            )
        worst = int(np.argmax(np.abs(residual)))
        left = (
            f"{name}: no consistent state found near the given one; "
            f"{self.residual_signals[worst].name} = {residual[worst]:.3g} is left after "
            f"{iterations} Newton steps. "
        )
        if are_dependent(self._gradients(state, parameters)):
            return left + (
                "The gradients of the constraints depend on each other where the search ended: "
                "the constraints contradict each other, or start away from this state"
            )
        return left + "Start nearer to the constraint, away from its singular states"


def _least_squares_step(gradients: FloatArray, residual: FloatArray) -> FloatArray:
    """The shortest dx that makes C dx + r smallest, with the rows of C scaled to length one."""
    length = np.linalg.norm(gradients, axis=1)
    length[length == 0.0] = 1.0
    if not np.all(np.isfinite(length)):
        return np.zeros(gradients.shape[1])
    solution = np.linalg.lstsq(gradients / length[:, None], -residual / length, rcond=DEPENDENT)
    return np.asarray(solution[0])
