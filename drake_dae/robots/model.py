"""A constrained robot as a DaeSystem.                        (37)-(45), (64)-(68), (74)-(78)"""

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import cached_property
from typing import Any, Self

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike
from pydrake.multibody.plant import MultibodyPlant

from drake_dae.arguments import checked
from drake_dae.arrays import FloatArray, show, vector
from drake_dae.dae import DaeSystem, Parameter, Signal, share_forces
from drake_dae.errors import InconsistentStateError, ModelError
from drake_dae.robots.actuation import ActuationChain, Stage, chain, diagonal_parameter
from drake_dae.robots.constraint import Constraint, ConstraintSet
from drake_dae.robots.couplings import plant_constraints
from drake_dae.robots.links import Links, check_links
from drake_dae.robots.loads import Load
from drake_dae.robots.loops import LoopState
from drake_dae.robots.multibody import MultibodyExpressions
from drake_dae.robots.outputs import ForceOutput, PositionOutput, as_force_outputs, force_rows
from drake_dae.trace.compiled import Compiled
from drake_dae.trace.factorization import Factorization
from drake_dae.trace.functions import TracedFunction
from drake_dae.trace.numerics import NewtonModel, newton, once, shortest_steps

MOST = 1000
"""The largest product of unknowns and squared equations whose Newton step is traced."""


