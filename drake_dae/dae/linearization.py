"""Linear models of (1)-(3) and of closed loops: as they stand, and in minimal form on N*."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from drake_dae.arguments import checked
from drake_dae.arrays import FloatArray, show, vector
from drake_dae.dae.manifold import coordinates
from drake_dae.dae.signals import DerivativeLayout, Indices, Signal
from drake_dae.dae.structure import ConstraintStructure, constraint_structure_of
from drake_dae.dae.system import DaeSystem
from drake_dae.dae.tracking import TrackingLaw
from drake_dae.errors import InconsistentStateError, ModelError
from drake_dae.trace.round_off import equilibration, smallest_singular_value

SINGULAR = 1e-12
"""The equations of the motion are singular below this singular value, rows and columns scaled."""


ComplexArray = np.typing.NDArray[np.complex128]


@dataclass(frozen=True, eq=False)
class LinearModel:
    """A linear model E x' = A x + B u, z = C x + D u, for small deviations."""

    E: FloatArray
    A: FloatArray
    B: FloatArray
    C: FloatArray
    D: FloatArray
    state_signals: tuple[Signal, ...]
    input_signals: tuple[Signal, ...]
    output_signals: tuple[Signal, ...]

    def response(self, s: complex) -> ComplexArray:
        """Returns the transfer matrix C (s E - A)^-1 B + D at a frequency s in 1/s."""
        pencil = s * self.E - self.A
        rows, columns = equilibration(np.abs(pencil))
        try:
            moved = np.linalg.solve(pencil / rows[:, None] / columns, self.B / rows[:, None])
        except np.linalg.LinAlgError:
            raise ModelError(f"s = {s:g} is a pole; evaluate the response at another s") from None
        return np.asarray(self.C @ (moved / columns[:, None]) + self.D, dtype=complex)


@dataclass(frozen=True, eq=False)
class Linearization:
    """The linear models of one system at one state and input."""

    descriptor: LinearModel
    minimal: LinearModel
    index: int
    coordinates: Indices
    basis: FloatArray
    state: FloatArray
    rate: FloatArray
    control: FloatArray
    constraint_input: FloatArray


@checked(ModelError)
def linearize(
    system: DaeSystem,
    state: ArrayLike | None = None,
    control: ArrayLike | None = None,
    *,
    structure: ConstraintStructure | None = None,
    parameters: ArrayLike | None = None,
) -> Linearization:
    """Linearizes a plant from its control u to its controlled outputs z.

    Exogenous signals are at rest at their parameters' values, unless `parameters` say otherwise.

    Args:
        system: The system (1)-(3).
        state: x on N*, shape (n,); the nominal consistent state if None.
        control: u, shape (p,); zero if None.
        structure: The structure of the system; found if None.
        parameters: Values of all parameters; the defaults if None.

    Raises:
        InconsistentStateError: The state is not on N*.
        ModelError: A shape is wrong, a number is not finite, or A(x) is singular at the state.
    """
    structure = constraint_structure_of("linearize", system, structure)
    p = system.num_controls
    u = np.zeros(p) if control is None else vector(f"{system.name}: control", control, p)
    plant = _PlantModel(structure, state, system.parameter_vector(parameters))
    no_feedback = np.zeros((p, system.num_states + system.num_constraints))
    return plant.linearization(u, no_feedback, np.eye(p), system.control_signals)


