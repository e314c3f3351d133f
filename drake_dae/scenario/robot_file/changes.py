"""The changes that a scenario makes to its robot: base, locked joints, actuators, payloads."""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Literal

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
    WeldJoint,
)

from drake_dae.arrays import unknown_name
from drake_dae.errors import DrakeDaeError, ModelError
from drake_dae.robots.constraints.plant_constraints import Coupling, couplings_of
from drake_dae.robots.links.frames import joint_names, unique_names
from drake_dae.scenario.forms.keys import at
from drake_dae.scenario.robot_file.efforts import Efforts, limits_of
from drake_dae.scenario.robot_file.loops import actuators_of, joints_of
from drake_dae.scenario.robot_file.payloads import add_payloads
from drake_dae.scenario.robot_file.reading import read_robot
from drake_dae.scenario.robot_file.robot import Robot, RobotPlacement


def change_robot(robot: Robot, plant: MultibodyPlant, efforts: Efforts) -> None:
    """Applies the changes that a scenario makes to the robot of its file.

    Args:
        robot: The key `robot` of the scenario.
        plant: The robot of that file, not finalized.
        efforts: The effort limits of the file, for new actuators.

    Raises:
        ScenarioError: A change does not fit the robot; the message names its key.
    """
    couplings: Sequence[Coupling] = ()
    if plant.num_constraints() > 0 and (robot.locked or robot.actuators == "all"):
        couplings = _read_couplings(robot)
    with _drake_errors():
        if robot.base is not None:
            weld_base(robot.base, plant)
        if robot.locked:
            lock_joints(robot.locked, plant, couplings)
        add_free_joints(robot.free, plant)
        if robot.actuators is not None:
            drive_joints(robot.actuators, plant, couplings, limits_of(plant, efforts))
        add_payloads("robot.payloads", robot.payloads, plant)


def finalize(plant: MultibodyPlant) -> None:
    """Finalizes a plant.

    Raises:
        ModelError: Drake cannot finalize it.
    """
    with _drake_errors():
        plant.Finalize()


@contextmanager
def _drake_errors() -> Iterator[None]:
    """Converts Drake's exceptions to ModelError, also the SystemExit of a failed assertion."""
    try:
        yield
    except DrakeDaeError:
        raise
    except (RuntimeError, ValueError, SystemExit) as error:
        raise ModelError(str(error)) from None


def _read_couplings(robot: Robot) -> Sequence[Coupling]:
    """Reads the couplings of the file from a second plant, since the plant must be finalized."""
    plant, _ = read_robot(robot)
    finalize(plant)
    return couplings_of(plant)


@at("robot.base.weld")
def weld_base(base: RobotPlacement, plant: MultibodyPlant) -> None:
    """Welds a frame of a body without a joint to the world.

    Raises:
        ScenarioError: There is no such frame, or its body has a joint.
    """
    try:
        frame = GetScopedFrameByName(plant, base.weld)
    except RuntimeError:
        free = _free_bodies(plant)
        raise ModelError(unknown_name("free body or frame on it", base.weld, free)) from None
    body = frame.body()
    if body.index() == plant.world_body().index():
        raise ModelError("the world needs no base; name a frame of the robot")
    if joint := _joints_to_parents(plant).get(body.index()):
        raise ModelError(
            f"body '{body.name()}' is attached already, by joint '{joint.name()}'; unattached "
            f"bodies: {', '.join(_free_bodies(plant)) or 'none'}"
        )
    rotation = RollPitchYaw(np.deg2rad(base.pose.rpy_deg))
    plant.WeldFrames(plant.world_frame(), frame, RigidTransform(rotation, base.pose.translation))


@at("robot.free")
def add_free_joints(bodies: Sequence[str], plant: MultibodyPlant) -> None:
    """Adds floating joints in roll, pitch and yaw to bodies without a joint.

    Raises:
        ScenarioError: There is no such body, or it has a joint.
    """
    for name in bodies:
        try:
            body = GetScopedFrameByName(plant, name).body()
            if joint := _joints_to_parents(plant).get(body.index()):
                raise ModelError(f"'{name}' is not free: joint '{joint.name()}' holds it")
            plant.AddJoint(RpyFloatingJoint(body.name(), plant.world_frame(), body.body_frame()))
        except RuntimeError as error:
            raise ModelError(f"'{name}' is no body that can be free: {error}") from None


@at("robot.locked")
def lock_joints(
    locked: Mapping[str, float], plant: MultibodyPlant, couplings: Sequence[Coupling]
) -> None:
    """Replaces joints by welds at given positions.

    Drake supports locked joints only in discrete time. The weld has the constant pose X_FM(q) of
    the joint, from its frame on the parent to its frame on the child. The actuator, the damping and
    the rotor of the joint are removed.

    Joints that are coupled to a locked one by q_f = ratio q_l + offset are locked as well.

    Args:
        locked: Name -> position, in rad or m.
        plant: The robot, not finalized; changed.
        couplings: The couplings of the plant.

    Raises:
        ScenarioError: There is no such joint, its position is outside of its limits or
            contradicts a coupling, or the file has constraints other than couplings.
    """
    joints = _movable(plant)
    positions = dict(locked)
    _lock_coupled(positions, couplings)
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
    with _without_constraints(plant, couplings):
        for name, value in positions.items():
            _weld_joint(joints[name], value, plant)


