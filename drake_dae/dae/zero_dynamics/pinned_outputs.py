"""States whose outputs are on a reference, and their motion.                        (28), (35)

Pinned outputs leave the states

    Z(R) = {x in N*: L_f*^j l*_i(x) = r_i^(j), j = 0, ..., mu_i - 1},

and the control u = B^-1 (-a + r^(mu)), which is (28) without an error; with more controls than
outputs, the system's metric chooses u. On Z(R) the state moves by x' = f* + h* u.
"""

from dataclasses import dataclass
from functools import cached_property

import casadi as ca
import numpy as np

from drake_dae.arrays import FloatArray, show
from drake_dae.dae.manifold.manifold import CONSISTENT, coordinates, tangent
from drake_dae.dae.structure.structure import Structure
from drake_dae.dae.system.layout import Indices
from drake_dae.errors import InconsistentStateError
from drake_dae.trace.functions import SINGULAR_PIVOT, TracedFunction
from drake_dae.trace.newton import NewtonModel, newton, shortest_steps

VANISHED = 1e-9
"""A or B counts as singular below this fraction of its usual margin, also if it is a single
number."""


@dataclass(frozen=True, eq=False)
class PinnedPoint:
    """A state on Z(R) with x', u, v, A of Assumption (2) and B of (5), which may be infinite.

    `pivot` is 0 exactly where A or B is singular; `unrest` is |E x'| relative to its terms.
    """

    state: FloatArray
    rate: FloatArray
    control: FloatArray
    constraint_input: FloatArray
    A: FloatArray
    B: FloatArray
    pivot: FloatArray
    unrest: FloatArray

    @cached_property
    def margins(self) -> tuple[float, float]:
        """The smallest singular values of A and B; infinite without constraints."""

        def margin(matrix: FloatArray) -> float:
            if matrix.size == 1:  # A(x) of one contact; LAPACK takes twenty times as long.
                return abs(matrix.item())
            values = np.linalg.svd(matrix, compute_uv=False)
            return float(np.min(values, initial=np.inf))

        return margin(self.A), margin(self.B)

    @cached_property
    def signs(self) -> tuple[float, ...]:
        """The signs of det A and det B; a matrix that is not square has none."""
        matrices = [matrix for matrix in (self.A, self.B) if len(matrix) == matrix.shape[1]]
        return tuple(float(np.linalg.slogdet(matrix)[0]) for matrix in matrices)


