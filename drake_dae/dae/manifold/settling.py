"""From a start that someone gave to N* level by level: positions first, then velocities."""

import casadi as ca
import numpy as np

from drake_dae.arrays import FloatArray
from drake_dae.dae.manifold.residual import Residual
from drake_dae.dae.system.layout import Indices, Layout
from drake_dae.trace.factorization import nonzeros
from drake_dae.trace.newton import Linearization, newton, shortest_steps


class Settling:
    """Newton's method on each order of derivatives, by the states that are new in it.

    Args:
        residual: What is zero on N*.
    """

    def __init__(self, residual: Residual) -> None:
        self._residual = residual
        self._levels = _levels(residual.layout, residual.gradient)

    def settled(self, start: FloatArray, parameters: FloatArray) -> FloatArray | None:
        """A state next to one, to round-off on N*; None where that leads nowhere."""
        found = start.copy()
        for rows, columns in self._levels:
            if not _settle_level(self._residual, found, rows, columns, parameters):
                return None
        return found


def _settle_level(
    residual: Residual, state: FloatArray, rows: Indices, columns: Indices, parameters: FloatArray
) -> bool:
    """Moves some states so that some rows of the residual vanish, and says whether they do."""
    scale = residual.scale[columns]

    def filled(z: FloatArray) -> FloatArray:
        x = state.copy()
        x[columns] = scale * z
        return x

    def linearize(z: FloatArray) -> Linearization | None:
        gradients = residual.gradients(filled(z), parameters)[np.ix_(rows, columns)]
        return shortest_steps(
            gradients * scale, lambda z: residual.function(filled(z), parameters)[0][rows]
        )

    z, converged = newton(state[columns] / scale, linearize)
    state[columns] = scale * z
    return converged


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
