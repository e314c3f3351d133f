"""The changes that a scenario makes to its robot: base, locked joints, actuators, payloads."""

from collections.abc import Mapping, Sequence
from typing import TypeVar

import numpy as np
from pydrake.common.eigen_geometry import AngleAxis
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.multibody.parsing import GetScopedFrameByName
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import (
    BodyIndex,
    Joint,
    PrismaticJoint,
    RevoluteJoint,
    RpyFloatingJoint,
    SpatialInertia,
    UnitInertia,
    WeldJoint,
)

from drake_dae.arrays import unknown_name
from drake_dae.errors import ModelError
from drake_dae.robots import Coupling, frame_named, joint_names, unique_names
from drake_dae.scenario.forms.keys import at
from drake_dae.scenario.robot_file.loops import actuators_of, joints_of
from drake_dae.scenario.robot_file.mending import Mender
from drake_dae.scenario.robot_file.mjcf import ARMATURE
from drake_dae.scenario.robot_file.reading import drake_errors
from drake_dae.scenario.robot_file.robot import Payload, Robot, RobotPlacement

T = TypeVar("T")


def change_robot(robot: Robot, plant: MultibodyPlant, mender: Mender) -> None:
    """Applies the changes that a scenario makes to the robot of its file."""
    couplings = _couplings(plant, mender)
    with drake_errors():
        if robot.base is not None:
            _weld_base(robot.base, plant)
        locked = _of_joints(plant, mender.standing) | robot.locked
        if locked:
            _lock_joints(locked, plant, couplings)
        _add_free_joints(robot.free, plant)
        if robot.actuators is not None:
            _drive_joints(robot.actuators, plant, couplings, mender)
        add_payloads("robot.payloads", robot.payloads, plant)
    driven = {actuator.joint().index() for actuator in actuators_of(plant)}
    is_left_out = ARMATURE in robot.leave_out
    for name, armature in _of_joints(plant, mender.armatures).items():
        if not is_left_out and joint_names(plant)[name].index() not in driven:
            raise ModelError(
                f"joint '{name}' has an armature of {armature:g} and no motor, and Drake gives "
                "only motors one; name it under robot.actuators, or write leave_out: "
                "[joint/armature] under robot"
            )


def finalize(plant: MultibodyPlant) -> None:
    """Finalizes a plant."""
    with drake_errors():
        plant.Finalize()


def add_payloads(key: str, payloads: Sequence[Payload], plant: MultibodyPlant) -> None:
    """Adds the payloads of a key of the scenario to a plant that is not finalized."""
    for index, payload in enumerate(payloads):
        with at(f"{key}.{index}"):
            frame = frame_named(plant, payload.frame)
            if frame.body() == plant.world_body():
                raise ModelError(
                    f"'{payload.frame}' is a frame of the world, and a payload there moves "
                    "nothing; name a frame of the robot"
                )
            if plant.HasBodyNamed(payload.name):
                raise ModelError(
                    f"a payload needs a name of its own; a body '{payload.name}' is there"
                )
            inertia = SpatialInertia(payload.mass, [0.0, 0.0, 0.0], UnitInertia(0.0, 0.0, 0.0))
            body = plant.AddRigidBody(payload.name, frame.model_instance(), inertia)
            plant.WeldFrames(frame, body.body_frame(), RigidTransform(list(payload.point)))


@at("robot.base.weld")
def _weld_base(base: RobotPlacement, plant: MultibodyPlant) -> None:
    """Welds a frame of a body without a joint to the world."""
    attached = _joints_to_parents(plant)
    bodies = [plant.get_body(BodyIndex(i)) for i in range(1, plant.num_bodies())]
    free = unique_names(plant, [body for body in bodies if body.index() not in attached])
    try:
        frame = GetScopedFrameByName(plant, base.weld)
    except RuntimeError:
        raise ModelError(unknown_name("free body or frame on it", base.weld, free)) from None
    body = frame.body()
    if body.index() == plant.world_body().index():
        raise ModelError("the world needs no base; name a frame of the robot")
    if joint := attached.get(body.index()):
        raise ModelError(
            f"body '{body.name()}' is attached already, by joint '{joint.name()}'; unattached "
            f"bodies: {', '.join(free) or 'none'}"
        )
    rotation = RollPitchYaw(np.deg2rad(base.pose.rpy_deg))
    plant.WeldFrames(plant.world_frame(), frame, RigidTransform(rotation, base.pose.translation))


@at("robot.free")
def _add_free_joints(bodies: Sequence[str], plant: MultibodyPlant) -> None:
    """Adds floating joints in roll, pitch and yaw to bodies without a joint."""
    for name in bodies:
        try:
            body = GetScopedFrameByName(plant, name).body()
            if joint := _joints_to_parents(plant).get(body.index()):
                raise ModelError(f"'{name}' is not free: joint '{joint.name()}' holds it")
            plant.AddJoint(RpyFloatingJoint(body.name(), plant.world_frame(), body.body_frame()))
        except RuntimeError as error:
            raise ModelError(f"'{name}' is no body that can be free: {error}") from None


