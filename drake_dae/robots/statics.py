"""Configurations (58) and static balance: two problems for Newton's method."""

import casadi as ca
import numpy as np

from drake_dae.arrays import FloatArray, show
from drake_dae.dae import DaeSystem
from drake_dae.errors import InconsistentStateError, ModelError
from drake_dae.robots.links import Links
from drake_dae.trace.functions import TracedFunction
from drake_dae.trace.numerics import NewtonModel, newton, once, shortest_steps


class StaticPlacement:
    """The equations 0 = phi(q), h_1(q) = z_1, to be solved for q: q = psi(z_1) of (58)."""

    def __init__(self, dae: DaeSystem, q: ca.SX, phi: ca.SX, h_1: ca.SX) -> None:
        p, of_outputs = dae.parameter_symbol, ca.SX.sym("p", dae.parameter_symbol.numel())
        h_1 = ca.substitute(h_1, p, of_outputs)
        self._robot = dae.name
        self._function = TracedFunction(
            f"{dae.name} positions",
            {"q": q, "parameters": p, "parameters of outputs": of_outputs},
            {"phi": phi, "h_1": h_1, "J": ca.jacobian(phi, q), "P": ca.jacobian(h_1, q)},
        )

    def solve(
        self, outputs: FloatArray, guess: FloatArray, parameters: FloatArray, of_outputs: FloatArray
    ) -> FloatArray:
        """A solution near a guess for the first components of z_1; the others are free.

        `parameters` are the values of all parameters for phi, `of_outputs` those for h_1.
        """
        count = outputs.size
        evaluated = once(lambda q: self._function(q, parameters, of_outputs))

        def residual(q: FloatArray) -> FloatArray:
            phi, h_1, _, _ = evaluated(q)
            return np.concatenate([phi, h_1[:count] - outputs])  # (58)

        def linearize(q: FloatArray) -> NewtonModel | None:
            _, _, J, P = evaluated(q)
            gradients = np.vstack([J.reshape(-1, q.size), P.reshape(-1, q.size)[:count]])
            return shortest_steps(gradients, residual)

        q, _ = newton(guess, linearize)
        left = residual(q)
        size = float(np.max(np.abs(left), initial=0.0))
        if size < 1e-10:
            return q
        raise InconsistentStateError(
            f"{self._robot}: no configuration near the guess satisfies the constraints with "
            f"outputs {show(outputs)}; {size:.2g} is left. They may be out of reach",
            left,
        )


class StaticBalance:
    """The equations 0 = f + g lambda + h u at v = 0, S lambda = z_2, for the stages' s, u, lambda.

    S is without redundant constraints. Without stages any state of the links is one at rest.
    """

    def __init__(self, dae: DaeSystem, robot: Links, S: ca.SX) -> None:
        q, v, links = robot.q, robot.v, robot.q.numel() + robot.v.numel()
        force, load = ca.SX.sym("lambda", dae.num_constraints), ca.SX.sym("z_2", S.shape[0])
        control = ca.SX.sym("u", dae.num_controls)
        balance = dae.f + ca.mtimes(dae.g, force) + ca.mtimes(dae.h, control)
        balance = ca.substitute(balance[q.numel() :], v, ca.SX.zeros(v.numel()))
        balance = ca.vertcat(balance, ca.mtimes(S, force) - load)
        all_forces = ca.substitute(dae.forces(force), v, ca.SX.zeros(v.numel()))
        unknown = ca.vertcat(dae.state[links:], control, force)
        self._unknowns = unknown.numel()
        self._robot, self._stages = dae.name, dae.num_states - links
        self._still = np.zeros(v.numel())
        self._function = TracedFunction(
            f"{dae.name} equilibrium",
            {"q": q, "z_2": load, "s, u, lambda": unknown, "parameters": dae.parameter_symbol},
            {"balance": balance, "gradient": ca.jacobian(balance, unknown), "lambda": all_forces},
        )

    def state(self, q: FloatArray, forces: FloatArray, parameters: FloatArray) -> FloatArray:
        """The state at rest; ModelError if no drive holds the robot there."""
        if not self._stages:  # Forces enter no state.
            return np.concatenate([q, self._still])
        state, _, left = self.rest(q, forces, parameters)
        if left > 1e-6 * (1.0 + float(np.max(np.abs(forces), initial=0.0))):
            raise ModelError(
                f"{self._robot}: no control holds the robot at rest at q = {show(q)} with forces "
                f"{forces}; {left:.2g} N m is left. It has fewer actuators than joints"
            )
        return state

    def rest(
        self, q: FloatArray, forces: FloatArray, parameters: FloatArray
    ) -> tuple[FloatArray, FloatArray, float]:
        """The state at rest, lambda, and the largest remaining residual, at positions, for z_2."""
        evaluated = once(lambda unknown: self._function(q, forces, unknown, parameters))

        def linearize(unknown: FloatArray) -> NewtonModel | None:
            balance, gradient, _ = evaluated(unknown)
            gradient = gradient.reshape(balance.size, -1)
            # Currents and forces differ by orders of magnitude.
            scale = np.maximum(np.linalg.norm(gradient, axis=0), np.finfo(float).tiny)
            steps = shortest_steps(gradient / scale, lambda x: evaluated(x)[0])
            if steps is None:
                return None
            return NewtonModel(lambda x: steps.step(x) / scale, steps.is_regular)

        solution, _ = newton(np.zeros(self._unknowns), linearize)
        residuals, _, constraint_force = self._function(q, forces, solution, parameters)
        state = np.concatenate([q, self._still, solution[: self._stages]])
        return state, constraint_force, float(np.max(np.abs(residuals), initial=0.0))