@checked(ModelError)
class RobotModel:
    """A robot in contact, equations (37)-(40):

        M(q) v' + H(q, v) = J(q)^T lambda + B tau,    q' = N(q) v,
        0 = phi(q),    z_1 = h_1(q),    z_2 = S(q) lambda,

    with J = (dphi/dq) N; with friction, G(q, v) takes the place of J^T. A nonholonomic constraint
    has its rate in place of phi, and r = 1. With rigid joints tau = u; stages of actuation add
    E s' = drift(q, v, s) + drive u, tau = tau(q, v, s), as in (64)-(65) and (74)-(75). The state is
    x = (q, v, s), the constraint input lambda, and the outputs are z = (z_1, z_2): the number of
    position outputs is that of actuators minus force outputs.

    Args:
        links: The links, which provide M, H and the frames.
        constraints: The constraints phi in their order; none for a robot in free motion. Those of
            the links' MultibodyPlant are appended: see `plant_constraints`.
        outputs: The position outputs h_1 in their order; None for a robot that is only simulated.
        nominal_positions: A configuration at work, shape (nq,), near which the structure is
            examined; if None the default one, or a random one on the constraints.
        name: The robot's name in messages.
        actuation: The stages from the joints toward the motor; none for rigid joints.
        forces: The force outputs z_2: names of constraint forces, and combinations, as a `Squeeze`;
            all constraint forces if None, none without actuators or outputs.
        exogenous: The names of parameters that are exogenous signals w with known derivatives,
            "wall.position" for example; see `DaeSystem`.
        known_forces: Known forces on frames, zero by default, and friction of joints.
        compliances: For redundant constraints: name of a constraint force -> its relative
            compliance, 1 if not named. The forces are shared by least squares, see `share_forces`.
        control_weights: w, positive, for more actuators than outputs: the least sum
            w_i (u_i - u_0i)^2 chooses u; see `DaeSystem`. They and u_0 become the parameters
            "control_weights" and "free_control". Weights 1 / limit^2 share the effort.
        compiled: Whether functions become machine code: True, False or "auto"; see `DaeSystem`.

    Attributes: the arguments, and `dae`, the `DaeSystem` (43)-(45); `stages`, attached;
    `joint_force`, tau as an expression, None with rigid joints; `control_limits`, the largest |u|;
    `loop_joints`, the joints that close loops.

    Raises:
        ModelError: There are too many or too few outputs, M is not positive definite, stages do not
            fit, or the plant has a constraint that cannot be read.
    """

    def __init__(
        self,
        links: Links,
        constraints: Sequence[Constraint] = (),
        outputs: Sequence[PositionOutput] | None = None,
        nominal_positions: ArrayLike | None = None,
        name: str = "robot",
        actuation: Sequence[Stage] = (),
        forces: Sequence[str | ForceOutput] | None = None,
        exogenous: Sequence[str] = (),
        known_forces: Sequence[Load] = (),
        compliances: Mapping[str, float] | None = None,
        control_weights: ArrayLike | None = None,
        compiled: Compiled = "auto",
    ) -> None:
        check_links(links)
        self.links, self.name = links, name
        every = (*constraints, *plant_constraints(links))
        self.constraints = tuple(constraint.moving(exogenous) for constraint in every)
        self.outputs, self.known_forces = tuple(outputs or ()), tuple(known_forces)
        bound = ConstraintSet(self.constraints)
        if forces is None and (outputs is None or not (links.actuator_signals or bound.motors)):
            forces = ()  # The robot is only simulated.
        for constraint in self.constraints:
            names = [signal.name for signal in constraint.force_signals]
            rows = constraint.residual(links).numel() or constraint.rate(links.kinematics()).numel()
            if rows != len(names):
                raise ModelError(
                    f"{name}: constraint '{constraint.name}' has {rows} equations and {len(names)} "
                    f"forces ({', '.join(names)}); give one force for each equation"
                )
        self.forces = as_force_outputs(forces, bound)
        S = force_rows(self.forces, bound, links)  # (40)
        h_1 = ca.vertcat(ca.SX(0, 1), *[o.expression(links) for o in self.outputs])  # (39)
        signals = [signal for output in self.outputs for signal in output.signals(links)]
        self._num_forces = S.shape[0]
        self._check_outputs(bound.motors, signals, is_chosen=control_weights is not None)
        driven = chain(actuation, links)
        if driven.stages and bound.motors:
            raise ModelError(
                f"{name}: '{bound.motors[0].name}' drives its joint directly, and the others "
                "drive theirs through stages: the control would reach the outputs at different "
                "orders. Cut the loop at a joint without motor"
            )
        choice = control_choice(control_weights, (*driven.control_signals, *bound.motors))
        self.stages = driven.stages
        self.joint_force = driven.joint_force if driven.stages else None
        efforts = links.effort_limits
        if driven.control_signals != tuple(links.actuator_signals):  # u is no joint force.
            efforts = np.full(efforts.size, np.inf)
        self.loop_joints = LoopState(bound, links)
        self.control_limits = np.concatenate([efforts, self.loop_joints.effort_limits])
        nominal = links.default_positions if nominal_positions is None else nominal_positions
        nominal = vector(f"{name}: nominal_positions", nominal, links.q.numel())
        signals += [signal for force in self.forces for signal in force.signals(bound)]
        equations = self._equations(bound, driven, h_1, S, tuple(signals), choice, nominal)
        self.dae = replace(equations, compiled=compiled).with_exogenous(exogenous)
        moving = {p.name for p in self.dae.exogenous.moving}
        for constraint in self.constraints:
            names = [p.name for p in constraint.parameters if p.name in moving]
            if names and constraint.residual(links).numel() < len(constraint.force_signals):
                raise ModelError(  # Its rate would be incomplete.
                    f"{name}: '{names[0]}' cannot move, since '{constraint.name}' restricts "
                    "velocities"
                )
        if compliances is not None:
            self.dae = share_forces(self.dae, compliances=compliances)
        mass = self.dae.matrix("mass_matrix", self.dae.mass_matrix)
        nq, nv = links.velocity_map.shape
        M = mass(self.dae.nominal_state, self.dae.parameter_values)[nq : nq + nv, nq : nq + nv]
        asymmetry = np.abs(M - M.T).max()
        if asymmetry > 1e-9 * np.abs(M).max():
            raise ModelError(f"{name}: M(q) is not symmetric, by {asymmetry:.2g}")
        if (smallest := float(np.linalg.eigvalsh(M)[0])) <= 0.0:
            raise ModelError(
                f"{name}: M(q) is not positive definite at the nominal configuration: smallest "
                f"eigenvalue {smallest:.2g}. A link without inertia cannot be moved by a force; "
                "give it mass, or weld it"
            )
        # Redundant rows mislead Newton's method.
        rows = [row for row in ca.vertsplit(self.dae.k) if not ca.depends_on(row, links.v)]
        phi = ca.vertcat(ca.SX(0, 1), *rows) if self.dae.sharing else bound.residual(links)
        p, of_outputs = self.dae.parameter_symbol, ca.SX.sym("p", self.dae.parameter_symbol.numel())
        h_1 = ca.substitute(h_1, p, of_outputs)
        slopes = {"J": ca.jacobian(phi, links.q), "P": ca.jacobian(h_1, links.q)}
        inputs = {"q": links.q, "parameters": p, "parameters of outputs": of_outputs}
        self._placed = inputs, {"phi": phi, "h_1": h_1, **slopes}
        self._placing = TracedFunction(f"{name} positions", *self._placed)
        self.balance = StaticBalance(self.dae, links, self.dae.m[h_1.numel() :, :])
        if nominal_positions is None:
            nominal = self._on_constraints(nominal)
            state = np.concatenate([nominal, self.dae.nominal_state[nominal.size :]])
            self.dae = replace(self.dae, nominal_state=state)
        self.nominal_positions = nominal
        if self.stages:  # At rest on the constraints, with unstrained shafts.
            with suppress(InconsistentStateError):
                nominal = self.configuration(None, nominal)
            values = self.dae.parameter_values
            state, _, _ = self.balance.rest(nominal, np.zeros(self._num_forces), values)
            self.dae = replace(self.dae, nominal_state=state)

    def _equations(
        self,
        bound: ConstraintSet,
        driven: ActuationChain,
        h_1: ca.SX,
        S: ca.SX,
        signals: tuple[Signal, ...],
        choice: tuple[Parameter, ...],
        nominal: FloatArray,
    ) -> DaeSystem:
        """(43)-(45) with z = (h_1(q), S(q) lambda) and M on the left; stages follow the links."""
        links = self.links
        nq, nv, k = links.q.numel(), links.v.numel(), driven.state.numel()
        controls = (*driven.control_signals, *bound.motors)
        m, nu = bound.size, len(controls)
        B = ca.SX(ca.sparsify(ca.DM(links.actuation_matrix)))
        velocity = ca.mtimes(links.velocity_map, links.v)
        kinematics, known = links.kinematics(), ca.SX(nv, 1)
        for load in self.known_forces:
            known += links.generalized_force(kinematics, load.reaction(kinematics))
        torque = ca.mtimes(B, driven.joint_force) + known + bound.drag(links)
        torque += self.loop_joints.force
        reflected = links.actuation_matrix * links.reflected_inertia @ links.actuation_matrix.T
        # Rotors move with the links, or with a stage.
        on_stage = any(stage.carries_rotors for stage in driven.stages)
        moved = ca.SX(ca.sparsify(ca.DM(reflected * on_stage)))

        def implicit(rate: ca.SX, constraint_force: ca.SX) -> tuple[ca.SX, ca.SX]:
            acceleration = rate[nq : nq + nv]
            inertial, constraint_rate = bound.implicit(links, acceleration, constraint_force)
            slip = ca.sparsify(rate[:nq] - velocity)
            if slip.nnz():  # q' is an unknown of its own where N is not the identity.
                moving = links.kinematics()
                constraint_rate += ca.jtimes(moving.value(bound.rate(moving)), links.q, slip)
            balance = inertial - ca.mtimes(moved, acceleration) - torque  # (37)
            stages = ca.mtimes(driven.mass, rate[nq + nv :]) - driven.drift
            return ca.vertcat(rate[:nq] - velocity, balance, stages), constraint_rate

        return DaeSystem(
            state=ca.vertcat(links.q, links.v, driven.state),
            mass_matrix=ca.diagcat(ca.SX.eye(nq), links.mass_matrix - moved, driven.mass),
            f=ca.vertcat(velocity, torque - links.bias, driven.drift),  # (43)
            g=ca.vertcat(ca.SX(nq, m), bound.force_matrix(links), ca.SX(k, m)),
            h=ca.vertcat(
                ca.SX(nq, nu),
                ca.horzcat(ca.mtimes(B, driven.direct), self.loop_joints.motors),
                ca.horzcat(driven.drive, ca.SX(k, self.loop_joints.motors.shape[1])),
            ),
            k=bound.constraint_output(links.kinematics()),  # (44)
            l=ca.vertcat(h_1, ca.SX(S.shape[0], 1)),  # (45)
            m=ca.vertcat(ca.SX(h_1.numel(), m), S),
            parameters=(
                *links.parameters,
                *(parameter for stage in driven.stages for parameter in stage.parameters),
                *bound.parameters,
                *(parameter for load in self.known_forces for parameter in load.parameters),
                *choice,
            ),
            state_signals=(
                *(*links.position_signals, *links.velocity_signals),
                *(signal for stage in driven.stages for signal in stage.state_signals),
            ),
            constraint_input_signals=bound.force_signals,
            constraint_output_signals=bound.residual_signals,
            control_signals=controls,
            output_signals=signals,
            nominal_state=np.concatenate([nominal, np.zeros(nv + k)]),
            state_scale=np.ones(nq + nv + k),  # For SI units and angles.
            name=self.name,
            implicit=implicit,
            control_metric=ca.diag(choice[0].symbol) if choice else None,
            free_control=choice[1].symbol if choice else None,
            contacts=bound.contacts(links),
            dry=tuple(name for load in self.known_forces for name in load.dry),
        )

    @classmethod
    def from_multibody(cls, plant: MultibodyPlant, *arguments: Any, **options: Any) -> Self:
        """The robot of a finalized MultibodyPlant; the other arguments are those of `RobotModel`.

        Raises:
            ModelError: The plant has an element that cannot be represented; the message names it.
                See `MultibodyExpressions` for what it reads.
        """
        return cls(MultibodyExpressions(plant), *arguments, **options)

    @property
    def position_signals(self) -> tuple[Signal, ...]:
        """Names and units of z_1."""
        return self.dae.output_signals[: self.dae.num_outputs - self._num_forces]

    @checked(ModelError)
    def configuration(
        self,
        outputs: ArrayLike | None,
        guess: ArrayLike,
        parameters: ArrayLike | None = None,
        of_outputs: ArrayLike | None = None,
    ) -> FloatArray:
        """q = psi(z_1) of (58), shape (nq,): the consistent configuration with given outputs.

        Args:
            outputs: z_1, shape (nu - k,) where k forces are outputs; None leaves them free.
            guess: Where Newton's method starts, shape (nq,); if the outputs do not determine q, the
                one next to it is returned.
            parameters: Values of all parameters; the defaults if None.
            of_outputs: Those in the outputs, if they are others, as those of a law.

        Raises:
            InconsistentStateError: There is no such configuration near the guess.
            ModelError: A shape does not fit.
        """
        start = vector(f"{self.name}: guess", guess, self.links.q.numel())
        count = 0 if outputs is None else len(self.position_signals)
        wanted = vector(f"{self.name}: outputs", [] if outputs is None else outputs, count)
        values = self.dae.parameter_vector(parameters)
        own = values if of_outputs is None else self.dae.parameter_vector(of_outputs)
        evaluated = once(lambda q: self._placing(q, values, own))
        step = self._step if count == len(self.position_signals) else None

        def residual(q: FloatArray) -> FloatArray:
            phi, h_1, _, _ = evaluated(q)
            return np.concatenate([phi, h_1[:count] - wanted])  # (58)

        def linearize(q: FloatArray) -> NewtonModel | None:
            if step is not None:
                step.evaluate(q, values, own, wanted, q)
                if step.is_valid:
                    return NewtonModel(
                        lambda x: step.evaluate(q, values, own, wanted, x)[0].copy(), True
                    )
            _, _, J, P = evaluated(q)
            gradients = np.vstack([J.reshape(-1, q.size), P.reshape(-1, q.size)[:count]])
            return shortest_steps(gradients, residual)

        q, _ = newton(start, linearize)
        left = residual(q)
        if not (size := float(np.max(np.abs(left), initial=0.0))) < 1e-10:
            raise InconsistentStateError(
                f"{self.name}: no configuration near the guess satisfies the constraints with "
                f"outputs {show(wanted)}; {size:.2g} is left. They may be out of reach",
                left,
            )
        return q

    @cached_property
    def _step(self) -> TracedFunction | None:
        """The shortest Newton step from any point by the matrix of q, if the robot is small."""
        inputs, outputs = self._placed
        phi, h_1, J, P = outputs.values()
        q, rows = self.links.q, phi.numel() + h_1.numel()
        if not (0 < rows <= q.numel() and rows**2 * q.numel() <= MOST):
            return None
        at, wanted = ca.SX.sym("at", q.numel()), ca.SX.sym("outputs", h_1.numel())
        factors = Factorization(ca.vertcat(J, P).T)
        step = factors.shortest(ca.substitute(ca.vertcat(phi, h_1 - wanted), q, at))
        inputs = {**inputs, "outputs": wanted, "at": at}
        return TracedFunction(f"{self.name} positions", inputs, {"step": -step}, factors.pivot)

    @checked(ModelError)
    def rest_state(
        self, positions: ArrayLike, forces: ArrayLike, parameters: ArrayLike | None = None
    ) -> FloatArray:
        """x = (q, 0, s), shape (n,), at rest in a configuration q with given force outputs.

        The states s of the stages (shaft positions, currents, actuator forces) and the forces that
        are not outputs are solved for with v = 0, v' = 0, s' = 0. With rigid joints the forces do
        not enter it.

        Args:
            positions: q, shape (nq,), on the constraints.
            forces: The force outputs z_2, shape (k,): lambda if all forces are outputs.
            parameters: Values of all parameters; the defaults if None.

        Raises:
            ModelError: No drive holds the robot there.
        """
        q = vector(f"{self.name}: positions", positions, self.links.q.numel())
        load = vector(f"{self.name}: forces", forces, self._num_forces)
        if not self.stages:  # Forces enter no state.
            return np.concatenate([q, np.zeros(self.links.v.numel())])
        state, _, left = self.balance.rest(q, load, self.dae.parameter_vector(parameters))
        if left > 1e-6 * (1.0 + float(np.max(np.abs(load), initial=0.0))):
            raise ModelError(
                f"{self.name}: no control holds the robot at rest at q = {show(q)} with forces "
                f"{load}; {left:.2g} N m is left. It has fewer actuators than joints"
            )
        return state

    def _check_outputs(
        self, motors: Sequence[Signal], positions: Sequence[Signal], is_chosen: bool
    ) -> None:
        """Refuses a number of outputs that does not fit that of the actuators."""
        actuators = [signal.name for signal in self.links.actuator_signals]
        names = ", ".join(signal.name for signal in positions) or "none"
        forces, count = self._num_forces, self._num_forces + len(positions)
        nu = len(actuators) + len(motors)
        given = f"{forces} constraint forces and {len(positions)} positions ({names})"
        if nu == 0 and count:
            raise ModelError(
                f"{self.name}: there are no actuators, so nothing can be steered: not {given}. To "
                "simulate it leave both out; to steer it give joints actuators, by "
                "plant.AddJointActuator or a <transmission>"
            )
        if is_chosen:
            if not 0 < count < nu:
                raise ModelError(
                    f"{self.name}: control_weights choose among the controls of more actuators "
                    f"than outputs, but there are {nu} actuators and {count} outputs"
                )
            return
        rank = int(np.linalg.matrix_rank(self.links.actuation_matrix)) if actuators else 0
        if rank < len(actuators):
            raise ModelError(
                f"{self.name}: the {len(actuators)} actuators {', '.join(actuators)} move the "
                f"joints in only {rank} independent ways; leave one out, or give control_weights "
                "and fewer outputs"
            )
        if count not in (0, nu):  # A robot that is only simulated needs no outputs.
            raise ModelError(
                f"{self.name}: {nu} actuators can steer {nu} outputs, not {given}; for fewer, "
                "control_weights choose the control; for more, name in `forces` those that shall "
                "be steered, [] for none, or add actuators: plant.AddJointActuator, <transmission>"
            )

    def _on_constraints(self, default: FloatArray) -> FloatArray:
        """The default configuration, or a random one if none on the constraints is near it."""
        low, high = np.clip(self.links.position_limits, default - np.pi, default + np.pi)
        random = np.random.default_rng(0)
        for guess in (default, *random.uniform(low, np.maximum(low, high), (20, default.size))):
            with suppress(InconsistentStateError):
                q = self.configuration(None, guess)
                return default if guess is default else q
        raise ModelError(
            f"{self.name}: no configuration on the constraints is found from the default one, nor "
            "from 20 random ones; give nominal_positions near one, or check the constraints"
        )


