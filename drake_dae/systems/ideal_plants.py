"""Any DaeSystem, and a robot, as a LeafSystem that stays on its manifold."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import casadi as ca
import numpy as np
from pydrake.systems.framework import Context, EventStatus

from drake_dae.arguments import checked
from drake_dae.arrays import FloatArray, show_state
from drake_dae.blocks.block import Block, Projection, Requirement
from drake_dae.blocks.failures import singular_configuration
from drake_dae.blocks.lifetime import SHARED_DICTIONARY, weakly
from drake_dae.dae import (
    ConstraintStructure,
    DaeSystem,
    Signal,
    find_constraint_structure,
    structure_of,
)
from drake_dae.dae.redundancy import manifold_of_left_out
from drake_dae.errors import (
    InconsistentStateError,
    ModelError,
    PainleveError,
    SimulationError,
    SingularityError,
)
from drake_dae.robots import ConstraintSet, RobotModel
from drake_dae.systems.plant import ParameterizedSystem, Plant, port_signals
from drake_dae.trace.functions import SINGULAR_PIVOT


@checked(ModelError)
class DaePlant(ParameterizedSystem, Plant):
    """The solution of a differential-algebraic system (1)-(3) on its manifold N*:

        x' = f(x) + g(x) v + h(x) u,    v = alpha(x) + beta(x) u,    z = l(x) + m(x) v.

    The state stays on N*: after each step it is projected to round-off. Drake does that at the
    start of the next step, so a log or a monitor sees it before its projection;
    `Simulator.AdvancePendingEvents()` projects the last state of a run.

    Only Assumptions (1)-(3) are needed: there may be other numbers of controls than of outputs, or
    none. The default state is the consistent one next to `system.nominal_state`.

    Input ports:
        control: u, shape (p,).
        exogenous: The signals w with their derivatives, if there are any.

    Output ports:
        state: x, shape (n,).
        constraint_force: v, shape (m,); direct feedthrough from `control` where beta is not zero.
            With `share_forces` it has all forces of `system.force_signals`.
        constraint_residual: k_i, L_f k_i, ..., L_f^(r_i - 1) k_i, shape (sum r_i,); zero on N*.
        controlled_output: z, shape (p,); direct feedthrough where n* = m beta is not zero.

    A converted plant (AutoDiffXd, for Linearize or DirectCollocation) has no projection.

    Args:
        system: The system (1)-(3).
        structure: Its structure; found if None.

    Raises:
        AssumptionError: The system violates one of Assumptions (1)-(3).
        ModelError: It is not a system, or the structure is that of another one.
        InconsistentStateError: A simulation starts from a state that is off N*.
        SingularityError, NonFiniteError, SimulationError: During a run A(x) is singular (a
            PainleveError in a paradox), a value is not finite, or the state cannot be projected.
    """

    __slots__ = SHARED_DICTIONARY

    def __init__(self, system: DaeSystem, *, structure: ConstraintStructure | None = None) -> None:
        structure = structure_of(system, structure, find_constraint_structure)
        self._start(structure, dae_block(structure))

    def _start(self, structure: ConstraintStructure, block: Block) -> None:
        """Makes the system of its block."""
        self.structure, self.equations = structure, structure.system
        self._left_out = manifold_of_left_out(structure.system)
        super().__init__(structure.system, block)
        self.DeclareInitializationPublishEvent(weakly(self._check_start))

    def explained(
        self, error: SimulationError, values: Mapping[str, FloatArray]
    ) -> SimulationError:
        """Returns the error with dependent constraints, or as that of a Painleve paradox."""
        if not isinstance(error, SingularityError):
            return error
        parameters = values.get("parameters", np.zeros(0)).copy()
        if "input exogenous" in values:
            parameters[self.exogenous_places] = values["input exogenous"]
        dae, state = self.dae, error.state
        contacts = dae.frictional_contacts
        if not contacts:
            names = self.structure.dependent_constraints(state, parameters)
            return singular_configuration(dae.name, error.time, state, names)
        reserve = contacts.reserve(self.structure.elimination.constraint_matrix)
        (value,) = dae.trace("reserve", {"reserve": reserve}, often=False)(state, parameters)
        if not value.item() < SINGULAR_PIVOT:
            return error
        places = ", ".join(f"'{dae.constraint_input_signals[i].name}'" for i in contacts.rows)
        return PainleveError(
            f"{dae.name}: Painleve paradox at the contact of {places} at t = {error.time:.6g} s, "
            f"state {show_state(state)}: a principal minor of A(x) has come to "
            f"{value.item():.2g} of what it is without friction, so that no force fits, or "
            "several. Lower the friction, slide the other way, or hold the robot less steeply to "
            "the surface",
            error.time,
            state,
        )

    def _check_start(self, context: Context) -> EventStatus:
        self.check_start(self.state(context), self._values(context))
        return EventStatus.DidNothing()

    def check_start(self, state: FloatArray, parameters: FloatArray) -> None:
        """Refuses a start off N*, or that violates redundant constraints that were left out."""
        manifold, left_out = self.structure.manifold, self._left_out
        if not manifold.is_consistent(state, parameters):
            residual = manifold.residual(state, parameters)
            table = ", ".join(
                f"{signal.name} = {value:.3g} {signal.unit}"
                for signal, value in zip(manifold.residual_signals, residual, strict=True)
                if not abs(value) <= 1e-3 * np.max(np.abs(residual))
            )
            raise InconsistentStateError(
                f"{self.dae.name}: the start state is not on the constraint: {table}. Call "
                "set_consistent_state(context, guess) to start from the nearest consistent state",
                residual,
            )
        if left_out is not None and not left_out.is_consistent(state, parameters):
            residual = left_out.residual(state, parameters)
            worst = int(np.argmax(np.abs(residual)))
            signal = left_out.residual_signals[worst]
            raise InconsistentStateError(
                f"{self.dae.name}: the constraints that stay hold at state {show_state(state)}, "
                f"but not the redundant '{signal.name}', which was left out: {residual[worst]:.3g} "
                f"{signal.unit}. The robot is assembled in another way there, or a parameter moves "
                "one of these constraints and not the others; start nearer to where all hold",
                residual,
            )


def dae_block(structure: ConstraintStructure) -> Block:
    """The motion on N* and the constraint force, (25), as a block; see `DaePlant`."""
    system, derivatives = structure.system, structure.derivatives
    manifold, control = structure.manifold, derivatives.control
    regular = Requirement.regular(structure.elimination.pivot, "A(x) of Assumption (2)")
    force = derivatives.expand(derivatives.constraint_input)
    output, none = system.outputs(force), ca.SX.zeros(control.numel())
    if not structure.elimination.n_star.nnz():  # m beta u cancels.
        output = ca.substitute(output, control, none)
    if not structure.elimination.beta.nnz():
        force = ca.substitute(force, control, none)
    projection = None
    if system.num_constraints:
        step = manifold.newton_step
        symbols = [ca.SX.sym(*item) for item in zip(step.input_names, step.sizes, strict=True)]
        newton = ca.Function("newton", symbols, step.function.call(symbols)[:1])
        projection = Projection(newton, manifold.projected, system.parameter_symbol)
    return Block(
        system.name,
        inputs={"control": control},
        outputs={
            "state": system.state,
            "constraint_force": regular.of(system.forces(force)),
            "constraint_residual": manifold.residual_expression,
            "controlled_output": regular.of(output),
        },
        state=system.state,
        derivative=regular.of(derivatives.expand(derivatives.rate)),
        parameters=system.parameter_symbol,
        start={
            "state": manifold.project(system.nominal_state),
            "parameters": system.parameter_values,
        },
        projection=projection,
        scale=system.scale,
        requirements=(regular,),
        signals={
            **port_signals(structure),
            "control": system.control_signals,
            "parameters": system.parameter_signals,
        },
    )


@checked(ModelError)
class RobotPlant(DaePlant):
    """A constrained robot (37)-(40) with the ports of `DaePlant` and:

    Output ports:
        link_state: (q, v) of the links, shape (nq + nv,), as Drake's MultibodyPlant orders it.
        joint_torque: The torques or forces of the stages on the joints, N m (N), shape (nu,); with
            any stage.
        constraint_wrenches: The wrench of each constraint on each of its frames: 6 numbers, the
            moment in N m and the force in N as in Drake's SpatialForce, in the world, the force at
            the frame's origin. Frame B comes before A; the positive direction is that of the
            constraint's class, and A gets the opposite at the same point. The total power of an
            ideal constraint is zero. `wrench_signals` has the names, "<constraint>.<frame>.mx",
            ..., "<constraint>.<frame>.fz".
        loop_state: The coordinates of the joints that close loops, and then their rates, named by
            `model.loop_joints.signals`; if there are such joints.

    A stage of actuation has further ports with its state, see its class: `motor_state` of
    `FlexibleJoints`, for example, or `motor_current` of `DcMotors`.

    `constraint_force` is lambda of (37), in N for contacts. With rigid joints it has direct
    feedthrough from `control`; with any stage it is a function of the state alone.

    Args:
        model: The robot.
        structure: As for `DaePlant`.
    """

    __slots__ = SHARED_DICTIONARY

    def __init__(self, model: RobotModel, *, structure: ConstraintStructure | None = None) -> None:
        structure = structure_of(model.dae, structure, find_constraint_structure)
        self.model: RobotModel = model
        self._start(structure, robot_block(model, structure))

    @property
    def wrench_signals(self) -> Sequence[Signal]:
        """Names and units of `constraint_wrenches`."""
        return self.block.signals["constraint_wrenches"]

    @property
    def further_signals(self) -> Mapping[str, Sequence[Signal]]:
        signals = self.model.loop_joints.signals
        return {"loop_state": signals} if signals else {}


def robot_block(model: RobotModel, structure: ConstraintStructure) -> Block:
    """The block of a constrained robot; see `RobotPlant`."""
    block, bound = dae_block(structure), ConstraintSet(model.constraints)
    force = ca.SX.sym("force", bound.size)
    wrenches, signals = bound.wrenches(model.links.kinematics(), force)
    lambdas = block.outputs["constraint_force"]
    outputs = {
        **block.outputs,
        **joint_outputs(model),
        "constraint_wrenches": ca.substitute(wrenches, force, lambdas),
    }
    named = {**block.signals, "constraint_wrenches": signals}
    if "loop_state" in outputs:
        named["loop_state"] = model.loop_joints.signals
    return replace(block, outputs=outputs, signals=named)


def joint_outputs(model: RobotModel) -> dict[str, ca.SX]:
    """The output ports of a robot's plant that are functions of its state and parameters."""
    first = model.links.q.numel() + model.links.v.numel()
    outputs = {"link_state": model.dae.state[:first, 0]}
    for stage in model.stages:
        own = model.dae.state[first:, 0]
        outputs |= {name: own[part, 0] for name, part in stage.ports.items()}
        first += stage.state.numel()
    if model.loop_joints.signals:
        outputs["loop_state"] = model.loop_joints.state
    if model.joint_force is not None:
        outputs["joint_torque"] = model.joint_force
    return outputs
