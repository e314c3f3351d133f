"""What a scenario changes of its robot, and loops of joints, which become constraints."""

from collections.abc import Container, Mapping, Sequence
from math import isfinite
from typing import Any, NamedTuple

import numpy as np
from pydrake.common.eigen_geometry import AngleAxis
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import (
    BodyIndex,
    Frame,
    JacobianWrtVariable,
    Joint,
    JointActuator,
    JointIndex,
    PrismaticJoint,
    RevoluteJoint,
    RpyFloatingJoint,
    SpatialInertia,
    UnitInertia,
    WeldJoint,
)

from drake_dae.arrays import FloatArray, unknown_name
from drake_dae.errors import ModelError
from drake_dae.robots import (
    Constraint,
    PrismaticLoopJoint,
    RevoluteLoopJoint,
    axes_along,
    frame_name,
    frame_named,
    joint_names,
    triple,
)
from drake_dae.scenario.form import at
from drake_dae.scenario.robot_file.mjcf import ARMATURE
from drake_dae.scenario.robot_file.robot import Payload, Robot, RobotPlacement

_Leader = tuple[JointIndex, float, float]
"""The joint that another one follows, the ratio, and the offset, rad or m."""


def joints_of(plant: MultibodyPlant) -> list[Joint]:
    """The joints of a plant."""
    return [plant.get_joint(index) for index in plant.GetJointIndices()]


def actuators_of(plant: MultibodyPlant) -> list[JointActuator]:
    """The actuators of a plant."""
    return [plant.get_joint_actuator(index) for index in plant.GetJointActuatorIndices()]


def noted(plant: MultibodyPlant, values: Mapping[tuple[str, str], Any]) -> dict[JointIndex, Any]:
    """What a file says of joints, (model, joint) -> value, by the joints of the plant."""
    found = {}
    for joint in joints_of(plant):
        for model in ("", plant.GetModelInstanceName(joint.model_instance())):
            if (model, joint.name()) in values:
                found[joint.index()] = values[model, joint.name()]
    return found


def change_robot(
    robot: Robot, plant: MultibodyPlant, known: Mapping[str, Mapping[tuple[str, str], Any]]
) -> None:
    """Applies the changes that a scenario makes to the robot of its file.

    `known` is what the file says of joints, `Mender.joints`.
    """
    leaders = _leaders(plant, noted(plant, known["follows"]))
    if robot.base is not None:
        _weld_base(robot.base, plant)
    locked = _lock_joints(robot.locked, plant, leaders)
    for follower, (leader, ratio, offset) in leaders.items():
        if follower not in locked:
            pair = plant.get_joint(follower), plant.get_joint(leader)
            plant.AddCouplerConstraint(*pair, ratio, offset)
    _add_free_joints(robot.free, plant)
    efforts, armatures = (noted(plant, known[what]) for what in ("effort", "armature"))
    if robot.actuators is not None:
        _drive_joints(robot.actuators, plant, leaders, efforts, armatures)
    add_payloads("robot.payloads", robot.payloads, plant)
    driven = {actuator.joint().index() for actuator in actuators_of(plant)}
    for name, joint in _movable(plant).items() if ARMATURE not in robot.leave_out else ():
        if joint.index() in armatures and joint.index() not in driven:
            raise ModelError(
                f"joint '{name}' has an armature of {armatures[joint.index()]:g} and no motor, and "
                "Drake gives only motors one; name it under robot.actuators, or write leave_out: "
                "[joint/armature] under robot"
            )


def add_payloads(key: str, payloads: Sequence[Payload], plant: MultibodyPlant) -> None:
    """Adds the payloads of a key of the scenario to a plant that is not finalized."""
    for index, payload in enumerate(payloads):
        with at(f"{key}.{index}"):
            frame = frame_named(plant, payload.frame)
            if frame.body() == plant.world_body():
                raise ModelError(f"a payload on '{payload.frame}', of the world, moves nothing")
            if plant.HasBodyNamed(payload.name):
                raise ModelError(f"a body '{payload.name}' is there; give the payload another name")
            inertia = SpatialInertia(payload.mass, [0.0, 0.0, 0.0], UnitInertia(0.0, 0.0, 0.0))
            body = plant.AddRigidBody(payload.name, frame.model_instance(), inertia)
            plant.WeldFrames(frame, body.body_frame(), RigidTransform(list(payload.point)))


