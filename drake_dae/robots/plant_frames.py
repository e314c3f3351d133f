"""The joints of a MultibodyPlant as a tree of links, and its frames on these, by name."""

from collections import Counter
from collections.abc import Sequence
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike
from pydrake.geometry import Box, Capsule, Convex, Cylinder, Ellipsoid, Mesh, SceneGraph, Sphere
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import (
    BallRpyJoint,
    Frame,
    FrameIndex,
    Joint,
    PlanarJoint,
    PrismaticJoint,
    RevoluteJoint,
    RigidBody,
    RpyFloatingJoint,
    ScrewJoint,
    UniversalJoint,
    WeldJoint,
)

from drake_dae.arrays import FloatArray, unknown_name, vector
from drake_dae.errors import ModelError
from drake_dae.robots.links import Outline
from drake_dae.robots.tree import ElementaryJoint, TreeLink

MOST_CORNERS = 200
"""The largest number of points of a mesh."""


def frame_named(plant: MultibodyPlant, name: str) -> Frame:
    """A frame of a plant by its name; "instance::name" if several have that name."""
    if name == "world":
        return plant.world_frame()
    frames = _frames(plant)
    matches = [frame for frame in frames if name in (frame.name(), scoped_name(plant, frame))]
    if len(matches) == 1:
        return matches[0]
    if matches:
        scoped = ", ".join(scoped_name(plant, frame) for frame in matches)
        raise ModelError(f"the plant has several frames '{name}'; say which: {scoped}")
    # Drake's parser adds frames at joints whose axis it must rotate.
    names = [n for n in unique_names(plant, frames) if not n.endswith(("_parent_F", "_M"))]
    raise ModelError(unknown_name("frame", name, names))


def position_of(pose: tuple[ca.SX, ca.SX], point: ArrayLike) -> ca.SX:
    """p_W in m of a point that is fixed in a frame with this pose, shape (3, 1)."""
    rotation, origin = pose
    return origin + rotation @ ca.SX(vector("a point", point, 3))


def frame_name(plant: MultibodyPlant, frame: Frame) -> str:
    """The name by which `frame_named` finds a frame."""
    if frame is plant.world_frame():
        return "world"
    return unique_names(plant, _frames(plant))[int(frame.index())]


def _frames(plant: MultibodyPlant) -> list[Frame]:
    return [plant.get_frame(FrameIndex(i)) for i in range(plant.num_frames())]


def scoped_name(plant: MultibodyPlant, item: Any) -> str:
    """The name of a joint, body, frame or actuator, preceded by its model instance."""
    return f"{plant.GetModelInstanceName(item.model_instance())}::{item.name()}"


def unique_names(plant: MultibodyPlant, items: Sequence[Any]) -> list[str]:
    """Names of joints, bodies, frames or actuators, scoped where they collide."""
    count = Counter(item.name() for item in items)
    return [item.name() if count[item.name()] == 1 else scoped_name(plant, item) for item in items]


def joint_names(plant: MultibodyPlant) -> dict[str, Joint]:
    """The joints that move, by names that are scoped where they collide."""
    joints = [plant.get_joint(index) for index in plant.GetJointIndices()]
    moving = [joint for joint in joints if joint.num_velocities() > 0]
    return dict(zip(unique_names(plant, moving), moving, strict=True))


def outlines_of(
    plant: MultibodyPlant, scene_graph: SceneGraph | None, bodies: list[RigidBody]
) -> tuple[Outline, ...]:
    """The outline of each collision geometry of bodies; of a body without any, its origin."""
    found = []
    inspector: Any = scene_graph and scene_graph.model_inspector()
    for body in bodies:
        frame, name, own = body.body_frame(), body.name(), []
        for geometry in plant.GetCollisionGeometriesForBody(body) if inspector else ():
            points, radius = _corners(inspector.GetShape(geometry))
            placed = inspector.GetPoseInFrame(geometry).multiply(points.T).T
            own += [Outline(name, frame, placed, radius)] if len(points) else []
        found += own or [Outline(name, frame)]
    return tuple(found)


