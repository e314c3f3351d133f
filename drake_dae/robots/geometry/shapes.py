"""The collision geometry of links, and overlaps of links along a motion."""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np
from pydrake.geometry import (
    Box,
    Capsule,
    Convex,
    Cylinder,
    Ellipsoid,
    FramePoseVector,
    GeometryId,
    Mesh,
    SceneGraph,
    Sphere,
)
from pydrake.multibody.tree import BodyIndex, JointIndex

from drake_dae.arrays import FloatArray
from drake_dae.robots.links.frames import frame_named
from drake_dae.robots.model import RobotModel

MOST_STATES = 60
"""The largest number of states of a motion that are examined: neighbours are usually closer than
the width of a link."""

TOUCHING = 1e-3
"""Shapes that overlap by less than this, in m, only touch."""

COARSE = 0.02
"""The allowed overlap, in m, of links with at most one link between them: vendors' shapes overlap
there in normal use."""

MOST_CORNERS = 200
"""The largest number of examined corners of a mesh."""

_RING = 2.0 * np.pi * np.arange(8) / 8


@dataclass(frozen=True)
class Collision:
    """Two links whose shapes overlap.

    Attributes:
        first, second: Their names; "world" for anything fixed.
        depth: The largest overlap, in m.
        time: The time of the largest overlap, in s.
        since: The time of the first overlap, in s.
    """

    first: str
    second: str
    depth: float
    time: float
    since: float

    def __str__(self) -> str:
        when = f"at {self.time:.4g} s" if self.time == self.since else f"from {self.since:.4g} s on"
        return f"{self.first} and {self.second} collide {when}, by up to {self.depth:.3g} m"


@dataclass(frozen=True)
class LeastDistance:
    """The least distance of two links, or of a link and a surface, along a motion.

    Attributes:
        first, second: The names of two links, or of a link and of the constraint of a surface.
        is_surface: Whether `second` is that of a surface.
        of_origin: Whether the distance is that of the link's origin, since links have no shapes.
        distance: The distance in m; negative if they overlap.
        time: The time of that distance, in s.
    """

    first: str
    second: str
    is_surface: bool
    of_origin: bool
    distance: float
    time: float

    def __str__(self) -> str:
        who = f"the origin of {self.first}" if self.of_origin else self.first
        what = f"the surface of '{self.second}'" if self.is_surface else self.second
        return f"{who} comes closest to {what} at {self.time:.4g} s, {self.distance:.3g} m"


def sampled(count: int, most: int = MOST_STATES) -> np.ndarray:
    """The evenly spaced indices of at most `most` among `count` items."""
    return np.unique(np.linspace(0, count - 1, min(count, most)).astype(int))