class PinnedOutputs:
    """Z(R) and the motion on it. R is a `reference` vector by `layout`."""

    def __init__(self, structure: Structure) -> None:
        self.structure = structure
        self.system = system = structure.system
        self.layout = layout = structure.layout
        self._R = goal = ca.SX.sym("R", layout.reference_size)
        self.residual_signals = (
            *structure.manifold.residual_signals,
            *layout.chain_signals(system.output_signals),
        )
        errors = structure.chain - goal[layout.chained.tolist(), :]
        residual = ca.vertcat(structure.manifold.residual_expression, errors)  # (36)
        derivatives, highest = structure.derivatives, goal[layout.highest.tolist(), :]
        control, pivot = structure.control_by_matrix(highest)
        self._rate, constraint_input = (  # (35)
            ca.substitute(derivatives.expand(unknown), derivatives.control, control)
            for unknown in (derivatives.rate, derivatives.constraint_input)
        )
        self._moved = ca.vertcat(constraint_input, control)
        self._inputs = {"reference": goal}
        self._residual = system.trace("pinned outputs", {"residual": residual}, self._inputs)
        self._gradient = system.trace(
            "gradient of the pinned outputs",
            {"gradient": ca.jacobian(ca.cse(residual), system.state)},
            often=False,  # Common subexpressions are removed already.
        )
        # E x' = f + g v + h u, and the sizes of its terms, which cancel at rest.
        mass, g, h = (ca.fabs(e) for e in (system.mass_matrix, system.g, system.h))
        states = ca.fmax(ca.DM(system.scale), ca.fabs(system.state))
        sizes = ca.mtimes(mass, states) + ca.fabs(system.f)
        sizes += ca.mtimes(g, ca.fabs(constraint_input)) + ca.mtimes(h, ca.fabs(control))
        self._motion = system.trace(
            "pinned motion",
            {
                "rate": self._rate,
                "control": control,
                "constraint_input": constraint_input,
                "constraint_matrix": structure.elimination.constraint_matrix,
                "control_matrix": structure.control_matrix,
                "pivot": ca.fmin(pivot, structure.elimination.pivot),
                "unrest": ca.fabs(ca.mtimes(system.mass_matrix, self._rate)) / sizes,
            },
            self._inputs,
        )

    def state(self, reference: FloatArray, guess: FloatArray, parameters: FloatArray) -> FloatArray:
        """Returns a state on Z(R) near a guess, to round-off, or raises InconsistentStateError."""
        name, outputs = self.system.name, self.describe(reference)
        state, converged = self.project(guess, reference, parameters)
        if converged:
            return state
        residual = self.residual(state, reference, parameters)
        if not np.all(np.isfinite(residual)):
            raise InconsistentStateError(
                f"{name}: {outputs} have no value near the given state; start inside the domain "
                "of the system",
                residual,
            )
        # The remaining distances, if these are small.
        length = np.linalg.norm(self.gradients(state, parameters) * self.system.scale, axis=1)
        missed = np.abs(residual) / np.where(length > 0.0, length, 1.0)
        worst = int(np.argmax(missed))
        if missed[worst] <= CONSISTENT:
            raise InconsistentStateError(
                f"{name}: {outputs} lead to x = {show(state)}, where A(x) or B(x) is singular",
                residual,
            )
        raise InconsistentStateError(
            f"{name}: {outputs} are not reached near the given state: "
            f"{self.residual_signals[worst].name} stays off by {residual[worst]:.3g}. Request "
            "outputs within reach of the system, or start closer to a state with these outputs",
            residual,
        )

    def project(
        self, start: FloatArray, reference: FloatArray, parameters: FloatArray
    ) -> tuple[FloatArray, bool]:
        """Returns the state on Z(R) closest to a start, and whether Newton's method converged."""
        scale = self.system.scale

        def residual(z: FloatArray) -> FloatArray:
            return self._residual.evaluate(scale * z, reference, parameters)[0]

        def linearize(z: FloatArray) -> NewtonModel | None:
            return shortest_steps(self.gradients(scale * z, parameters) * scale, residual)

        z, converged = newton(start / scale, linearize)
        return scale * z, converged

    def describe(self, reference: FloatArray) -> str:
        """Returns the outputs of a reference vector as text."""
        values = zip(self.system.output_signals, self.layout.values(reference), strict=True)
        return "the outputs " + ", ".join(f"{signal.name} = {v:.6g}" for signal, v in values)

    def residual(
        self, state: FloatArray, reference: FloatArray, parameters: FloatArray
    ) -> FloatArray:
        """Returns the residual of Z(R), named by `residual_signals`, shape (k,)."""
        return self._residual.evaluate(state, reference, parameters)[0].copy()

    def gradients(self, state: FloatArray, parameters: FloatArray) -> FloatArray:
        """Returns the gradients C of the residual, shape (k, n)."""
        gradients = self._gradient.evaluate(state, parameters)[0]
        return gradients.reshape(-1, self.system.num_states)

    def tangent(self, state: FloatArray, parameters: FloatArray, scale: FloatArray) -> FloatArray:
        """Returns a basis of the tangent space of Z(R), orthonormal in scaled states, (n, d)."""
        return tangent(self.gradients(state, parameters), scale)

    def coordinates(
        self, state: FloatArray, parameters: FloatArray, scale: FloatArray
    ) -> tuple[Indices, FloatArray]:
        """Returns states that are coordinates of Z(R), and the derivatives of all by them."""
        return coordinates(self.gradients(state, parameters), scale)

    def point(
        self, state: FloatArray, reference: FloatArray, parameters: FloatArray
    ) -> PinnedPoint:
        """Evaluates rate, inputs and matrices at a state on Z(R)."""
        values = self._motion.evaluate(state, reference, parameters)
        rate, u, v, A, B, pivot, unrest = (value.copy() for value in values)
        A, B = A.reshape(v.size, v.size), B.reshape(self.system.num_outputs, u.size)
        return PinnedPoint(state, rate, u, v, A, B, pivot, unrest)

    def flaw(self, point: PinnedPoint) -> str:
        """Returns why the motion is not determined at a point; empty if it is."""
        if not (np.isfinite(point.A).all() and np.isfinite(point.B).all()):
            return "A(x) or B(x) is not finite"
        pairs = zip(point.margins, self._usual_margins, strict=True)
        vanished = any(now < VANISHED * usual for now, usual in pairs)
        if vanished or not point.pivot[0] > SINGULAR_PIVOT:
            return "A(x) or B(x) is singular"
        moving = np.concatenate([point.rate, point.control, point.constraint_input])
        return "" if np.isfinite(moving).all() else "x' is not finite"

    @cached_property
    def _usual_margins(self) -> tuple[float, float]:
        """The largest margins of A and B at the states of the structure."""
        reference, parameters = np.zeros(self.layout.reference_size), self.system.parameter_values
        margins = [
            self.point(state, reference, parameters).margins for state in self.structure.states
        ]
        return max(a for a, _ in margins), max(b for _, b in margins)

    def rate(self, state: FloatArray, reference: FloatArray, parameters: FloatArray) -> FloatArray:
        """Returns x' = f* + h* u, shape (n,)."""
        return self._motion.evaluate(state, reference, parameters)[0].copy()

    def slopes(
        self, state: FloatArray, reference: FloatArray, parameters: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Returns dx'/dx, shape (n, n), and dx'/dr_i for the outputs of degree 0."""
        n, directions = state.size, np.eye(state.size + self.layout.reference_size)
        direct = self.layout.lowest[self.layout.direct]
        chosen = directions[[*range(n), *(n + direct)]]
        slopes = self.slopes_along(state, reference, parameters, chosen.T)
        return slopes[:, :n], slopes[:, n:]

    def slopes_along(
        self,
        state: FloatArray,
        reference: FloatArray,
        parameters: FloatArray,
        directions: FloatArray,
        of: int = 0,
    ) -> FloatArray:
        """Returns the derivatives of x', or of (v, u), along directions of x or of (x, R)."""
        n, still = state.size, np.zeros(self.layout.reference_size)
        columns = [
            self._slope.evaluate(
                state, reference, along[:n], along[n:] if along.size > n else still, parameters
            )[of].copy()
            for along in directions.T
        ]
        return np.array(columns).reshape(directions.shape[1], -1).T

    @cached_property
    def _slope(self) -> TracedFunction:
        """The derivatives of x' and (v, u) along a direction of state and reference."""
        system, dr = self.system, ca.SX.sym("dR", self.layout.reference_size)
        dx = ca.SX.sym("dx", system.num_states)
        at, along = ca.vertcat(system.state, self._R), ca.vertcat(dx, dr)
        slopes = {
            name: ca.jtimes(ca.cse(moving), at, along)
            for name, moving in (("rate", self._rate), ("inputs", self._moved))
        }
        inputs = {**self._inputs, "dx": dx, "dR": dr}
        return system.trace("slope of the pinned motion", slopes, inputs, often=False)

    def sizes_of_slopes(
        self, state: FloatArray, reference: FloatArray, parameters: FloatArray
    ) -> FloatArray:
        """Returns the sizes of the terms of dx'/dx before cancellation, shape (n, n)."""
        point, n = self.point(state, reference, parameters), state.size
        values = (point.rate, point.control, point.constraint_input, parameters)
        mass, slope, fields = (m.reshape(n, -1) for m in self._balance.evaluate(state, *values))
        moved = self.slopes_along(state, reference, parameters, np.eye(n), of=1)
        return np.abs(np.linalg.inv(mass)) @ (np.abs(slope) + np.abs(fields) @ np.abs(moved))

    @cached_property
    def _balance(self) -> TracedFunction:
        """E, the derivative of f + g v + h u - E x' by the state alone, and (g, h)."""
        system, u = self.system, self.structure.derivatives.control
        rate, v = ca.SX.sym("x'", system.num_states), ca.SX.sym("v", system.num_constraints)
        balance = system.f + ca.mtimes(system.g, v) + ca.mtimes(system.h, u)
        balance -= ca.mtimes(system.mass_matrix, rate)
        return system.trace(
            "balance",
            {
                "mass": system.mass_matrix,
                "slope": ca.jacobian(balance, system.state),
                "fields": ca.densify(ca.horzcat(system.g, system.h)),
            },
            {"rate": rate, "u": u, "v": v},
            often=False,
        )
