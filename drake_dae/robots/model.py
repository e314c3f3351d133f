"""A constrained robot as a DaeSystem.                        (37)-(45), (64)-(68), (74)-(78)"""

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from typing import Self

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike
from pydrake.multibody.plant import MultibodyPlant

from drake_dae.arguments import checked
from drake_dae.arrays import FloatArray, listed, vector
from drake_dae.dae import Signal, share_forces
from drake_dae.errors import InconsistentStateError, ModelError
from drake_dae.robots.actuation.chain import chain
from drake_dae.robots.actuation.stage import Stage
from drake_dae.robots.constraints.constraint import Constraint
from drake_dae.robots.constraints.constraint_set import ConstraintSet
from drake_dae.robots.constraints.plant_constraints import plant_constraints
from drake_dae.robots.control_choice import check_outputs, control_choice
from drake_dae.robots.equations import (
    Outputs,
    check_mass_matrix,
    robot_equations,
)
from drake_dae.robots.force_outputs import ForceOutput, as_force_outputs, force_rows
from drake_dae.robots.known_forces import Load
from drake_dae.robots.links.links import Links
from drake_dae.robots.links.multibody import MultibodyExpressions
from drake_dae.robots.loop_state import LoopState
from drake_dae.robots.outputs import PositionOutput
from drake_dae.robots.statics import StaticBalance, StaticPlacement
from drake_dae.trace.compiled import Compiled