class LinkShapes:
    """The collision geometry of a robot's links in a current configuration; see `place`.

    Args:
        model: The robot.
        scene_graph: The geometry of the plant of its links, or None.

    Attributes:
        model: The robot.
    """

    def __init__(self, model: RobotModel, scene_graph: SceneGraph | None) -> None:
        self.model, self._body = model, dict[GeometryId, int]()
        plant = model.links.plant
        if scene_graph is None or plant is None or plant.get_source_id() is None:
            return
        self._plant, self._scene_graph = plant, scene_graph
        self._plant_context = plant.CreateDefaultContext()
        self._scene_context = scene_graph.CreateDefaultContext()
        self._bodies = [plant.get_body(BodyIndex(index)) for index in range(plant.num_bodies())]
        self._fixed = {int(body.index()) for body in plant.GetBodiesWeldedTo(plant.world_body())}
        self._body = {
            geometry: index
            for index, body in enumerate(self._bodies)
            for geometry in plant.GetCollisionGeometriesForBody(body)
        }

    def __bool__(self) -> bool:
        return bool(self._body)

    def place(self, state: FloatArray) -> None:
        """Moves the links to the configuration of a state."""
        poses = FramePoseVector()
        self._plant.SetPositions(self._plant_context, state[: self._plant.num_positions()])
        for body in self._bodies[1:]:
            frame = self._plant.GetBodyFrameIdIfExists(body.index())
            if frame is not None:
                poses.set_value(frame, self._plant.EvalBodyPoseInWorld(self._plant_context, body))
        port = self._scene_graph.get_source_pose_port(self._plant.get_source_id())
        port.FixValue(self._scene_context, poses)

    @property
    def count(self) -> int:
        """The number of links, including the world."""
        return len(self._bodies)

    @property
    def links(self) -> set[int]:
        """The links that have shapes and move."""
        return set(self._body.values()) - self._fixed

    def at_base(self) -> set[int]:
        """The links whose joints are fixed to the world."""
        return {
            int(joint.child_body().index())
            for joint in map(self._plant.get_joint, self._plant.GetJointIndices())
            if int(joint.parent_body().index()) in self._fixed and joint.num_positions() < 3
        }

    def overlaps(self) -> dict[tuple[int, int], float]:
        """Pair of overlapping links -> their overlap in the current configuration, in m.

        Drake excludes neighbours at a joint, and the pairs that the robot's file excludes.
        """
        overlaps: dict[tuple[int, int], float] = {}
        for contact in self._query().ComputePointPairPenetration():
            pair = self._pair(contact)
            if pair[0] >= 0:
                overlaps[pair] = max(overlaps.get(pair, 0.0), contact.depth)
        return overlaps

    def distances(self) -> dict[tuple[int, int], float]:
        """Pair of links -> their distance in the current configuration, in m; negative overlaps.

        Raises:
            RuntimeError: Drake has no distance between two of the shapes.
        """
        distances: dict[tuple[int, int], float] = {}
        for nearest in self._query().ComputeSignedDistancePairwiseClosestPoints():
            pair = self._pair(nearest)
            if pair[0] >= 0 and pair[0] != pair[1]:
                distances[pair] = min(distances.get(pair, np.inf), nearest.distance)
        return distances

    def _query(self) -> Any:
        return self._scene_graph.get_query_output_port().Eval(self._scene_context)

    def _pair(self, result: Any) -> tuple[int, int]:
        """The links of a result of Drake, the lower index first; -1 for other geometry."""
        first, second = (self._body.get(geometry, -1) for geometry in (result.id_A, result.id_B))
        return min(first, second), max(first, second)

    def corners(self) -> Iterator[tuple[int, FloatArray, float]]:
        """For each shape of a moving link: the link, points of the shape, and a radius in m.

        The shape lies within this radius of the convex hull of the points, which are in the world,
        shape (k, 3).
        """
        inspector = self._scene_graph.model_inspector()
        for geometry, index in self._body.items():
            points, radius = _corners(inspector.GetShape(geometry))
            body = self._plant.EvalBodyPoseInWorld(self._plant_context, self._bodies[index])
            pose = body @ inspector.GetPoseInFrame(geometry)
            if len(points) and index not in self._fixed:
                yield index, pose.multiply(points.T).T, radius

    def held(self) -> set[tuple[int, int]]:
        """The pairs of links that constraints bring together, and all links that move with them."""
        held: set[tuple[int, int]] = set()
        for constraint in self.model.constraints:
            for application in constraint.applications(self.model.links.kinematics()):
                frames = application.frame_a, application.frame_b
                held |= {(min(pair), max(pair)) for pair in product(*map(self.moved_with, frames))}
        return held

    def name(self, index: int) -> str:
        """The name of a link."""
        return str(self._bodies[index].name())

    def moved_with(self, frame: str) -> set[int]:
        """A frame's link, and all links that its joint moves."""
        body = int(frame_named(self._plant, frame).body().index())
        joints = self.joints_below(body)
        moved = self._plant.GetBodiesKinematicallyAffectedBy(joints[:1]) if joints else []
        return {body, *map(int, moved)}

    def joints_below(self, index: int) -> list[JointIndex]:
        """The moving joints between a link and the world, that of the link first."""
        joints = map(self._plant.get_joint, self._plant.GetJointIndices())
        inboard = {int(joint.child_body().index()): joint for joint in joints}
        below = []
        while index in inboard:
            if inboard[index].num_positions():
                below.append(inboard[index].index())
            index = int(inboard[index].parent_body().index())
        return below

    def may_overlap(self, pair: tuple[int, int]) -> float:
        """The overlap of two links, in m, that may be due to coarse shapes."""
        first, second = map(self.joints_below, pair)
        return COARSE if len({*first} ^ {*second}) < 3 else TOUCHING


