"""The joints of a MultibodyPlant as rotations about coordinate axes and translations."""

import casadi as ca
import numpy as np
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import (
    BallRpyJoint,
    Joint,
    PlanarJoint,
    PrismaticJoint,
    RevoluteJoint,
    RpyFloatingJoint,
    ScrewJoint,
    UniversalJoint,
    WeldJoint,
)

from drake_dae.arrays import FloatArray
from drake_dae.errors import ModelError
from drake_dae.robots.links.tree import ElementaryJoint, TreeLink

SUPPORTED_JOINTS = (
    RevoluteJoint,
    PrismaticJoint,
    WeldJoint,
    ScrewJoint,
    UniversalJoint,
    PlanarJoint,
    BallRpyJoint,
    RpyFloatingJoint,
)


def check_joint(joint: Joint) -> None:
    """Refuses a joint that is not a sequence of rotations and translations."""
    if isinstance(joint, SUPPORTED_JOINTS):
        return
    if joint.is_ephemeral():
        raise ModelError(
            f"body '{joint.child_body().name()}' is free, so Finalize gave it a "
            f"{joint.type_name()} joint. A quaternion is not supported: its length 1 is an "
            "equation that no force keeps, so that J M^-1 J^T would be singular. Before Finalize, "
            "weld it to the world (plant.WeldFrames) or add an RpyFloatingJoint from the world to "
            "it, which has roll, pitch and yaw"
        )
    names = ", ".join(supported.kTypeName for supported in SUPPORTED_JOINTS)
    raise ModelError(
        f"joint '{joint.name()}' has type {joint.type_name()}, which is not supported; "
        f"supported are {names}"
    )


def elementary_joints(
    plant: MultibodyPlant, joint: Joint, reverse: bool = False
) -> tuple[list[ElementaryJoint], FloatArray]:
    """A joint as elementary ones from inboard to outboard, and R with X_FM(q) = R (joints) R^T.

    The constant R, shape (3, 3), turns an oblique axis into a coordinate axis, which saves
    operations. A `reverse` joint leads from the frame on the child to the one on the parent; Drake
    allows it for revolute, prismatic and weld joints, where the inverse has the opposite axis.
    """
    sign = -1.0 if reverse else 1.0
    i, j = joint.position_start(), joint.velocity_start()
    unit = np.eye(3)

    def turn(axis: int, k: int = 0) -> ElementaryJoint:
        return ElementaryJoint(axis, (i + k,), (j + k,), unit[:, [axis]])

    def shift(directions: FloatArray, first: int = 0) -> ElementaryJoint:
        places = range(first, first + directions.shape[1])
        return ElementaryJoint(
            None, tuple(i + k for k in places), tuple(j + k for k in places), directions
        )

    # R_FM = Rz(yaw) Ry(pitch) Rx(roll); the first turn carries the angular velocity in F.
    roll_pitch_yaw = [
        ElementaryJoint(2, (i + 2,), (j, j + 1, j + 2), unit),
        ElementaryJoint(1, (i + 1,), (), np.zeros((3, 0))),
        ElementaryJoint(0, (i,), (), np.zeros((3, 0))),
    ]
    match joint:
        case RevoluteJoint():
            axis, rotation = _align(sign * joint.revolute_axis())
            return [turn(axis)], rotation
        case PrismaticJoint():
            return [shift(sign * joint.translation_axis().reshape(3, 1))], unit
        case ScrewJoint():
            axis, rotation = _align(_screw_axis(plant, joint))
            metres_per_radian = joint.screw_pitch() / (2.0 * np.pi)
            return [shift(metres_per_radian * unit[:, [axis]]), turn(axis)], rotation
        case UniversalJoint():
            return [turn(0), turn(1, 1)], unit
        case PlanarJoint():
            return [shift(unit[:, :2]), turn(2, 2)], unit
        case BallRpyJoint():
            return roll_pitch_yaw, unit
        case RpyFloatingJoint():
            return [shift(unit, 3), *roll_pitch_yaw], unit
    return [], unit