@at("robot.locked")
def _lock_joints(
    locked: Mapping[str, float], plant: MultibodyPlant, couplings: Sequence[Coupling]
) -> None:
    """Replaces joints, and those that are coupled to them, by welds at given positions.

    Drake supports locked joints only in discrete time. The weld has the constant pose X_FM(q) of
    the joint, from its frame on the parent to its frame on the child. The actuator, the damping and
    the rotor of the joint are removed.
    """
    joints = _movable(plant)
    positions = _with_coupled(locked, couplings)
    for name, value in positions.items():
        joint = _named(name, joints)
        low, high = joint.position_lower_limits()[0], joint.position_upper_limits()[0]
        # Round-off of a ratio must not put a finger outside.
        if not low - 1e-9 <= value <= high + 1e-9:
            unit = "m" if isinstance(joint, PrismaticJoint) else "rad"
            why = "" if name in locked else ", as the joint that it is coupled to has it,"
            raise ModelError(
                f"{name} = {value:g} {unit}{why} is outside its limits, {low:g} to {high:g} {unit}"
            )
    if plant.num_constraints() > len(couplings):
        raise ModelError(
            "the file has constraints other than mimic joints, which Drake loses when a joint is "
            "locked; name them under robot.leave_out, and write them under constraints"
        )
    # Drake removes joints only from plants without constraints.
    for key in plant.GetConstraintIds():
        plant.RemoveConstraint(key)
    for name, value in positions.items():
        joint = joints[name]
        inboard, outboard = joint.frame_on_parent(), joint.frame_on_child()
        if isinstance(joint, PrismaticJoint):
            pose = RigidTransform(value * joint.translation_axis())
        else:
            pose = RigidTransform(AngleAxis(value, joint.revolute_axis()), np.zeros(3))
        for actuator in actuators_of(plant):
            if actuator.joint() is joint:
                plant.RemoveJointActuator(actuator)
        own_name = joint.name()
        try:
            plant.RemoveJoint(joint)
        except RuntimeError as error:
            raise ModelError(f"'{name}' cannot be locked: {error}") from None
        plant.AddJoint(WeldJoint(own_name, inboard, outboard, pose))
    joints = _movable(plant)
    for coupling in couplings:
        if coupling.follower in joints:
            pair = joints[coupling.follower], joints[coupling.leader]
            plant.AddCouplerConstraint(*pair, coupling.ratio, coupling.offset)


def _with_coupled(locked: Mapping[str, float], couplings: Sequence[Coupling]) -> dict[str, float]:
    """The positions of locked joints, and of those that are coupled to them."""
    positions = dict(locked)
    for _ in couplings:  # As often as the longest chain needs.
        for coupling in couplings:
            leader, follower = coupling.leader, coupling.follower
            if leader in positions:
                coupled = coupling.ratio * positions[leader] + coupling.offset
                value = positions.setdefault(follower, coupled)
                if abs(value - coupled) > 1e-9:
                    raise ModelError(
                        f"{follower} = {value:g}, but it is coupled to {leader} = "
                        f"{positions[leader]:g}, which makes it {coupled:g}; lock one of them"
                    )
            elif follower in positions and coupling.ratio != 0.0:
                positions[leader] = (positions[follower] - coupling.offset) / coupling.ratio
    return positions


@at("robot.actuators")
def _drive_joints(
    driven: str | Sequence[str] | Mapping[str, float | None],
    plant: MultibodyPlant,
    couplings: Sequence[Coupling],
    mender: Mender,
) -> None:
    """Adds actuators to the joints that a scenario names, and removes those of all other joints.

    Actuators of the file remain, with their gear ratios and rotors.
    """
    joints = _movable(plant)
    if driven == "all":
        followers = {coupling.follower for coupling in couplings}
        driven = [name for name in joints if name not in followers]
    limits = driven if isinstance(driven, Mapping) else dict.fromkeys(driven)
    efforts = _of_joints(plant, mender.efforts)
    armatures = _of_joints(plant, mender.armatures)
    names = {_named(name, joints).index(): name for name in limits}
    with_actuator = set()
    for actuator in actuators_of(plant):
        name = names.get(actuator.joint().index())
        if name is None:
            plant.RemoveJointActuator(actuator)
            continue
        with_actuator.add(name)
        if (limit := limits[name]) is not None:
            actuator.set_effort_limit(limit)
    for name, limit in limits.items():
        if name not in with_actuator:
            effort = efforts.get(name, np.inf) if limit is None else limit
            actuator = plant.AddJointActuator(joints[name].name(), joints[name], effort)
            actuator.set_default_rotor_inertia(armatures.get(name, 0.0))


def _named(name: str, joints: Mapping[str, Joint]) -> Joint:
    if name not in joints:
        raise ModelError(unknown_name("turning or sliding joint", name, joints))
    return joints[name]


def _movable(plant: MultibodyPlant) -> dict[str, Joint]:
    """Name -> joint, for revolute and prismatic joints."""
    kinds = RevoluteJoint | PrismaticJoint
    return {name: joint for name, joint in joint_names(plant).items() if isinstance(joint, kinds)}


def _of_joints(plant: MultibodyPlant, values: Mapping[tuple[str, str], T]) -> dict[str, T]:
    """What is known of joints by (model, joint), by their names in a scenario."""
    found = {}
    for name, joint in joint_names(plant).items():
        for model in ("", plant.GetModelInstanceName(joint.model_instance())):
            if (model, joint.name()) in values:
                found[name] = values[model, joint.name()]
    return found


def _couplings(plant: MultibodyPlant, mender: Mender) -> list[Coupling]:
    """The couplings of joints of a plant, by names."""
    if plant.num_constraints() == 0:
        return []
    joints = joint_names(plant)
    names = {(int(j.model_instance()), j.name()): name for name, j in joints.items()}
    couplings = []
    for name, (leader, ratio, offset) in _of_joints(plant, mender.followers).items():
        leading = names.get((int(joints[name].model_instance()), leader))
        couplings += [Coupling(name, leading, ratio, offset)] if leading else []
    return couplings


def _joints_to_parents(plant: MultibodyPlant) -> dict[BodyIndex, Joint]:
    """Index of a body -> the joint by which it is attached."""
    return {joint.child_body().index(): joint for joint in reversed(joints_of(plant))}
