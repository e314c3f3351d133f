"""Constraint forces and moments as arrows in Meshcat."""

from collections.abc import Sequence

import numpy as np
from pydrake.common.eigen_geometry import AngleAxis
from pydrake.geometry import Cylinder, Meshcat, MeshcatCone, Rgba
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.systems.framework import Context, EventStatus, LeafSystem

from drake_dae.arrays import FloatArray
from drake_dae.robots.constraint_wrenches import ConstraintWrenches, Wrenches, own_values
from drake_dae.robots.constraints.constraint import Constraint
from drake_dae.robots.model import RobotModel
from drake_dae.robots.surfaces.surface import axes_along
from drake_dae.systems.blocks.lifetime import SHARED_DICTIONARY, weakly

FORCE_COLOR = Rgba(0.85, 0.15, 0.1, 1.0)
MOMENT_COLOR = Rgba(0.55, 0.2, 0.75, 1.0)

PATH_COLOR = Rgba(0.1, 0.2, 0.8, 1.0)

_PIECE = 32
"""The number of points in a piece of a growing path."""

_NEGLIGIBLE = 1e-6
"""A moment is negligible below so much of the largest force at the length of the longest arrow."""

LEAST_SCALE = 1e-3
"""The scale of an arrow without force: a transformation must not be zero."""


class ForceArrows:
    """Draws the force of each constraint on a robot: an arrow whose tip is where it acts.

    It points in the direction of the force, from a surface to its free side, and so does not cover
    the tool. A moment has its own arrow with two heads, along its axis. Lengths are relative to the
    largest force so far.

    Args:
        meshcat: The Meshcat to draw in.
        model: The robot.
        length: The length of the longest arrow, m.

    Attributes:
        largest_force, largest_moment: The force and moment of the longest arrow, N and N m.
        has_moment: Whether some moment is not negligible beside the forces.
    """

    def __init__(self, meshcat: Meshcat, model: RobotModel, length: float = 0.25) -> None:
        self.largest_force = self.largest_moment = 1e-6
        self.has_moment, self._length = False, length
        self._meshcat, self._model = meshcat, model
        self._wrenches = ConstraintWrenches(model)
        pairs = zip(self._wrenches.constraints, self._wrenches.with_moment, strict=True)
        for constraint, with_moment in pairs:
            _add_arrow(meshcat, path_of(constraint, "force"), length, 1, FORCE_COLOR)
            if with_moment:
                _add_arrow(meshcat, path_of(constraint, "moment"), 0.6 * length, 2, MOMENT_COLOR)

    def draw(self, wrenches: Wrenches, time: float) -> None:
        """Draws the arrows.

        Args:
            wrenches: The wrenches at this moment.
            time: The time in a recording, s.
        """
        self.measure([wrenches])
        pairs = zip(self._wrenches.constraints, self._wrenches.with_moment, strict=True)
        for row, (constraint, with_moment) in enumerate(pairs):
            point, force, moment = wrenches.points[row], wrenches.forces[row], wrenches.moments[row]
            self._draw_arrow(path_of(constraint, "force"), point, force / self.largest_force, time)
            if with_moment:
                turned = moment / self.largest_moment
                self._draw_arrow(path_of(constraint, "moment"), point, turned, time)

    def place(self, parameters: FloatArray, time: float) -> None:
        """Moves exogenous surfaces to their present poses.

        Args:
            parameters: Values of all parameters.
            time: The time in a recording, s.
        """
        dae = self._model.dae
        moving = {p.name for p in dae.exogenous.moving}
        for constraint in self._model.constraints:
            if not moving.isdisjoint(p.name for p in constraint.parameters):
                stands = constraint.placement(own_values(constraint, dae, parameters))
                self._meshcat.SetTransform(path_of(constraint, "surface"), stands, time)

    def measure(self, course: Sequence[Wrenches]) -> None:
        """Adapts the scale to these wrenches."""
        for wrenches in course:
            force, moment = (
                float(np.max(np.linalg.norm(rows, axis=1), initial=0.0))
                for rows in (wrenches.forces, wrenches.moments)
            )
            self.largest_force = max(self.largest_force, force)
            least = _NEGLIGIBLE * self._length * self.largest_force
            self.has_moment = self.has_moment or moment > least
            self.largest_moment = max(self.largest_moment, moment, least)

    def _draw_arrow(self, path: str, point: FloatArray, arrow: FloatArray, time: float) -> None:
        size = float(np.linalg.norm(arrow))
        direction = arrow / size if size > 0.0 else np.array([0.0, 0.0, 1.0])
        pose = RigidTransform(RotationMatrix(axes_along(direction)), point)
        self._meshcat.SetTransform(path, pose, time)
        scale = max(size, LEAST_SCALE)
        self._meshcat.SetProperty(f"{path}/arrow", "scale", [scale] * 3, time)


