"""From a user's start to N* level by level: positions first, then velocities."""

from functools import cached_property

import casadi as ca
import numpy as np

from drake_dae.arrays import FloatArray
from drake_dae.dae.kinetic_metric import KineticMetric
from drake_dae.dae.manifold.residual import Residual
from drake_dae.dae.system.layout import DerivativeLayout, Indices
from drake_dae.dae.system.system import DaeSystem
from drake_dae.trace.factorization import nonzeros
from drake_dae.trace.newton import NewtonModel, newton, shortest_steps, steps_along


class Settling:
    """Newton's method on each order of derivatives, by the states that are new in it.

    Where constraint forces do no work, as in a mechanism, its steps take the least kinetic energy,
    see `KineticMetric`; else they are shortest relative to the scale of the states.
    """

    def __init__(self, system: DaeSystem, residual: Residual) -> None:
        self._system, self._residual = system, residual
        self._levels = _levels(residual.layout, residual.gradient)

    @cached_property
    def _kinetic(self) -> KineticMetric:
        return KineticMetric(self._system, self._residual.layout)

    def settled(self, start: FloatArray, parameters: FloatArray) -> FloatArray | None:
        """The consistent state next to one, to round-off; None if the method does not converge."""
        kinetic = self._kinetic
        if kinetic.does_no_work(start, parameters, self._residual.gradients(start, parameters)):
            state = start.copy()
            moves = (
                _settle_level(self._residual, state, rows, columns, parameters, (kinetic, depth))
                for rows, columns, depth in kinetic.levels
            )
            if all(moves):
                return state
        state = start.copy()
        moves = (_settle_level(self._residual, state, *level, parameters) for level in self._levels)
        return state if all(moves) else None


def _settle_level(
    residual: Residual,
    state: FloatArray,
    rows: Indices,
    columns: Indices,
    parameters: FloatArray,
    energy: tuple[KineticMetric, int] | None = None,
) -> bool:
    """Changes some states so that some rows of the residual vanish; returns whether they do."""
    scale = residual.scale[columns]

    def filled(z: FloatArray) -> FloatArray:
        x = state.copy()
        x[columns] = scale * z
        return x

    def level_residual(z: FloatArray) -> FloatArray:
        return residual.residual_function(filled(z), parameters)[0][rows]

    def linearize(z: FloatArray) -> NewtonModel | None:
        x = filled(z)
        gradients = residual.gradients(x, parameters)[np.ix_(rows, columns)]
        if energy is None:
            return shortest_steps(gradients * scale, level_residual)
        kinetic, depth = energy
        directions = kinetic.directions(x, parameters, gradients, depth)
        return steps_along(gradients * scale, directions / scale[:, None], level_residual)

    z, converged = newton(state[columns] / scale, linearize)
    state[columns] = scale * z
    return converged


def _levels(layout: DerivativeLayout, gradient: ca.SX) -> list[tuple[Indices, Indices]]:
    """The rows of each order of derivatives, and the states that are new in them."""
    used = nonzeros(gradient.sparsity())
    taken = np.zeros(gradient.shape[1], dtype=bool)
    levels = []
    for order in range(max(layout.degrees, default=0)):
        rows = np.flatnonzero(layout.orders == order)
        new = used[rows].any(axis=0) & ~taken
        taken |= new
        levels.append((rows, np.flatnonzero(new)))
    return levels
