"""Where a robot can stand (58), and what holds it there: two problems for Newton's method."""

from collections.abc import Sequence

import casadi as ca
import numpy as np

from drake_dae.arrays import FloatArray
from drake_dae.dae.system import DaeSystem
from drake_dae.trace.functions import TracedFunction
from drake_dae.trace.newton import Linearization, newton, shortest_steps


class Placing:
    """The equations 0 = phi(q), h_1(q) = z_1, to be solved for q: q = psi(z_1) of (58).

    Args:
        dae: The robot's system, for its parameters.
        q: Positions, shape (nq, 1).
        phi: Constraints, shape (k, 1).
        h_1: Position outputs, shape (p, 1).
    """

    def __init__(self, dae: DaeSystem, q: ca.SX, phi: ca.SX, h_1: ca.SX) -> None:
        self._function = TracedFunction(
            f"{dae.name} positions",
            {"q": q, "parameters": dae.parameter_symbol},
            {"phi": phi, "h_1": h_1, "J": ca.jacobian(phi, q), "P": ca.jacobian(h_1, q)},
        )

    def solve(
        self, outputs: FloatArray, guess: FloatArray, parameters: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """A solution near a guess, and what is left of the equations.

        Args:
            outputs: The first components of z_1; the others are free.
            guess: Where to start, shape (nq,).
            parameters: Values of all parameters.
        """
        count = outputs.size

        def residual(q: FloatArray) -> FloatArray:
            phi, h_1, _, _ = self._function(q, parameters)
            return np.concatenate([phi, h_1[:count] - outputs])

        def linearize(q: FloatArray) -> Linearization | None:
            _, _, J, P = self._function(q, parameters)
            gradients = np.vstack([J.reshape(-1, q.size), P.reshape(-1, q.size)[:count]])
            return shortest_steps(gradients, residual)

        found, _ = newton(guess, linearize)
        return found, residual(found)


class Balance:
    """The equations 0 = f + g lambda + h u at v = 0, to be solved for the stages' s and for u.

    Args:
        dae: The robot's system, with the state (q, v, s).
        q, v: Positions and velocities, shapes (nq, 1) and (nv, 1).
        given: Which entries of lambda are given; the others are solved for as well.
    """

    def __init__(self, dae: DaeSystem, q: ca.SX, v: ca.SX, given: Sequence[int]) -> None:
        links = q.numel() + v.numel()
        control = ca.SX.sym("u", dae.num_controls)
        force = ca.SX.sym("lambda", dae.num_constraints)
        balance = dae.f + ca.mtimes(dae.g, force) + ca.mtimes(dae.h, control)
        balance = ca.substitute(balance[q.numel() :], v, ca.SX.zeros(v.numel()))
        free = [i for i in range(dae.num_constraints) if i not in given]
        unknown = ca.vertcat(dae.state[links:], control, force[free])
        self._unknowns = unknown.numel()
        self._stages = dae.num_states - links
        self._still = np.zeros(v.numel())
        self._function = TracedFunction(
            f"{dae.name} equilibrium",
            {
                "q": q,
                "constraint_force": force[list(given)],
                "s, u, free forces": unknown,
                "parameters": dae.parameter_symbol,
            },
            {"balance": balance, "gradient": ca.jacobian(balance, unknown)},
        )

    def rest(
        self, q: FloatArray, constraint_force: FloatArray, parameters: FloatArray
    ) -> tuple[FloatArray, float]:
        """The state at rest, and the largest entry of the balance that is left.

        Args:
            q: Positions, shape (nq,).
            constraint_force: The entries of lambda that are given.
            parameters: Values of all parameters.
        """

        def residual(unknown: FloatArray) -> FloatArray:
            return self._function(q, constraint_force, unknown, parameters)[0]

        def linearize(unknown: FloatArray) -> Linearization | None:
            balance, gradient = self._function(q, constraint_force, unknown, parameters)
            gradient = gradient.reshape(balance.size, -1)
            # Currents and forces differ by orders of magnitude.
            scale = np.maximum(np.linalg.norm(gradient, axis=0), np.finfo(float).tiny)
            steps = shortest_steps(gradient / scale, residual)
            if steps is None:
                return None
            return Linearization(lambda x: steps.step(x) / scale, steps.is_regular)

        solution, _ = newton(np.zeros(self._unknowns), linearize)
        left = float(np.max(np.abs(residual(solution)), initial=0.0))
        return np.concatenate([q, self._still, solution[: self._stages]]), left
