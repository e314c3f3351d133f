"""The normal form (20)-(24), and linear models: of the descriptor system, and on N*."""

from dataclasses import dataclass

import casadi as ca
import numpy as np
import scipy.linalg
from numpy.typing import ArrayLike

from drake_dae.arguments import checked
from drake_dae.arrays import FloatArray, listed, show, vector
from drake_dae.dae.manifold import coordinates
from drake_dae.dae.margins import find_margin
from drake_dae.dae.samples import Samples
from drake_dae.dae.signals import Indices, Signal
from drake_dae.dae.structure import (
    ConstraintStructure,
    Structure,
    find_constraint_structure,
    find_structure,
    structure_of,
)
from drake_dae.dae.system import DaeSystem
from drake_dae.errors import InconsistentStateError, ModelError
from drake_dae.trace.numerics import NewtonModel, equilibration, newton, unit_rows

# Single states complete the chains if the sine of their smallest angle is above this.
TRANSVERSAL = 0.05


@checked(ModelError)
class NormalForm:
    """The change of coordinates Phi (20)-(22),

        y    = k_i, L_f k_i, ..., L_f^(r_i - 1) k_i              (xtilde, zero on N*)
        zeta = l*_i, L_f* l*_i, ..., L_f*^(mu_i - 1) l*_i        (xbar; outputs with mu_i >= 1)
        xi   = Psi_2(x)                                          (the completion)

    both chains in the order of the system's constraints and outputs.

    Phi is a local diffeomorphism where its Jacobian is regular. By Theorem 2.1 the differentials of
    both chains are independent wherever A(x) of Assumption (2) and B(x) of (16) are regular. The
    paper allows any completion, L_h* xi = 0 is not required: xi are d = n - sum r_i - sum mu_i
    states that complete the chains well at all of `structure.states`. In all methods states,
    guesses and coordinates (y, zeta, xi) have shape (n,), and `parameters` are those of all, the
    defaults if None.

    Args:
        system: The system (1)-(3).
        structure: The structure of the system; found if None.

    Attributes:
        completion, completion_signals: xi, shape (d, 1), and its names and units.
        coordinate_signals: Names and units of (y, zeta, xi), n in all.
        margin: The margin of the Jacobian of Phi over `structure.states`.

    Raises:
        ModelError: No states complete the chains at all of them, or B(x) is singular.
    """

    def __init__(self, system: DaeSystem, *, structure: Structure | None = None) -> None:
        structure = structure_of(system, structure, find_structure)
        self.structure, self.system = structure, system
        if structure.control_margin.is_singular:
            raise ModelError(
                f"{system.name}: B(x) of (16) is singular at x = "
                f"{show(structure.control_margin.state)}, so the output chains are not independent "
                "there and are no coordinates; choose other outputs"
            )
        chains = ca.vertcat(structure.manifold.residual_expression, structure.chain)  # (21)
        samples = Samples(structure.manifold, structure.states)
        chosen = _completing_states(structure, chains, samples)
        self.completion = system.state[chosen, :]  # (22)
        self.completion_signals = tuple(system.state_signals[i] for i in chosen)
        self.coordinate_signals = (
            *structure.manifold.residual_signals,
            *structure.layout.chain_signals(system.output_signals),
            *self.completion_signals,
        )
        coordinates = ca.vertcat(chains, self.completion)  # (20)
        jacobian = ca.jacobian(coordinates, system.state)
        self.margin = find_margin(samples, jacobian)
        if self.margin.is_singular:
            raise ModelError(
                f"{system.name}: Phi (20) is no change of coordinates at x = "
                f"{show(self.margin.state)}: A(x) of Assumption (2) or B(x) of (16) is close to "
                "singular there, or the states that complete the chains do not. Give `structure`, "
                "found with a smaller spread"
            )
        self._map = system.trace(
            "normal form and Jacobian", {"y": coordinates, "jacobian": jacobian}
        )
        # Not the scale of `samples`, in which a state that is zero on N* is round-off.
        self._scale = structure.scale

    def __repr__(self) -> str:
        names = listed(signal.name for signal in self.coordinate_signals)
        return f"NormalForm('{self.system.name}', coordinates={names})"

    def coordinates(self, state: ArrayLike, parameters: ArrayLike | None = None) -> FloatArray:
        """Returns Phi(x) = (y, zeta, xi) of (20)-(22), for x on N* or not."""
        return self._at(self.system.state_vector(state), parameters)[0]

    def jacobian(self, state: ArrayLike, parameters: ArrayLike | None = None) -> FloatArray:
        """Returns dPhi/dx, shape (n, n); it is singular where Phi is no change of coordinates."""
        return self._at(self.system.state_vector(state), parameters)[1]

    def rates(
        self, state: ArrayLike, control: ArrayLike, parameters: ArrayLike | None = None
    ) -> FloatArray:
        """Returns the state realization (26)-(27), the rates of (zeta, xi) at a state on N*:

            zeta_i,j' = zeta_i,j+1,    zeta_i,mu_i' = a_i(x) + B_i(x) u,
            xi' = L_f* xi + L_h* xi u.

        With `state`, which is Phi^-1(0, zeta, xi), these are n - sum r_i ordinary differential
        equations without constraints.
        """
        structure, dae, layout = self.structure, self.system, self.structure.layout
        u = structure.derivatives.control
        highest = structure.drift + ca.mtimes(structure.control_matrix, u)  # (26)
        chain = ca.vertcat(structure.chain, 0)[1:, :]
        chain[layout.ends.tolist()] = highest[layout.dynamic.tolist(), :]
        moving = structure.derivatives.expand(structure.derivatives.rate)
        rate = ca.jtimes(self.completion, dae.state, moving)
        values = ca.vertcat(chain, rate if self.completion.numel() else ca.SX(0, 1))  # (27)
        function = structure.trace("state realization", values, True)
        p = dae.parameter_vector(parameters)
        return function(dae.state_vector(state), vector("control", control, dae.num_controls), p)[0]

    def state(
        self,
        coordinates: ArrayLike,
        guess: ArrayLike | None = None,
        parameters: ArrayLike | None = None,
    ) -> FloatArray:
        """Returns x = Phi^-1(y, zeta, xi) of (24), to round-off; with y = 0 that of (27), on N*.

        Of several such states (elbow up, elbow down) the one is found that continues the guess: by
        Newton's method, or along the line from its coordinates to the given ones.

        Raises:
            InconsistentStateError: There is no such state, or it is not reached from the guess;
                `residual` is the remaining error of the coordinates.
        """
        target = vector(f"{self.system.name}: coordinates", coordinates, self.system.num_states)
        x = self.system.state_vector(self.structure.states[0] if guess is None else guess)
        p = self.system.parameter_vector(parameters)
        start, reached, stride = self._at(x, p)[0], 0.0, 1.0
        while reached < 1.0:
            share = min(1.0, reached + stride)
            goal = target if share == 1.0 else start + share * (target - start)
            solution = self._newton(x, goal, p)  # (24)
            if solution is not None:
                x, reached, stride = solution, share, 2.0 * stride
            elif stride > 1e-4:
                stride /= 2.0
            else:
                missing = target - self._at(x, p)[0]
                worst = int(np.argmax(np.abs(missing)))
                raise InconsistentStateError(
                    f"{self.system.name}: no way from the guess to the given coordinates: "
                    f"{self.coordinate_signals[worst].name} does not reach {target[worst]:.6g}; "
                    f"the search ended at x = {show(x)}. Start from a guess that is nearer, or "
                    "A(x), B(x) or the Jacobian of xi loses its rank there (Theorem 2.1)",
                    missing,
                )
        return x

    def _newton(
        self, state: FloatArray, target: FloatArray, parameters: FloatArray
    ) -> FloatArray | None:
        """The state with given coordinates, sought from another one in units of its size."""
        # Powers of 2, so that nothing is rounded.
        scale = np.exp2(np.ceil(np.log2(np.maximum(self._scale, np.abs(state)))))

        def linearize(z: FloatArray) -> NewtonModel | None:
            matrix = self._at(scale * z, parameters)[1] * scale
            rows = np.abs(matrix).max(axis=1)
            if not (rows.min() > 0.0 and rows.max() < np.inf):
                return None
            try:
                inverse = np.linalg.inv(matrix / rows[:, None])
            except np.linalg.LinAlgError:
                return None

            def step(z: FloatArray) -> FloatArray:
                missing = target - self._map.evaluate(scale * z, parameters)[0]
                return np.asarray(inverse @ (missing / rows))

            return NewtonModel(step, True)

        solution, converged = newton(state / scale, linearize)
        return scale * solution if converged else None

    def _at(self, state: FloatArray, parameters: ArrayLike | None) -> tuple[FloatArray, FloatArray]:
        """Phi and its Jacobian at a state."""
        values, jacobian = self._map(state, self.system.parameter_vector(parameters))
        return values, jacobian.reshape(values.size, -1)


