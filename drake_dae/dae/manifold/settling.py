"""From a user's start to N* level by level: positions first, then velocities.

A mechanical system E x' = f + g v has constraint forces along the gradients of its constraints.
Their impulses change velocities by dv = M^-1 J^T mu, the change of least kinetic energy. Positions
change in the same way, dq = N M^-1 N^T J_q^T mu with q' = N v. So heavy bodies move little in any
units, and coordinates on which no constraint force acts do not change.
"""

from functools import cached_property
from typing import TYPE_CHECKING, Any

import casadi as ca
import numpy as np

from drake_dae.arrays import FloatArray
from drake_dae.dae.signals import DerivativeLayout, Indices
from drake_dae.dae.system import DaeSystem
from drake_dae.trace.factorization import nonzeros
from drake_dae.trace.newton import NewtonModel, newton, shortest_steps, steps_along

if TYPE_CHECKING:
    from drake_dae.dae.manifold.manifold import Manifold

CONSISTENT = 1e-8
"""A state counts as consistent, and is projected without a message, if its distance from N*
relative to its size is at most this; where gradients are dependent, if its residual is."""

ALONG = 1e-6
"""Constraint forces do no work if they are along the gradients to this, as the sine of an angle."""


class KineticMetric:
    """The directions in which states move onto N* with least kinetic energy."""

    def __init__(self, system: DaeSystem, layout: DerivativeLayout) -> None:
        self._system = system
        orders, degrees = layout.orders, np.array(layout.degrees, dtype=int)
        owners = np.repeat(np.arange(degrees.size), degrees)
        # The number of further derivatives of a row until the constraint inputs act.
        further = degrees[owners] - 1 - orders if degrees.size else np.zeros(0, dtype=int)
        groups = _groups(system, int(max(degrees, default=0)))
        self.levels: list[tuple[Indices, Indices, int]] = [
            (np.flatnonzero(further == depth), groups[depth], depth)
            for depth in reversed(range(len(groups)))
            if np.any(further == depth)
        ]
        self._last = np.flatnonzero(further == 0)
        self.is_known = len(groups) == int(max(degrees, default=0)) and bool(groups)
        if not self.is_known:
            return
        moving = groups[0].tolist()
        forces = system.frictional_contacts.without_friction(system.g)[moving, :]
        outputs = {
            "mass": ca.densify(system.mass_matrix[moving, moving]),
            "forces": ca.densify(forces),
        }
        for depth in range(1, len(groups)):
            rates, by = system.f[groups[depth].tolist()], system.state[groups[depth - 1].tolist()]
            outputs[f"rate{depth}"] = ca.densify(ca.jacobian(rates, by))
        self._groups = groups
        self._function = system.trace("kinetic metric", outputs, often=False)

    def does_no_work(
        self, state: FloatArray, parameters: FloatArray, gradients: FloatArray
    ) -> bool:
        """Returns whether all constraint forces are along their gradients at a state."""
        if not self.is_known:
            return False
        forces = self._values(state, parameters)[1]
        across = gradients[np.ix_(self._last, self._groups[0])].T
        lengths = np.linalg.norm(across, axis=0), np.linalg.norm(forces, axis=0)
        if not all(np.all(np.isfinite(length)) and np.all(length > 0.0) for length in lengths):
            return False
        basis, unit = across / lengths[0], forces / lengths[1]
        residual = unit - basis @ np.linalg.lstsq(basis, unit, rcond=None)[0]
        return bool(np.max(np.abs(residual)) <= ALONG)

    def directions(
        self, state: FloatArray, parameters: FloatArray, gradient: FloatArray, depth: int
    ) -> FloatArray:
        """Returns W^-1 C^T of some rows of C, where W is the metric of the states of a level."""
        mass, _, *rates = self._values(state, parameters)
        moved: FloatArray = gradient.T
        for rate in reversed(rates[:depth]):
            moved = rate.T @ moved
        moved = np.asarray(np.linalg.solve(mass, moved), dtype=np.float64)
        for rate in rates[:depth]:
            moved = rate @ moved
        return moved

    def _values(self, state: FloatArray, parameters: FloatArray) -> list[FloatArray]:
        sizes = [group.size for group in self._groups]
        shapes = [(sizes[0], sizes[0]), (sizes[0], self._system.num_constraints)]
        shapes += list(zip(sizes[1:], sizes[:-1], strict=True))
        values = self._function.evaluate(state, parameters)
        return [value.copy().reshape(shape) for value, shape in zip(values, shapes, strict=True)]


