"""Constraint forces and moments as arrows in Meshcat."""

from collections.abc import Sequence

import numpy as np
from pydrake.common.eigen_geometry import AngleAxis
from pydrake.geometry import Cylinder, Meshcat, MeshcatCone, Rgba
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.systems.framework import Context, EventStatus, LeafSystem

from drake_dae.arrays import FloatArray
from drake_dae.blocks.lifetime import SHARED_DICTIONARY, weakly
from drake_dae.robots import (
    Constraint,
    ConstraintWrenches,
    RobotModel,
    Wrenches,
    axes_along,
    own_values,
)

FORCE_COLOR = Rgba(0.85, 0.15, 0.1, 1.0)
MOMENT_COLOR = Rgba(0.55, 0.2, 0.75, 1.0)
PATH_COLOR = Rgba(0.1, 0.2, 0.8, 1.0)

_PIECE = 32  # points in a piece of a growing path

_NEGLIGIBLE = 1e-6  # of a moment, relative to the largest force times the longest arrow's length

LEAST_SCALE = 1e-3  # of an arrow without force; Meshcat cannot draw a scale of 0


class ForceArrows:
    """Draws each constraint force on a robot as an arrow whose tip is at the point of application.

    A moment is an arrow with two heads. The longest, of this length in m, is the largest until now.
    """

    def __init__(self, meshcat: Meshcat, model: RobotModel, length: float = 0.25) -> None:
        self.largest_force = self.largest_moment = 1e-6
        self.has_moment, self._length = False, length
        self._meshcat, self._model = meshcat, model
        wrenches = ConstraintWrenches(model)
        self._rows = list(zip(wrenches.constraints, wrenches.with_moment, strict=True))
        for constraint, with_moment in self._rows:
            _add_arrow(meshcat, path_of(constraint, "force"), length, 1, FORCE_COLOR)
            if with_moment:
                _add_arrow(meshcat, path_of(constraint, "moment"), 0.6 * length, 2, MOMENT_COLOR)

    def draw(self, wrenches: Wrenches, time: float) -> None:
        """Draws the arrows at a time of a recording, in s."""
        self.measure([wrenches])
        for row, (constraint, with_moment) in enumerate(self._rows):
            arrows = {"force": wrenches.forces[row] / self.largest_force}
            if with_moment:
                arrows["moment"] = wrenches.moments[row] / self.largest_moment
            for kind, arrow in arrows.items():
                path, size = path_of(constraint, kind), float(np.linalg.norm(arrow))
                axes = axes_along(arrow / size if size else np.array([0.0, 0.0, 1.0]))
                pose = RigidTransform(RotationMatrix(axes), wrenches.points[row])
                self._meshcat.SetTransform(path, pose, time)
                scale = [max(size, LEAST_SCALE)] * 3
                self._meshcat.SetProperty(f"{path}/arrow", "scale", scale, time)

    def place(self, parameters: FloatArray, time: float) -> None:
        """Moves surfaces with exogenous parameters to their poses for these values of all."""
        dae = self._model.dae
        moving = {p.name for p in dae.exogenous.moving}
        for constraint in self._model.constraints:
            if not moving.isdisjoint(p.name for p in constraint.parameters):
                pose = constraint.placement(own_values(constraint, dae, parameters))
                self._meshcat.SetTransform(path_of(constraint, "surface"), pose, time)

    def measure(self, motion: Sequence[Wrenches]) -> None:
        """Enlarges the scale so that these wrenches fit."""
        for wrenches in motion:
            both = wrenches.forces, wrenches.moments
            force, moment = (float(np.linalg.norm(r, axis=1).max(initial=0.0)) for r in both)
            self.largest_force = max(self.largest_force, force)
            negligible = _NEGLIGIBLE * self._length * self.largest_force
            self.has_moment = self.has_moment or moment > negligible
            self.largest_moment = max(self.largest_moment, moment, negligible)


class ConstraintForceVisualizer(LeafSystem):
    """Draws the constraint forces and the paths of their points while a robot runs."""

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
        self._arrows, self._meshcat, self._wrenches = arrows, meshcat, ConstraintWrenches(model)
        self._values, self._places = model.dae.parameter_values, list(places)
        self._piece, self._number, self._time = list[FloatArray](), 0, -np.inf
        size = model.links.q.numel() + model.links.v.numel()
        self._link_state = self.DeclareVectorInputPort("link_state", size)
        self._force = self.DeclareVectorInputPort("constraint_force", len(model.dae.force_signals))
        self._exogenous = self.DeclareVectorInputPort("exogenous", len(self._places))
        self.DeclarePeriodicPublishEvent(period, 0.0, weakly(self._publish))
        self.DeclareForcedPublishEvent(weakly(self._publish))

    def _publish(self, context: Context) -> EventStatus:
        time = context.get_time()
        if self._places and self._exogenous.HasValue(context):
            self._values[self._places] = self._exogenous.Eval(context)
            self._arrows.place(self._values, time)
        state, force = self._link_state.Eval(context), self._force.Eval(context)
        wrenches = self._wrenches(state, force, self._values)
        self._arrows.draw(wrenches, time)
        self._extend_paths(wrenches.points, time)
        return EventStatus.Succeeded()

    def _extend_paths(self, points: FloatArray, time: float) -> None:
        """Appends points to the paths; a time before the last one clears the paths first."""
        if time < self._time:
            self._meshcat.Delete("/paths")
            self._piece, self._number = [], 0
        self._time = time
        self._piece.append(points)
        for row, constraint in enumerate(self._wrenches.constraints):
            line = np.array([each[row] for each in self._piece])
            path = f"/paths/{constraint.name}/actual/{self._number}"
            self._meshcat.SetLine(path, np.asfortranarray(line.T), 4.0, PATH_COLOR)
        # In pieces, since Meshcat sends a whole line again with each new point.
        if len(self._piece) > _PIECE:
            self._piece, self._number = [points], self._number + 1


def path_of(constraint: Constraint, what: str) -> str:
    """The Meshcat path of a constraint's "surface", "force", "moment" and the like."""
    return f"/contact/{constraint.name}/{what}"


def _add_arrow(meshcat: Meshcat, path: str, length: float, heads: int, color: Rgba) -> None:
    """Adds an arrow along z whose tip is at the origin, with one or two heads in a row."""
    # A MeshcatCone opens along +z from its tip at the origin: turned, it points along +z.
    half_turn = RotationMatrix(AngleAxis(np.pi, np.array([1.0, 0.0, 0.0])))
    head = 0.2 * length
    shaft = length - heads * head
    parts = {
        "shaft": (Cylinder(0.16 * head, shaft), RigidTransform([0.0, 0.0, shaft / 2 - length]))
    }
    for number, name in enumerate(["head", "second_head"][:heads]):
        pose = RigidTransform(half_turn, [0.0, 0.0, -number * head])
        parts[name] = MeshcatCone(head, 0.4 * head, 0.4 * head), pose
    for name, (form, pose) in parts.items():
        meshcat.SetObject(f"{path}/arrow/{name}", form, color)
        meshcat.SetTransform(f"{path}/arrow/{name}", pose)
        # It is drawn over everything, since a force in a joint acts inside bodies.
        mesh = f"{path}/arrow/{name}/<object>"
        meshcat.SetProperty(mesh, "material.depthTest", False)
        meshcat.SetProperty(mesh, "material.transparent", True)
        meshcat.SetProperty(mesh, "renderOrder", 1.0)
