"""The actual and desired motion of a robot in a run, frame by frame."""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np
from pydrake.geometry import SceneGraph
from pydrake.systems.framework import Context

from drake_dae.arrays import FloatArray
from drake_dae.blocks.traced_system import context_in
from drake_dae.diagrams.closed_loop import ClosedLoop
from drake_dae.diagrams.record import Record
from drake_dae.errors import InconsistentStateError
from drake_dae.robots import ConstraintWrenches, RobotModel, Wrenches, own_values, tangents
from drake_dae.scene.surroundings import direction_of, framed, scene_points
from drake_dae.scene.view import FRAME_RATE

# A path on a surface is omitted if its extent is below this fraction of the largest coordinate of
# all contact points.
_STILL = 1e-4


@dataclass(frozen=True, eq=False)
class RunMotion:
    """The motion of a robot in a run, at k frames, whose times in s begin at 0."""

    model: RobotModel
    times: FloatArray
    start_time: float
    states: FloatArray  # (k, n)
    parameters: FloatArray  # all, a row for each frame
    wrenches: Sequence[Wrenches]
    desired: (
        FloatArray  # link states at rest with the desired outputs, until these are out of reach
    )
    acting: ConstraintWrenches

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

    @property
    def normals(self) -> FloatArray:
        """Unit normals of surfaces, zero without one, (k, constraints, 3)."""
        pairs = zip(self.states, self.parameters, strict=True)
        return np.array([surface_normals(self.model, self.acting, *pair) for pair in pairs])


def surface_normals(
    model: RobotModel, acting: ConstraintWrenches, state: FloatArray, parameters: FloatArray
) -> FloatArray:
    """Unit normals of surfaces at a state, zero without one, (constraints, 3): forces at rest."""
    nq, nv = model.links.q.numel(), model.links.v.numel()
    force = np.array([one for c in model.constraints for one in c.is_unilateral], float)
    normals = acting(np.pad(state[:nq], (0, nv)), force, parameters).forces
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    return np.divide(normals, lengths, out=np.zeros_like(normals), where=lengths > 0.0)


@dataclass(frozen=True, eq=False)
class ContactPath:
    """The path of a contact point on a surface, in the plane across the surface's mean normal."""

    name: str
    actual: FloatArray  # m, (k, 2)
    desired: FloatArray  # m, (j, 2)
    points_left: bool = (
        False  # Whether the first axis does, with the second up, from the free side.
    )


def follow(
    loop: ClosedLoop, record: Record, context: Context, rate: float = FRAME_RATE
) -> RunMotion:
    """The motion of a robot in a recorded run, frame by frame; the context has the parameters."""
    plant = loop.plant
    model = plant.robot("a picture of a run")
    parameters = plant.parameters(context_in(plant, context))
    acting = ConstraintWrenches(model, parameters)
    recorded = record.time - record.time[0]
    times = frame_times(recorded[-1], rate)

    def at_frames(name: str) -> FloatArray:
        columns = [np.interp(times, recorded, column) for column in record[name].T]
        return np.array(columns).reshape(-1, len(times)).T

    states, values = at_frames("state"), np.tile(parameters, (len(times), 1))
    if "exogenous" in record.signals:
        values[:, plant.exogenous_places] = at_frames("exogenous")
    rows = zip(states, at_frames("constraint_force"), values, strict=True)
    wrenches = [acting(*row) for row in rows]
    if "contact_force" in record.signals:  # This has the plant's friction, not that of the law.
        forces = at_frames("contact_force").reshape(len(times), -1, 3)
        wrenches = [replace(w, forces=force) for w, force in zip(wrenches, forces, strict=True)]
    # Link states with the desired outputs. With rolling constraints these do not determine q, so
    # that each initial guess follows the actual motion.
    nq, nv, desired = model.links.q.numel(), model.links.v.numel(), list[FloatArray]()
    q, steps = states[0, :nq], np.diff(states[:, :nq], axis=0, prepend=states[:1, :nq])
    wanted = at_frames("desired_output")[:, : len(model.position_signals)]
    with suppress(InconsistentStateError):  # The desired path ends where it is out of reach.
        for position, own, step in zip(wanted, values, steps, strict=True):
            q = model.configuration(position, q + step, own)
            desired.append(np.concatenate([q, np.zeros(nv)]))
    at_rest, start = np.array(desired).reshape(-1, nq + nv), float(record.time[0])
    return RunMotion(model, times, start, states, values, wrenches, at_rest, acting)


def frame_times(duration: float, rate: float = FRAME_RATE) -> FloatArray:
    """The times of frames, in s after the start; the last is at the end or just after."""
    return np.arange(int(np.ceil(duration * rate - 1e-9)) + 1) / rate


def contact_paths(motion: RunMotion) -> list[ContactPath]:
    """The paths of moving contact points on surfaces; on a curved one in a tangent plane."""
    size = float(np.max(np.abs(motion.points), initial=0.0))
    normals, desired_points, paths = motion.normals, motion.desired_points, []
    for row, constraint in enumerate(motion.acting.constraints):
        if not any(constraint.is_unilateral):
            continue
        values = [own_values(constraint, motion.model.dae, p) for p in motion.parameters]
        poses = [constraint.placement(own) for own in values]
        actual, desired = (
            np.array([pose.inverse() @ p for pose, p in zip(poses, points, strict=False)])
            for points in (motion.points[:, row], desired_points[:, row])
        )
        desired = desired.reshape(-1, 3)
        if np.max(np.ptp(np.vstack([actual, desired]), axis=0)) <= _STILL * size:
            continue
        turns = [pose.rotation().inverse() for pose in poses]
        own = np.array([turn @ n for turn, n in zip(turns, normals[:, row], strict=True)])
        # The normals of a path all around a surface have the mean 0; then the first is used.
        mean = own.mean(axis=0)
        normal = mean / np.linalg.norm(mean) if np.linalg.norm(mean) > 1e-3 else own[0]
        axes = np.column_stack(tangents(normal))
        points_left = bool(np.cross(axes[:, 0], axes[:, 1]) @ normal < 0.0)
        paths.append(ContactPath(constraint.name, actual @ axes, desired @ axes, points_left))
    return paths


def run_points(motion: RunMotion, scene_graph: SceneGraph | None) -> FloatArray:
    """Points that enclose the robot and its paths over the run, m, shape (k, 3)."""
    states = motion.states[:: max(1, len(motion.states) // 60)]  # They are enough.
    paths = [motion.points.reshape(-1, 3), motion.desired_points.reshape(-1, 3)]
    return np.vstack([scene_points(motion.model, motion.acting, states, scene_graph), *paths])


def run_view(
    motion: RunMotion,
    scene_graph: SceneGraph | None,
    view: tuple[float, float, float],
    arrow: float,
) -> tuple[FloatArray, FloatArray]:
    """A camera that shows a whole run, and a point on its axis, m; `arrow` is the longest one."""
    forces = np.array([wrench.forces for wrench in motion.wrenches])
    largest = np.max(np.linalg.norm(forces, axis=2), initial=1e-6)
    tails = (motion.points - arrow * forces / largest).reshape(-1, 3)
    middle = len(motion.times) // 2
    now = motion.states[middle][None]
    robot = scene_points(motion.model, motion.acting, now, scene_graph)
    direction = direction_of(robot, motion.points[middle], motion.normals[middle])
    return framed(np.vstack([run_points(motion, scene_graph), tails]), direction, view)
