"""The collision geometry of links, where a robot's file has any: which of them overlap."""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import product

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

ROWS = 60
"""So many states of a motion are looked at, at most: within a link's width, as a rule."""

TOUCHING = 1e-3
"""Shapes that overlap by less than this, in m, touch."""

COARSE = 0.02
"""So much, in m, shapes may overlap with one link between them: those of vendors do in use."""

MOST_CORNERS = 200
"""So many corners of a mesh are looked at, at most."""

_RING = 2.0 * np.pi * np.arange(8) / 8


@dataclass(frozen=True)
class Collision:
    """Two links whose shapes overlap.

    Attributes:
        first, second: Their names; "world" for what stands still.
        depth: By how much, at most, in m.
        time: When, in s.
        since: When they first do, in s.
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
    """How near something of a robot comes to something else along a motion.

    Attributes:
        first, second: The names of two links, or of a link and of the constraint of a surface.
        is_surface: Whether `second` is that of a surface.
        of_origin: Whether the link is its origin, since links have no shapes.
        distance: The distance in m; below 0 if they overlap.
        time: When, in s.
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


def moments(count: int, most: int = ROWS) -> np.ndarray:
    """Which of so many states are looked at, evenly."""
    return np.unique(np.linspace(0, count - 1, min(count, most)).astype(int))


class LinkShapes:
    """The collision geometry of a robot's links, at one configuration after the other.

    Args:
        model: The robot.
        scene_graph: The geometry of the plant that its links come from, or None.

    Attributes:
        model: The robot.
    """

    def __init__(self, model: RobotModel, scene_graph: SceneGraph | None) -> None:
        self.model, self._body = model, dict[GeometryId, int]()
        plant = model.links.plant
        if scene_graph is None or plant is None or plant.get_source_id() is None:
            return
        self._plant, self._scene_graph = plant, scene_graph
        self._of_plant = plant.CreateDefaultContext()
        self._of_scene = scene_graph.CreateDefaultContext()
        self._bodies = [plant.get_body(BodyIndex(index)) for index in range(plant.num_bodies())]
        still = plant.GetBodiesWeldedTo(plant.world_body())
        self._still = {int(body.index()) for body in still}
        self._body = {
            geometry: index
            for index, body in enumerate(self._bodies)
            for geometry in plant.GetCollisionGeometriesForBody(body)
        }

    def __bool__(self) -> bool:
        return bool(self._body)

    def place(self, state: FloatArray) -> None:
        """Moves the links to the configuration that a state begins with."""
        poses = FramePoseVector()
        self._plant.SetPositions(self._of_plant, state[: self._plant.num_positions()])
        for body in self._bodies[1:]:
            frame = self._plant.GetBodyFrameIdIfExists(body.index())
            if frame is not None:
                poses.set_value(frame, self._plant.EvalBodyPoseInWorld(self._of_plant, body))
        port = self._scene_graph.get_source_pose_port(self._plant.get_source_id())
        port.FixValue(self._of_scene, poses)

    @property
    def count(self) -> int:
        """How many links there are, the world among them."""
        return len(self._bodies)

    @property
    def links(self) -> set[int]:
        """The links that have shapes and move."""
        return set(self._body.values()) - self._still

    def at_base(self) -> set[int]:
        """The links whose joints are on what stands still."""
        return {
            int(joint.child_body().index())
            for joint in map(self._plant.get_joint, self._plant.GetJointIndices())
            if int(joint.parent_body().index()) in self._still and joint.num_positions() < 3
        }

    def overlaps(self) -> dict[tuple[int, int], float]:
        """Pairs of links that overlap now -> by how much, in m.

        Drake leaves out neighbours at a joint, and what the robot's file says.
        """
        query = self._scene_graph.get_query_output_port().Eval(self._of_scene)
        found: dict[tuple[int, int], float] = {}
        for each in query.ComputePointPairPenetration():
            first, second = (self._body.get(one, -1) for one in (each.id_A, each.id_B))
            pair = min(first, second), max(first, second)
            if pair[0] >= 0:
                found[pair] = max(found.get(pair, 0.0), each.depth)
        return found

    def distances(self) -> dict[tuple[int, int], float]:
        """Pairs of links -> their distance now, in m, below 0 where they overlap.

        Raises:
            RuntimeError: Drake has no distance between two of the shapes.
        """
        query = self._scene_graph.get_query_output_port().Eval(self._of_scene)
        found: dict[tuple[int, int], float] = {}
        for each in query.ComputeSignedDistancePairwiseClosestPoints():
            first, second = (self._body.get(one, -1) for one in (each.id_A, each.id_B))
            pair = min(first, second), max(first, second)
            if pair[0] >= 0 and pair[0] != pair[1]:
                found[pair] = min(found.get(pair, np.inf), each.distance)
        return found

    def corners(self) -> Iterator[tuple[int, FloatArray, float]]:
        """Of each shape that moves its link, points, and how far it goes beyond these, in m.

        The points are where they are now in the world, shape (k, 3).
        """
        inspector = self._scene_graph.model_inspector()
        for geometry, index in self._body.items():
            points, radius = _corners(inspector.GetShape(geometry))
            body = self._plant.EvalBodyPoseInWorld(self._of_plant, self._bodies[index])
            pose = body @ inspector.GetPoseInFrame(geometry)
            if len(points) and index not in self._still:
                yield index, pose.multiply(points.T).T, radius

    def held(self) -> set[tuple[int, int]]:
        """Pairs of links that constraints bring together, with all that moves with them."""
        found: set[tuple[int, int]] = set()
        for constraint in self.model.constraints:
            for each in constraint.applications(self.model.links.kinematics()):
                pairs = product(self.moved_with(each.frame_a), self.moved_with(each.frame_b))
                found |= {(min(pair), max(pair)) for pair in pairs}
        return found

    def name(self, index: int) -> str:
        """The name of a link."""
        return str(self._bodies[index].name())

    def moved_with(self, frame: str) -> set[int]:
        """A frame's link, and those that the joint moves that it hangs on."""
        body = int(frame_named(self._plant, frame).body().index())
        joints = self.joints_below(body)
        moved = self._plant.GetBodiesKinematicallyAffectedBy(joints[:1]) if joints else []
        return {body, *map(int, moved)}

    def joints_below(self, index: int) -> list[JointIndex]:
        """The joints that move between a link and the world, its own one first."""
        joints = [self._plant.get_joint(each) for each in self._plant.GetJointIndices()]
        inboard = {int(joint.child_body().index()): joint for joint in joints}
        found = []
        while index in inboard:
            if inboard[index].num_positions():
                found.append(inboard[index].index())
            index = int(inboard[index].parent_body().index())
        return found

    def may_overlap(self, pair: tuple[int, int]) -> float:
        """By how much two links may overlap as their shapes are made, in m."""
        first, second = map(self.joints_below, pair)
        return COARSE if len({*first} ^ {*second}) < 3 else TOUCHING