@at("robot.base.weld")
def _weld_base(base: RobotPlacement, plant: MultibodyPlant) -> None:
    """Welds a frame of a body without a joint to the world."""
    frame = _unattached(base.weld, plant)
    rotation = RollPitchYaw(np.deg2rad(base.pose.rpy_deg))
    plant.WeldFrames(plant.world_frame(), frame, RigidTransform(rotation, base.pose.translation))


@at("robot.free")
def _add_free_joints(bodies: Sequence[str], plant: MultibodyPlant) -> None:
    """Adds floating joints in roll, pitch and yaw to bodies without a joint."""
    for name in bodies:
        body = _unattached(name, plant).body()
        plant.AddJoint(RpyFloatingJoint(body.name(), plant.world_frame(), body.body_frame()))


def _unattached(name: str, plant: MultibodyPlant) -> Frame:
    """A frame of a body without a joint to a parent."""
    frame = frame_named(plant, name)
    if frame.body() == plant.world_body():
        raise ModelError("the world is no part of the robot; name a frame of the robot")
    holding = {joint.child_body().index(): joint.name() for joint in reversed(joints_of(plant))}
    if frame.body().index() in holding:
        bodies = [plant.get_body(BodyIndex(i)) for i in range(1, plant.num_bodies())]
        free = [body.name() for body in bodies if body.index() not in holding]
        raise ModelError(
            f"'{name}' is attached already, by joint '{holding[frame.body().index()]}'; unattached "
            f"bodies: {', '.join(free) or 'none'}"
        )
    return frame


@at("robot.locked")
def _lock_joints(
    locked: Mapping[str, float], plant: MultibodyPlant, leaders: Mapping[JointIndex, _Leader]
) -> Container[JointIndex]:
    """Replaces joints, and those that follow them, by welds with their constant X_FM(q).

    Drake supports locked joints only in discrete time. Actuator, damping and rotor go.
    """
    movable = _movable(plant)
    joints = {joint.index(): (name, joint) for name, joint in movable.items()}
    positions = {index: offset for index, (_, ratio, offset) in leaders.items() if ratio == 0.0}
    positions |= {_named(name, movable).index(): value for name, value in locked.items()}
    for _ in leaders:  # As often as the longest chain needs.
        for follower, (leader, ratio, offset) in leaders.items():
            if leader in positions and ratio != 0.0:
                coupled = ratio * positions[leader] + offset
                if abs(positions.setdefault(follower, coupled) - coupled) > 1e-9:
                    raise ModelError(
                        f"'{plant.get_joint(follower).name()}' follows "
                        f"'{plant.get_joint(leader).name()}', which makes it {coupled:g}, and not "
                        f"{positions[follower]:g}; lock one of them"
                    )
            elif follower in positions and ratio != 0.0:
                positions[leader] = (positions[follower] - offset) / ratio
    if positions and plant.num_constraints() > 0:
        raise ModelError(
            "the file has constraints other than mimic joints, with which Drake locks no joint; "
            "name them under robot.leave_out, and write them under constraints"
        )
    welds = list[tuple[JointIndex, WeldJoint]]()
    for index, value in positions.items():
        if index not in joints:
            own = plant.get_joint(index).name()
            raise ModelError(unknown_name("turning or sliding joint", own, movable))
        name, joint = joints[index]
        low, high = joint.position_lower_limits()[0], joint.position_upper_limits()[0]
        slides = isinstance(joint, PrismaticJoint)
        if not low - 1e-9 <= value <= high + 1e-9:  # Round-off of a ratio puts nothing outside.
            unit = "m" if slides else "rad"
            why = "" if name in locked else ", as the joint that it is coupled to has it,"
            raise ModelError(
                f"{name} = {value:g} {unit}{why} is outside its limits, {low:g} to {high:g} {unit}"
            )
        if slides:
            pose = RigidTransform(value * joint.translation_axis())
        else:
            pose = RigidTransform(AngleAxis(value, joint.revolute_axis()), np.zeros(3))
        frames = joint.frame_on_parent(), joint.frame_on_child()
        welds.append((index, WeldJoint(joint.name(), *frames, pose)))
        del joint
    # Python's joint must be gone before Drake's is: a new one at its address would be taken for it.
    joints.clear()
    movable.clear()
    for index, _ in welds:
        for actuator in actuators_of(plant):
            if actuator.joint().index() == index:
                plant.RemoveJointActuator(actuator)
        try:
            plant.RemoveJoint(plant.get_joint(index))
        except RuntimeError as error:
            own = plant.get_joint(index).name()
            raise ModelError(f"'{own}' cannot be locked: {error}") from None
    for _, weld in welds:
        plant.AddJoint(weld)
    return positions


