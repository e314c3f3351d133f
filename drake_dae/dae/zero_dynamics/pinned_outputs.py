"""The states that have their outputs on a reference, and how they move.             (28), (35)

Pinned outputs leave the states

    Z(R) = {x in N*: L_f*^j l*_i(x) = r_i^(j), j = 0, ..., mu_i - 1},

and the control u = B^-1 (-a + r^(mu)), which is (28) without an error. On Z(R) the state moves by
x' = f* + h* u.
"""

from dataclasses import dataclass
from functools import cached_property

import casadi as ca
import numpy as np

from drake_dae.arrays import FloatArray, show
from drake_dae.dae.manifold import CONSISTENT
from drake_dae.dae.structure import Structure
from drake_dae.errors import InconsistentStateError
from drake_dae.trace.factorization import Factorization
from drake_dae.trace.functions import SINGULAR_PIVOT, TracedFunction
from drake_dae.trace.newton import Linearization, newton, shortest_steps

VANISHED = 1e-9
"""Below this part of its usual margin A or B counts as singular, also where it is one number."""


@dataclass(frozen=True, eq=False)
class Point:
    """A state on Z(R), and what belongs to it, finite or not.

    Attributes:
        state: x, shape (n,).
        rate: x', shape (n,).
        control: u, shape (p,).
        constraint_input: v, shape (m,).
        A, B: The matrices of Assumptions (2) and (5).
        pivot: 0 exactly where one of them is singular, shape (1,).
        unrest: |E x'| relative to the sizes of the terms that cancel in it at rest, shape (n,).
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
        """The smallest singular values of A and B."""
        return _margin(self.A), _margin(self.B)

    @cached_property
    def signs(self) -> tuple[float, ...]:
        """Of det A and det B."""
        return tuple(float(np.linalg.slogdet(_square(matrix))[0]) for matrix in (self.A, self.B))


class PinnedOutputs:
    """Z(R) and the motion on it; all arguments are arrays of the right sizes.

    Args:
        structure: Of the system.

    Attributes:
        size: Of R = (r_1, r_1', ..., r_1^(mu_1), r_2, ...), sum (mu_i + 1).
        starts: Where r_1, r_2, ... stand in R.
        met: The outputs of degree 0, which the control meets at once.
        residual_signals: What is zero on Z(R): the constraints, then the output errors, each with
            its derivatives.
    """

    def __init__(self, structure: Structure) -> None:
        self.structure = structure
        self.system = system = structure.system
        ends = np.cumsum([degree + 1 for degree in structure.output_degrees])
        self.size, self.starts = int(ends[-1]), np.array([0, *ends[:-1]])
        self.met = [i for i, degree in enumerate(structure.output_degrees) if degree == 0]
        self._R = goal = ca.SX.sym("R", self.size)
        errors, signals = [], list(structure.manifold.residual_signals)
        for chain, start, signal in zip(
            structure.output_chains, self.starts, system.output_signals, strict=True
        ):
            errors += [element - goal[int(start) + j] for j, element in enumerate(chain)]
            signals += [signal.derivative(j) for j in range(len(chain))]
        self.residual_signals = tuple(signals)
        residual = ca.vertcat(structure.manifold.residual_expression, *errors)

        motion, highest = structure.motion, goal[(ends - 1).tolist()]
        factors = Factorization(structure.control_matrix)
        control = factors.solve(highest - structure.drift)
        self._rate, force = (
            ca.substitute(motion.expand(unknown), motion.control, control)
            for unknown in (motion.rate, motion.constraint_input)
        )
        x, p = system.state, system.parameter_symbol
        self._inputs = {"state": x, "reference": goal, "parameters": p}
        self._residual = TracedFunction(
            f"{system.name} pinned outputs", self._inputs, {"residual": residual}
        )
        self._gradient = TracedFunction(
            f"{system.name} gradient of the pinned outputs",
            {"state": x, "parameters": p},
            {"gradient": ca.jacobian(ca.cse(residual), x)},
            often=False,  # It shares what the residual does; to find more takes long.
        )
        # E x' = f + g v + h u, and the sizes of what cancels in it at rest.
        mass, g, h = (ca.fabs(e) for e in (system.mass_matrix, system.g, system.h))
        sizes = ca.mtimes(mass, ca.fmax(1.0, ca.fabs(x))) + ca.fabs(system.f)
        sizes += ca.mtimes(g, ca.fabs(force)) + ca.mtimes(h, ca.fabs(control))
        self._motion = TracedFunction(
            f"{system.name} pinned motion",
            self._inputs,
            {
                "rate": self._rate,
                "control": control,
                "force": force,
                "constraint_matrix": structure.elimination.constraint_matrix,
                "control_matrix": structure.control_matrix,
                "pivot": ca.fmin(factors.pivot, structure.elimination.pivot),
                "unrest": ca.fabs(ca.mtimes(system.mass_matrix, self._rate)) / sizes,
            },
        )

    def state(self, reference: FloatArray, guess: FloatArray, parameters: FloatArray) -> FloatArray:
        """A state on Z(R), to round-off; raises InconsistentStateError if none is found."""
        name, outputs = self.system.name, self.describe(reference)
        found, converged = self.project(guess, reference, parameters)
        if converged:
            return found
        residual = self.residual(found, reference, parameters)
        if not np.all(np.isfinite(residual)):
            raise InconsistentStateError(
                f"{name}: {outputs} have no value near the given state; start inside the domain "
                "of the system",
                residual,
            )
        # The distances by which they are missed, if these are small.
        length = np.linalg.norm(self.gradients(found, parameters), axis=1)
        missed = np.abs(residual) / np.where(length > 0.0, length, 1.0)
        worst = int(np.argmax(missed))
        if missed[worst] <= CONSISTENT:
            raise InconsistentStateError(
                f"{name}: {outputs} lead to x = {show(found)}, where A(x) or B(x) is singular",
                residual,
            )
        raise InconsistentStateError(
            f"{name}: {outputs} are not reached near the given state: "
            f"{self.residual_signals[worst].name} stays off by {residual[worst]:.3g}. Ask for "
            "outputs that the system can have, or start nearer to the state that has them",
            residual,
        )

    def project(
        self, start: FloatArray, reference: FloatArray, parameters: FloatArray
    ) -> tuple[FloatArray, bool]:
        """The state on Z(R) next to a start; or where Newton's method ended, and False."""

        def residual(x: FloatArray) -> FloatArray:
            return self._residual.evaluate(x, reference, parameters)[0]

        def linearize(x: FloatArray) -> Linearization | None:
            return shortest_steps(self.gradients(x, parameters), residual)

        return newton(start, linearize)

    def describe(self, reference: FloatArray) -> str:
        """The outputs of a reference, for a message."""
        values = zip(self.system.output_signals, reference[self.starts], strict=True)
        return "the outputs " + ", ".join(f"{signal.name} = {v:.6g}" for signal, v in values)

    def residual(
        self, state: FloatArray, reference: FloatArray, parameters: FloatArray
    ) -> FloatArray:
        """What is zero on Z(R), as `residual_signals`."""
        return self._residual.evaluate(state, reference, parameters)[0].copy()

    def gradients(self, state: FloatArray, parameters: FloatArray) -> FloatArray:
        """C, the gradients of the residual, shape (k, n)."""
        gradients = self._gradient.evaluate(state, parameters)[0]
        return gradients.reshape(-1, self.system.num_states)

    def rate(self, state: FloatArray, reference: FloatArray, parameters: FloatArray) -> FloatArray:
        """x' = f* + h* u, shape (n,)."""
        return self._motion.evaluate(state, reference, parameters)[0].copy()

    @cached_property
    def _slope(self) -> TracedFunction:
        """The derivative of x' along a direction of state and reference."""
        dx, dr = ca.SX.sym("dx", self.system.num_states), ca.SX.sym("dR", self.size)
        at, along = ca.vertcat(self.system.state, self._R), ca.vertcat(dx, dr)
        return TracedFunction(
            f"{self.system.name} slope of the pinned motion",
            {**self._inputs, "dx": dx, "dR": dr},
            {"slope": ca.jtimes(ca.cse(self._rate), at, along)},
            often=False,
        )

    def slopes(
        self, state: FloatArray, reference: FloatArray, parameters: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """dx'/dx, shape (n, n), and dx'/dr_i for the outputs of degree 0."""
        n, directions = state.size, np.eye(state.size + self.size)
        chosen = directions[[*range(n), *(n + self.starts[self.met])]]
        columns = [
            self._slope.evaluate(state, reference, parameters, along[:n], along[n:])[0].copy()
            for along in chosen
        ]
        slopes = np.array(columns).T
        return slopes[:, :n], slopes[:, n:]

    def sizes_of_slopes(
        self, state: FloatArray, reference: FloatArray, parameters: FloatArray
    ) -> FloatArray:
        """How large the terms are that add up to dx'/dx, before they cancel, shape (n, n)."""
        point = self.point(state, reference, parameters)
        given = (point.rate, point.control, point.constraint_input, parameters)
        mass, slope = (m.reshape(state.size, -1) for m in self._balance(state, *given))
        return np.abs(np.linalg.inv(mass)) @ np.abs(slope)

    @cached_property
    def _balance(self) -> TracedFunction:
        """E, and the slope of f + g v + h u - E x' with all but the state fixed."""
        system, motion = self.system, self.structure.motion
        rate = ca.SX.sym("x'", system.num_states)
        u, v = motion.control, ca.SX.sym("v", system.num_constraints)
        balance = system.f + ca.mtimes(system.g, v) + ca.mtimes(system.h, u)
        balance -= ca.mtimes(system.mass_matrix, rate)
        return TracedFunction(
            f"{system.name} balance",
            {"state": system.state, "rate": rate, "u": u, "v": v, "p": system.parameter_symbol},
            {"mass": system.mass_matrix, "slope": ca.jacobian(balance, system.state)},
            often=False,
        )

    def point(self, state: FloatArray, reference: FloatArray, parameters: FloatArray) -> Point:
        """What belongs to a state on Z(R)."""
        values = self._motion.evaluate(state, reference, parameters)
        return Point(state, *(value.copy() for value in values))

    def flaw(self, point: Point) -> str:
        """Why the motion is not determined at a point; empty if it is."""
        if not (np.all(np.isfinite(point.A)) and np.all(np.isfinite(point.B))):
            return "A(x) or B(x) is not finite"
        pairs = zip(point.margins, self._usual_margins, strict=True)
        if not point.pivot[0] > SINGULAR_PIVOT or any(
            now < VANISHED * usual for now, usual in pairs
        ):
            return "A(x) or B(x) is singular"
        moving = np.concatenate([point.rate, point.control, point.constraint_input])
        return "" if np.all(np.isfinite(moving)) else "x' is not finite"

    @cached_property
    def _usual_margins(self) -> tuple[float, float]:
        """The largest margins of A and B at the states of the structure."""
        reference, parameters = np.zeros(self.size), self.system.parameter_values
        margins = [
            self.point(state, reference, parameters).margins for state in self.structure.states
        ]
        return max(a for a, _ in margins), max(b for _, b in margins)


def _square(matrix: FloatArray) -> FloatArray:
    """A square matrix, which came as a vector if it has one column."""
    return matrix.reshape(round(matrix.size**0.5), round(matrix.size**0.5))


def _margin(matrix: FloatArray) -> float:
    """The smallest singular value; that of a matrix without columns is infinite."""
    values = np.linalg.svd(_square(matrix), compute_uv=False)
    return float(np.min(values, initial=np.inf))