class GrowingPaths:
    """Draws growing paths of the points of application of constraints.

    Args:
        meshcat: The Meshcat to draw in.
        constraints: The constraints that act at a point.
    """

    def __init__(self, meshcat: Meshcat, constraints: Sequence[Constraint]) -> None:
        self._meshcat, self._constraints = meshcat, constraints
        self._piece: list[FloatArray] = []
        self._number, self._time = 0, -np.inf

    def add(self, points: FloatArray, time: float) -> None:
        """Appends the present points; an earlier time than the last starts again.

        Args:
            points: The points of application, m, shape (k, 3).
            time: The time in s.
        """
        if time < self._time:
            self._meshcat.Delete("/paths")
            self._piece, self._number = [], 0
        self._time = time
        self._piece.append(points)
        line = np.array(self._piece)
        for row, constraint in enumerate(self._constraints):
            path = f"/paths/{constraint.name}/actual/{self._number}"
            self._meshcat.SetLine(path, np.asfortranarray(line[:, row].T), 4.0, PATH_COLOR)
        # In pieces, since a line is sent completely with each new point.
        if len(self._piece) > _PIECE:
            self._piece, self._number = [points], self._number + 1


class ConstraintForceVisualizer(LeafSystem):
    """Draws the constraint forces of a robot while it runs, and the paths of their points.

    Input ports:
        link_state: (q, v).
        constraint_force: lambda, shape (m,).
        exogenous: The plant's port of that name, with exogenous signals.

    Args:
        arrows: The force arrows.
        meshcat: Where to draw the paths.
        model: The robot.
        places: The indices of the entries of `exogenous` among the parameters.
        period: Time between pictures in s.
    """

    __slots__ = SHARED_DICTIONARY

    def __init__(
        self,
        arrows: ForceArrows,
        meshcat: Meshcat,
        model: RobotModel,
        places: Sequence[int],
        period: float,
    ) -> None:
        super().__init__()
        self.set_name("constraint_force_visualizer")
        self._model = model
        self._arrows, self._wrenches = arrows, ConstraintWrenches(model)
        self._paths = GrowingPaths(meshcat, self._wrenches.constraints)
        self._values, self._places = model.dae.parameter_values, list(places)
        size = model.links.q.numel() + model.links.v.numel()
        self._link_state = self.DeclareVectorInputPort("link_state", size)
        self._force = self.DeclareVectorInputPort("constraint_force", len(model.dae.force_signals))
        self._exogenous = self.DeclareVectorInputPort("exogenous", len(self._places))
        self.DeclarePeriodicPublishEvent(period, 0.0, weakly(self._publish))
        self.DeclareForcedPublishEvent(weakly(self._publish))

    def _publish(self, context: Context) -> EventStatus:
        state, force, time = (
            self._link_state.Eval(context),
            self._force.Eval(context),
            context.get_time(),
        )
        if self._places and self._exogenous.HasValue(context):
            self._values[self._places] = self._exogenous.Eval(context)
            self._arrows.place(self._values, time)
        wrenches = self._wrenches(state, force, self._values)
        self._arrows.draw(wrenches, time)
        self._paths.add(wrenches.points, time)
        return EventStatus.Succeeded()


def path_of(constraint: Constraint, what: str) -> str:
    """The path of a constraint's surface, force or moment in the scene."""
    return f"/contact/{constraint.name}/{what}"


def _add_arrow(meshcat: Meshcat, path: str, length: float, heads: int, color: Rgba) -> None:
    """An arrow along z that ends at the origin, with one head behind the other."""
    # A MeshcatCone has its tip at the origin: rotated, it points along +z.
    turned = RotationMatrix(AngleAxis(np.pi, np.array([1.0, 0.0, 0.0])))
    head, names = 0.2 * length, ["head", "second_head"][:heads]
    for number, name in enumerate(names):
        cone = f"{path}/arrow/{name}"
        meshcat.SetObject(cone, MeshcatCone(head, 0.4 * head, 0.4 * head), color)
        meshcat.SetTransform(cone, RigidTransform(turned, [0.0, 0.0, -number * head]))
    shaft = length - heads * head
    meshcat.SetObject(f"{path}/arrow/shaft", Cylinder(0.16 * head, shaft), color)
    middle = np.array([0.0, 0.0, shaft / 2 - length])
    meshcat.SetTransform(f"{path}/arrow/shaft", RigidTransform(middle))
    # Drawn over everything, since the force in a joint acts inside bodies.
    for part in (*names, "shaft"):
        mesh = f"{path}/arrow/{part}/<object>"
        meshcat.SetProperty(mesh, "material.depthTest", False)
        meshcat.SetProperty(mesh, "material.transparent", True)
        meshcat.SetProperty(mesh, "renderOrder", 1.0)
