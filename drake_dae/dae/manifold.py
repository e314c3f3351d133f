"""The manifold N* of consistent states, and the projection onto it.                 (4)"""

from collections.abc import Sequence
from functools import cached_property
from math import isfinite

import casadi as ca
import numpy as np
import scipy  # SciPy loads its large parts when they are used.
from numpy.typing import ArrayLike

from drake_dae.arrays import FloatArray, numbers
from drake_dae.dae.signals import DerivativeLayout, Indices, places_of
from drake_dae.dae.system import DaeSystem
from drake_dae.errors import InconsistentStateError, ModelError
from drake_dae.trace.factorization import PositiveDefiniteFactorization, nonzeros
from drake_dae.trace.functions import TracedFunction, count_operations
from drake_dae.trace.numerics import (
    PRECISION,
    ROUNDING,
    NewtonModel,
    are_dependent,
    equilibration,
    newton,
    norm,
    polished,
    rank_of,
    row_lengths,
    shortest_steps,
    unit_rows,
)

POLE = 1e-3  # A larger residual, over its usual change by the scale of the states, is no round-off.
NEAR_POLE = 1e-6, 1e-3  # The distances at which poles show, in states over their scale.
SEARCH = 200  # The largest number of steps where gradients are dependent; a dozen are enough.
RESTARTS = 12  # The number of random starts of `Manifold.settle`.
# A velocity is kept if no state moves further for it than so many times the size of the state.
FAR = 100.0
# A state counts as consistent, and is projected without a message, if its distance from N*
# relative to its size is at most this; where gradients are dependent, if its residual is.
CONSISTENT = 1e-8
# Rows of the residual, the states that are new in them, and how many further derivatives of these
# rows there are until the constraint inputs act.
Level = tuple[Indices, Indices, int]
FLOOR = 1e-12  # A distance from N* that is round-off even if all states are zero.


