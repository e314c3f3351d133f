"""The drawn surfaces in contact with a robot, and the extent of a robot."""

from dataclasses import dataclass

import numpy as np
from pydrake.geometry import Box, SceneGraph, Shape
from pydrake.math import RigidTransform
from pydrake.multibody.tree import BodyIndex

from drake_dae.arrays import FloatArray
from drake_dae.robots.constraint_wrenches import ConstraintWrenches, own_values
from drake_dae.robots.constraints import Constraint
from drake_dae.robots.model import RobotModel
from drake_dae.robots.surfaces.picture import PosedShape
from drake_dae.trace.functions import TracedFunction


@dataclass(frozen=True, eq=False)
class DrawnSurface:
    """The drawn surface of one or several constraints.

    Attributes:
        constraint: The first of them.
        stands: Its pose for their parameters.
        picture: The surface, relative to that.
    """

    constraint: Constraint
    stands: RigidTransform
    picture: PosedShape

    @property
    def level(self) -> float | None:
        """The height of a level plane, m; None of any other surface."""
        pose, form = self.stands @ self.picture.pose, self.picture.form
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
    """The surfaces in contact with a robot, each once, since coinciding ones would flicker.

    An unbounded surface is drawn around the middle of its contact points, and larger than their
    extent.

    Args:
        model: The robot.
        acting: Its constraint wrenches.
        points: Where its constraints act along a run, m, shape (k, constraints, 3).
        parameters: The values of all parameters.
        size: The size of the drawn piece of an unbounded surface, m.
    """

    def seen(row: int, touched: FloatArray) -> DrawnSurface | None:
        constraint = acting.constraints[row]
        own = own_values(constraint, model.dae, parameters)
        low, high = touched.min(axis=0), touched.max(axis=0)
        nearest = np.argmin(np.linalg.norm(touched - (low + high) / 2, axis=1))
        extent = max(size, 1.4 * float(np.linalg.norm(high - low)))
        picture = constraint.picture(own, touched[nearest], extent)
        if picture is None:
            return None
        stands = constraint.placement(own)
        return DrawnSurface(constraint, stands, picture.moved(stands.inverse()))

    found: list[tuple[list[int], DrawnSurface]] = []
    for row, constraint in enumerate(acting.constraints):
        one = seen(row, points[:, row])
        if one is None:
            continue
        moves = any(parameter.exogenous for parameter in constraint.parameters)
        for number, (rows, other) in enumerate(found):
            if moves or any(parameter.exogenous for parameter in other.constraint.parameters):
                continue
            touched = points[:, [*rows, row]].reshape(-1, 3)
            first, second = seen(rows[0], touched), seen(row, touched)
            if first is not None and second is not None and _coincide(first, second):
                found[number] = ([*rows, row], first)
                break
        else:
            found.append(([row], one))
    return [one for _, one in found]


def _coincide(first: DrawnSurface, second: DrawnSurface) -> bool:
    """Whether two pictures are equal."""
    poses = [one.stands @ one.picture.pose for one in (first, second)]
    if not poses[0].IsNearlyEqualTo(poses[1], 1e-9):
        return False
    one, other = first.picture.form, second.picture.form
    if isinstance(one, Shape) or isinstance(other, Shape):
        return repr(one) == repr(other)
    first_corners, second_corners = (np.array(form.vertices()) for form in (one, other))
    return first_corners.shape == second_corners.shape and np.allclose(
        first_corners, second_corners, rtol=0.0, atol=1e-9
    )


def scene_extent(
    model: RobotModel,
    wrenches: ConstraintWrenches,
    state: FloatArray,
    scene_graph: SceneGraph | None = None,
) -> tuple[FloatArray, float]:
    """The center and the size, in m, of the box around a robot and its constrained points.

    Args:
        model: The robot.
        wrenches: Its constraint wrenches.
        state: x, or only its first part, the link state (q, v).
        scene_graph: The geometry of its links, or None: then each link is its origin.
    """
    places = scene_points(model, wrenches, state[None], scene_graph)
    low, high = places.min(axis=0), places.max(axis=0)
    return (low + high) / 2, max(float(np.linalg.norm(high - low)), 1e-3)


def scene_points(
    model: RobotModel,
    wrenches: ConstraintWrenches,
    states: FloatArray,
    scene_graph: SceneGraph | None = None,
) -> FloatArray:
    """Points that enclose a robot and its constrained points, m, shape (k, 3).

    Args:
        model: The robot.
        wrenches: Its constraint wrenches.
        states: x, or only its first part, the link state (q, v), one row for each moment.
        scene_graph: The geometry of its links, or None: then each link is its origin.
    """
    links, dae = model.links, model.dae
    inputs = {"q": links.q, "parameters": dae.parameter_symbol}
    # The world's own origin is no part of a robot.
    own = [name != "world" for name in links.landmark_names]
    kept = links.landmarks()[:, np.flatnonzero(own).tolist()] if any(own) else links.landmarks()
    landmarks = TracedFunction("landmarks", inputs, {"points": kept})
    none, found = np.zeros(len(dae.force_signals)), []
    for state in states:
        origins = landmarks(state[: links.q.numel()], dae.parameter_values)[0]
        found.append(origins.reshape(3, -1, order="F").T)
        found.append(wrenches(state, none).points)
    return np.vstack([*found, _corners(model, states, scene_graph)])


def _corners(model: RobotModel, states: FloatArray, scene_graph: SceneGraph | None) -> FloatArray:
    """The corners of the bounding boxes of the links' geometry, and points between these, m."""
    drawn = model.links.plant
    if scene_graph is None or drawn is None or drawn.get_source_id() is None:
        return np.zeros((0, 3))
    inspector, context = scene_graph.model_inspector(), drawn.CreateDefaultContext()
    signs = np.array(np.meshgrid(*[[-1.0, 0.0, 1.0]] * 3)).reshape(3, -1)
    boxes = []
    for number in range(1, drawn.num_bodies()):
        body = drawn.get_body(BodyIndex(number))
        for geometry in drawn.GetVisualGeometriesForBody(body):
            try:
                box = inspector.GetObbInGeometryFrame(geometry)
            except RuntimeError:  # A mesh that Drake does not read, or without extent.
                continue
            if box is not None:
                stands = inspector.GetPoseInFrame(geometry) @ box.pose()
                boxes.append((body, stands.multiply(signs * box.half_width()[:, None])))
    found = [np.zeros((0, 3))]
    for state in states:
        drawn.SetPositions(context, state[: drawn.num_positions()])
        found += [drawn.EvalBodyPoseInWorld(context, body).multiply(box).T for body, box in boxes]
    return np.vstack(found)