def _groups(system: DaeSystem, count: int) -> list[Indices]:
    """Returns the states whose rates contain constraint inputs, then those that depend on these."""
    mass = nonzeros(system.mass_matrix.sparsity())
    moved = nonzeros(system.g.sparsity()).any(axis=1)
    while True:
        both = moved | mass[:, moved].any(axis=1)
        if np.array_equal(both, moved):
            break
        moved = both
    plain = np.array(
        [
            mass[i].sum() == 1 and bool(system.mass_matrix[i, i].is_one())
            for i in range(system.num_states)
        ]
    )
    uses = nonzeros(ca.jacobian_sparsity(system.f, system.state))
    groups, taken = [np.flatnonzero(moved)], moved.copy()
    while len(groups) < count:
        following = uses[:, groups[-1]].any(axis=1) & ~taken & plain
        if not following.any():
            break
        groups.append(np.flatnonzero(following))
        taken |= following
    return groups if moved.any() else []


class Settling:
    """Newton's method on each order of derivatives, by the states that are new in it.

    Where constraint forces do no work, as in a mechanism, its steps take the least kinetic energy,
    see `KineticMetric`; else they are shortest relative to the scale of the states.
    """

    def __init__(self, manifold: "Manifold") -> None:
        self._manifold = manifold
        # The rows of each order of derivatives, and the states that are new in them.
        self._levels: list[tuple[Indices, Indices]] = []
        used = nonzeros(manifold.gradient.sparsity())
        taken = np.zeros(used.shape[1], dtype=bool)
        for order in range(max(manifold.layout.degrees, default=0)):
            rows = np.flatnonzero(manifold.layout.orders == order)
            new = used[rows].any(axis=0) & ~taken
            taken |= new
            self._levels.append((rows, np.flatnonzero(new)))

    @cached_property
    def _kinetic(self) -> KineticMetric:
        return KineticMetric(self._manifold.system, self._manifold.layout)

    def settled(
        self, start: FloatArray, parameters: FloatArray, kept: Indices
    ) -> FloatArray | None:
        """The consistent state next to one, with some states kept; None if there is none near."""
        kinetic, ways = self._kinetic, list[list[tuple[Indices, Indices, Any]]]()
        if kinetic.does_no_work(start, parameters, self._manifold.gradients(start, parameters)):
            ways.append([(rows, of, (kinetic, depth)) for rows, of, depth in kinetic.levels])
        for levels in [*ways, [(rows, of, None) for rows, of in self._levels]]:
            state = start.copy()
            moves = (
                _settle_level(
                    self._manifold,
                    state,
                    rows,
                    np.setdiff1d(columns, kept),
                    parameters,
                    None if np.isin(columns, kept).any() else energy,
                )
                for rows, columns, energy in levels
            )
            if all(moves):
                return state
        return None

    def given_rates(self, start: FloatArray) -> Indices:
        """The states that are new in derivatives of constraints, as velocities, where some are 0.

        Those that are not 0 are given, and the others may follow.
        """
        found = [np.zeros(0, dtype=np.intp)]
        for _, columns in self._levels[1:]:
            given = columns[start[columns] != 0.0]
            found += [given] if given.size < columns.size else []
        return np.concatenate(found)

    @property
    def places(self) -> Indices:
        """The states on which the constraints themselves depend, such as positions."""
        return self._levels[0][1] if self._levels else np.zeros(0, dtype=np.intp)


def _settle_level(
    manifold: "Manifold",
    state: FloatArray,
    rows: Indices,
    columns: Indices,
    parameters: FloatArray,
    energy: tuple[KineticMetric, int] | None = None,
) -> bool:
    """Changes some states so that some rows of the residual vanish; returns whether they do."""
    scale = manifold.scale[columns]

    def filled(z: FloatArray) -> FloatArray:
        x = state.copy()
        x[columns] = scale * z
        return x

    def level_residual(z: FloatArray) -> FloatArray:
        return manifold.residual_function(filled(z), parameters)[0][rows]

    def linearize(z: FloatArray) -> NewtonModel | None:
        x = filled(z)
        gradients = manifold.gradients(x, parameters)[np.ix_(rows, columns)]
        if energy is None:
            return shortest_steps(gradients * scale, level_residual)
        kinetic, depth = energy
        directions = kinetic.directions(x, parameters, gradients, depth)
        return steps_along(gradients * scale, directions / scale[:, None], level_residual)

    if not columns.size:
        lengths = np.linalg.norm(
            manifold.gradients(state, parameters)[rows] * manifold.scale, axis=1
        )
        return bool(np.all(np.abs(level_residual(state[columns])) <= CONSISTENT * lengths))
    z, converged = newton(state[columns] / scale, linearize)
    state[columns] = scale * z
    return converged
