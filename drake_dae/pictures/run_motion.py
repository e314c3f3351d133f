"""The actual and desired motion of a robot in a run, frame by frame."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Protocol, runtime_checkable

import numpy as np
from pydrake.geometry import SceneGraph
from pydrake.systems.framework import Context

from drake_dae.arrays import FloatArray
from drake_dae.blocks.traced_system import context_in
from drake_dae.diagrams.record import Record
from drake_dae.errors import InconsistentStateError
from drake_dae.robots import ConstraintWrenches, RobotModel, Wrenches, own_values, tangents
from drake_dae.scene.framing import ViewAngles, direction_of, framed
from drake_dae.scene.surroundings import scene_points
from drake_dae.scene.view import FRAME_RATE
from drake_dae.systems.plants.contract import Plant

STILL = 1e-4
"""A path on a surface is omitted if its extent is below this fraction of the largest coordinate of
all contact points."""

_EXTENT_STATES = 60
"""The approximate number of states from which the extent of a run is computed."""


@runtime_checkable
class ShownLoop(Protocol):
    """A diagram with a plant and its geometry, such as a `ClosedLoop`."""

    @property
    def plant(self) -> Plant:
        """The simulated plant."""

    @property
    def scene_graph(self) -> SceneGraph | None:
        """The geometry of the robot's links, or None."""


@dataclass(frozen=True, eq=False)
class RunMotion:
    """The motion of a robot in a run, at the times of k frames.

    Attributes:
        plant: The simulated plant.
        model: The robot.
        times: The times of the frames, in s after the start, shape (k,).
        start_time: The time at which the run starts, in s.
        states: x, shape (k, n).
        parameters: The values of all parameters, shape (k, number of parameters).
        wrenches: The constraint wrenches in each frame.
        desired: Link states at rest (q, 0) with the desired outputs, until these are out of reach,
            shape (j, nq + nv) with j <= k.
        acting: The function of the constraint wrenches, for the parameters at the start.
        friction: Name of a constraint -> its coefficient of friction in the plant.
    """

    plant: Plant
    model: RobotModel
    times: FloatArray
    start_time: float
    states: FloatArray
    parameters: FloatArray
    wrenches: Sequence[Wrenches]
    desired: FloatArray
    acting: ConstraintWrenches
    friction: Mapping[str, float]

    @property
    def points(self) -> FloatArray:
        """The points of application, m, shape (k, constraints, 3)."""
        return np.array([wrench.points for wrench in self.wrenches])

    @property
    def desired_points(self) -> FloatArray:
        """The points of application for the desired outputs, m, shape (j, constraints, 3)."""
        no_force = np.zeros(len(self.model.dae.force_signals))
        pairs = zip(self.desired, self.parameters, strict=False)
        points = [self.acting(state, no_force, parameters).points for state, parameters in pairs]
        return np.array(points).reshape(len(points), len(self.acting.constraints), 3)

    def arrow_tails(self, length: float) -> FloatArray:
        """Returns the tails of the arrows of all forces, m, shape (k * constraints, 3).

        Args:
            length: The length of the longest arrow, in m.
        """
        forces = np.array([wrench.forces for wrench in self.wrenches])
        largest = np.max(np.linalg.norm(forces, axis=2), initial=1e-6)
        return (self.points - length * forces / largest).reshape(-1, 3)

    @property
    def normals(self) -> FloatArray:
        """The normals of the surfaces in the world, not of unit length, (k, constraints, 3).

        They are computed as the forces at rest: without friction a force is along the normal.
        """
        model, links = self.model, self.model.links
        unit_forces = [np.array(item.is_unilateral, float) for item in model.constraints]
        force = np.concatenate([np.zeros(0), *unit_forces])
        nq, nv = links.q.numel(), links.v.numel()
        at_rest = np.pad(self.states[:, :nq], ((0, 0), (0, nv)))
        pairs = zip(at_rest, self.parameters, strict=True)
        return np.array([self.acting(state, force, values).forces for state, values in pairs])


@dataclass(frozen=True, eq=False)
class ContactPath:
    """The path of a contact point on a surface, in the plane normal to the surface's mean normal.

    Attributes:
        name: The constraint's name.
        actual: The path along two axes of the surface, m, shape (k, 2).
        desired: The desired path, m, shape (j, 2).
        points_left: Whether an observer on the free side who sees the second axis upward sees the
            first axis to the left.
    """

    name: str
    actual: FloatArray
    desired: FloatArray
    points_left: bool = False


def follow(
    loop: ShownLoop, record: Record, context: Context, rate: float = FRAME_RATE
) -> RunMotion:
    """Returns the motion of a robot in a recorded run.

    Args:
        loop: A loop of a `RobotPlant`.
        record: The record of a run of this loop.
        context: The context of its diagram, which contains the parameters; not changed.
        rate: Frames per second.

    Raises:
        ModelError: The plant is not a robot.
    """
    plant, plant_context = loop.plant, context_in(loop.plant, context)
    model = plant.robot("a picture of a run")
    parameters = plant.parameters(plant_context)
    acting = ConstraintWrenches(model, parameters)
    times = frame_times(record.time[-1] - record.time[0], rate)
    states = _interpolated(record, "state", times)
    forces = _interpolated(record, "constraint_force", times)
    desired = _interpolated(record, "desired_output", times)
    values = np.tile(parameters, (len(times), 1))
    if "exogenous" in record.signals:
        values[:, plant.exogenous_places] = _interpolated(record, "exogenous", times)
    wrenches = [acting(*row) for row in zip(states, forces, values, strict=True)]
    if "contact_force" in record.signals:  # This has the plant's friction, not that of the law.
        shape = (len(times), len(acting.constraints), 3)
        contact_forces = _interpolated(record, "contact_force", times).reshape(shape)
        wrenches = [
            replace(wrench, forces=force)
            for wrench, force in zip(wrenches, contact_forces, strict=True)
        ]
    return RunMotion(
        plant,
        model,
        times,
        float(record.time[0]),
        states,
        values,
        wrenches,
        _desired_states(model, states, desired, values),
        acting,
        plant.friction(plant_context),
    )


