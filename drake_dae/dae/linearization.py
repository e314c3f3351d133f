"""Linear models of (1)-(3) and of closed loops: as they stand, and in minimal form on N*."""

from dataclasses import dataclass
from math import floor

import casadi as ca
import numpy as np
import scipy.linalg
from numpy.typing import ArrayLike

from drake_dae.arguments import checked
from drake_dae.arrays import FloatArray, number, positive, show, vector
from drake_dae.dae.manifold import coordinates
from drake_dae.dae.signals import Indices, Signal
from drake_dae.dae.structure import ConstraintStructure, constraint_structure_of
from drake_dae.dae.system import DaeSystem
from drake_dae.dae.tracking import TrackingLaw
from drake_dae.errors import InconsistentStateError, ModelError
from drake_dae.trace.round_off import equilibration

SAME = 1e-9  # Times that differ by less than this, in periods, count as equal.
# A state counts as an equilibrium if its change within the time constant of the fastest pole is at
# most this, relative to its scale.
RESTS = 1e-4
# The largest number of states, including delayed ones; for more, the poles would take minutes.
MOST_STATES = 2000

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
    structure, p = constraint_structure_of("linearize", system, structure), system.num_controls
    u = np.zeros(p) if control is None else vector(f"{system.name}: control", control, p)
    values = system.parameter_vector(parameters)
    x, feedback = _consistent(structure, state, values), np.zeros((p, system.num_states))
    return _linearized(structure, x, values, u, feedback, np.eye(p))


@checked(ModelError)
def linearize_loop(
    law: TrackingLaw,
    reference: ArrayLike,
    state: ArrayLike | None = None,
    *,
    parameters: ArrayLike | None = None,
) -> Linearization:
    """Linearizes a plant under the law (28), from R to the controlled outputs z."""
    if law.integral.outputs or law.control_takes_force:
        what = "integrals" if law.integral.outputs else "a measured force in its control"
        raise ModelError(
            f"{law.system.name}: a law with {what} has a state in the loop that this model does "
            "not include; take the law without it, or convert the loop's diagram to AutoDiffXd and "
            "use Drake's Linearize"
        )
    system, structure, n = law.system, law.structure, law.system.num_states
    R = vector(f"{system.name}: reference", reference, law.layout.reference_size)
    values = system.parameter_vector(parameters)
    x = _consistent(structure, state, values)
    force = [np.zeros(system.num_constraints)] if law.measured_force else []
    at = (x, R, *force, law.all_parameters())
    control = law.function(*at)[0]
    slope = law.function.derivative(law.function.output_names.index("control"), range(2))
    gains = slope(*at)[0].reshape(control.size, -1)
    return _linearized(structure, x, values, control, gains[:, :n], gains[:, n:])


def _linearized(
    structure: ConstraintStructure,
    state: FloatArray,
    parameters: FloatArray,
    control: FloatArray,
    feedback: FloatArray,
    forward: FloatArray,
) -> Linearization:
    """The linear models at a state with du = feedback dx + forward dw."""
    system, motion, x = structure.system, structure.derivatives, structure.system.state
    n, m, p = system.num_states, system.num_constraints, system.num_controls
    # On N*: (x', v), and their derivatives by x and by u.
    moved = ca.cse(motion.expand(ca.vertcat(motion.rate, motion.constraint_input)))
    outputs = {"moved": moved, "by_state": ca.jacobian(moved, x)}
    outputs["by_control"] = ca.jacobian(moved, motion.control)
    inputs, pivot = {"control": motion.control}, structure.elimination.pivot
    function = system.trace("linearized motion", outputs, inputs, pivot, often=False)
    values = [value.reshape(n + m, -1) for value in function(state, control, parameters)]
    if not function.is_valid:
        raise ModelError(
            f"{system.name}: A(x) of Assumption (2) is singular at x = {show(state)}, so the "
            "motion is not determined there; linearize at another state"
        )
    (rate, force), by_state, by_control = np.split(values[0][:, 0], [n]), *values[1:]
    # In descriptor form, in (x, v).
    v, u, r = ca.SX.sym("v", m), ca.SX.sym("u", p), ca.SX.sym("r", n)
    balance = system.f + ca.mtimes(system.g, v) + ca.mtimes(system.h, u)
    rows = ca.vertcat(balance - ca.mtimes(system.mass_matrix, r), system.k, system.outputs(v))
    slopes = ca.jacobian(rows, ca.vertcat(x, v, u))
    outputs = {"mass": ca.densify(system.mass_matrix), "slopes": ca.densify(slopes)}
    function = system.trace("linearization", outputs, {"r": r, "v": v, "u": u}, often=False)
    mass, whole = function(state, rate, force, control, parameters)
    whole = whole.reshape(slopes.shape)
    A, B, C = whole[: n + m, : n + m].copy(), whole[: n + m, n + m :], whole[n + m :, : n + m]
    A[:, :n] += B @ feedback
    E = scipy.linalg.block_diag(mass.reshape(n, n), np.zeros((m, m)))
    unknowns = (*system.state_signals, *system.constraint_input_signals)
    none = np.zeros((system.num_outputs, forward.shape[1]))
    descriptor = LinearModel(E, A, B @ forward, C, none, unknowns, system.output_signals)
    # In minimal form: (dx', dv) = by_state dx + by_input dw.
    by_state, by_input = by_state + by_control @ feedback, by_control @ forward
    gradients = structure.manifold.gradients(state, parameters)
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
    at = (state, rate, control, force)
    return Linearization(descriptor, minimal, structure.index, free, basis, *at)