def collisions(shapes: LinkShapes, times: FloatArray, states: FloatArray) -> tuple[Collision, ...]:
    """Links that collide with each other along a motion, the deepest first.

    Shapes that overlap all the time, and where the robot is by default, are how the file has them.
    What a constraint brings together, as a hand and what it holds, is meant to touch.

    Args:
        shapes: The shapes of the links.
        times: The times of the motion in s, shape (k,).
        states: x at these times, shape (k, n).
    """
    if not shapes:
        return ()
    chosen, found = moments(len(times)), dict[tuple[int, int], FloatArray]()
    for row, index in enumerate(chosen):
        shapes.place(states[index])
        for pair, depth in shapes.overlaps().items():
            found.setdefault(pair, np.zeros(len(chosen)))[row] = depth
    if not found:
        return ()
    shapes.place(shapes.model.links.default_positions)
    usual, held = shapes.overlaps(), shapes.held()
    collided = []
    for pair, depths in found.items():
        deep = depths > shapes.may_overlap(pair)
        if not deep.any() or (pair in usual and deep.all()) or pair in held:
            continue
        at = chosen[[int(np.argmax(depths)), int(np.argmax(deep))]]
        first, second = map(shapes.name, pair)
        deepest, since = map(float, times[at])
        collided.append(Collision(first, second, float(depths.max()), deepest, since))
    return tuple(sorted(collided, key=lambda one: -one.depth))


def nearest_links(
    shapes: LinkShapes, times: FloatArray, states: FloatArray
) -> LeastDistance | None:
    """The two links that come closest to each other along a motion.

    Pairs with fewer than three joints between them, and those that a constraint brings together,
    are close by design.

    Args:
        shapes: The shapes of the links.
        times: The times of the motion in s, shape (k,).
        states: x at these times, shape (k, n).

    Returns:
        None if no pair is left, or Drake has no distance between the shapes.
    """
    found: LeastDistance | None = None
    if not shapes:
        return None
    skipped = shapes.held()
    for index in moments(len(times)):
        shapes.place(states[index])
        try:
            now = shapes.distances()
        except RuntimeError:
            return None
        for pair, distance in now.items():
            if pair in skipped or shapes.may_overlap(pair) == COARSE:
                continue
            if found is None or distance < found.distance:
                first, second = map(shapes.name, pair)
                time = float(times[index])
                found = LeastDistance(first, second, False, False, distance, time)
    return found


def _corners(shape: object) -> tuple[FloatArray, float]:
    """Points of a shape, and how far it goes beyond these; none of a shape without an end."""
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
            places = np.array([hull.vertex(index) for index in range(hull.num_vertices())])
            return places[moments(len(places), MOST_CORNERS)], 0.0
    return np.zeros((0, 3)), 0.0