def frame_times(duration: float, rate: float = FRAME_RATE) -> FloatArray:
    """Returns the times of frames, in s after the start; the last is at the end or just after."""
    return np.arange(int(np.ceil(duration * rate - 1e-9)) + 1) / rate


def contact_paths(course: RunMotion) -> list[ContactPath]:
    """Returns the paths of moving contact points on their surfaces.

    The points are relative to the surface's reference point, and projected along the surface's mean
    normal. On a plane these are the plane's coordinates; on a curved surface those of a tangent
    plane.
    """
    dae = course.model.dae
    size = float(np.max(np.abs(course.points), initial=0.0))
    world_normals, desired_points = course.normals, course.desired_points
    paths = []
    for row, constraint in enumerate(course.acting.constraints):
        if not any(constraint.is_unilateral):
            continue
        poses = [constraint.placement(own_values(constraint, dae, p)) for p in course.parameters]
        actual, desired = (
            np.array([pose.inverse() @ p for pose, p in zip(poses, points, strict=False)])
            for points in (course.points[:, row], desired_points[:, row])
        )
        desired = desired.reshape(-1, 3)
        if np.max(np.ptp(np.vstack([actual, desired]), axis=0)) <= STILL * size:
            continue
        normals = [
            pose.rotation().inverse() @ normal
            for pose, normal in zip(poses, world_normals[:, row], strict=True)
        ]
        # The normals of a path all around a surface have the mean 0; then the first is used.
        normal = next(n for n in (np.mean(normals, axis=0), normals[0]) if np.linalg.norm(n) > 1e-3)
        axes = np.column_stack(tangents(normal / np.linalg.norm(normal)))
        points_left = bool(np.cross(axes[:, 0], axes[:, 1]) @ normal < 0.0)
        paths.append(ContactPath(constraint.name, actual @ axes, desired @ axes, points_left))
    return paths


def run_points(course: RunMotion, scene_graph: SceneGraph | None) -> FloatArray:
    """Returns points that enclose the robot and its paths over the run, m, shape (k, 3).

    Args:
        course: The motion of the robot.
        scene_graph: The geometry of its links, or None.
    """
    states = course.states[:: max(1, len(course.states) // _EXTENT_STATES)]
    paths = [course.points.reshape(-1, 3), course.desired_points.reshape(-1, 3)]
    return np.vstack([scene_points(course.model, course.acting, states, scene_graph), *paths])


def run_view(
    course: RunMotion, scene_graph: SceneGraph | None, view: ViewAngles, arrow: float
) -> tuple[FloatArray, FloatArray]:
    """Returns the position of a camera that shows a whole run, and a point on its axis, m.

    Args:
        course: The motion of the robot.
        scene_graph: The geometry of its links, or None.
        view: The angles of view of the camera.
        arrow: The length of the longest arrow of a force, in m.
    """
    points = np.vstack([run_points(course, scene_graph), course.arrow_tails(arrow)])
    frame = len(course.times) // 2
    robot = scene_points(course.model, course.acting, course.states[frame][None], scene_graph)
    normals = course.normals[frame]
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    normals = normals / np.where(lengths > 0.0, lengths, 1.0)
    return framed(points, direction_of(robot, course.points[frame], normals), view)


def _interpolated(record: Record, name: str, times: FloatArray) -> FloatArray:
    """Returns a signal at times after the start, interpolated linearly, shape (k, size)."""
    recorded = record.time - record.time[0]
    columns = [np.interp(times, recorded, column) for column in record[name].T]
    return np.array(columns).reshape(-1, len(times)).T


def _desired_states(
    model: RobotModel, states: FloatArray, desired: FloatArray, values: FloatArray
) -> FloatArray:
    """Returns link states at rest (q, 0) with the desired outputs, until these are out of reach.

    Args:
        model: The robot.
        states, desired, values: x, the desired outputs and the parameters, one row for each frame.
    """
    nq, nv = model.links.q.numel(), model.links.v.numel()
    q, desired_states = states[0, :nq], []
    # With rolling constraints the outputs do not determine q, so that each initial guess follows
    # the actual motion.
    steps = np.diff(states[:, :nq], axis=0, prepend=states[:1, :nq])
    try:
        positions = desired[:, : len(model.position_signals)]
        for position, parameters, step in zip(positions, values, steps, strict=True):
            q = model.configuration(position, q + step, parameters)
            desired_states.append(np.concatenate([q, np.zeros(nv)]))
    except InconsistentStateError:
        pass  # The desired path ends where it is out of reach.
    return np.array(desired_states).reshape(-1, nq + nv)