@contextmanager
def _without_constraints(plant: MultibodyPlant, couplings: Sequence[Coupling]) -> Iterator[None]:
    """Removes the constraints of a plant, and restores those between remaining joints.

    Drake removes joints only from plants without constraints.

    Raises:
        ModelError: The plant has constraints other than these couplings.
    """
    if plant.num_constraints() > len(couplings):
        raise ModelError(
            "the file has constraints other than mimic joints, which Drake loses when a joint is "
            "locked; take them out of it, and write them under constraints"
        )
    for key in plant.GetConstraintIds():
        plant.RemoveConstraint(key)
    yield
    joints = _movable(plant)
    for coupling in couplings:
        if coupling.follower in joints:
            pair = joints[coupling.follower], joints[coupling.leader]
            plant.AddCouplerConstraint(*pair, coupling.ratio, coupling.offset)


def _lock_coupled(positions: dict[str, float], couplings: Sequence[Coupling]) -> None:
    """Adds the positions of joints that are coupled to locked ones."""
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


def _weld_joint(joint: Joint, position: float, plant: MultibodyPlant) -> None:
    """Replaces a joint with one position by a weld."""
    name, inboard, outboard = joint.name(), joint.frame_on_parent(), joint.frame_on_child()
    if isinstance(joint, PrismaticJoint):
        pose = RigidTransform(position * joint.translation_axis())
    else:
        pose = RigidTransform(AngleAxis(position, joint.revolute_axis()), np.zeros(3))
    for actuator in actuators_of(plant):
        if actuator.joint() is joint:
            plant.RemoveJointActuator(actuator)
    try:
        plant.RemoveJoint(joint)
    except RuntimeError as error:
        raise ModelError(f"'{name}' cannot be locked: {error}") from None
    plant.AddJoint(WeldJoint(name, inboard, outboard, pose))


@at("robot.actuators")
def drive_joints(
    driven: Literal["all"] | Sequence[str] | Mapping[str, float | None],
    plant: MultibodyPlant,
    couplings: Sequence[Coupling],
    efforts: Mapping[str, float],
) -> None:
    """Adds actuators to the joints that a scenario names, and removes those of all other joints.

    Actuators of the file remain, with their gear ratios and rotors.

    Args:
        driven: Names of joints, or name -> effort limit in N m or N; or "all", the revolute and
            prismatic joints that mimic no other.
        plant: The robot, not finalized; changed.
        couplings: The couplings of the plant.
        efforts: Name -> effort limit of the file, for new actuators without a limit.

    Raises:
        ScenarioError: There is no such joint, or it has several positions.
    """
    joints = _movable(plant)
    if driven == "all":
        followers = {coupling.follower for coupling in couplings}
        driven = [name for name in joints if name not in followers]
    limits = driven if isinstance(driven, Mapping) else dict.fromkeys(driven)
    names = {_named(name, joints).index(): name for name in limits}
    kept = set()
    for actuator in actuators_of(plant):
        name = names.get(actuator.joint().index())
        kept.add(name)
        if name is None:
            plant.RemoveJointActuator(actuator)
        elif (limit := limits[name]) is not None:
            actuator.set_effort_limit(limit)
    for name in (name for name in limits if name not in kept):
        joint, limit = joints[name], limits[name]
        effort = efforts.get(name, np.inf) if limit is None else limit
        plant.AddJointActuator(joint.name(), joint, effort)


def _named(name: str, joints: Mapping[str, Joint]) -> Joint:
    if name not in joints:
        raise ModelError(unknown_name("turning or sliding joint", name, joints))
    return joints[name]


def _movable(plant: MultibodyPlant) -> dict[str, Joint]:
    """Name -> joint, for revolute and prismatic joints."""
    return {
        name: joint
        for name, joint in joint_names(plant).items()
        if isinstance(joint, RevoluteJoint | PrismaticJoint)
    }


def _joints_to_parents(plant: MultibodyPlant) -> dict[BodyIndex, Joint]:
    """Index of a body -> the joint by which it is attached."""
    return {joint.child_body().index(): joint for joint in reversed(joints_of(plant))}


def _free_bodies(plant: MultibodyPlant) -> list[str]:
    """The names of the bodies without a joint, except the world."""
    attached = _joints_to_parents(plant)
    bodies = [plant.get_body(BodyIndex(i)) for i in range(1, plant.num_bodies())]
    return unique_names(plant, [body for body in bodies if body.index() not in attached])
