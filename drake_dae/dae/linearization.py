"""Linear models of (1)-(3) and of closed loops: as they stand, and in minimal form on N*."""

from dataclasses import dataclass

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from drake_dae.arguments import checked
from drake_dae.arrays import FloatArray, show, vector
from drake_dae.dae.manifold import coordinates
from drake_dae.dae.signals import Indices, Signal
from drake_dae.dae.structure import ConstraintStructure, constraint_structure_of
from drake_dae.dae.system import DaeSystem
from drake_dae.dae.tracking import TrackingLaw
from drake_dae.errors import InconsistentStateError, ModelError
from drake_dae.trace.round_off import equilibration, smallest_singular_value

SINGULAR = 1e-12
"""A loop of control and measured force has no solution below this singular value."""

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
    return plant.linearization(u, no_feedback, np.eye(p))


@checked(ModelError)
def linearize_loop(
    law: TrackingLaw,
    reference: ArrayLike,
    state: ArrayLike | None = None,
    *,
    parameters: ArrayLike | None = None,
) -> Linearization:
    """Linearizes a plant under the law (28), from R to the controlled outputs z."""
    if law.integral.outputs:
        raise ModelError(
            f"{law.system.name}: a law with integral action has a state, which this function does "
            "not support. Convert the loop's diagram to AutoDiffXd and use Drake's Linearize"
        )
    system, values = law.system, law.all_parameters()
    R = vector(f"{system.name}: reference", reference, law.layout.reference_size)
    plant = _PlantModel(law.structure, state, system.parameter_vector(parameters))
    n, m, p = system.num_states, system.num_constraints, system.num_controls
    free, _, by_control = plant.motion(np.zeros(p))
    # u = u_0 + K_v v and v = v_0 + beta u: the law is affine in the measured force.
    force = [np.zeros(m)] if law.measured_force else []
    slope = law.function.derivative(
        law.function.output_names.index("control"), range(2 + len(force))
    )
    control = law.function(plant.state, R, *force, values)[0].copy()
    if law.measured_force:
        gains = slope(plant.state, R, *force, values)[0].reshape(p, -1)[:, n + R.size :]
        around = np.eye(p) - gains @ by_control[n:]
        if smallest_singular_value(around) < SINGULAR:
            raise ModelError(
                f"{system.name}: the measured force and the control do not determine each other at "
                f"x = {show(plant.state)}; take another force gain"
            )
        solved = np.linalg.solve(around, control + gains @ free[n:])
        control = np.asarray(solved, dtype=np.float64)
        force = [plant.motion(control)[0][n:]]
    gains = slope(plant.state, R, *force, values)[0].reshape(p, -1)
    by_force = gains[:, n + R.size :] if force else np.zeros((p, m))
    feedback = np.hstack([gains[:, :n], by_force])
    return plant.linearization(control, feedback, gains[:, n : n + R.size])


class _PlantModel:
    """The motion of a plant at a state: (x', v) and their derivatives by x and u."""

    def __init__(
        self, structure: ConstraintStructure, state: ArrayLike | None, parameters: FloatArray
    ) -> None:
        self.structure, self.system, self.parameters = structure, structure.system, parameters
        system, manifold = self.system, structure.manifold
        self.state = system.state_vector(structure.states[0] if state is None else state)
        if not manifold.is_consistent(self.state, parameters):
            raise InconsistentStateError(
                f"{system.name}: x = {show(self.state)} is not on N*, where the motion is; "
                "linearize at `find_structure(system).manifold.project(x)`",
                manifold.residual(self.state, parameters),
            )
        motion = structure.derivatives
        moved = ca.cse(motion.expand(ca.vertcat(motion.rate, motion.constraint_input)))
        outputs = {"moved": moved, "by_state": ca.jacobian(moved, system.state)}
        outputs["by_control"] = ca.jacobian(moved, motion.control)
        inputs, pivot = {"control": motion.control}, structure.elimination.pivot
        self._motion = system.trace("linearized motion", outputs, inputs, pivot, often=False)

    def motion(self, control: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """(x', v), and the derivatives by x and by u, shapes (n + m, n) and (n + m, p)."""
        moved, *slopes = self._motion(self.state, control, self.parameters)
        if not self._motion.is_valid:
            raise ModelError(
                f"{self.system.name}: A(x) of Assumption (2) is singular at x = "
                f"{show(self.state)}, so the motion is not determined there; linearize at another "
                "state"
            )
        by_state, by_control = (slope.reshape(moved.size, -1) for slope in slopes)
        return moved, by_state, by_control

    def linearization(
        self, control: FloatArray, feedback: FloatArray, forward: FloatArray
    ) -> Linearization:
        """The linear models with du = feedback (dx, dv) + forward dw."""
        system, structure, x = self.system, self.structure, self.system.state
        n, m, p = system.num_states, system.num_constraints, system.num_controls
        moved, by_state, by_control = self.motion(control)
        rate, force = moved[:n], moved[n:]
        v, u, r = ca.SX.sym("v", m), ca.SX.sym("u", p), ca.SX.sym("r", n)
        balance = system.f + ca.mtimes(system.g, v) + ca.mtimes(system.h, u)
        rows = ca.vertcat(balance - ca.mtimes(system.mass_matrix, r), system.k, system.outputs(v))
        slopes = ca.jacobian(rows, ca.vertcat(x, v, u))
        outputs = {"mass": ca.densify(system.mass_matrix), "slopes": ca.densify(slopes)}
        function = system.trace("linearization", outputs, {"r": r, "v": v, "u": u}, often=False)
        mass, whole = function(self.state, rate, force, control, self.parameters)
        whole = whole.reshape(slopes.shape)
        A, B, C = whole[: n + m, : n + m], whole[: n + m, n + m :], whole[n + m :, : n + m]
        # In descriptor form, in (x, v).
        E = np.zeros((n + m, n + m))
        E[:n, :n] = mass.reshape(n, n)
        unknowns = (*system.state_signals, *system.constraint_input_signals)
        none = np.zeros((system.num_outputs, forward.shape[1]))
        descriptor = LinearModel(
            E, A + B @ feedback, B @ forward, C, none, unknowns, system.output_signals
        )
        # On N*: (dx', dv) = by_state dx + by_control du, and dv out of du.
        of_x, of_v = feedback[:, :n], feedback[:, n:]
        around = np.eye(p) - of_v @ by_control[n:]
        by_state = by_state + by_control @ np.linalg.solve(around, of_x + of_v @ by_state[n:])
        by_input = by_control @ np.linalg.solve(around, forward)
        gradients = structure.manifold.gradients(self.state, self.parameters)
        free, basis = coordinates(gradients, structure.scale)
        minimal = LinearModel(
            np.eye(free.size),
            (by_state[:n] @ basis)[free],
            by_input[free],
            (C[:, :n] + C[:, n:] @ by_state[n:]) @ basis,
            C[:, n:] @ by_input[n:],
            tuple(system.state_signals[i] for i in free),
            system.output_signals,
        )
        at = (self.state, rate, control, force)
        return Linearization(descriptor, minimal, structure.index, free, basis, *at)
