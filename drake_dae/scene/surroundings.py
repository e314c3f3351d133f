"""The drawn surfaces that a robot touches, and the extent of a robot."""

from dataclasses import dataclass

import numpy as np
from pydrake.geometry import Box, SceneGraph, Shape
from pydrake.math import RigidTransform
from pydrake.multibody.tree import BodyIndex

from drake_dae.arrays import FloatArray
from drake_dae.robots import Constraint, ConstraintWrenches, PosedShape, RobotModel, own_values
from drake_dae.trace.functions import TracedFunction


@dataclass(frozen=True, eq=False)
class DrawnSurface:
    """The drawn surface of one or several constraints.

    Attributes:
        constraint: The first of these constraints.
        pose: The pose of the surface's frame in the world.
        picture: The shape, and its pose in the surface's frame.
    """

    constraint: Constraint
    pose: RigidTransform
    picture: PosedShape

    @property
    def level(self) -> float | None:
        """The height of a horizontal plane, m; None for any other surface."""
        pose, form = self.pose @ self.picture.pose, self.picture.form
        if not isinstance(form, Box) or pose.rotation().matrix()[2, 2] < 1.0 - 1e-6:
            return None
        return float(pose.translation()[2] + form.height() / 2.0)


def surroundings(
    model: RobotModel,
    acting: ConstraintWrenches,
    points: FloatArray,
    parameters: FloatArray,
    size: float,
) -> list[DrawnSurface]:
    """Returns the surfaces that a robot touches, each only once: two at one pose would flicker.

    An unbounded surface is drawn as a piece around the middle of its contact points, larger than
    their extent.

    Args:
        model: The robot.
        acting: Its constraint wrenches.
        points: The points of application in a run, m, shape (k, constraints, 3).
        parameters: The values of all parameters.
        size: The least size of the drawn piece of an unbounded surface, m.
    """

    def surface_of(row: int, contacts: FloatArray) -> DrawnSurface | None:
        constraint = acting.constraints[row]
        values = own_values(constraint, model.dae, parameters)
        low, high = contacts.min(axis=0), contacts.max(axis=0)
        nearest = np.argmin(np.linalg.norm(contacts - (low + high) / 2, axis=1))
        extent = max(size, 1.4 * float(np.linalg.norm(high - low)))
        picture = constraint.picture(values, contacts[nearest], extent)
        if picture is None:
            return None
        pose = constraint.placement(values)
        return DrawnSurface(constraint, pose, picture.moved(pose.inverse()))

    def moves(constraint: Constraint) -> bool:
        return any(parameter.exogenous for parameter in constraint.parameters)

    drawn: list[tuple[list[int], DrawnSurface]] = []
    for row, constraint in enumerate(acting.constraints):
        surface = surface_of(row, points[:, row])
        if surface is None:
            continue
        for i, (rows, other) in enumerate(drawn):
            if moves(constraint) or moves(other.constraint):
                continue
            contacts = points[:, [*rows, row]].reshape(-1, 3)
            first, second = surface_of(rows[0], contacts), surface_of(row, contacts)
            if first is not None and second is not None and _coincide(first, second):
                drawn[i] = ([*rows, row], first)
                break
        else:
            drawn.append(([row], surface))
    return [surface for _, surface in drawn]


def _coincide(first: DrawnSurface, second: DrawnSurface) -> bool:
    """Whether two surfaces have the same pose and shape."""
    poses = [surface.pose @ surface.picture.pose for surface in (first, second)]
    if not poses[0].IsNearlyEqualTo(poses[1], 1e-9):
        return False
    form, other = first.picture.form, second.picture.form
    if isinstance(form, Shape) or isinstance(other, Shape):
        return repr(form) == repr(other)
    first_corners, second_corners = (np.array(mesh.vertices()) for mesh in (form, other))
    return first_corners.shape == second_corners.shape and np.allclose(
        first_corners, second_corners, rtol=0.0, atol=1e-9
    )


def scene_extent(
    model: RobotModel,
    wrenches: ConstraintWrenches,
    state: FloatArray,
    scene_graph: SceneGraph | None = None,
) -> tuple[FloatArray, float]:
    """Returns the center and the diagonal, m, of the box around a robot and its contact points.

    Args:
        model: The robot.
        wrenches: Its constraint wrenches.
        state: x, or only its first part, the link state (q, v).
        scene_graph: The geometry of its links; None if only the links' origins count.
    """
    points = scene_points(model, wrenches, state[None], scene_graph)
    low, high = points.min(axis=0), points.max(axis=0)
    return (low + high) / 2, max(float(np.linalg.norm(high - low)), 1e-3)


def scene_points(
    model: RobotModel,
    wrenches: ConstraintWrenches,
    states: FloatArray,
    scene_graph: SceneGraph | None = None,
) -> FloatArray:
    """Returns points that enclose a robot and its contact points, m, shape (k, 3).

    Args:
        model: The robot.
        wrenches: Its constraint wrenches.
        states: x, or only its first part, the link state (q, v), one row for each time.
        scene_graph: The geometry of its links; None if only the links' origins count.
    """
    links, dae = model.links, model.dae
    inputs = {"q": links.q, "parameters": dae.parameter_symbol}
    # The world's origin is not a part of the robot.
    is_link = [name != "world" for name in links.landmark_names]
    origins = links.landmarks()
    if any(is_link):
        origins = origins[:, np.flatnonzero(is_link).tolist()]
    landmarks = TracedFunction("landmarks", inputs, {"points": origins})
    no_force, points = np.zeros(len(dae.force_signals)), []
    for state in states:
        values = landmarks(state[: links.q.numel()], dae.parameter_values)[0]
        points.append(values.reshape(3, -1, order="F").T)
        points.append(wrenches(state, no_force).points)
    return np.vstack([*points, _corners(model, states, scene_graph)])


def _corners(model: RobotModel, states: FloatArray, scene_graph: SceneGraph | None) -> FloatArray:
    """Returns corners and middles of the bounding boxes of the links' geometry, m, (k, 3)."""
    plant = model.links.plant
    if scene_graph is None or plant is None or plant.get_source_id() is None:
        return np.zeros((0, 3))
    inspector, context = scene_graph.model_inspector(), plant.CreateDefaultContext()
    signs = np.array(np.meshgrid(*[[-1.0, 0.0, 1.0]] * 3)).reshape(3, -1)
    boxes = []
    for number in range(1, plant.num_bodies()):
        body = plant.get_body(BodyIndex(number))
        for geometry in plant.GetVisualGeometriesForBody(body):
            try:
                box = inspector.GetObbInGeometryFrame(geometry)
            except RuntimeError:  # A mesh that Drake does not read, or without extent.
                continue
            if box is not None:
                pose = inspector.GetPoseInFrame(geometry) @ box.pose()
                boxes.append((body, pose.multiply(signs * box.half_width()[:, None])))
    corners = [np.zeros((0, 3))]
    for state in states:
        plant.SetPositions(context, state[: plant.num_positions()])
        corners += [plant.EvalBodyPoseInWorld(context, body).multiply(box).T for body, box in boxes]
    return np.vstack(corners)
