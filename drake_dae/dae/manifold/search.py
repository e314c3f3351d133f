"""The consistent state next to one from which the first Newton steps do not converge."""

import numpy as np

from drake_dae.arrays import FloatArray
from drake_dae.dae.manifold.first_steps import FOUND
from drake_dae.dae.manifold.residual import Residual
from drake_dae.errors import InconsistentStateError
from drake_dae.trace.functions import TracedFunction
from drake_dae.trace.newton import (
    NewtonModel,
    newton,
    shortest_steps,
)
from drake_dae.trace.round_off import are_dependent, positive

CONSISTENT = 1e-8
"""A state counts as consistent, and is projected without a message, if its distance from N*
relative to its size is at most this; where gradients are dependent, if its residual is."""


class ConsistentStateSearch:
    """Searches a consistent state by Newton's method, then by least squares."""

    def __init__(self, residual: Residual, first_steps: TracedFunction) -> None:
        self._residual, self._first_steps = residual, first_steps

    def searched(self, start: FloatArray, p: FloatArray) -> FloatArray:
        """Acts as `project` from a state from which `first_steps` did not converge."""
        function = self._first_steps
        sizes, moved, _ = function.evaluate(start, p)
        is_finite = function.is_finite
        if (
            is_finite
            and sizes.item(1) == 0.0
            and not self._residual.residual_function.evaluate(start, p)[0].any()
        ):
            return start
        if is_finite and sizes.item(0) == FOUND:
            return moved.copy()
        scale = self._residual.scale
        z, converged = newton(start / scale, lambda z: self._linearize(scale * z, p))
        if not converged:
            # Gradients are dependent or steps diverge: least squares with decreasing residual.
            z, converged = newton(start / scale, lambda z: self._downhill(scale * z, p))
        state = scale * z
        if converged and not np.array_equal(state, start):
            return state
        # Otherwise the residual is round-off in coarse units, or no state changes it.
        if self._residual.relative_size(state, p) <= CONSISTENT:
            return state
        residual = self._residual.residual_function.evaluate(state, p)[0].copy()
        if converged and self._first_steps.evaluate(state, p)[1].any():
            return state
        raise InconsistentStateError(self._why(state, p, residual), residual)

    def _linearize(self, state: FloatArray, parameters: FloatArray) -> NewtonModel:
        """Newton steps of least norm by the gradients at a state, in states over their scale."""
        scale = self._residual.scale
        return NewtonModel(
            lambda z: self._residual.newton_step.evaluate(scale * z, state, parameters)[0].copy(),
            is_regular=True,
        )

    def _downhill(self, state: FloatArray, parameters: FloatArray) -> NewtonModel | None:
        """Least-squares steps that decrease the residual; its rows are scaled to length one."""
        scale = self._residual.scale
        gradients = self._residual.gradients(state, parameters) * scale
        length = positive(np.linalg.norm(gradients, axis=1))

        def residual(z: FloatArray) -> FloatArray:
            return self._residual.residual_function(scale * z, parameters)[0]

        def measure(z: FloatArray) -> float:
            return float(np.linalg.norm(residual(z) / length))

        steps = shortest_steps(gradients, residual)
        return None if steps is None else steps._replace(measure=measure)

    def _why(self, state: FloatArray, parameters: FloatArray, residual: FloatArray) -> str:
        """Returns in words why a Newton iteration that ended at a state failed."""
        name = self._residual.system.name
        values = zip(self._residual.residual_signals, residual, strict=True)
        bad = [signal.name for signal, value in values if not np.isfinite(value)]
        if bad:
            return (
                f"{name}: {', '.join(bad)} is not finite at the given state; start inside the "
                "domain of the constraints"
            )
        worst = int(np.argmax(np.abs(residual)))
        text = (
            f"{name}: no consistent state found near the given one; "
            f"{self._residual.residual_signals[worst].name} = {residual[worst]:.3g} is left where "
            "Newton's method ends. "
        )
        if are_dependent(self._residual.gradients(state, parameters) * self._residual.scale):
            return text + (
                "The gradients of the constraints depend on each other there: the constraints "
                "contradict each other, or start away from this state"
            )
        return text + "Start nearer to the constraint, away from its singular states"
