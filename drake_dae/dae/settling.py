"""From a user's start to N* level by level: positions first, then velocities.

A mechanical system E x' = f + g v has constraint forces along the gradients of its constraints.
Their impulses change velocities by dv = M^-1 J^T mu, the change of least kinetic energy. Positions
change in the same way, dq = N M^-1 N^T J_q^T mu with q' = N v. So heavy bodies move little in any
units, and coordinates on which no constraint force acts do not change.
"""

from collections.abc import Callable
from functools import cached_property

import casadi as ca
import numpy as np

from drake_dae.arrays import FloatArray
from drake_dae.dae.signals import DerivativeLayout, Indices
from drake_dae.dae.system import DaeSystem
from drake_dae.trace.factorization import nonzeros
from drake_dae.trace.functions import TracedFunction
from drake_dae.trace.newton import NewtonModel, newton, shortest_steps, steps_along

# A function of the state and the parameters.
AtState = Callable[[FloatArray, FloatArray], FloatArray]
# Rows of the residual, the states that are new in them, and how many rates lead from velocities to
# these states; None if their steps do not take the least kinetic energy.
Level = tuple[Indices, Indices, int | None]
# A state counts as consistent, and is projected without a message, if its distance from N*
# relative to its size is at most this; where gradients are dependent, if its residual is.
CONSISTENT = 1e-8
# Constraint forces do no work if they are along the gradients to this, as the sine of an angle.
ALONG = 1e-6


