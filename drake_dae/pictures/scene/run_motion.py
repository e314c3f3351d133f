"""The actual and desired motion of a robot in a run, frame by frame."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from pydrake.geometry import SceneGraph
from pydrake.systems.framework import Context

from drake_dae.arrays import FloatArray
from drake_dae.errors import InconsistentStateError
from drake_dae.pictures.scene.framing import ViewAngles, direction_of, framed
from drake_dae.pictures.scene.surroundings import scene_points
from drake_dae.pictures.scene.view import FRAME_RATE
from drake_dae.robots.constraint_wrenches import ConstraintWrenches, Wrenches, own_values
from drake_dae.robots.model import RobotModel
from drake_dae.robots.surfaces.surface import tangents
from drake_dae.simulation.records.events import flashes
from drake_dae.simulation.records.record import Record
from drake_dae.systems.plants.contract import Plant

STILL = 1e-4
"""A contact point whose path is shorter than this fraction of its distance has no path to draw."""

_PLACES = 60
"""The number of states for the extent of a run."""


class ShownLoop(Protocol):
    """A diagram with a plant and its geometry, as a `ClosedLoop`."""

    @property
    def plant(self) -> Plant:
        """What was simulated."""

    @property
    def scene_graph(self) -> SceneGraph | None:
        """The geometry of a robot, or None."""


@dataclass(frozen=True, eq=False)
class RunMotion:
    """A run of a robot at k equidistant times.

    Attributes:
        plant: What was simulated.
        model: The robot.
        times: The moments in s after the start, shape (k,).
        start_time: When the run began, in s.
        states: x, shape (k, n).
        parameters: The values of all parameters, shape (k, number of parameters).
        wrenches: The wrenches of the constraints.
        wanted: Link states at rest with the desired outputs, as long as they are reachable, shape
            (j, nq + nv) with j <= k.
        acting: The constraint wrenches, for the parameters at the start.
        flashes: The brightness of each constraint's flash at an impact, 0 to 1, shape (k,
            constraints).
        friction: Name of a constraint -> its coefficient of friction in the plant.
    """

    plant: Plant
    model: RobotModel
    times: FloatArray
    start_time: float
    states: FloatArray
    parameters: FloatArray
    wrenches: Sequence[Wrenches]
    wanted: FloatArray
    acting: ConstraintWrenches
    flashes: FloatArray
    friction: Mapping[str, float]

    @property
    def points(self) -> FloatArray:
        """The points of application, m, shape (k, constraints, 3)."""
        return np.array([wrench.points for wrench in self.wrenches])

    @property
    def wanted_points(self) -> FloatArray:
        """The points of application for the desired outputs, m, shape (j, constraints, 3)."""
        none = np.zeros(len(self.model.dae.force_signals))
        pairs = zip(self.wanted, self.parameters, strict=False)
        found = [self.acting(state, none, own).points for state, own in pairs]
        return np.array(found).reshape(len(found), len(self.acting.constraints), 3)

    def arrow_tails(self, length: float) -> FloatArray:
        """Where arrows of the forces begin, m, shape (k times constraints, 3).

        Args:
            length: The length of the longest one, in m.
        """
        forces = np.array([wrench.forces for wrench in self.wrenches])
        largest = np.max(np.linalg.norm(forces, axis=2), initial=1e-6)
        return (self.points - length * forces / largest).reshape(-1, 3)

    @property
    def normals(self) -> FloatArray:
        """The normals of the surfaces, of any length, in the world, shape (k, constraints, 3).

        At rest there is no friction, so that a force is along the normal.
        """
        model, links = self.model, self.model.links
        ones = [np.array(constraint.is_unilateral, float) for constraint in model.constraints]
        push = np.concatenate([np.zeros(0), *ones])
        nq, nv = links.q.numel(), links.v.numel()
        rest = np.pad(self.states[:, :nq], ((0, 0), (0, nv)))
        pairs = zip(rest, self.parameters, strict=True)
        return np.array([self.acting(state, push, own).forces for state, own in pairs])


@dataclass(frozen=True, eq=False)
class ContactPath:
    """The path of a point on a surface, as seen along the (mean) normal.

    Attributes:
        name: The constraint's name.
        actual: The path along two axes of the surface, m, shape (k, 2).
        desired: The desired path, m, shape (j, 2).
        points_left: Whether the first axis points to the left for an observer on the free side,
            with the second axis up.
    """

    name: str
    actual: FloatArray
    desired: FloatArray
    points_left: bool = False


def follow(
    loop: ShownLoop, record: Record, context: Context, rate: float = FRAME_RATE
) -> RunMotion:
    """The course of a run of a robot.

    Args:
        loop: A loop of a `RobotPlant`.
        record: The record of a run of this loop.
        context: The context of its diagram, for the parameters; not changed.
        rate: Moments per second.

    Raises:
        ModelError: There is no robot.
    """
    plant, own_context = loop.plant, loop.plant.GetMyContextFromRoot(context)
    model = plant.robot("a picture of a run")
    parameters = plant.parameters(own_context)
    acting = ConstraintWrenches(model, parameters)
    times = frame_times(record.time[-1] - record.time[0], rate)
    states = _interpolated(record, "state", times)
    forces = _interpolated(record, "constraint_force", times)
    desired = _interpolated(record, "desired_output", times)
    values = np.tile(parameters, (len(times), 1))
    if "exogenous" in record.signals:
        values[:, plant.exogenous_places] = _interpolated(record, "exogenous", times)
    wrenches = [acting(*row) for row in zip(states, forces, values, strict=True)]
    if "contact_force" in record.signals:  # With the friction of the plant, not the law's.
        shape = (len(times), len(acting.constraints), 3)
        whole = _interpolated(record, "contact_force", times).reshape(shape)
        wrenches = [replace(one, forces=own) for one, own in zip(wrenches, whole, strict=True)]
    wanted = _desired_states(model, states, desired, values)
    begin, names = float(record.time[0]), [constraint.name for constraint in acting.constraints]
    bright = flashes(record.events, names, begin + times)
    friction = plant.friction(own_context)
    return RunMotion(
        plant, model, times, begin, states, values, wrenches, wanted, acting, bright, friction
    )


def frame_times(duration: float, rate: float = FRAME_RATE) -> FloatArray:
    """The moments to show, in s after the start; the last one is the end or the next after it."""
    return np.arange(int(np.ceil(duration * rate - 1e-9)) + 1) / rate


def contact_paths(course: RunMotion) -> list[ContactPath]:
    """The paths of moving contact points, each on its surface.

    They are projected along the surface's mean normal: for a plane its own coordinates, for a
    curved surface those of a tangent plane, relative to its reference point.
    """
    dae = course.model.dae
    size = float(np.max(np.abs(course.points), initial=0.0))
    pushes = course.normals
    found = []
    for row, constraint in enumerate(course.acting.constraints):
        if not any(constraint.is_unilateral):
            continue
        stands = [constraint.placement(own_values(constraint, dae, p)) for p in course.parameters]
        actual, desired = (
            np.array([stand.inverse() @ p for stand, p in zip(stands, points, strict=False)])
            for points in (course.points[:, row], course.wanted_points[:, row])
        )
        way = np.vstack([actual, desired.reshape(-1, 3)])
        if np.max(np.ptp(way, axis=0)) <= STILL * size:
            continue
        normals = [
            stand.rotation().inverse() @ push
            for stand, push in zip(stands, pushes[:, row], strict=True)
        ]
        # A path all around the surface has no mean normal.
        normal = next(n for n in (np.mean(normals, axis=0), normals[0]) if np.linalg.norm(n) > 1e-3)
        axes = np.column_stack(tangents(normal / np.linalg.norm(normal)))
        points_left = bool(np.cross(axes[:, 0], axes[:, 1]) @ normal < 0.0)
        found.append(
            ContactPath(constraint.name, actual @ axes, desired.reshape(-1, 3) @ axes, points_left)
        )
    return found


def run_points(course: RunMotion, scene_graph: SceneGraph | None) -> FloatArray:
    """Points that enclose the robot and its paths over the run, m, shape (k, 3).

    Args:
        course: The motion of the robot.
        scene_graph: The geometry of its links, or None.
    """
    some = course.states[:: max(1, len(course.states) // _PLACES)]
    paths = [course.points.reshape(-1, 3), course.wanted_points.reshape(-1, 3)]
    return np.vstack([scene_points(course.model, course.acting, some, scene_graph), *paths])


def run_view(
    course: RunMotion, scene_graph: SceneGraph | None, view: ViewAngles, arrow: float
) -> tuple[FloatArray, FloatArray]:
    """The eye of a camera that shows a whole run, and the point that it looks at, m.

    Args:
        course: The motion of the robot.
        scene_graph: The geometry of its links, or None.
        view: What the camera shows.
        arrow: The length of the longest arrow of a force, in m.
    """
    seen = run_points(course, scene_graph)
    middle = len(course.times) // 2
    now = scene_points(course.model, course.acting, course.states[middle][None], scene_graph)
    normals = course.normals[middle]
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    normals = normals / np.where(lengths > 0.0, lengths, 1.0)
    direction = direction_of(now, course.points[middle], normals)
    return framed(np.vstack([seen, course.arrow_tails(arrow)]), direction, view)


def _interpolated(record: Record, name: str, times: FloatArray) -> FloatArray:
    """A signal at times after the start, shape (k, size): straight lines between the steps."""
    moments = record.time - record.time[0]
    rows = [np.interp(times, moments, column) for column in record[name].T]
    return np.array(rows).reshape(-1, len(times)).T


def _desired_states(
    model: RobotModel, states: FloatArray, desired: FloatArray, values: FloatArray
) -> FloatArray:
    """Link states at rest with the desired outputs, as long as they are within reach.

    Args:
        model: The robot.
        states, desired, values: x, z and the parameters at each moment, one row each.
    """
    nq, nv = model.links.q.numel(), model.links.v.numel()
    q, found = states[0, :nq], []
    # With rolling constraints the configuration is not determined; the actual one is used.
    moves = np.diff(states[:, :nq], axis=0, prepend=states[:1, :nq])
    try:
        wanted = desired[:, : len(model.position_signals)]
        for row, own, move in zip(wanted, values, moves, strict=True):
            q = model.configuration(row, q + move, own)
            found.append(np.concatenate([q, np.zeros(nv)]))
    except InconsistentStateError:
        pass  # The reference becomes unreachable: its path ends there.
    return np.array(found).reshape(-1, nq + nv)