def _consistent(
    structure: ConstraintStructure, state: ArrayLike | None, parameters: FloatArray
) -> FloatArray:
    """A state on N*, the nominal consistent one if None."""
    system, manifold = structure.system, structure.manifold
    x = system.state_vector(structure.states[0] if state is None else state)
    if manifold.is_consistent(x, parameters):
        return x
    raise InconsistentStateError(
        f"{system.name}: x = {show(x)} is not on N*, where the motion is; linearize at "
        "`find_structure(system).manifold.project(x)`",
        manifold.residual(x, parameters),
    )


@checked(ModelError)
def sampled_poles(
    law: TrackingLaw,
    reference: ArrayLike,
    period: float,
    delay: float = 0.0,
    *,
    state: ArrayLike | None = None,
    parameters: ArrayLike | None = None,
) -> ComplexArray:
    """Returns the exact poles of a robot under a sampled law, about an equilibrium.

    The law samples at t_k = k T; its control acts from t_k + d until t_(k+1) + d. About an
    equilibrium a deviation x of the minimal states on N* has x' = A x without the law and x' = (A +
    G) x with it. With d = n T + c, 0 <= c < T, and Gamma(t) = int_0^t exp(A s) ds,

        x_(k+1) = exp(A T) x_k + Gamma(T - c) G x_(k-n) + exp(A (T - c)) Gamma(c) G x_(k-n-1).

    The loop is stable where all of these poles, shape ((n + 2) k,) for k minimal states, largest
    first, are within the unit circle; where T and d tend to 0 they tend to exp(p T) for the poles p
    of the continuous loop, and to 0. A compliant constraint has further poles: `contact_damping`.
    The state, the nominal consistent one if None, must be an equilibrium under the law with R.
    """
    period, delay = positive("period", period), number("delay", delay)
    if delay < 0.0:
        raise ModelError(f"delay must be 0 s or more, got {delay:g}")
    loop = linearize_loop(law, reference, state, parameters=parameters)
    plant = linearize(
        law.system, loop.state, loop.control, structure=law.structure, parameters=parameters
    )
    A = plant.minimal.A
    G = loop.minimal.A - A
    moves = np.abs(loop.rate) / law.system.scale
    worst = int(np.argmax(moves))
    if moves[worst] > RESTS * np.max(np.abs(np.linalg.eigvals(A + G)), initial=0.0):
        signal = law.system.state_signals[worst]
        raise ModelError(
            f"{law.system.name}: poles are computed at an equilibrium under the law, but at this "
            f"state {signal.name} changes by {loop.rate[worst]:.3g} {signal.unit} per second. Give "
            "a constant reference, and its steady state"
        )
    size, late = len(A), floor(delay / period + SAME)
    if (late + 2) * size > MOST_STATES:
        raise ModelError(
            f"a delay of {delay:g} s is {late} periods of {period:g} s, which needs "
            f"{late + 2} x {size} states; at most {MOST_STATES} are allowed. Use a longer period"
        )
    rest = max(delay - late * period, 0.0)
    both = np.block([[A, G], [np.zeros((size, 2 * size))]])
    # exp(A t) and Gamma(t) G.
    begin, end = (scipy.linalg.expm(both * t)[:size] for t in (rest, period - rest))
    matrix = np.eye((late + 2) * size, k=-size)
    matrix[:size] = 0.0
    matrix[:size, :size] = end[:, :size] @ begin[:, :size]
    matrix[:size, late * size : (late + 1) * size] += end[:, size:]
    matrix[:size, (late + 1) * size :] += end[:, :size] @ begin[:, size:]
    eigenvalues = np.linalg.eigvals(matrix).astype(complex)
    return eigenvalues[np.argsort(-np.abs(eigenvalues), kind="stable")]