class Settling:
    """Newton's method on each order of derivatives, by the states that are new in it.

    Where constraint forces do no work, as in a mechanism, its steps take the least kinetic energy;
    else they are shortest relative to the scale of the states.
    """

    def __init__(
        self,
        system: DaeSystem,
        layout: DerivativeLayout,
        gradient: ca.SX,
        gradients: AtState,
        residual: AtState,
    ) -> None:
        self._system, self._layout = system, layout
        self._gradients, self._residual = gradients, residual
        self._levels: list[Level] = []
        used = nonzeros(gradient.sparsity())
        taken = np.zeros(used.shape[1], dtype=bool)
        for order in range(max(layout.degrees, default=0)):
            rows = np.flatnonzero(layout.orders == order)
            new = used[rows].any(axis=0) & ~taken
            taken |= new
            self._levels.append((rows, np.flatnonzero(new), None))

    @property
    def places(self) -> Indices:
        """The states on which the constraints themselves depend, such as positions."""
        return self._levels[0][1] if self._levels else np.zeros(0, dtype=np.intp)

    def given_rates(self, start: FloatArray) -> Indices:
        """The states that are new in derivatives of constraints and not 0, where others are 0."""
        found = [np.zeros(0, dtype=np.intp)]
        for _, columns, _ in self._levels[1:]:
            given = columns[start[columns] != 0.0]
            found += [given] if given.size < columns.size else []
        return np.concatenate(found)

    def settled(
        self, start: FloatArray, parameters: FloatArray, kept: Indices
    ) -> FloatArray | None:
        """The consistent state next to one, with some states kept; None if there is none near."""
        ways = [self._levels]
        if self._does_no_work(start, parameters):
            # The number of further derivatives of a row until the constraint inputs act.
            degrees, orders = self._layout.degrees, self._layout.orders
            further = np.repeat(degrees, degrees).astype(int) - 1 - orders
            kinetic: list[Level] = [
                (np.flatnonzero(further == depth), self._groups[depth], depth)
                for depth in reversed(range(len(self._groups)))
                if np.any(further == depth)
            ]
            ways = [kinetic, self._levels]
        for levels in ways:
            state = start.copy()
            if all(self._met(state, parameters, kept, *level) for level in levels):
                return state
        return None

    def _met(
        self,
        state: FloatArray,
        parameters: FloatArray,
        kept: Indices,
        rows: Indices,
        new: Indices,
        depth: int | None,
    ) -> bool:
        """Changes new states that are not kept so that some rows of the residual vanish."""
        columns = np.setdiff1d(new, kept)
        scale = self._system.scale[columns]

        def filled(z: FloatArray) -> FloatArray:
            x = state.copy()
            x[columns] = scale * z
            return x

        def residual(z: FloatArray) -> FloatArray:
            return self._residual(filled(z), parameters)[rows]

        def linearize(z: FloatArray) -> NewtonModel | None:
            x = filled(z)
            gradients = self._gradients(x, parameters)[np.ix_(rows, columns)]
            if depth is None or columns.size < new.size:
                return shortest_steps(gradients * scale, residual)
            # W^-1 C^T, where W is the metric of the states of this level.
            mass, _, *rates = self._metric_at(x, parameters)
            moved: FloatArray = gradients.T
            for rate in reversed(rates[:depth]):
                moved = rate.T @ moved
            moved = np.asarray(np.linalg.solve(mass, moved), dtype=np.float64)
            for rate in rates[:depth]:
                moved = rate @ moved
            return steps_along(gradients * scale, moved / scale[:, None], residual)

        if not columns.size:
            gradients = self._gradients(state, parameters)[rows] * self._system.scale
            allowed = CONSISTENT * np.linalg.norm(gradients, axis=1)
            return bool(np.all(np.abs(residual(np.zeros(0))) <= allowed))
        z, converged = newton(state[columns] / scale, linearize)
        state[columns] = scale * z
        return converged

    @cached_property
    def _groups(self) -> list[Indices]:
        """The states whose rates contain constraint inputs, then those that depend on these."""
        system = self._system
        mass = nonzeros(system.mass_matrix.sparsity())
        moved = nonzeros(system.g.sparsity()).any(axis=1)
        for _ in range(system.num_states):
            moved = moved | mass[:, moved].any(axis=1)
        of_one = [bool(entry.is_one()) for entry in ca.vertsplit(ca.diag(system.mass_matrix))]
        plain = (mass.sum(axis=1) == 1) & np.array(of_one)
        uses = nonzeros(ca.jacobian_sparsity(system.f, system.state))
        groups, following, taken = list[Indices](), moved, moved
        while following.any() and len(groups) < max(self._layout.degrees, default=0):
            groups.append(np.flatnonzero(following))
            following = uses[:, groups[-1]].any(axis=1) & ~taken & plain
            taken = taken | following
        return groups

    @cached_property
    def _metric(self) -> tuple[TracedFunction, list[tuple[int, int]]]:
        """M, the forces along velocities, and dq'/dv, d(q')/dq, ...; and their shapes."""
        system, groups = self._system, [group.tolist() for group in self._groups]
        moving = groups[0]
        forces = system.frictional_contacts.without_friction(system.g)[moving, :]
        outputs = {"mass": system.mass_matrix[moving, moving], "forces": forces}
        for depth in range(1, len(groups)):
            rates, by = system.f[groups[depth]], system.state[groups[depth - 1]]
            outputs[f"rate{depth}"] = ca.jacobian(rates, by)
        dense = {name: ca.densify(value) for name, value in outputs.items()}
        shapes = [value.shape for value in outputs.values()]
        return system.trace("kinetic metric", dense, often=False), shapes

    def _metric_at(self, state: FloatArray, parameters: FloatArray) -> list[FloatArray]:
        function, shapes = self._metric
        values = zip(function.evaluate(state, parameters), shapes, strict=True)
        return [value.copy().reshape(shape) for value, shape in values]

    def _does_no_work(self, state: FloatArray, parameters: FloatArray) -> bool:
        """Whether all constraint forces are along their gradients at a state."""
        if not len(self._groups) == max(self._layout.degrees, default=0) > 0:
            return False
        forces = self._metric_at(state, parameters)[1]
        gradients = self._gradients(state, parameters)
        across = gradients[np.ix_(self._layout.ends, self._groups[0])].T
        lengths = np.linalg.norm(across, axis=0), np.linalg.norm(forces, axis=0)
        if not all(np.all(np.isfinite(length)) and np.all(length > 0.0) for length in lengths):
            return False
        basis, unit = across / lengths[0], forces / lengths[1]
        residual = unit - basis @ np.linalg.lstsq(basis, unit, rcond=None)[0]
        return bool(np.max(np.abs(residual)) <= ALONG)