def collisions(shapes: LinkShapes, times: FloatArray, states: FloatArray) -> tuple[Collision, ...]:
    """Links that collide with each other along a motion, the deepest first.

    Shapes that overlap along the whole motion and in the default configuration do not count: they
    overlap in the robot's file. Links that a constraint brings together, such as a hand and the
    object that it holds, do not count either.

    Args:
        shapes: The shapes of the links.
        times: The times of the motion in s, shape (k,).
        states: x at these times, shape (k, n).
    """
    if not shapes:
        return ()
    chosen, overlaps = sampled(len(times)), dict[tuple[int, int], FloatArray]()
    for row, index in enumerate(chosen):
        shapes.place(states[index])
        for pair, depth in shapes.overlaps().items():
            overlaps.setdefault(pair, np.zeros(len(chosen)))[row] = depth
    if not overlaps:
        return ()
    shapes.place(shapes.model.links.default_positions)
    usual, held = shapes.overlaps(), shapes.held()
    collided = []
    for pair, depths in overlaps.items():
        deep = depths > shapes.may_overlap(pair)
        if not deep.any() or (pair in usual and deep.all()) or pair in held:
            continue
        at = chosen[[int(np.argmax(depths)), int(np.argmax(deep))]]
        first, second = map(shapes.name, pair)
        deepest, since = map(float, times[at])
        collided.append(Collision(first, second, float(depths.max()), deepest, since))
    return tuple(sorted(collided, key=lambda collision: -collision.depth))


def nearest_links(
    shapes: LinkShapes, times: FloatArray, states: FloatArray
) -> LeastDistance | None:
    """The two links that come closest to each other along a motion; None if there are none.

    Pairs with fewer than three joints between them, and those that a constraint brings together,
    are close by design and do not count. None also if Drake has no distance between the shapes.

    Args:
        shapes: The shapes of the links.
        times: The times of the motion in s, shape (k,).
        states: x at these times, shape (k, n).
    """
    nearest: LeastDistance | None = None
    if not shapes:
        return None
    skipped = shapes.held()
    for index in sampled(len(times)):
        shapes.place(states[index])
        try:
            distances = shapes.distances()
        except RuntimeError:
            return None
        for pair, distance in distances.items():
            if pair in skipped or shapes.may_overlap(pair) == COARSE:
                continue
            if nearest is None or distance < nearest.distance:
                first, second = map(shapes.name, pair)
                time = float(times[index])
                nearest = LeastDistance(first, second, False, False, distance, time)
    return nearest


def _corners(shape: object) -> tuple[FloatArray, float]:
    """Points of a shape, and its radius around these; no points for unbounded shapes."""
    corners = np.array(np.meshgrid(*[[-1.0, 0.0, 1.0]] * 3)).reshape(3, -1).T
    match shape:
        case Sphere():
            return np.zeros((1, 3)), shape.radius()
        case Capsule():
            along = np.linspace(-0.5, 0.5, 9)[:, None] * shape.length()
            return along * [[0.0, 0.0, 1.0]], shape.radius()
        case Cylinder():
            ring = shape.radius() * np.column_stack([np.cos(_RING), np.sin(_RING)])
            ends = np.linspace(-0.5, 0.5, 3) * shape.length()
            return np.vstack([np.column_stack([ring, np.full(8, end)]) for end in ends]), 0.0
        case Box():
            return corners * shape.size() / 2.0, 0.0
        case Ellipsoid():
            directions = corners[np.any(corners, axis=1)]
            directions /= np.linalg.norm(directions, axis=1, keepdims=True)
            return directions * [shape.a(), shape.b(), shape.c()], 0.0
        case Mesh() | Convex():
            hull = shape.GetConvexHull()
            vertices = np.array([hull.vertex(index) for index in range(hull.num_vertices())])
            return vertices[sampled(len(vertices), MOST_CORNERS)], 0.0
    return np.zeros((0, 3)), 0.0