def _completing_states(structure: Structure, chains: ca.SX, samples: Samples) -> list[int]:
    """States whose differentials complete those of the chains well at all samples.

    They are regular on the null spaces of the chains' differentials: one QR with pivoting for all.
    """
    system, count = structure.system, structure.zero_dynamics_dimension
    gradients = samples.values(gradient=ca.jacobian(chains, system.state))
    rows = np.array([unit_rows(gradient * samples.scale) for (gradient,) in gradients])
    spaces = np.linalg.svd(rows)[2][:, system.num_states - count :].transpose(0, 2, 1)
    rest, chosen = spaces.copy(), list[int]()
    for _ in range(count):
        # Rounded, so that ties go to the first state on every machine.
        chosen.append(int(np.argmax(np.round(np.linalg.norm(rest, axis=2).min(axis=0), 6))))
        direction = unit_rows(rest[:, chosen[-1]])
        rest -= np.einsum("kid,kd,ke->kie", rest, direction, direction)
    sines = np.linalg.svd(spaces[:, sorted(chosen)], compute_uv=False)
    if sines.min(initial=1.0) <= TRANSVERSAL:
        raise ModelError(
            f"{system.name}: no {count} states complete the chains (20) at all states around the "
            "nominal one; give `structure`, found with a smaller spread"
        )
    return sorted(chosen)


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

    Exogenous signals are at rest, unless `parameters` say otherwise.

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
