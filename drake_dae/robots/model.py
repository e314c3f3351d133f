"""A constrained robot as a DaeSystem.                        (37)-(45), (64)-(68), (74)-(78)"""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from typing import Self

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike
from pydrake.multibody.plant import MultibodyPlant

from drake_dae.arrays import FloatArray
from drake_dae.dae.signals import Signal
from drake_dae.dae.system import DaeSystem
from drake_dae.errors import InconsistentStateError, ModelError
from drake_dae.robots.actuation.chain import ActuationChain, chain
from drake_dae.robots.actuation.stage import Stage
from drake_dae.robots.contact.constraint import Constraint
from drake_dae.robots.links.links import Links
from drake_dae.robots.links.multibody import MultibodyExpressions
from drake_dae.robots.outputs import PositionOutput
from drake_dae.trace.functions import TracedFunction
from drake_dae.trace.newton import Linearization, newton, shortest_steps


class RobotModel:
    """A robot in contact, equations (37)-(40):

        M(q) v' + H(q, v) = J(q)^T lambda + B tau,    q' = N(q) v,
        0 = phi(q),    z_1 = h_1(q),    z_2 = lambda,

    with J = (dphi/dq) N. With rigid joints tau = u; stages of actuation put their own dynamics
    between u and tau: E s' = drift(q, v, s) + drive u, tau = tau(q, v, s), as in (64)-(65) and
    (74)-(75). The state is x = (q, v, s), the constraint input is lambda, and the controlled
    outputs are z = (z_1, z_2), so there are as many position outputs as there are actuators less
    constraints.

    Args:
        links: M, H and kinematics.
        constraints: phi, one below the other; none is a robot that moves freely.
        positions: h_1, one below the other.
        nominal_positions: A configuration of the robot at work, shape (nq,), near which the
            structure is examined; `links.default_positions` if None.
        name: For messages.
        actuation: Stages from the joints toward the motor; none is rigid joints.

    Attributes:
        dae: The `DaeSystem` (43)-(45).
        links, constraints, positions: As given.
        stages: The attached stages.
        joint_force: tau as an expression of `dae.state`; None with rigid joints.

    Raises:
        ModelError: Too many or too few outputs, an M that is not positive definite, or stages
            that do not fit.
    """

    def __init__(
        self,
        links: Links,
        constraints: Sequence[Constraint],
        positions: Sequence[PositionOutput],
        nominal_positions: ArrayLike | None = None,
        name: str = "robot",
        actuation: Sequence[Stage] = (),
    ) -> None:
        for stage in actuation if isinstance(actuation, Sequence) else [None]:
            if not hasattr(stage, "attach"):
                raise ModelError(
                    f"{name}: actuation is a list of stages such as [FlexibleJoints(8000.0)], got "
                    f"{actuation!r}"
                )
        self.links = links
        self.constraints = tuple(constraints)
        self.positions = tuple(positions)
        self.name = name
        phi = self._residual(links)
        h_1 = ca.vertcat(ca.SX(0, 1), *[p.expression(links) for p in self.positions])
        self._check_number(phi.numel(), h_1.numel())
        nominal = np.asarray(
            links.default_positions if nominal_positions is None else nominal_positions, float
        )
        if nominal.shape != (links.q.numel(),):
            raise ModelError(
                f"{name}: nominal_positions has shape {nominal.shape}, not ({links.q.numel()},)"
            )
        self._chain = self._attach(actuation)
        self.stages = self._chain.stages
        self.joint_force = self._chain.joint_force if self.stages else None
        #: Largest |u| per actuator, infinite where there is none or where u is no joint force.
        self.control_limits = (
            links.effort_limits
            if self._chain.control_signals == tuple(links.actuator_signals)
            else np.full(len(links.actuator_signals), np.inf)
        )
        self.dae = self._equations(phi, h_1, nominal)
        self._configuration = TracedFunction(
            f"{name} configuration",
            {"q": links.q, "parameters": self.dae.parameter_symbol},
            {"phi": phi, "h_1": h_1, "jacobian": ca.jacobian(ca.vertcat(phi, h_1), links.q)},
        )
        self._trace_equilibrium()
        if self.stages:
            # On the constraints first: shafts that rest off them would strain the springs.
            with suppress(InconsistentStateError):
                nominal = self.configuration(None, nominal)
            rest = self._rest(nominal, np.zeros(phi.numel()), self.dae.parameter_values)[0]
            self.dae = replace(self.dae, nominal_state=rest)

    @classmethod
    def from_multibody(
        cls,
        plant: MultibodyPlant,
        constraints: Sequence[Constraint],
        positions: Sequence[PositionOutput],
        nominal_positions: ArrayLike | None = None,
        name: str = "robot",
        actuation: Sequence[Stage] = (),
    ) -> Self:
        """The robot of a finalized MultibodyPlant; see `MultibodyExpressions` for what it reads.

        Raises:
            ModelError: What the plant has and cannot be represented, by name.
        """
        links = MultibodyExpressions(plant)
        return cls(links, constraints, positions, nominal_positions, name, actuation)

    @property
    def position_signals(self) -> tuple[Signal, ...]:
        """Names and units of z_1."""
        return self.dae.output_signals[: self.dae.num_controls - self.dae.num_constraints]

    def configuration(
        self, outputs: ArrayLike | None, guess: ArrayLike, parameters: ArrayLike | None = None
    ) -> FloatArray:
        """q = psi(z_1) of (58): the consistent configuration with given position outputs.

        Args:
            outputs: z_1, shape (nu - m,); None leaves them free.
            guess: Where Newton's method starts, shape (nq,).
            parameters: Values of all parameters; the defaults if None.

        Returns:
            Shape (nq,); where the outputs leave freedom, the one next to the guess.

        Raises:
            InconsistentStateError: No such configuration near the guess.
            ModelError: A shape that does not fit.
        """
        q = np.array(guess, dtype=float)
        count = 0 if outputs is None else len(self.position_signals)
        wanted = np.zeros(0) if outputs is None else np.asarray(outputs, dtype=float)
        if wanted.shape != (count,) or q.shape != (self.links.q.numel(),):
            raise ModelError(
                f"{self.name}: outputs and guess have shapes {wanted.shape} and {q.shape}, "
                f"expected ({count},) and ({self.links.q.numel()},)"
            )
        values = self.dae.parameter_values if parameters is None else parameters

        def residual(q: FloatArray) -> FloatArray:
            phi, h_1, _ = self._configuration(q, values)
            return np.concatenate([phi, h_1[:count] - wanted])

        def linearize(q: FloatArray) -> Linearization | None:
            jacobian = self._configuration(q, values)[2].reshape(-1, q.size)
            return shortest_steps(jacobian[: self.dae.num_constraints + count], residual)

        found, _ = newton(q, linearize)
        left = residual(found)
        size = float(np.max(np.abs(left), initial=0.0))
        if size < 1e-10:
            return found
        raise InconsistentStateError(
            f"{self.name}: no configuration near the guess satisfies the constraints with "
            f"outputs {np.array2string(wanted, precision=4)}; {size:.2g} is left. They may be out "
            "of reach",
            left,
        )

    def rest_state(
        self, positions: ArrayLike, forces: ArrayLike, parameters: ArrayLike | None = None
    ) -> FloatArray:
        """The state at rest in a configuration with given constraint forces.

        What the stages need to hold the robot there (shaft positions, currents, actuator forces)
        is solved for: v = 0, v' = 0, s' = 0.

        Args:
            positions: q, shape (nq,), on the constraints.
            forces: lambda, shape (m,).
            parameters: Values of all parameters; the defaults if None.

        Returns:
            x = (q, 0, s), shape (n,). With rigid joints the forces do not enter it.

        Raises:
            ModelError: No drive holds the robot there.
        """
        values = self.dae.parameter_values if parameters is None else np.asarray(parameters)
        q, load = np.asarray(positions, dtype=float), np.asarray(forces, dtype=float)
        state, left = self._rest(q, load, values)
        if self.stages and left > 1e-6 * (1.0 + float(np.max(np.abs(load), initial=0.0))):
            raise ModelError(
                f"{self.name}: no drive holds the robot at rest at q = "
                f"{np.array2string(q, precision=4)} with forces {load}; {left:.2g} N m is left. It "
                "has fewer actuators than joints"
            )
        return state

    def _residual(self, links: Links) -> ca.SX:
        """phi(q), shape (m, 1)."""
        return ca.vertcat(ca.SX(0, 1), *[c.residual(links) for c in self.constraints])

    def _check_number(self, m: int, count: int) -> None:
        """m constraint forces and the position outputs are as many as the actuators."""
        nu = self.links.actuation_matrix.shape[1]
        if m > nu:
            raise ModelError(
                f"{self.name}: {m} constraint forces are outputs, but {nu} actuators can steer "
                f"{nu} outputs; take constraints away, or add actuators"
            )
        if count + m != nu:
            names = [s.name for p in self.positions for s in p.signals(self.links)]
            raise ModelError(
                f"{self.name}: {nu} actuators can steer {nu} outputs. The {m} constraint forces "
                f"are outputs already, so {nu - m} position outputs are needed; given are "
                f"{count} ({', '.join(names) or 'none'})"
            )

    def _attach(self, actuation: Sequence[Stage]) -> ActuationChain:
        select = self.links.actuation_matrix
        if actuation and not np.allclose(select.T @ select, np.eye(select.shape[1])):
            raise ModelError(
                f"{self.name}: actuation stages need one actuator per actuated joint, so "
                "orthonormal columns of the actuation matrix"
            )
        transposed = ca.SX(ca.sparsify(ca.DM(select.T)))
        rates = ca.mtimes(transposed, self.links.velocity_map)
        if actuation and not ca.is_equal(ca.sparsify(rates), transposed, 9):
            raise ModelError(
                f"{self.name}: actuation stages need the actuated velocities to be derivatives of "
                "positions, q_i' = v_i: choose such coordinates where N(q) is not the identity"
            )
        position = ca.mtimes(transposed, self.links.q)
        return chain(actuation, self.links, position, ca.mtimes(transposed, self.links.v))

    def _equations(self, phi: ca.SX, h_1: ca.SX, nominal: FloatArray) -> DaeSystem:
        """E x' = f + g lambda + h u of the links and then of the stages."""
        links, stages = self.links, self._chain
        nq, nv, m = links.q.numel(), links.v.numel(), phi.numel()
        nu, k = links.actuation_matrix.shape[1], stages.state.numel()
        # The rotors turn with the first stage, or else with the joints.
        rotors = ca.SX(nv, nv)
        if self.stages and self.stages[0].carries_rotors:
            B = links.actuation_matrix
            rotors = ca.SX(ca.sparsify(ca.DM(B * links.reflected_inertia @ B.T)))
        mass = links.mass_matrix - rotors
        self._check_mass_matrix(mass, nominal)
        actuation_matrix = ca.SX(ca.sparsify(ca.DM(links.actuation_matrix)))
        velocity = ca.mtimes(links.velocity_map, links.v)
        torque = ca.mtimes(actuation_matrix, stages.joint_force)

        def motion(rate: ca.SX, multiplier: ca.SX) -> tuple[ca.SX, ca.SX]:
            acceleration = rate[nq : nq + nv]
            inertial, phi_rate = links.motion(acceleration, self._residual, multiplier)
            balance = inertial - ca.mtimes(rotors, acceleration) - torque
            driven = ca.mtimes(stages.mass, rate[nq + nv :]) - stages.drift
            return ca.vertcat(rate[:nq] - velocity, balance, driven), phi_rate

        force_signals = tuple(s for c in self.constraints for s in c.force_signals)
        return DaeSystem(
            state=ca.vertcat(links.q, links.v, stages.state),
            mass_matrix=ca.diagcat(ca.SX.eye(nq), mass, stages.mass),
            f=ca.vertcat(velocity, torque - links.bias, stages.drift),
            g=ca.vertcat(ca.SX(nq, m), links.jacobian(self._residual).T, ca.SX(k, m)),
            h=ca.vertcat(ca.SX(nq, nu), ca.mtimes(actuation_matrix, stages.direct), stages.drive),
            k=phi,
            l=ca.vertcat(h_1, ca.SX(m, 1)),
            m=ca.vertcat(ca.SX(nu - m, m), ca.SX.eye(m)),
            parameters=(
                *links.parameters,
                *(p for stage in self.stages for p in stage.parameters),
                *(p for constraint in self.constraints for p in constraint.parameters),
            ),
            state_signals=(
                *links.position_signals,
                *links.velocity_signals,
                *(s for stage in self.stages for s in stage.state_signals),
            ),
            constraint_input_signals=force_signals,
            constraint_output_signals=tuple(
                s for c in self.constraints for s in c.residual_signals
            ),
            control_signals=stages.control_signals,
            output_signals=(
                *(s for p in self.positions for s in p.signals(links)),
                *force_signals,
            ),
            nominal_state=np.concatenate([nominal, np.zeros(nv + k)]),
            name=self.name,
            motion=motion,
        )

    def _trace_equilibrium(self) -> None:
        """Balance of forces and of the stages at v = 0, to be solved for (s, u)."""
        dae, links = self.dae, self.links
        first = links.q.numel() + links.v.numel()
        control = ca.SX.sym("u", dae.num_controls)
        force = ca.SX.sym("lambda", dae.num_constraints)
        balance = dae.f + ca.mtimes(dae.g, force) + ca.mtimes(dae.h, control)
        balance = balance[links.q.numel() :]
        balance = ca.substitute(balance, links.v, ca.SX.zeros(links.v.numel()))
        unknown = ca.vertcat(dae.state[first:], control)
        self._equilibrium = TracedFunction(
            f"{self.name} equilibrium",
            {"q": links.q, "lambda": force, "s": unknown, "parameters": dae.parameter_symbol},
            {"balance": balance, "gradient": ca.jacobian(balance, unknown)},
        )

    def _rest(
        self, q: FloatArray, forces: FloatArray, parameters: FloatArray
    ) -> tuple[FloatArray, float]:
        """The state at rest and what is left of the balance of forces."""
        nv = self.links.v.numel()
        stages = self.dae.num_states - q.size - nv
        trial, left = np.zeros(stages + self.dae.num_controls), np.inf
        solution = trial
        for _ in range(20):
            balance, gradient = self._equilibrium(q, forces, trial, parameters)
            size = float(np.max(np.abs(balance), initial=0.0))
            if not size < left:
                break
            solution, left = trial, size
            gradient = gradient.reshape(balance.size, -1)
            # Currents and forces differ by orders of magnitude.
            scale = np.maximum(np.linalg.norm(gradient, axis=0), np.finfo(float).tiny)
            trial = solution - np.linalg.lstsq(gradient / scale, balance)[0] / scale
        return np.concatenate([q, np.zeros(nv), solution[:stages]]), left

    def _check_mass_matrix(self, mass_matrix: ca.SX, nominal: FloatArray) -> None:
        parameters = self.links.parameters
        mass = TracedFunction(
            "mass matrix",
            {
                "q": self.links.q,
                "p": ca.vertcat(ca.SX(0, 1), *[p.symbol for p in parameters]),
            },
            {"mass_matrix": mass_matrix},
        )(nominal, np.concatenate([np.zeros(0), *[p.value for p in parameters]]))[0]
        mass = np.atleast_2d(mass)
        asymmetry = np.abs(mass - mass.T).max()
        if asymmetry > 1e-9 * np.abs(mass).max():
            raise ModelError(f"{self.name}: M(q) is not symmetric, by {asymmetry:.2g}")
        smallest = float(np.linalg.eigvalsh(mass)[0])
        if smallest <= 0.0:
            raise ModelError(
                f"{self.name}: M(q) is not positive definite at the nominal configuration: "
                f"smallest eigenvalue {smallest:.2g}. A link without inertia cannot be moved by a "
                "force; give it mass, or weld it"
            )