def _corners(shape: object) -> tuple[FloatArray, float]:
    """Points of a shape, and its radius around these; no points for unbounded shapes."""
    grid = np.array(np.meshgrid(*[[-1.0, 0.0, 1.0]] * 3)).reshape(3, -1).T
    match shape:
        case Sphere():
            return np.zeros((1, 3)), shape.radius()
        case Capsule():
            end = np.array([0.0, 0.0, 0.5]) * shape.length()
            return np.linspace(-end, end, 9), shape.radius()
        case Cylinder():
            turns = np.pi * np.arange(16) / 8
            ring = shape.radius() * np.column_stack([np.cos(turns), np.sin(turns), 0.0 * turns])
            ends = np.array([-0.5, 0.0, 0.5])[:, None, None] * [0.0, 0.0, shape.length()]
            return (ring + ends).reshape(-1, 3), 0.0
        case Box():
            return grid * shape.size() / 2.0, 0.0
        case Ellipsoid():
            directions = grid[np.any(grid, axis=1)]
            directions /= np.linalg.norm(directions, axis=1, keepdims=True)
            return directions * [shape.a(), shape.b(), shape.c()], 0.0
        case Mesh() | Convex():
            hull = shape.GetConvexHull()
            count = hull.num_vertices()
            chosen = np.unique(np.linspace(0, count - 1, MOST_CORNERS).astype(int))
            return np.array([hull.vertex(int(i)) for i in chosen]), 0.0
    return np.zeros((0, 3)), 0.0


def elementary_joints(
    plant: MultibodyPlant, joint: Joint, reverse: bool = False
) -> tuple[list[ElementaryJoint], FloatArray]:
    """A joint as elementary ones from inboard to outboard, and R with X_FM(q) = R (joints) R^T.

    R turns an oblique axis into a coordinate axis, which saves operations. A `reverse` joint, which
    is revolute, prismatic or a weld, leads from child to parent. Others raise ModelError.
    """
    sign = -1.0 if reverse else 1.0
    i, j = joint.position_start(), joint.velocity_start()
    unit = np.eye(3)

    def turn(axis: int, k: int = 0) -> ElementaryJoint:
        return ElementaryJoint(axis, (i + k,), (j + k,), unit[:, [axis]])

    def shift(directions: FloatArray, first: int = 0) -> ElementaryJoint:
        places = np.arange(first, first + directions.shape[1])
        return ElementaryJoint(None, tuple(i + places), tuple(j + places), directions)

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
    if joint.is_ephemeral():
        raise ModelError(
            f"body '{joint.child_body().name()}' is free, so Finalize gave it a "
            f"{joint.type_name()} joint, which is not supported. Before Finalize, weld it to the "
            "world (plant.WeldFrames), or add an RpyFloatingJoint from the world to it"
        )
    raise ModelError(
        f"joint '{joint.name()}' has type {joint.type_name()}, which is no sequence of rotations "
        "and translations"
    )


def joint_velocity_map(joint: Joint, q: ca.SX) -> ca.SX:
    """N(q) of one joint, shape (k, k), with q' = N v for its own positions and velocities."""
    count, start = joint.num_positions(), joint.position_start()
    if not isinstance(joint, (BallRpyJoint, RpyFloatingJoint)):
        return ca.SX.eye(count)
    # The velocities are the angular velocity of M in F, not the rates of the angles.
    pitch, yaw = q[start + 1], q[start + 2]
    s, c, s_yaw, c_yaw = ca.sin(pitch), ca.cos(pitch), ca.sin(yaw), ca.cos(yaw)
    rates = ca.blockcat(
        [[c_yaw / c, s_yaw / c, 0], [-s_yaw, c_yaw, 0], [c_yaw * s / c, s_yaw * s / c, 1]]
    )
    return ca.diagcat(ca.sparsify(rates), ca.SX.eye(count - 3))


def read_links(
    plant: MultibodyPlant, q: ca.SX
) -> tuple[list[TreeLink], dict[int, tuple[int, RigidTransform]]]:
    """The links of a plant, without inertia; and body -> its link and constant pose in that."""
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