@checked(ModelError)
class RobotModel:
    """A robot in contact, equations (37)-(40):

        M(q) v' + H(q, v) = J(q)^T lambda + B tau,    q' = N(q) v,
        0 = phi(q),    z_1 = h_1(q),    z_2 = lambda,

    with J = (dphi/dq) N. With friction, G(q, v) takes the place of J^T; viscous friction is part of
    H. A nonholonomic constraint has its rate in place of phi, and r = 1. With rigid joints tau = u;
    stages of actuation add dynamics between u and tau: E s' = drift(q, v, s) + drive u, tau =
    tau(q, v, s), as in (64)-(65) and (74)-(75). The state is x = (q, v, s); the constraint input is
    lambda, and the controlled outputs are z = (z_1, z_2), so the number of position outputs is that
    of actuators minus constraints. If fewer forces are controlled (wheels, mimic joints), or
    combinations of them (a grasp), `forces` chooses them: z_2 = S(q) lambda, and the number of
    position outputs is that of actuators minus these. The plant's port always has all of lambda.
    With fewer outputs than actuators, as in a redundantly actuated parallel robot,
    `control_weights` w chooses the control with the least sum w_i (u_i - u_0i)^2 among all with the
    same outputs; see `DaeSystem`. u_0 is the parameter "free_control", zero by default: it affects
    internal forces and motions that are not outputs. With flexible joints each additional actuator
    leaves one undamped deflection: rather make the internal force an output.

    Args:
        links: The links, which provide M, H and the frames.
        constraints: The constraints phi in their order; none for a robot in free motion. Those of
            the links' MultibodyPlant are appended: see `plant_constraints`.
        outputs: The position outputs h_1 in their order; None for a robot that is only simulated,
            without force outputs unless `forces` names them.
        nominal_positions: A configuration of the robot at work, shape (nq,), near which the
            structure is examined; `links.default_positions` if None, or, if no configuration on the
            constraints is near them, a random one that is.
        name: The robot's name in messages.
        actuation: The stages from the joints toward the motor; none for rigid joints.
        forces: The force outputs z_2, in their order: names of constraint forces, and combinations
            of forces, as a `Squeeze`; all constraint forces if None, none without actuators.
        exogenous: The names of parameters that are exogenous signals w with known derivatives,
            "wall.position" for example; see `DaeSystem`.
        known_forces: Known forces on frames, zero by default, and friction of joints.
        compliances: For a robot whose constraints are redundant: name of a constraint force -> its
            relative compliance, 1 if not named, {} for equal ones. The forces are then shared by
            least squares, see `share_forces`. An output that depends on the split is refused, since
            it is not determined. None refuses redundant constraints.
        control_weights: w, positive, for more actuators than outputs: one for each, shape (nu,), or
            a number for all if all controls have the same unit. Weights 1 / limit^2 share the
            effort in proportion to the limits. It becomes the parameter "control_weights".
        compiled: Whether functions become machine code: True, False or "auto"; see `DaeSystem`.

    Attributes:
        dae: The `DaeSystem` (43)-(45).
        links, outputs, nominal_positions, name, known_forces: The arguments.
        constraints: The constraints, with those of the plant.
        forces: The force outputs; a name is a `NamedForce`.
        stages: The attached stages.
        joint_force: tau as an expression of `dae.state`; None with rigid joints.
        control_limits: The largest |u| per actuator; infinite without a limit or if u is not a
            joint force. Those in joints that close loops come last.
        loop_joints: The joints that close loops, with their coordinates and limits.
        placing, balance: The equations of `configuration` and `rest_state`.

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
        self.links = links
        all_constraints = (*constraints, *plant_constraints(links))
        self.constraints = tuple(constraint.moving(exogenous) for constraint in all_constraints)
        self.outputs = tuple(outputs or ())
        self.name = name
        self.known_forces = tuple(known_forces)
        bound = ConstraintSet(self.constraints)
        if forces is None and (outputs is None or not (links.actuator_signals or bound.motors)):
            forces = ()  # The robot is only simulated.
        self.forces = as_force_outputs(forces, bound)
        S = force_rows(self.forces, bound, links)  # (40)
        self._num_forces = S.shape[0]
        h_1 = ca.vertcat(
            ca.SX(0, 1), *[output.expression(links) for output in self.outputs]
        )  # (39)
        signals = [signal for output in self.outputs for signal in output.signals(links)]
        weighted = control_weights is not None
        check_outputs(name, links, bound.motors, self._num_forces, signals, weighted)
        driven = chain(actuation, links)
        if driven.stages and bound.motors:
            raise ModelError(
                f"{name}: '{bound.motors[0].name}' drives its joint directly, and the others "
                "drive theirs through stages: the control would reach the outputs at different "
                "orders. Cut the loop at a joint without motor"
            )
        controls = (*driven.control_signals, *bound.motors)
        choice = control_choice(name, control_weights, controls)
        self.stages = driven.stages
        self.joint_force = driven.joint_force if driven.stages else None
        is_joint_force = driven.control_signals == tuple(links.actuator_signals)
        efforts = links.effort_limits
        if not is_joint_force:
            efforts = np.full(efforts.size, np.inf)
        motors = [joint.effort_limit for _, joint in bound.joints if joint.motor is not None]
        self.control_limits = np.concatenate([efforts, motors])
        self.loop_joints = LoopState.of(bound, links)
        self.nominal_positions = nominal = self._nominal(nominal_positions)
        steered = (*signals, *(s for f in self.forces for s in f.signals(bound)))
        equations = robot_equations(
            name,
            links,
            bound,
            driven,
            self.loop_joints,
            self.known_forces,
            Outputs(h_1, S, steered),
            choice,
            nominal,
        )
        self.dae = replace(equations, compiled=compiled).with_exogenous(exogenous)
        self._check_exogenous()
        if compliances is not None:
            self.dae = share_forces(self.dae, compliances=compliances)
        check_mass_matrix(self.dae, links, nominal)
        # Redundant rows mislead Newton's method.
        rows = [row for row in ca.vertsplit(self.dae.k) if not ca.depends_on(row, links.v)]
        phi = ca.vertcat(ca.SX(0, 1), *rows) if self.dae.sharing else bound.residual(links)
        self.placing = StaticPlacement(self.dae, links.q, phi, h_1)
        chosen = self.dae.m[h_1.numel() :, :]
        self.balance = StaticBalance(self.dae, links, chosen, bool(self.stages))
        if nominal_positions is None:
            self.nominal_positions = nominal = self._on_constraints(nominal)
            nominal_state = self.dae.nominal_state.copy()
            nominal_state[: nominal.size] = nominal
            self.dae = replace(self.dae, nominal_state=nominal_state)
        if self.stages:
            self.dae = replace(self.dae, nominal_state=self._nominal_rest(nominal))

    @classmethod
    def from_multibody(
        cls,
        plant: MultibodyPlant,
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
    ) -> Self:
        """The robot of a finalized MultibodyPlant; see `MultibodyExpressions` for what it reads.

        Raises:
            ModelError: The plant has an element that cannot be represented; the message names it.
        """
        links = MultibodyExpressions(plant)
        return cls(
            links,
            constraints,
            outputs,
            nominal_positions,
            name,
            actuation,
            forces,
            exogenous,
            known_forces,
            compliances,
            control_weights,
            compiled,
        )

    def __repr__(self) -> str:
        constraints = listed(constraint.name for constraint in self.constraints)
        stages = listed(type(stage).__name__ for stage in self.stages) if self.stages else ""
        return (
            f"RobotModel('{self.name}', positions={self.links.q.numel()}, "
            f"constraints={constraints}, "
            + (f"actuation={stages}, " if stages else "")
            + f"outputs={listed(signal.name for signal in self.dae.output_signals)})"
        )

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
        output_parameters: ArrayLike | None = None,
    ) -> FloatArray:
        """q = psi(z_1) of (58): the consistent configuration with given position outputs.

        Args:
            outputs: z_1, shape (nu - k,) where k forces are outputs; None leaves them free.
            guess: Where Newton's method starts, shape (nq,).
            parameters: Values of all parameters; the defaults if None.
            output_parameters: Values of all parameters for z_1, such as those that a law assumes
                for a wall that its constraint has elsewhere; `parameters` if None.

        Returns:
            q, shape (nq,); if the outputs do not determine it, the one next to the guess.

        Raises:
            InconsistentStateError: There is no such configuration near the guess.
            ModelError: A shape does not fit.
        """
        q = vector(f"{self.name}: guess", guess, self.links.q.numel())
        count = 0 if outputs is None else len(self.position_signals)
        wanted = vector(f"{self.name}: outputs", [] if outputs is None else outputs, count)
        values = self.dae.parameter_vector(parameters)
        of_outputs = values
        if output_parameters is not None:
            of_outputs = self.dae.parameter_vector(output_parameters)
        return self.placing.solve(wanted, q, values, of_outputs)

    @checked(ModelError)
    def rest_state(
        self, positions: ArrayLike, forces: ArrayLike, parameters: ArrayLike | None = None
    ) -> FloatArray:
        """The state at rest in a configuration with given constraint forces.

        The states of the stages (shaft positions, currents, actuator forces) and the forces that
        are not outputs are solved for with v = 0, v' = 0, s' = 0.

        Args:
            positions: q, shape (nq,), on the constraints.
            forces: The force outputs z_2, shape (k,): lambda if all forces are outputs.
            parameters: Values of all parameters; the defaults if None.

        Returns:
            x = (q, 0, s), shape (n,). With rigid joints the forces do not enter it.

        Raises:
            ModelError: No drive holds the robot there.
        """
        values = self.dae.parameter_vector(parameters)
        q = vector(f"{self.name}: positions", positions, self.links.q.numel())
        load = vector(f"{self.name}: forces", forces, self._num_forces)
        return self.balance.state(q, load, values)

    @checked(ModelError)
    def rest_forces(
        self, positions: ArrayLike, forces: ArrayLike, parameters: ArrayLike | None = None
    ) -> FloatArray:
        """All constraint forces at rest in a configuration, for given force outputs.

        Args:
            positions: q, shape (nq,), on the constraints.
            forces: The force outputs z_2, shape (k,).
            parameters: Values of all parameters; the defaults if None.

        Returns:
            lambda, shape (m,), with S lambda = z_2.
        """
        values = self.dae.parameter_vector(parameters)
        q = vector(f"{self.name}: positions", positions, self.links.q.numel())
        load = vector(f"{self.name}: forces", forces, self._num_forces)
        return self.balance.rest(q, load, values)[1]

    def _check_exogenous(self) -> None:
        """Refuses exogenous parameters of nonholonomic constraints: their rate is incomplete."""
        moving = {p.name for p in self.dae.exogenous.moving}
        for constraint in self.constraints:
            names = [p.name for p in constraint.parameters if p.name in moving]
            rows = constraint.residual(self.links).numel()
            if names and rows < len(constraint.force_signals):
                raise ModelError(
                    f"{self.name}: '{names[0]}' cannot move, since '{constraint.name}' restricts "
                    "velocities"
                )

    def _nominal(self, positions: ArrayLike | None) -> FloatArray:
        nominal = self.links.default_positions if positions is None else positions
        return vector(f"{self.name}: nominal_positions", nominal, self.links.q.numel())

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

    def _nominal_rest(self, nominal: FloatArray) -> FloatArray:
        """The state at rest on the constraints, with unstrained shafts."""
        with suppress(InconsistentStateError):
            nominal = self.configuration(None, nominal)
        forces = np.zeros(self._num_forces)
        return self.balance.rest(nominal, forces, self.dae.parameter_values)[0]