@checked(ModelError)
def linearize_loop(
    law: TrackingLaw,
    reference: ArrayLike,
    state: ArrayLike | None = None,
    *,
    parameters: ArrayLike | None = None,
) -> Linearization:
    """Linearizes a plant under the law (28), from R to the controlled outputs z.

    All entries of R = (r_1, r_1', ..., r_1^(mu_1), r_2, ...) are inputs of their own. With r_i^(j)
    = s^j r_i the transfer matrix is the identity if the plant is the model of the law.

    Args:
        law: The law.
        reference: R, shape (sum (mu_i + 1),).
        state: x on N*, shape (n,); the nominal consistent state if None.
        parameters: Values of the plant's parameters; the defaults if None. The law has its own,
            the defaults.

    Raises:
        InconsistentStateError: The state is not on N*.
        ModelError: A shape is wrong, a number is not finite, or A(x) or B(x) is singular at the
            state; or the force that the law measures is not determined.
    """
    if law.integral.outputs:
        raise ModelError(
            f"{law.system.name}: a law with integral action has a state, which this function does "
            "not support. Convert the loop's diagram to AutoDiffXd and use Drake's Linearize"
        )
    system, values = law.system, law.all_parameters()
    R = vector(f"{system.name}: reference", reference, law.layout.reference_size)
    plant = _PlantModel(law.structure, state, system.parameter_vector(parameters))
    n, m, p = system.num_states, system.num_constraints, system.num_controls
    measured = [np.zeros(m)] if law.measured_force else []
    moving = tuple(range(2 + len(measured)))
    slope = law.function.derivative(law.function.output_names.index("control"), moving)
    _, free_force = plant.motion(np.zeros(p))
    # u = u_0 + K_v v and v = v_0 + beta u: the law is affine in the measured force.
    first = law.function(plant.state, R, *measured, values)[0].copy()
    gains = slope(plant.state, R, *measured, values)[0].reshape(p, -1).copy()
    by_force = gains[:, n + R.size :] if measured else np.zeros((p, m))
    around = np.eye(p) - by_force @ plant.by_control[n:]
    if smallest_singular_value(around) < SINGULAR:
        raise ModelError(
            f"{system.name}: the measured force and the control do not determine each other at x = "
            f"{show(plant.state)}; take another force gain"
        )
    control = np.asarray(np.linalg.solve(around, first + by_force @ free_force), dtype=np.float64)
    if measured:
        _, force = plant.motion(control)
        gains = slope(plant.state, R, force, values)[0].reshape(p, -1).copy()
    feedback = np.hstack([gains[:, :n], by_force])
    return plant.linearization(control, feedback, gains[:, n : n + R.size], law.reference_signals)


