"""A RobotModel as a LeafSystem."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import casadi as ca

from drake_dae.arguments import checked
from drake_dae.blocks.block import Block
from drake_dae.blocks.lifetime import SHARED_DICTIONARY
from drake_dae.dae import ConstraintStructure, Signal, constraint_structure_of
from drake_dae.errors import ModelError
from drake_dae.robots import ConstraintSet, RobotModel
from drake_dae.systems.plants.dae_plant import DaePlant, dae_block


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
        structure, project: As for `DaePlant`.
    """

    __slots__ = SHARED_DICTIONARY

    def __init__(
        self,
        model: RobotModel,
        *,
        structure: ConstraintStructure | None = None,
        project: bool = True,
    ) -> None:
        structure = constraint_structure_of(type(self).__name__, model.dae, structure)
        self.model: RobotModel = model
        self._start(structure, robot_block(model, structure, project))

    @property
    def wrench_signals(self) -> Sequence[Signal]:
        """Names and units of `constraint_wrenches`."""
        return self.block.signals["constraint_wrenches"]

    @property
    def further_signals(self) -> Mapping[str, Sequence[Signal]]:
        signals = self.model.loop_joints.signals
        return {"loop_state": signals} if signals else {}


def robot_block(model: RobotModel, structure: ConstraintStructure, project: bool = True) -> Block:
    """The block of a constrained robot; see `RobotPlant`."""
    block, bound = dae_block(structure, project), ConstraintSet(model.constraints)
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
