"""What a picture of a robot shows around it: surfaces, a grid below it, and where its camera is."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from pydrake.geometry import Box, SceneGraph, Shape
from pydrake.math import RigidTransform
from pydrake.multibody.tree import BodyIndex

from drake_dae.arrays import FloatArray
from drake_dae.robots import Constraint, ConstraintWrenches, PosedShape, RobotModel, own_values
from drake_dae.trace.functions import TracedFunction

_CELLS = 8.0  # the approximate number of grid cells along the diagonal of a scene

_NEAR = 0.1  # of the diagonal: so near to the lowest point, the grid is on a horizontal surface


@dataclass(frozen=True, eq=False)
class DrawnSurface:
    """A surface in the world that one or several constraints touch, of which it has the first."""

    constraint: Constraint
    pose: RigidTransform
    picture: PosedShape


@dataclass(frozen=True, eq=False)
class Floor:
    """A horizontal grid: the side of a cell, and the ends of its lines, m, shape (k, 3) each."""

    cell: float
    begins: FloatArray
    ends: FloatArray


def surroundings(
    model: RobotModel,
    acting: ConstraintWrenches,
    points: FloatArray,
    parameters: FloatArray,
    size: float,
) -> list[DrawnSurface]:
    """The surfaces that a robot touches, each only once: two at one pose would flicker.

    Of an unbounded one a piece of this size or more around its contact points, (times, m, 3).
    """
    constraints = acting.constraints

    def piece(row: int, contacts: FloatArray) -> DrawnSurface | None:
        values = own_values(constraints[row], model.dae, parameters)
        surface, pose = constraints[row].surface_at(values), constraints[row].placement(values)
        if surface is None:
            return None
        low, high = contacts.min(axis=0), contacts.max(axis=0)
        nearest = np.argmin(np.linalg.norm(contacts - (low + high) / 2, axis=1))
        extent = max(size, 1.4 * float(np.linalg.norm(high - low)))
        picture = surface.picture(pose.inverse() @ contacts[nearest], extent)
        return None if picture is None else DrawnSurface(constraints[row], pose, picture)

    groups = list[list[int]]()
    for row in range(len(constraints)):
        if piece(row, points[:, row]) is None:
            continue
        for group in groups:
            if any(p.exogenous for k in (row, group[0]) for p in constraints[k].parameters):
                continue
            contacts = points[:, [*group, row]].reshape(-1, 3)
            if _coincide(piece(group[0], contacts), piece(row, contacts)):
                group.append(row)
                break
        else:
            groups.append([row])
    pieces = [piece(group[0], points[:, group].reshape(-1, 3)) for group in groups]
    return [surface for surface in pieces if surface is not None]


def _coincide(first: DrawnSurface | None, second: DrawnSurface | None) -> bool:
    if first is None or second is None:
        return False
    pose, other_pose = (each.pose @ each.picture.pose for each in (first, second))
    form, other = first.picture.form, second.picture.form
    if isinstance(form, Shape) or isinstance(other, Shape):
        is_same = repr(form) == repr(other)
    else:
        is_same = np.array_equal(form.vertices(), other.vertices())
    return is_same and pose.IsNearlyEqualTo(other_pose, 1e-9)


def floor_below(points: FloatArray, surfaces: Sequence[DrawnSurface] = ()) -> Floor:
    """A grid slightly below points, m, shape (k, 3), or on a horizontal plane near the lowest."""
    size, low, high = diagonal(points), points.min(axis=0), points.max(axis=0)
    power = 10.0 ** np.floor(np.log10(size / _CELLS) + 1e-9)
    cell = power * max(step for step in (1, 2, 5) if step * power <= size / _CELLS * (1 + 1e-9))
    height = low[2] - 0.003 * size
    for surface in surfaces:
        pose, form = surface.pose @ surface.picture.pose, surface.picture.form
        if isinstance(form, Box) and pose.rotation().matrix()[2, 2] > 1.0 - 1e-6:
            level = pose.translation()[2] + form.height() / 2.0
            if abs(level - low[2]) < _NEAR * size:
                height = level + 0.003 * size
    first, last = np.floor(low[:2] / cell) - 1, np.ceil(high[:2] / cell) + 1
    xs, ys = (cell * np.arange(a, b + 0.5) for a, b in zip(first, last, strict=True))
    begins = [*((x, ys[0], height) for x in xs), *((xs[0], y, height) for y in ys)]
    ends = [*((x, ys[-1], height) for x in xs), *((xs[-1], y, height) for y in ys)]
    return Floor(float(cell), np.array(begins), np.array(ends))


def diagonal(points: FloatArray) -> float:
    """The diagonal of the bounding box of points, shape (k, 3), at least 1 mm."""
    return max(float(np.linalg.norm(np.ptp(points, axis=0))), 1e-3)


def scene_points(
    model: RobotModel,
    wrenches: ConstraintWrenches,
    states: FloatArray,
    scene_graph: SceneGraph | None = None,
) -> FloatArray:
    """Points that enclose a robot and its contact points at some states, m, shape (k, 3)."""
    links, dae = model.links, model.dae
    origins = links.landmarks()
    if origins.shape[1] > 1:  # The world's origin is not a part of the robot.
        origins = origins[:, 1:]
    inputs = {"q": links.q, "parameters": dae.parameter_symbol}
    landmarks = TracedFunction("landmarks", inputs, {"points": origins})
    no_force, points = np.zeros(len(dae.force_signals)), []
    for state in states:
        values = landmarks(state[: links.q.numel()], dae.parameter_values)[0]
        points += [values.reshape(3, -1, order="F").T, wrenches(state, no_force).points]
    # Corners and middles of the bounding boxes of the links' geometry.
    plant = links.plant
    if scene_graph is None or plant is None or plant.get_source_id() is None:
        return np.vstack(points)
    inspector, context = scene_graph.model_inspector(), plant.CreateDefaultContext()
    signs = np.array(np.meshgrid(*[[-1.0, 0.0, 1.0]] * 3)).reshape(3, -1)
    boxes = []
    for body in map(plant.get_body, map(BodyIndex, range(1, plant.num_bodies()))):
        for geometry in plant.GetVisualGeometriesForBody(body):
            try:
                box = inspector.GetObbInGeometryFrame(geometry)
            except RuntimeError:  # A mesh that Drake does not read, or without extent.
                continue
            if box is not None:
                pose = inspector.GetPoseInFrame(geometry) @ box.pose()
                boxes.append((body, pose.multiply(signs * box.half_width()[:, None])))
    for state in states:
        plant.SetPositions(context, state[: plant.num_positions()])
        points += [plant.EvalBodyPoseInWorld(context, body).multiply(box).T for body, box in boxes]
    return np.vstack(points)


_FLAT = 0.35  # The camera is higher if a scene's height is below this share of its largest extent.

_TURNS = np.deg2rad([0, -30, 30, -60, 60, -90, 90, 120, 150, 180])
"""The tried angles of the camera about the vertical, in order of preference, in rad."""

_FROM, _FROM_ABOVE = np.array([-0.6, -0.85, 0.4]), np.array([-0.6, -0.85, 1.3])
"""The preferred directions to the camera, of usual and of flat scenes."""

_MARGIN = 0.06  # the fraction of a picture's height that is free at each side


def view_angles(angle: float, aspect: float, top: float = 0.0) -> tuple[float, float, float]:
    """The tangents of a camera's angles to each side, up and down, with margins left free.

    `top` is the fraction of a picture's height that is also free at the top.
    """
    half = float(np.tan(angle / 2.0))
    return half * (aspect - 2 * _MARGIN), half * (1 - 2 * (top + _MARGIN)), half * (1 - 2 * _MARGIN)


def direction_of(points: FloatArray, contacts: FloatArray, normals: FloatArray) -> FloatArray:
    """The unit vector from a scene to its camera, turned until little hides the contacts.

    Normals point toward the free side at each contact, or are zero.
    """
    extents = np.ptp(points, axis=0)
    size = float(np.linalg.norm(extents))
    x, y, z = _FROM_ABOVE if extents[2] < _FLAT * np.max(extents) else _FROM
    best, least = np.zeros(3), np.inf
    for number, turn in enumerate(_TURNS):
        c, s = np.cos(turn), np.sin(turn)
        direction = np.array([c * x - s * y, s * x + c * y, z]) / np.linalg.norm([x, y, z])
        cost = 0.03 * number
        for contact, normal in zip(contacts, normals, strict=True):
            ahead = (points - contact) @ direction
            aside = np.linalg.norm(points - contact - np.outer(ahead, direction), axis=1)
            hides = np.any((ahead > 0.12 * size) & (aside < 0.06 * size))
            is_behind = normal @ direction < -1e-6 * np.linalg.norm(normal)
            cost += (bool(hides) + 2.0 * bool(is_behind)) / len(contacts)
        if cost < least:
            best, least = direction, cost
    return best


def framed(
    points: FloatArray, direction: FloatArray, view: tuple[float, float, float]
) -> tuple[FloatArray, FloatArray]:
    """The nearest camera that shows all points: its position, and a point on its axis, m."""
    # x points to the right, y up and z to the camera, at the distance D and the offset s from the z
    # axis. It shows a point if |x - s_x| <= side (D - z) and -down (D - z) <= y - s_y <= up (D -
    # z). Each condition has a least D for which an s exists; the larger one is used.
    side, up, down = view
    right = np.cross([0.0, 0.0, 1.0], direction)
    right /= np.linalg.norm(right)
    axes = np.column_stack([right, np.cross(direction, right), direction])
    middle = (points.min(axis=0) + points.max(axis=0)) / 2.0
    x, y, z = ((points - middle) @ axes).T
    # D >= high - s / above and D >= low + s / below.
    sides = [
        (above, below, np.max(p / above + z), np.max(-p / below + z))
        for p, above, below in ((x, side, side), (y, up, down))
    ]
    distance = max(
        *((above * high + below * low) / (above + below) for above, below, high, low in sides),
        np.max(z) + 1e-3,
    )
    offset = [
        (above * (high - distance) + below * (distance - low)) / 2.0
        for above, below, high, low in sides
    ]
    at = middle + axes @ np.array([*offset, 0.0])
    return at + distance * direction, at