def control_choice(weights: ArrayLike | None, controls: Sequence[Signal]) -> tuple[Parameter, ...]:
    """The parameters "control_weights" and "free_control" of the least sum w_i (u_i - u_0i)^2."""
    if weights is None:
        return ()
    nu, units = len(controls), {signal.unit for signal in controls}
    chosen, _ = diagonal_parameter("control_weights", weights, nu, "", positive=True)
    return chosen, Parameter("free_control", np.zeros(nu), units.pop() if len(units) == 1 else "")


class StaticBalance:
    """0 = f + g lambda + h u at v = 0, S lambda = z_2, solved for the stages' s, u and lambda."""

    def __init__(self, dae: DaeSystem, robot: Links, S: ca.SX) -> None:
        q, v, links = robot.q, robot.v, robot.q.numel() + robot.v.numel()
        force, load = ca.SX.sym("lambda", dae.num_constraints), ca.SX.sym("z_2", S.shape[0])
        control = ca.SX.sym("u", dae.num_controls)
        balance = dae.f + ca.mtimes(dae.g, force) + ca.mtimes(dae.h, control)
        balance = ca.substitute(balance[q.numel() :], v, ca.SX.zeros(v.numel()))
        balance = ca.vertcat(balance, ca.mtimes(S, force) - load)
        all_forces = ca.substitute(dae.forces(force), v, ca.SX.zeros(v.numel()))
        unknown = ca.vertcat(dae.state[links:], control, force)
        self._unknowns, self._stages = unknown.numel(), dae.num_states - links
        self._still = np.zeros(v.numel())
        self._function = TracedFunction(
            f"{dae.name} equilibrium",
            {"q": q, "z_2": load, "s, u, lambda": unknown, "parameters": dae.parameter_symbol},
            {"balance": balance, "gradient": ca.jacobian(balance, unknown), "lambda": all_forces},
        )

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