@at("robot.actuators")
def _drive_joints(
    driven: str | Sequence[str] | Mapping[str, float | None],
    plant: MultibodyPlant,
    followers: Container[JointIndex],
    efforts: Mapping[JointIndex, float],
    armatures: Mapping[JointIndex, float],
) -> None:
    """Adds actuators to the joints that a scenario names, and removes those of all other joints.

    Actuators of the file remain, with their gear ratios and rotors.
    """
    joints = _movable(plant)
    if driven == "all":
        driven = [name for name, joint in joints.items() if joint.index() not in followers]
    limits = driven if isinstance(driven, Mapping) else dict.fromkeys(driven)
    names, with_actuator = {_named(name, joints).index(): name for name in limits}, set()
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
            joint = joints[name]
            effort = efforts.get(joint.index(), np.inf) if limit is None else limit
            actuator = plant.AddJointActuator(joint.name(), joint, effort)
            actuator.set_default_rotor_inertia(armatures.get(joint.index(), 0.0))


def _named(name: str, joints: Mapping[str, Joint]) -> Joint:
    if name not in joints:
        raise ModelError(unknown_name("turning or sliding joint", name, joints))
    return joints[name]


def _movable(plant: MultibodyPlant) -> dict[str, Joint]:
    """Name -> joint, for revolute and prismatic joints."""
    return {name: joint for name, joint in joint_names(plant).items() if _is_simple(joint)}


def _is_simple(joint: Joint) -> bool:
    return isinstance(joint, RevoluteJoint | PrismaticJoint)


def _leaders(
    plant: MultibodyPlant, follows: Mapping[JointIndex, tuple[str, float, float]]
) -> dict[JointIndex, _Leader]:
    """Joint that follows -> its leader, ratio and offset; a leader is of the same model."""
    leaders = dict[JointIndex, _Leader]()
    for index, (name, ratio, offset) in follows.items():
        joint = plant.get_joint(index)
        if name == joint.name() or not plant.HasJointNamed(name, joint.model_instance()):
            text = f"joint '{joint.name()}' mimics '{name}', which is no other joint of its file"
            raise ModelError(text)
        leader = plant.GetJointByName(name, joint.model_instance())
        leaders[index] = leader.index(), ratio, offset
    return leaders


class CutJoint(NamedTuple):
    """A joint that closed a loop: its axis and poses are those of its frames on both bodies."""

    slides: bool
    bodies: tuple[BodyIndex, BodyIndex]
    poses: tuple[RigidTransform, RigidTransform]
    axis: FloatArray
    options: dict[str, Any]


def cut_loops(plant: MultibodyPlant, parents: Mapping[tuple[str, str], str]) -> list[CutJoint]:
    """Removes joints until the others form a tree; driven joints only if necessary.

    `parents` are the frames that an SDFormat file names as the parents of joints.
    """
    driven = {actuator.joint().index(): actuator for actuator in actuators_of(plant)}
    names = {joint.index(): name for name, joint in joint_names(plant).items()}
    named, groups, cuts = noted(plant, parents), list(range(plant.num_bodies())), []
    for joint in sorted(
        joints_of(plant),
        key=lambda joint: (not _is_simple(joint), joint.index() in driven),
        reverse=True,
    ):
        first, second = (
            groups[int(body.index())] for body in (joint.parent_body(), joint.child_body())
        )
        if first == second:
            name = names.get(joint.index(), joint.name())
            _check_parent(joint, name, plant, named.get(joint.index(), ""))
            cuts.append(_cut(joint, name, driven.get(joint.index()), plant))
        groups = [second if group == first else group for group in groups]
    return cuts


