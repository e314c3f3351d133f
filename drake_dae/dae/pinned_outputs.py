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
from drake_dae.dae.settling import CONSISTENT
from drake_dae.dae.structure import Structure
from drake_dae.errors import InconsistentStateError
from drake_dae.trace.functions import SINGULAR_PIVOT, TracedFunction
from drake_dae.trace.newton import NewtonModel, newton, shortest_steps

VANISHED = 1e-9
"""A or B counts as singular below this fraction of its usual margin, also if it is a single
number."""


@dataclass(frozen=True, eq=False)
class PinnedPoint:
    """A state on Z(R) with x', u, v, A of Assumption (2) and B of (5), which may be infinite."""

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
    """Z(R) and the motion on it, for all R; `at` is that for one."""

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
        self._inputs = {"reference": goal}
        self.residual = system.trace("pinned outputs", {"residual": residual}, self._inputs)
        self.gradient = system.trace(
            "gradient of the pinned outputs",
            {"gradient": ca.jacobian(ca.cse(residual), system.state)},
            often=False,  # Common subexpressions are removed already.
        )
        # E x' = f + g v + h u, and the sizes of its terms, which cancel at rest.
        mass, g, h = (ca.fabs(e) for e in (system.mass_matrix, system.g, system.h))
        states = ca.fmax(ca.DM(system.scale), ca.fabs(system.state))
        sizes = ca.mtimes(mass, states) + ca.fabs(system.f)
        sizes += ca.mtimes(g, ca.fabs(constraint_input)) + ca.mtimes(h, ca.fabs(control))
        self.motion = system.trace(
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

    def at(self, reference: FloatArray, parameters: FloatArray) -> "PinnedSet":
        """Returns Z(R) for one R and values of all parameters."""
        return PinnedSet(self, reference, parameters)

    @cached_property
    def slope(self) -> TracedFunction:
        """The derivative of x' along a direction of state and reference."""
        system, dr = self.system, ca.SX.sym("dR", self.layout.reference_size)
        dx = ca.SX.sym("dx", system.num_states)
        at, along = ca.vertcat(system.state, self._R), ca.vertcat(dx, dr)
        slopes = {"rate": ca.jtimes(ca.cse(self._rate), at, along)}
        inputs = {**self._inputs, "dx": dx, "dR": dr}
        return system.trace("slope of the pinned motion", slopes, inputs, often=False)

    @cached_property
    def usual_margins(self) -> tuple[float, float]:
        """The largest margins of A and B at the states of the structure."""
        still = self.at(np.zeros(self.layout.reference_size), self.system.parameter_values)
        margins = [still.point(state).margins for state in self.structure.states]
        return max(a for a, _ in margins), max(b for _, b in margins)


@dataclass(frozen=True, eq=False)
class PinnedSet:
    """Z(R) for one R and values of all parameters."""

    outputs: PinnedOutputs
    reference: FloatArray
    parameters: FloatArray

    def state(self, guess: FloatArray) -> FloatArray:
        """Returns a state near a guess, to round-off, or raises InconsistentStateError."""
        system = self.outputs.system
        state, converged = self.project(guess)
        if converged:
            return state
        residual = self.residual(state)
        length = np.linalg.norm(self.gradients(state) * system.scale, axis=1)
        missed = np.abs(residual) / np.where(length > 0.0, length, 1.0)
        worst = int(np.argmax(missed))
        if not np.all(np.isfinite(residual)):
            why = "have no value near the given state; start inside the domain of the system"
        elif missed[worst] <= CONSISTENT:
            why = f"lead to x = {show(state)}, where A(x) or B(x) is singular"
        else:
            why = (
                f"are not reached near the given state: {self.outputs.residual_signals[worst].name}"
                f" stays off by {residual[worst]:.3g}. Request outputs within reach, or start "
                "closer to a state with these outputs"
            )
        raise InconsistentStateError(f"{system.name}: {self.describe()} {why}", residual)

    def project(self, start: FloatArray) -> tuple[FloatArray, bool]:
        """Returns the closest state to a start, and whether Newton's method converged."""
        scale, trace = self.outputs.system.scale, self.outputs.residual

        def residual(z: FloatArray) -> FloatArray:
            return trace.evaluate(scale * z, self.reference, self.parameters)[0]

        def linearize(z: FloatArray) -> NewtonModel | None:
            return shortest_steps(self.gradients(scale * z) * scale, residual)

        z, converged = newton(start / scale, linearize)
        return scale * z, converged

    def describe(self) -> str:
        """Returns the outputs as text."""
        values = self.outputs.layout.values(self.reference)
        pairs = zip(self.outputs.system.output_signals, values, strict=True)
        return "the outputs " + ", ".join(f"{signal.name} = {v:.6g}" for signal, v in pairs)

    def residual(self, state: FloatArray) -> FloatArray:
        """Returns the residual, named by `residual_signals`, shape (k,)."""
        return self.outputs.residual.evaluate(state, self.reference, self.parameters)[0].copy()

    def gradients(self, state: FloatArray) -> FloatArray:
        """Returns the gradients C of the residual, shape (k, n)."""
        return self.outputs.gradient.evaluate(state, self.parameters)[0].reshape(-1, state.size)

    def point(self, state: FloatArray) -> PinnedPoint:
        """Evaluates rate, inputs and matrices at a state."""
        values = self.outputs.motion.evaluate(state, self.reference, self.parameters)
        rate, u, v, A, B, pivot, unrest = (value.copy() for value in values)
        A, B = A.reshape(v.size, v.size), B.reshape(self.outputs.system.num_outputs, u.size)
        return PinnedPoint(state, rate, u, v, A, B, pivot, unrest)

    def flaw(self, point: PinnedPoint) -> str:
        """Returns why the motion is not determined at a point; empty if it is."""
        if not (np.isfinite(point.A).all() and np.isfinite(point.B).all()):
            return "A(x) or B(x) is not finite"
        pairs = zip(point.margins, self.outputs.usual_margins, strict=True)
        vanished = any(now < VANISHED * usual for now, usual in pairs)
        if vanished or not point.pivot[0] > SINGULAR_PIVOT:
            return "A(x) or B(x) is singular"
        moving = np.concatenate([point.rate, point.control, point.constraint_input])
        return "" if np.isfinite(moving).all() else "x' is not finite"

    def rate(self, state: FloatArray) -> FloatArray:
        """Returns x' = f* + h* u, shape (n,)."""
        return self.outputs.motion.evaluate(state, self.reference, self.parameters)[0].copy()

    def slopes(self, state: FloatArray) -> FloatArray:
        """Returns dx'/dx, shape (n, n)."""
        return self.slopes_along(state, np.eye(state.size))

    def slopes_along(
        self, state: FloatArray, directions: FloatArray, by: FloatArray | None = None
    ) -> FloatArray:
        """Returns the derivatives of x' along columns of dx, and of dR if given."""
        if by is None:
            by = np.zeros((self.reference.size, directions.shape[1]))
        slope = self.outputs.slope
        columns = [
            slope.evaluate(state, self.reference, dx, dr, self.parameters)[0].copy()
            for dx, dr in zip(directions.T, by.T, strict=True)
        ]
        return np.array(columns).reshape(len(columns), -1).T