class Manifold:
    """The manifold N* = {x : L_f^k k_i(x) = 0, k = 0, ..., r_i - 1, i = 1, ..., m} (4)."""

    def __init__(self, system: DaeSystem, chains: Sequence[Sequence[ca.SX]]) -> None:
        self.system, self.scale = system, system.scale
        self.residual_expression = ca.vertcat(
            ca.SX(0, 1), *[ca.vertcat(*chain) for chain in chains]
        )  # (4)
        self.layout = DerivativeLayout(tuple(len(chain) for chain in chains))
        self.residual_signals = self.layout.chain_signals(system.constraint_output_signals)
        self.gradient = ca.jacobian(self.residual_expression, system.state)
        self.residual_function = system.trace("manifold", {"residual": self.residual_expression})
        outputs = {"gradient": self.gradient}
        self._gradient = system.trace("manifold gradient", outputs, often=False)
        usual = np.linalg.norm(self.gradients(system.nominal_state) * self.scale, axis=1)
        # Of the residuals: how much they change while the states change by their scale.
        self._usual = np.maximum(np.where(np.isfinite(usual).all(), usual, 0.0), 1.0)

    @property
    def dimension(self) -> int:
        """The dimension of N*, n - (r_1 + ... + r_m), Theorem 1.1."""
        return self.system.num_states - len(self.residual_signals)

    def residual(self, state: ArrayLike, parameters: ArrayLike | None = None) -> FloatArray:
        """Returns k_1, k_1', ..., constraint-major, shape (sum r_i,)."""
        return self.residual_function(state, self.system.parameter_vector(parameters))[0]

    def gradients(self, state: ArrayLike, parameters: ArrayLike | None = None) -> FloatArray:
        """Returns the gradients C of the residual at a state, shape (sum r_i, n)."""
        values = self._gradient(state, self.system.parameter_vector(parameters))[0]
        return values.reshape(-1, self.system.num_states)

    @cached_property
    def short_gradient(self) -> ca.SX:
        """`gradient`, in fewer operations where constraint forces are along the gradients."""
        system = self.system
        if set(self.layout.degrees) != {2}:
            return self.gradient
        slope, rate = ca.SX(system.num_constraints, system.num_states), 0 * system.state
        forces = system.frictional_contacts.without_friction(system.g)
        index = {entry.name(): i for i, entry in enumerate(ca.vertsplit(system.state))}
        moved = ca.SX(*slope.shape)
        for i, entry in enumerate(ca.vertsplit(system.f)):
            if entry.is_symbolic() and (j := index.get(entry.name())) is not None:
                rate[i], slope[:, i], moved[:, j] = entry, forces[j, :].T, forces[j, :].T
        further = ca.jtimes(ca.vec(ca.densify(slope)), system.state, rate)
        moved += ca.reshape(further, slope.shape)
        rows = zip(ca.vertsplit(slope), ca.vertsplit(moved), strict=True)
        short = ca.sparsify(ca.vertcat(*[row for pair in rows for row in pair]))
        is_shorter = count_operations(short) < count_operations(self.gradient)
        return short if is_shorter and system.agree(short, self.gradient) else self.gradient

    @cached_property
    def newton_step(self) -> TracedFunction:
        """The Newton step of least norm from a state, divided by the scale of the states.

        A function of the state, another state at which the gradients C are taken, and parameters:
        -(C S)' N^-1 residual, N = C S (C S)', with the scale S, and rows by their largest entries,
        whose squares may be too large for a number. An error of N^-1 only makes Newton slower.
        """
        other, state = ca.SX.sym("other", self.system.num_states), self.system.state
        gradient = ca.substitute(self.short_gradient, state, other)
        step = ca.SX(gradient.shape[1], 1)
        if gradient.shape[0]:
            scaled = ca.mtimes(gradient, ca.diag(ca.SX(self.scale)))
            largest = [ca.norm_inf(row) for row in ca.vertsplit(scaled)]
            sizes = ca.vertcat(*[ca.if_else(size > 0, size, 1) for size in largest])
            scaled = ca.sparsify(scaled / ca.repmat(sizes, 1, scaled.shape[1]))
            normal = PositiveDefiniteFactorization(ca.mtimes(scaled, scaled.T))
            # CasADi lets the infinities of constant gradients cancel each other.
            regular = ca.if_else(normal.pivot > 0, 0, ca.SX.nan())
            solved = normal.solve(self.residual_expression / sizes)
            step = regular - ca.mtimes(scaled.T, solved)
        return self.system.trace("step to the manifold", {"step": step}, {"other": other})

    @np.errstate(all="ignore")  # Iterates outside the domain are tried and rejected.
    def _relative_size(self, state: FloatArray, parameters: FloatArray) -> float:
        """The norm of the residual, each entry divided by its scaled gradient."""
        residual = self.residual_function.evaluate(state, parameters)[0]
        if not residual.any():
            return 0.0
        return norm(residual / row_lengths(self.gradients(state, parameters) * self.scale))

    @np.errstate(all="ignore")
    def _step(self, state: FloatArray, p: FloatArray) -> FloatArray | None:
        """The Newton step in scaled states; None where the gradients are dependent or infinite."""
        gradients = self.gradients(state, p) * self.scale
        steps = shortest_steps(gradients, lambda z: self.residual_function.evaluate(state, p)[0])
        if steps is None or not steps.is_regular:
            return None
        step = steps.step(state)
        return step if isfinite(norm(step)) else None

    def is_consistent(self, state: ArrayLike, parameters: ArrayLike | None = None) -> bool:
        """Returns whether a state is on N* up to round-off: whether Newton's step is short."""
        x, p = self._state(state), self.system.parameter_vector(parameters)
        step = self._step(x, p)
        if step is not None and norm(step) > 0.0:
            is_near = norm(step) <= CONSISTENT * norm(x / self.scale) + FLOOR
            return is_near and not self._is_at_pole(x, p)
        # Dependent gradients, a residual of zero, or one that no state changes.
        return self._relative_size(x, p) <= CONSISTENT and not self._is_at_pole(x, p)

    def project(self, state: ArrayLike, parameters: ArrayLike | None = None) -> FloatArray:
        """Returns the consistent state next to a state, to round-off, by Newton's method.

        Raises:
            InconsistentStateError: Newton's method does not reach N*.
        """
        p = self.system.parameter_vector(parameters)
        found = self.projected(self._state(state), p)
        if self._is_at_pole(found, p):
            why = "a pole of the constraint, as where a rotation is half a turn off"
            raise self._failed(found, p, f"{why}: start nearer to the constraint")
        return found

    @np.errstate(all="ignore")  # Iterates outside the domain are tried and rejected.
    def projected(self, start: FloatArray, p: FloatArray) -> FloatArray:
        """Acts as `project`, without checks; returns the start itself if it is consistent."""
        scale, step_from = self.scale, self.newton_step.evaluate
        step = step_from(start, start, p)[0]
        length = norm(step)
        if length <= ROUNDING and (length > 0.0 or not self.residual(start, p).any()):
            return start
        moved, unit = start + scale * step, np.maximum(scale, np.abs(start))
        size = norm(scale * step / unit)
        step = step_from(moved, start, p)[0]
        left = norm(scale * step / unit)
        if left * left <= PRECISION * size:  # The test of `newton`, without its overhead.
            return polished(moved, step, lambda x: step_from(x, start, p)[0], scale)

        def linearize(z: FloatArray) -> NewtonModel:
            x = scale * z
            return NewtonModel(lambda z: step_from(scale * z, x, p)[0].copy(), True)

        first = start / scale
        z, converged = newton(first, linearize)
        # Gradients are dependent, or steps diverge.
        found: FloatArray = scale * z if converged else self._downhill(start, p)
        # Otherwise the residual is round-off in coarse units, or no state changes it.
        if not converged and not self._relative_size(found, p) <= CONSISTENT:
            why = "the end of Newton's method: start nearer to the constraint"
            if are_dependent(self.gradients(found, p) * self.scale):
                why = (
                    "a state at which the gradients of the constraints depend on each other: the "
                    "constraints contradict each other, or start away from this state"
                )
            raise self._failed(found, p, why)
        step = step_from(found, found, p)[0]
        if converged or not np.isfinite(step).all():  # As where gradients are dependent.
            return found
        return polished(found, step, lambda x: step_from(x, found, p)[0], scale)

    def _downhill(self, start: FloatArray, p: FloatArray) -> FloatArray:
        """The end of least-squares steps, each of which decreases the residual."""
        length = row_lengths(self.gradients(start, p) * self.scale)
        if not (np.isfinite(length).all() and np.isfinite(self.residual(start, p)).all()):
            return start
        found = scipy.optimize.least_squares(
            lambda z: self.residual(self.scale * z, p) / length,
            start / self.scale,
            lambda z: self.gradients(self.scale * z, p) * self.scale / length[:, None],
            xtol=PRECISION * 10.0,
            ftol=None,
            gtol=None,
            max_nfev=SEARCH,
        )
        return np.asarray(self.scale * found.x)

    @np.errstate(all="ignore")  # Of a state that grew without bound.
    def _is_at_pole(self, x: FloatArray, p: FloatArray) -> bool:
        """Whether the residual is large, or not finite, though Newton's step may be short.

        At a pole it may be 0 by round-off; next to it, it is large and falls with the distance.
        """
        away = self.scale * np.random.default_rng(0).normal(size=x.size)
        left, near, far = (
            norm(self.residual_function.evaluate(state, p)[0] / self._usual)
            for state in (x, x + NEAR_POLE[0] * away, x + NEAR_POLE[1] * away)
        )
        return not left <= POLE or bool(near > 1.0 and near > far)

    def _failed(self, state: FloatArray, p: FloatArray, why: str) -> InconsistentStateError:
        """The exception for a search that ends at a state which is not consistent."""
        residual, names = self.residual(state, p), [each.name for each in self.residual_signals]
        worst = int(np.argmax(np.abs(residual)))
        text = (
            f"no consistent state found near the given one; {names[worst]} = "
            f"{residual[worst]:.3g} is left at {why}"
        )
        if not np.isfinite(residual).all():
            bad = ", ".join(names[i] for i in np.flatnonzero(~np.isfinite(residual)))
            text = f"{bad} is not finite at the given state; start inside the domain of "
            text += "the constraints"
        return InconsistentStateError(f"{self.system.name}: {text}", residual)

    def settle(
        self, state: ArrayLike, parameters: ArrayLike | None = None, fixed: Sequence[str] = ()
    ) -> FloatArray:
        """Returns the consistent state next to a user's start, level by level: positions first.

        Newton's method is used on each order of derivatives, by the states that are new in it:
        these change as impulses mu of the constraint inputs change them, dv = E^-1 g mu, and
        dq = (dq'/dv) E^-1 g mu. In a mechanical system this is the change of least kinetic energy,
        dv = M^-1 J^T mu, in which heavy bodies move little in any units, and coordinates on which
        no constraint force acts do not change. Where states keep their values, or impulses do not
        reach the constraint, steps are shortest relative to the scale of the states.
        """
        start, p = self._state(state), self.system.parameter_vector(parameters)
        named = places_of("state", fixed, self.system.state_signals, f"{self.system.name}: ")
        chosen = np.array(named, dtype=np.intp)
        residual = self.residual(start, p)
        if not residual.any():
            return start
        step = self._step(start, p)
        is_there = step is not None and 0.0 < norm(step) <= FLOOR
        if is_there and not self._is_at_pole(start, p):
            return self.project(start, p)  # It was there up to round-off, which no level moves.
        error = InconsistentStateError(
            f"{self.system.name}: no consistent state is found near the given one in which "
            f"{', '.join(fixed)} keep their values; fix fewer states, or give others",
            residual,
        )
        random, free = np.random.default_rng(0), np.setdiff1d(self._levels[0][1], chosen)
        for spread in (0.0, *np.geomspace(0.1, 3.0, RESTARTS)):
            moved = start.copy()
            moved[free] += spread * self.scale[free] * random.normal(size=free.size)
            try:
                found = self._settled(moved, p, chosen)
                if found is not None or not fixed:
                    return self.project(moved if found is None else found, p)
            except InconsistentStateError as failure:
                error = error if fixed or spread else failure
        raise error

    def _settled(self, start: FloatArray, p: FloatArray, chosen: Indices) -> FloatArray | None:
        """The state next to a start where chosen states, and if possible velocities, stay."""
        # The states that are new in derivatives of constraints and not 0, where others are 0.
        moving = [new[start[new] != 0.0] for _, new, _ in self._levels[1:] if not start[new].all()]
        wanted = np.unique(np.concatenate([chosen, *moving]))
        for kept in (wanted, chosen) if wanted.size > chosen.size else (chosen,):
            state = start.copy()
            if all(self._met(state, p, kept, level) for level in self._levels):
                far = norm((state - start) / self.scale)
                if kept is chosen or far <= FAR * norm(start / self.scale):
                    return state
        return None

    def _state(self, state: ArrayLike) -> FloatArray:
        """A state as a new array; its numbers need not be finite."""
        name, size = self.system.name, self.system.num_states
        x = numbers(f"{name}: a state", state).reshape(-1)
        if x.size != size:
            raise ModelError(f"{name}: a state has shape ({size},), got {x.shape}")
        return x

    @cached_property
    def _levels(self) -> list[Level]:
        """The levels, the farthest from the constraint inputs first, as positions are."""
        further = np.array(self.layout.degrees)[self.layout.owners] - 1 - self.layout.orders
        used, levels = nonzeros(self.gradient.sparsity()), list[Level]()
        taken = np.zeros(used.shape[1], dtype=bool)
        for depth in reversed(range(max(self.layout.degrees))):
            rows = np.flatnonzero(further == depth)
            new = used[rows].any(axis=0) & ~taken
            taken |= new
            levels.append((rows, np.flatnonzero(new), depth))
        return levels

    @cached_property
    def _impulses(self) -> tuple[TracedFunction, list[list[int]]]:
        """E^-1 g in the states that it moves, then the changes of states that follow from these."""
        system, inertia = self.system, PositiveDefiniteFactorization(self.system.mass_matrix)
        pushed, coupled = system.frictional_contacts.without_friction(system.g), system.mass_matrix
        taken, outputs = np.zeros(system.num_states, dtype=bool), dict[str, ca.SX]()
        groups = list[list[int]]()
        for depth in range(max(self.layout.degrees)):
            moved = nonzeros(pushed.sparsity()).any(axis=1)
            for _ in range(system.num_states):
                moved = moved | nonzeros(coupled.sparsity())[:, moved].any(axis=1)
            group, rest = (np.flatnonzero(each & ~taken).tolist() for each in (moved, ~moved))
            taken = taken | moved
            changes = inertia.solve(pushed)[group, :]
            outputs[f"change{depth}"] = ca.densify(changes)
            groups.append(group)
            pushed = ca.SX(*pushed.shape)
            pushed[rest, :] = ca.mtimes(ca.jacobian(system.f[rest], system.state[group]), changes)
        return system.trace("impulses", outputs, often=False), groups

    def _met(self, state: FloatArray, p: FloatArray, kept: Indices, level: Level) -> bool:
        """Changes new states that are not kept so that some rows of the residual vanish."""
        (rows, new, depth), (function, groups) = level, self._impulses
        columns = np.setdiff1d(np.union1d(new, groups[depth]), kept)
        scale, changes = self.scale[columns], np.zeros((state.size, self.system.num_constraints))

        def filled(z: FloatArray) -> FloatArray:
            x = state.copy()
            x[columns] = scale * z
            return x

        def residual(z: FloatArray) -> FloatArray:
            return self.residual(filled(z), p)[rows]

        def linearize(z: FloatArray) -> NewtonModel | None:
            x = filled(z)
            gradients = self.gradients(x, p)[np.ix_(rows, columns)] * scale
            changes[groups[depth]] = function.evaluate(x, p)[depth].reshape(len(groups[depth]), -1)
            along = changes[np.ix_(columns, self.layout.owners[rows])] / scale[:, None]
            matrix = gradients @ along
            is_kept = np.intersect1d(groups[depth], kept).size > 0
            if is_kept or not np.isfinite(matrix).all() or rank_of(matrix) < len(rows):
                return shortest_steps(gradients, residual)
            sizes, units = equilibration(matrix)
            inverse = np.linalg.inv(matrix / sizes[:, None] / units) / units[:, None] / sizes
            return NewtonModel(lambda z: -along @ (inverse @ residual(z)), True)

        if not columns.size:
            gradients = self.gradients(state, p)[rows] * self.scale
            allowed = CONSISTENT * np.linalg.norm(gradients, axis=1)
            return bool(np.all(np.abs(residual(np.zeros(0))) <= allowed))
        z, converged = newton(state[columns] / scale, linearize)
        state[columns] = scale * z
        return converged


def tangent(gradients: FloatArray, scale: FloatArray) -> FloatArray:
    """Returns a basis T of the tangent space, orthonormal in scaled states, shape (n, n - k)."""
    rows = unit_rows(gradients * scale)
    return scale[:, None] * np.linalg.svd(rows)[2][len(rows) :].T


def coordinates(gradients: FloatArray, scale: FloatArray) -> tuple[Indices, FloatArray]:
    """Returns n - k states that are coordinates, and the derivatives of all states by them."""
    basis = tangent(gradients, scale) / scale[:, None]
    count = basis.shape[1]
    free = np.sort(scipy.linalg.qr(basis.T, mode="r", pivoting=True)[1][:count])
    rest = np.setdiff1d(np.arange(scale.size), free)
    rows = unit_rows(gradients * scale)
    moved = np.zeros(basis.shape)
    moved[free] = np.eye(count)
    moved[rest] = -np.linalg.solve(rows[:, rest], rows[:, free])
    return free, scale[:, None] * moved / scale[free]
