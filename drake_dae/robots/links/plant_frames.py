"""The frames of a MultibodyPlant, by name, on the links that carry them; outlines of bodies."""

from collections import Counter
from collections.abc import Sequence
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike
from pydrake.geometry import Box, Capsule, Convex, Cylinder, Ellipsoid, Mesh, SceneGraph, Sphere
from pydrake.math import RigidTransform
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import (
    Frame,
    FrameIndex,
    Joint,
    RigidBody,
    SpatialInertia,
    default_model_instance,
)

from drake_dae.arrays import FloatArray, unknown_name, vector
from drake_dae.errors import ModelError
from drake_dae.robots.links.joints import constant_pose
from drake_dae.robots.links.links import Outline
from drake_dae.robots.links.tree import TreeLink, link_poses

MOST_CORNERS = 200
"""The largest number of points of a mesh."""


class PlantFrames:
    """The frames of a finalized plant, each fixed to a link of its tree.

    `bodies` is the index of a body -> its link, and its constant pose in that link.
    """

    def __init__(
        self,
        plant: MultibodyPlant,
        links: Sequence[TreeLink],
        bodies: dict[int, tuple[int, RigidTransform]],
    ) -> None:
        self.plant, self._links, self._bodies = plant, links, bodies
        self._poses: dict[int, tuple[ca.SX, ca.SX]] = {}

    def find(self, frame: str | Frame) -> Frame:
        """A frame of the plant by name; "instance::name" if several have that name.

        Raises:
            ModelError: No frame, or more than one, has that name; or it belongs to another plant.
        """
        resolved = frame_named(self.plant, frame) if isinstance(frame, str) else frame
        if resolved.GetParentPlant() is not self.plant:
            raise ModelError(f"frame '{resolved.name()}' belongs to another plant")
        return resolved

    def pose(self, frame: Frame) -> tuple[ca.SX, ca.SX]:
        """R_WF, shape (3, 3), and p_WF in m, shape (3, 1), as expressions of q."""
        index = int(frame.index())
        if index not in self._poses:
            link, rotation, offset = self.on_link(frame)
            R_WL, p_WL = self.link_poses[link]
            self._poses[index] = (R_WL @ ca.SX(rotation), p_WL + R_WL @ ca.SX(offset))
        return self._poses[index]

    def on_link(self, frame: Frame) -> tuple[int, FloatArray, FloatArray]:
        """The index of the link that carries a frame; R_LF, shape (3, 3), and p_LF, shape (3,)."""
        link, X_LB = self._bodies[int(frame.body().index())]
        return link, *constant_pose(X_LB @ frame.GetFixedPoseInBodyFrame())

    @cached_property
    def link_poses(self) -> list[tuple[ca.SX, ca.SX]]:
        """R_WL, shape (3, 3), and p_WL in m, shape (3, 1), of every link."""
        return link_poses(self._links)


def body_with_frame(plant: MultibodyPlant, name: str) -> tuple[RigidBody, RigidTransform]:
    """A body of a plant that is not finalized, for a constraint of Drake, and a frame's pose in it.

    Drake 1.51 ends the process at a constraint with the world, but not at one with a body that is
    welded to the world. So a frame of the world is put on such a body, which is added.
    """
    frame = frame_named(plant, name)
    body, pose = frame.body(), frame.GetFixedPoseInBodyFrame()
    if body.index() == plant.world_body().index():
        ground = f"drake_dae_ground_{plant.num_bodies()}"
        inertia = SpatialInertia.SolidBoxWithMass(1.0, 1.0, 1.0, 1.0)
        body = plant.AddRigidBody(ground, default_model_instance(), inertia)
        plant.WeldFrames(plant.world_frame(), body.body_frame())
    return body, pose


def frame_named(plant: MultibodyPlant, name: str) -> Frame:
    """A frame of a plant by its name; "instance::name" if several have that name.

    Raises:
        ModelError: No frame, or more than one, has that name.
    """
    if name == "world":
        return plant.world_frame()
    frames = [plant.get_frame(FrameIndex(i)) for i in range(plant.num_frames())]
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
    frames = [plant.get_frame(FrameIndex(i)) for i in range(plant.num_frames())]
    is_unique = [other.name() for other in frames].count(frame.name()) == 1
    return str(frame.name()) if is_unique else scoped_name(plant, frame)


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
