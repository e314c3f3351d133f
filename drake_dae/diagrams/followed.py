"""The lines that a tool has followed: edges, found by the paths of its contact points."""

from collections.abc import Sequence
from dataclasses import dataclass

import casadi as ca
import numpy as np
from pydrake.systems.framework import Context

from drake_dae.arguments import checked
from drake_dae.arrays import FloatArray
from drake_dae.diagrams.closed_loop import ClosedLoop
from drake_dae.errors import ModelError
from drake_dae.robots.model import RobotModel
from drake_dae.simulation.records.record import Record
from drake_dae.systems.control.phase_change import PhaseChange
from drake_dae.trace.functions import TracedFunction


@dataclass(frozen=True, eq=False)
class FollowedLine:
    """The line of an edge that a phase has followed.

    Attributes:
        phase: The name of the phase.
        contacts: The names of the contacts.
        point: The point of the line in the middle of the way, in the world, m, shape (3,).
        direction: The direction of the motion, in the world, of length 1, shape (3,).
        rms: The root mean square of the distances of the contact points from their lines, m.
        largest: The largest of these distances, m.
    """

    phase: str
    contacts: tuple[str, ...]
    point: FloatArray
    direction: FloatArray
    rms: float
    largest: float

    def __str__(self) -> str:
        point, direction = (
            ", ".join(f"{number:.5f}" for number in part) for part in (self.point, self.direction)
        )
        return (
            f"{self.phase}: the edge by {' and '.join(self.contacts)} is the line through "
            f"[{point}] m along [{direction}]; the contact points are off straight lines by "
            f"{1e3 * self.rms:.3g} mm rms, {1e3 * self.largest:.3g} mm at most"
        )


@checked(ModelError)
def followed_lines(loop: ClosedLoop, record: Record, context: Context) -> tuple[FollowedLine, ...]:
    """Fits a line to the way of the tool in each phase that follows an edge, such as a `Follow`.

    The contact point i of such a phase has the positions p_i(t). Their mean is c_i, and the common
    direction d of all points is the one of their largest variance, sum_i sum_t ((p_i - c_i) . d)^2,
    which makes the sum of their squared distances from the lines c_i + s d least. Each point
    touches one plane of the edge, whose normal n_i is that of the law's model without its part
    along d. The edge is the line along d through the point e with

        n_i . (e - c_i) = 0    for all i,    d . (e - mean of c_i) = 0.

    With one contact it is the way of its point. With two, d needs no model. An angle a between a
    plane and its model, turned about d, moves e by a times the distance of the point from the edge.

    Args:
        loop: The closed loop.
        record: A record of a run of it.
        context: The context of its diagram after the run.

    Returns:
        A line for each such phase, in the order of the run; none if the plant is no robot.
    """
    changes, model = loop.changes(context), loop.plant.model
    if model is None or not any(change.followed for change in changes):
        return ()
    parameters = loop.plant_parameters(record, context)
    ends = [*(change.time for change in changes[1:]), float(record.time[-1])]
    found = []
    for change, end in zip(changes, ends, strict=True):
        rows = np.flatnonzero((record.time > change.time) & (record.time <= end))
        if change.followed and rows.size > 1:
            found.append(_line(change, model, record["state"][rows], parameters[rows]))
    return tuple(found)


def _line(
    change: PhaseChange, model: RobotModel, states: FloatArray, parameters: FloatArray
) -> FollowedLine:
    """The line of one phase, from the states and the plant's parameters during it."""
    points, normals = _touched(model, change.followed, states, parameters)
    centers = points.mean(axis=0)
    offsets = points - centers
    direction = np.linalg.svd(offsets.reshape(-1, 3), full_matrices=False)[2][0]
    direction *= np.sign(direction @ (points[-1, 0] - points[0, 0])) or 1.0
    across = offsets - (offsets @ direction)[..., None] * direction
    distances = np.linalg.norm(across, axis=-1)
    normals = normals - np.outer(normals @ direction, direction)
    middle = centers.mean(axis=0)
    rows = np.vstack([normals, direction])
    heights = [*np.sum(normals * (centers - middle), axis=1), 0.0]
    # The least change where they do not determine the point, as with one contact.
    moved = np.linalg.lstsq(rows, np.array(heights), rcond=None)[0]
    rms = float(np.sqrt(np.mean(distances**2)))
    return FollowedLine(
        change.phase, change.followed, middle + moved, direction, rms, float(distances.max())
    )


def _touched(
    model: RobotModel, names: Sequence[str], states: FloatArray, parameters: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """The points of contacts in the world, shape (k, c, 3), and their mean normals, (c, 3).

    The normals are those of the law's model of the surfaces.
    """
    links = model.links
    constraints = {constraint.name: constraint for constraint in model.constraints}
    touches = [touch for name in names if (touch := constraints[name].touch(links))]
    points = ca.horzcat(*(links.position(touch.frame, touch.point) for touch in touches))
    normals = ca.horzcat(*(touch.normal for touch in touches))
    inputs = {"q": links.q, "parameters": model.dae.parameter_symbol}
    placed = TracedFunction("contact points", inputs, {"points": points.T})
    turned = TracedFunction("contact normals", inputs, {"normals": normals.T})
    positions, nominal = states[:, : links.q.numel()], model.dae.parameter_values
    along = [placed(q, own)[0] for q, own in zip(positions, parameters, strict=True)]
    return np.array(along), np.mean([turned(q, nominal)[0] for q in positions], axis=0)
