"""The linear model of (1)-(3): as a descriptor system, and in minimal form on N*."""

from dataclasses import dataclass

import casadi as ca
import numpy as np
import scipy.linalg
from numpy.typing import ArrayLike

from drake_dae.arguments import checked
from drake_dae.arrays import FloatArray, show, vector
from drake_dae.dae.manifold import coordinates
from drake_dae.dae.signals import Indices, Signal
from drake_dae.dae.structure import ConstraintStructure, find_constraint_structure, structure_of
from drake_dae.dae.system import DaeSystem
from drake_dae.errors import InconsistentStateError, ModelError
from drake_dae.trace.numerics import equilibration

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
    structure, p = (structure_of(system, structure, find_constraint_structure), system.num_controls)
    u = np.zeros(p) if control is None else vector(f"{system.name}: control", control, p)
    values, manifold = system.parameter_vector(parameters), structure.manifold
    x = system.state_vector(structure.states[0] if state is None else state)
    if not manifold.is_consistent(x, values):
        raise InconsistentStateError(
            f"{system.name}: x = {show(x)} is not on N*, where the motion is; linearize at "
            "`find_structure(system).manifold.project(x)`",
            manifold.residual(x, values),
        )
    motion, n, m = structure.derivatives, system.num_states, system.num_constraints
    # On N*: (x', v), and their derivatives by x and by u.
    moved = ca.cse(motion.expand(ca.vertcat(motion.rate, motion.constraint_input)))
    outputs = {"moved": moved, "by_state": ca.jacobian(moved, system.state)}
    outputs["by_control"] = ca.jacobian(moved, motion.control)
    inputs, pivot = {"control": motion.control}, structure.elimination.pivot
    function = system.trace("linearized motion", outputs, inputs, pivot, often=False)
    found = [value.reshape(n + m, -1) for value in function(x, u, values)]
    if not function.is_valid:
        raise ModelError(
            f"{system.name}: A(x) of Assumption (2) is singular at x = {show(x)}, so the "
            "motion is not determined there; linearize at another state"
        )
    (rate, force), by_state, by_control = np.split(found[0][:, 0], [n]), *found[1:]
    # In descriptor form, in (x, v).
    r, v, w = ca.SX.sym("r", n), ca.SX.sym("v", m), ca.SX.sym("u", p)
    balance = system.f + ca.mtimes(system.g, v) + ca.mtimes(system.h, w)
    rows = ca.vertcat(balance - ca.mtimes(system.mass_matrix, r), system.k, system.outputs(v))
    slopes = ca.jacobian(rows, ca.vertcat(system.state, v, w))
    outputs = {"mass": ca.densify(system.mass_matrix), "slopes": ca.densify(slopes)}
    function = system.trace("linearization", outputs, {"r": r, "v": v, "u": w}, often=False)
    mass, whole = function(x, rate, force, u, values)
    (A, B), (C, D) = (
        np.split(half, [n + m], axis=1) for half in np.split(whole.reshape(slopes.shape), [n + m])
    )
    E = scipy.linalg.block_diag(mass.reshape(n, n), np.zeros((m, m)))
    unknowns = (*system.state_signals, *system.constraint_input_signals)
    descriptor = LinearModel(E, A, B, C, D, unknowns, system.output_signals)
    # In minimal form: (dx', dv) = by_state dx + by_control du.
    free, basis = coordinates(manifold.gradients(x, values), structure.scale)
    minimal = LinearModel(
        np.eye(free.size),
        (by_state[:n] @ basis)[free],
        by_control[free],
        (C[:, :n] + C[:, n:] @ by_state[n:]) @ basis,
        C[:, n:] @ by_control[n:],
        tuple(system.state_signals[i] for i in free),
        system.output_signals,
    )
    return Linearization(descriptor, minimal, structure.index, free, basis, x, rate, u, force)