def joint_velocity_map(joint: Joint, q: ca.SX) -> ca.SX:
    """N(q) of one joint, shape (k, k), with q' = N v for its own positions and velocities."""
    count = joint.num_positions()
    block = ca.SX.eye(count)
    if isinstance(joint, (BallRpyJoint, RpyFloatingJoint)):
        # The velocities are the angular velocity of M in F, not the rates of the angles.
        s, c, s_yaw, c_yaw = ca.sin(q[1]), ca.cos(q[1]), ca.sin(q[2]), ca.cos(q[2])
        rates = ca.vertcat(
            ca.horzcat(c_yaw / c, s_yaw / c, 0),
            ca.horzcat(-s_yaw, c_yaw, 0),
            ca.horzcat(c_yaw * s / c, s_yaw * s / c, 1),
        )
        block = ca.diagcat(ca.sparsify(rates), ca.SX.eye(count - 3))
    return block


def read_links(
    plant: MultibodyPlant, q: ca.SX
) -> tuple[list[TreeLink], dict[int, tuple[int, RigidTransform]]]:
    """Reads the tree of a plant whose joints are supported, outward from the world.

    Returns the links, still without inertia, and for every body its index -> its link, and its
    constant pose in that link.
    """
    links = [TreeLink()]
    bodies = {int(plant.world_body().index()): (0, RigidTransform())}
    joints = [plant.get_joint(index) for index in plant.GetJointIndices()]
    reached = list(bodies)
    for body in reached:
        for joint in joints:
            ends = [int(joint.parent_body().index()), int(joint.child_body().index())]
            frames = [joint.frame_on_parent(), joint.frame_on_child()]
            reverse = body == ends[1]
            if reverse:
                ends, frames = ends[::-1], frames[::-1]
            if body != ends[0] or ends[1] in bodies:
                continue
            link, X_LB = bodies[body]
            X_LF = X_LB @ frames[0].GetFixedPoseInBodyFrame()
            if isinstance(joint, WeldJoint):
                X_LM = X_LF @ (joint.X_FM().inverse() if reverse else joint.X_FM())
            else:
                parts, rotation = elementary_joints(plant, joint, reverse)
                X_FA = RigidTransform(RotationMatrix(rotation), np.zeros(3))
                start = X_LF @ X_FA
                for elementary in parts:
                    links.append(TreeLink.moved(link, *constant_pose(start), elementary, q))
                    link, start = len(links) - 1, RigidTransform()
                X_LM = X_FA.inverse()
            bodies[ends[1]] = (link, X_LM @ frames[1].GetFixedPoseInBodyFrame().inverse())
            reached.append(ends[1])
    return links, bodies


def constant_pose(pose: RigidTransform) -> tuple[FloatArray, FloatArray]:
    """R, shape (3, 3), and p, shape (3,), of a constant pose."""
    return _snap(pose.rotation().matrix()), without_round_off(pose.translation())


def without_round_off(values: FloatArray) -> FloatArray:
    """Sets entries to zero that are below 1e-13 of the largest one."""
    return np.where(np.abs(values) < 1e-13 * np.abs(values).max(), 0.0, values)


def _snap(rotation: FloatArray) -> FloatArray:
    """Makes entries of a rotation within 1e-13 of -1, 0, 1 exact, so that expressions simplify.

    Files write pi with 14 digits; its error must not fill the zeros of a rotation.
    """
    nearest = np.rint(rotation)
    return np.where(np.abs(rotation - nearest) < 1e-13, nearest, rotation)


def _screw_axis(plant: MultibodyPlant, joint: ScrewJoint) -> FloatArray:
    """The axis of a screw joint, which pydrake does not bind, from a quarter turn."""
    context = plant.CreateDefaultContext()
    q = np.zeros(plant.num_positions())
    q[joint.position_start()] = np.pi / 2
    plant.SetPositions(context, q)
    R = joint.frame_on_child().CalcPose(context, joint.frame_on_parent()).rotation().matrix()
    axis = np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]])
    return axis / np.linalg.norm(axis)


def _align(direction: FloatArray) -> tuple[int, FloatArray]:
    """A coordinate axis, and a rotation that takes it to `direction`."""
    direction = _snap(direction)
    first = int(np.argmax(np.abs(direction)))
    second, third = (first + 1) % 3, (first + 2) % 3
    rotation = np.eye(3)
    if direction[first] != 1.0:
        normal = np.cross(direction, np.eye(3)[second])
        rotation[:, first] = direction
        rotation[:, third] = normal / np.linalg.norm(normal)
        rotation[:, second] = np.cross(rotation[:, third], direction)
    return first, rotation