class _PlantModel:
    """The equations of motion at a state, in numbers.

    With c the last derivatives of the constraints the motion solves

        [[E, -g], [C, 0]] (x', v) = (f + h u, -c_t),    C = dc/dx,

    where c_t is the part of c' from exogenous signals; a deviation solves the linearized equations.
    """

    def __init__(
        self, structure: ConstraintStructure, state: ArrayLike | None, parameters: FloatArray
    ) -> None:
        self.structure, self.system = structure, structure.system
        system, manifold = self.system, structure.manifold
        x = system.state_vector(structure.states[0] if state is None else state)
        if not manifold.is_consistent(x, parameters):
            residual = manifold.residual(x, parameters)
            raise InconsistentStateError(
                f"{system.name}: x = {show(x)} is not on N*, where the motion is; linearize at "
                "`find_structure(system).manifold.project(x)`",
                residual,
            )
        self.state, self.parameters = x, parameters
        m = system.num_constraints
        outputs = {
            "mass": system.mass_matrix,
            "f": system.f,
            "g": system.g,
            "h": system.h,
            "C": structure.elimination.constraint_gradient,
            "c_t": self._carried,
        }
        self._mass, self._f, self._g, self._h, self._C, self._c_t = self._values(outputs)
        matrix = np.block([[self._mass, -self._g], [self._C, np.zeros((m, m))]])
        self._rows, self._columns = equilibration(np.abs(matrix))
        self._matrix = matrix / self._rows[:, None] / self._columns
        if not np.all(np.isfinite(matrix)) or smallest_singular_value(self._matrix) < SINGULAR:
            raise ModelError(
                f"{system.name}: A(x) of Assumption (2) is singular at x = {show(x)}, so the "
                "motion is not determined there; linearize at another state"
            )

    def _values(self, outputs: dict[str, ca.SX], **inputs: FloatArray) -> list[FloatArray]:
        """Expressions as matrices of numbers at the state."""
        symbols = {name: self._symbols[name] for name in inputs}
        dense = {name: ca.densify(value) for name, value in outputs.items()}
        function = self.system.trace("linearization", dense, symbols, often=False)
        values = function(self.state, *inputs.values(), self.parameters)
        shapes = [value.shape for value in outputs.values()]
        return [np.array(value).reshape(shape) for value, shape in zip(values, shapes, strict=True)]

    @property
    def _carried(self) -> ca.SX:
        """c_t, shape (m, 1)."""
        ends = DerivativeLayout(self.structure.constraint_degrees).ends.tolist()
        return self.system.exogenous.rate(self.structure.manifold.residual_expression[ends, :])

    @cached_property
    def _symbols(self) -> dict[str, ca.SX]:
        system = self.system
        return {
            "rate": ca.SX.sym("x'", system.num_states),
            "constraint_input": ca.SX.sym("v", system.num_constraints),
            "control": ca.SX.sym("u", system.num_controls),
        }

    def _solve(self, right: FloatArray) -> FloatArray:
        """(x', v) of right sides, shape (n + m, k)."""
        solved = np.linalg.solve(self._matrix, right / self._rows[:, None])
        return np.asarray(solved / self._columns[:, None], dtype=np.float64)

    @cached_property
    def by_control(self) -> FloatArray:
        """The derivatives of x' and v by u, shape (n + m, p)."""
        m, p = self.system.num_constraints, self.system.num_controls
        return self._solve(np.vstack([self._h, np.zeros((m, p))]))

    def motion(self, control: FloatArray) -> tuple[FloatArray, FloatArray]:
        """x' and v at the state with a control."""
        n = self.system.num_states
        push = np.concatenate([self._f[:, 0] + self._h @ control, -self._c_t[:, 0]])
        moved = self._solve(push[:, None])[:, 0]
        return moved[:n], moved[n:]

    def linearization(
        self,
        control: FloatArray,
        feedback: FloatArray,
        forward: FloatArray,
        inputs: Sequence[Signal],
    ) -> Linearization:
        """The linear models with du = feedback (dx, dv) + forward dw."""
        system, structure, symbols = self.system, self.structure, self._symbols
        rate, force = self.motion(control)
        n, m, p = system.num_states, system.num_constraints, system.num_controls
        x, v = system.state, symbols["constraint_input"]
        balance = system.f + ca.mtimes(system.g, v) + ca.mtimes(system.h, symbols["control"])
        balance -= ca.mtimes(system.mass_matrix, symbols["rate"])
        constraint_rate = ca.mtimes(structure.elimination.constraint_gradient, symbols["rate"])
        constraint_rate += self._carried
        outputs = {
            "balance": ca.jacobian(balance, x),
            "kept": ca.jacobian(constraint_rate, x),
            "k": ca.jacobian(system.k, x),
            "z": ca.jacobian(system.outputs(v), x),
            "m": system.m,
        }
        slope, constraint_slope, k_slope, z_slope, z_force = self._values(
            outputs, rate=rate, constraint_input=force, control=control
        )
        # In descriptor form, in (x, v).
        none = np.zeros((m, m))
        E = np.block([[self._mass, np.zeros((n, m))], [np.zeros((m, n + m))]])
        A = np.block([[slope, self._g], [k_slope, none]])
        B = np.vstack([self._h, np.zeros((m, p))])
        C = np.hstack([z_slope, z_force])
        no_feedthrough = np.zeros((system.num_outputs, forward.shape[1]))
        unknowns = (*system.state_signals, *system.constraint_input_signals)
        signals = (tuple(inputs), system.output_signals)
        descriptor = LinearModel(
            E, A + B @ feedback, B @ forward, C, no_feedthrough, unknowns, *signals
        )
        # On N*: (dx', dv) = moved dx + by_control du, and dv out of du.
        moved = self._solve(np.vstack([slope, -constraint_slope]))
        of_x, of_v = feedback[:, :n], feedback[:, n:]
        around = np.eye(p) - of_v @ self.by_control[n:]
        control_by_state = np.linalg.solve(around, of_x + of_v @ moved[n:])
        control_by_input = np.linalg.solve(around, forward)
        by_state = moved + self.by_control @ control_by_state
        by_input = self.by_control @ control_by_input
        gradients = structure.manifold.gradients(self.state, self.parameters)
        free, basis = coordinates(gradients, structure.scale)
        minimal = LinearModel(
            np.eye(free.size),
            (by_state[:n] @ basis)[free],
            by_input[free],
            (z_slope + z_force @ by_state[n:]) @ basis,
            z_force @ by_input[n:],
            tuple(system.state_signals[i] for i in free),
            *signals,
        )
        return Linearization(
            descriptor,
            minimal,
            structure.index,
            free,
            basis,
            self.state,
            rate,
            control,
            force,
        )