def _check_parent(joint: Joint, name: str, plant: MultibodyPlant, named: str) -> None:
    """Refuses a loop that is open where its file means it to be closed.

    A joint of SDFormat is at its child; of a frame that is its parent, only the body counts.
    """
    if not named or not plant.HasFrameNamed(named, joint.model_instance()):
        return
    frame = plant.GetFrameByName(named, joint.model_instance())
    meant, found = (one.GetFixedPoseInBodyFrame() for one in (frame, joint.frame_on_parent()))
    gap = float(np.linalg.norm(meant.translation() - found.translation()))
    if frame.name() != frame.body().name() and gap > 1e-6:
        raise ModelError(
            f"joint '{name}' closes a loop at its child, {gap:.3g} m from the frame '{named}' that "
            f"it names as its parent: of that only the body '{frame.body().name()}' counts. Let "
            "<pose> place the joint at the frame"
        )


def _cut(
    joint: Joint, name: str, actuator: JointActuator | None, plant: MultibodyPlant
) -> CutJoint:
    if not _is_simple(joint):
        raise ModelError(
            f"joint '{name}' closes a loop, and neither turns nor slides; take it out of the file, "
            "and write it under constraints, as a !WeldedFrames or !CoincidentPoints"
        )
    limits = {
        "lower": joint.position_lower_limits()[0],
        "upper": joint.position_upper_limits()[0],
        "velocity_limit": joint.velocity_upper_limits()[0],
    }
    options: dict[str, Any] = {"damping": joint.default_damping(), "name": name}
    if actuator is not None:
        if actuator.default_rotor_inertia() != 0.0:
            raise ModelError(
                f"joint '{name}' closes a loop, as all joints of it do that could be cut, and its "
                "motor has a rotor: that cannot be a constraint; leave one joint without motor"
            )
        options["motor"] = True
        limits["effort_limit"] = actuator.effort_limit()
        plant.RemoveJointActuator(actuator)
    options |= {key: float(value) for key, value in limits.items() if isfinite(value)}
    parent, child = joint.frame_on_parent(), joint.frame_on_child()
    slides = isinstance(joint, PrismaticJoint)
    cut = CutJoint(
        slides,
        (parent.body().index(), child.body().index()),
        (parent.GetFixedPoseInBodyFrame(), child.GetFixedPoseInBodyFrame()),
        np.array(joint.translation_axis() if slides else joint.revolute_axis()),
        options,
    )
    try:
        plant.RemoveJoint(joint)
    except RuntimeError as error:
        raise ModelError(
            f"joint '{name}' closes a loop, and cannot be cut: {error} Springs stop it: "
            "robot.leave_out takes them out, as [dynamics/spring_stiffness]"
        ) from None
    return cut


def loop_constraint(cut: CutJoint, plant: MultibodyPlant) -> Constraint:
    """The constraint that replaces a cut joint; planar where the loop is, or it were redundant."""
    bodies, context = [plant.get_body(index) for index in cut.bodies], plant.CreateDefaultContext()
    rotation = plant.EvalBodyPoseInWorld(context, bodies[0]).rotation() @ cut.poses[0].rotation()
    axes, options = axes_along(cut.axis), dict(cut.options)
    # The columns of the rate of the child in the parent: of joints that turn, and that slide.
    rates = plant.CalcJacobianSpatialVelocity(
        context,
        JacobianWrtVariable.kV,
        bodies[1].body_frame(),
        np.zeros((3, 1)),
        bodies[0].body_frame(),
        plant.world_frame(),
    )
    turning = [column[:3] for column in rates.T if np.linalg.norm(column[:3]) > 1e-9]
    sliding = [*rates[3:].T]
    (sliding if cut.slides else turning).append(rotation @ cut.axis)
    normal = turning[-1] if turning else None
    leans = [] if normal is None else [np.linalg.norm(np.cross(normal, axis)) for axis in turning]
    leans += [] if normal is None else [abs(normal @ axis) for axis in sliding]
    if any(lean > 1e-9 for lean in leans):
        normal = None
    if cut.slides and normal is not None:
        across = rotation.inverse() @ normal
        axes = np.column_stack([across, np.cross(cut.axis, across), cut.axis])
    for letter, body, pose in zip("ab", bodies, cut.poses, strict=True):
        frame = pose @ RigidTransform(RotationMatrix(axes), np.zeros(3))
        options[f"frame_{letter}"] = frame_name(plant, body.body_frame())
        options[f"point_{letter}"] = triple("a point", frame.translation())
        options[f"rpy_{letter}"] = triple("an angle", RollPitchYaw(frame.rotation()).vector())
    if cut.slides:
        return PrismaticLoopJoint(axis="z", normal=None if normal is None else "x", **options)
    return RevoluteLoopJoint(axis="z", planar=normal is not None, **options)
