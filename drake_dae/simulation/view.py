"""Looking at a constrained robot in Drake's Meshcat: surface, contact force, tool path."""

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike
from pydrake.common.eigen_geometry import AngleAxis
from pydrake.geometry import (
    Box,
    Cylinder,
    Ellipsoid,
    Meshcat,
    MeshcatCone,
    MeshcatParams,
    Rgba,
    Sphere,
)
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.tree import BodyIndex
from pydrake.systems.framework import Context, EventStatus, LeafSystem

from drake_dae.arrays import FloatArray
from drake_dae.robots.contact import surfaces
from drake_dae.robots.contact.points import PointOnSurface
from drake_dae.robots.links.multibody import MultibodyExpressions
from drake_dae.robots.model import RobotModel
from drake_dae.trace.functions import TracedFunction

FRAME_RATE = 32.0
"""Frames per second of the live view and of the recording."""


_SURFACE_COLOR = Rgba(0.55, 0.65, 0.75, 0.45)


_FORCE_COLOR = Rgba(0.85, 0.15, 0.1, 1.0)


def start_meshcat(host: str = "localhost") -> Meshcat:
    """A Meshcat server that only this machine reaches, unless told otherwise."""
    meshcat = Meshcat(MeshcatParams(host=host))
    meshcat.SetProperty("/Background", "visible", False)
    meshcat.SetProperty("/Grid", "visible", False)
    meshcat.SetProperty("/Axes", "visible", False)
    return meshcat


def contacts(model: RobotModel) -> list[PointOnSurface]:
    """The constraints that have a contact point."""
    return [c for c in model.constraints if isinstance(c, PointOnSurface)]


def draw_surface(
    meshcat: Meshcat, contact: PointOnSurface, position: ArrayLike, center: ArrayLike, size: float
) -> None:
    """Draws the surface of a contact; a plane or a cylinder as a piece around `center`.

    Args:
        meshcat: Where.
        contact: Its surface. An ImplicitSurface has no shape to draw and is left out.
        position: Where the surface stands, m, shape (3,).
        center: A point of interest in the world, m, shape (3,).
        size: Of such a piece, m.
    """
    surface, path = contact.surface, f"/contact/{contact.name}/surface"
    stand, middle = np.asarray(position, dtype=float), np.asarray(center, dtype=float)
    if isinstance(surface, surfaces.Torus):
        meshcat.PlotSurface(path, *_torus(surface, stand), rgba=_SURFACE_COLOR)
    elif isinstance(surface, surfaces.Plane):
        normal = np.array(surface.normal)
        foot = middle - np.dot(middle - stand, normal) * normal
        rotation = RotationMatrix(np.column_stack(_axes(normal)))
        thickness = 0.01 * size
        meshcat.SetObject(path, Box(size, size, thickness), _SURFACE_COLOR)
        meshcat.SetTransform(path, RigidTransform(rotation, foot - thickness / 2 * normal))
    elif isinstance(surface, surfaces.Sphere):
        meshcat.SetObject(path, Sphere(surface.radius), _SURFACE_COLOR)
        meshcat.SetTransform(path, RigidTransform(stand))
    elif isinstance(surface, surfaces.Cylinder):
        axis = np.array(surface.axis)
        foot = stand + np.dot(middle - stand, axis) * axis
        meshcat.SetObject(path, Cylinder(surface.radius, size), _SURFACE_COLOR)
        rotation = RotationMatrix(np.column_stack(_axes(axis)))
        meshcat.SetTransform(path, RigidTransform(rotation, foot))
    elif isinstance(surface, surfaces.Ellipsoid):
        meshcat.SetObject(path, Ellipsoid(*surface.semi_axes), _SURFACE_COLOR)
        meshcat.SetTransform(path, RigidTransform(stand))


def draw_path(
    meshcat: Meshcat, name: str, points: FloatArray, color: Rgba, width: float = 3.0
) -> None:
    """Draws a line through points in the world, m, shape (k, 3)."""
    meshcat.SetLine(f"/paths/{name}", np.asfortranarray(points.T), width, color)


class ContactPoints:
    """Where a robot touches, as a fast function of its configuration.

    Args:
        model: A robot; those of its contacts count that are `PointOnSurface`.
        parameters: Values of all parameters; the defaults if None.
    """

    def __init__(self, model: RobotModel, parameters: ArrayLike | None = None) -> None:
        self.contacts = contacts(model)
        links = model.links
        empty = ca.SX(3, 0)
        points = [links.position(c.frame, c.point) for c in self.contacts]
        normals = [c.normal(links) for c in self.contacts]
        self._function = TracedFunction(
            "contact points",
            {"q": links.q, "parameters": model.dae.parameter_symbol},
            {"points": ca.horzcat(empty, *points), "normals": ca.horzcat(empty, *normals)},
        )
        values = model.dae.parameter_values if parameters is None else parameters
        self._parameters = np.asarray(values, dtype=float)
        self._size = links.q.numel()

    def __call__(self, link_state: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Points in m and unit normals of all contacts, each of shape (contacts, 3).

        Args:
            link_state: (q, v), or q alone.
        """
        points, normals = self._function(link_state[: self._size], self._parameters)
        return points.reshape(3, -1, order="F").T, normals.reshape(3, -1, order="F").T

    def path(self, link_states: FloatArray, contact: int = 0) -> FloatArray:
        """Path of one contact point, m, shape (k, 3), from states of shape (k, nq + nv)."""
        return np.array([self(state)[0][contact] for state in link_states])


class ContactForceVisualizer(LeafSystem):
    """Draws each contact force as an arrow that ends at the contact point.

    It points along lambda times the normal, as the surface pushes the robot.

    Input ports:
        link_state: (q, v).
        constraint_force: lambda in N, shape (m,).

    Args:
        meshcat: Where.
        model: The robot.
        period: Of drawing in s; None draws only when told to.
        length: Of the longest arrow, m.

    Attributes:
        largest_force: Which force gets the longest arrow, N; it grows with the forces drawn.
    """

    def __init__(
        self, meshcat: Meshcat, model: RobotModel, period: float | None, length: float = 0.25
    ) -> None:
        super().__init__()
        self.set_name("contact_force_visualizer")
        self.largest_force = 1e-6
        self._meshcat = meshcat
        self._points = ContactPoints(model)
        size = model.links.q.numel() + model.links.v.numel()
        self._link_state = self.DeclareVectorInputPort("link_state", size)
        self._force = self.DeclareVectorInputPort("constraint_force", model.dae.num_constraints)
        starts = np.cumsum([0, *[len(c.force_signals) for c in model.constraints]])
        self._rows = [
            int(start)
            for start, constraint in zip(starts, model.constraints, strict=False)
            if isinstance(constraint, PointOnSurface)
        ]
        # A MeshcatCone stands on its tip: turned over, it points along +z, at the origin.
        turned = RotationMatrix(AngleAxis(np.pi, np.array([1.0, 0.0, 0.0])))
        head = 0.2 * length
        for contact in self._points.contacts:
            path = f"{self.path(contact)}/arrow"
            meshcat.SetObject(
                f"{path}/head", MeshcatCone(head, 0.4 * head, 0.4 * head), _FORCE_COLOR
            )
            meshcat.SetTransform(f"{path}/head", RigidTransform(turned))
            shaft = length - head
            meshcat.SetObject(f"{path}/shaft", Cylinder(0.16 * head, shaft), _FORCE_COLOR)
            middle = np.array([0.0, 0.0, -head - shaft / 2])
            meshcat.SetTransform(f"{path}/shaft", RigidTransform(middle))
        if period is not None:
            self.DeclarePeriodicPublishEvent(period, 0.0, self._publish)
        self.DeclareForcedPublishEvent(self._publish)

    @staticmethod
    def path(contact: PointOnSurface) -> str:
        """Where the arrow of a contact stands in the scene."""
        return f"/contact/{contact.name}/force"

    def draw(
        self,
        link_state: FloatArray,
        forces: FloatArray,
        time: float,
        points: ContactPoints | None = None,
    ) -> None:
        """Draws the arrows.

        Args:
            link_state: (q, v).
            forces: lambda in N, shape (m,).
            time: In a recording, s.
            points: The robot's contact points, if not those with default parameters.
        """
        places, normals = (points or self._points)(link_state)
        contact_forces = forces[self._rows]
        largest = float(np.max(np.abs(contact_forces), initial=0.0))
        self.largest_force = max(self.largest_force, largest)
        for contact, place, normal, force in zip(
            self._points.contacts, places, normals, contact_forces, strict=True
        ):
            path = self.path(contact)
            rotation = RotationMatrix(np.column_stack(_axes(normal if force >= 0.0 else -normal)))
            self._meshcat.SetTransform(path, RigidTransform(rotation, place), time)
            # Not zero, which no transformation survives.
            scale = max(abs(float(force)) / self.largest_force, 1e-3)
            self._meshcat.SetProperty(f"{path}/arrow", "scale", [scale] * 3, time)

    def _publish(self, context: Context) -> EventStatus:
        self.draw(self._link_state.Eval(context), self._force.Eval(context), context.get_time())
        return EventStatus.Succeeded()


def frame_times(duration: float, rate: float = FRAME_RATE) -> FloatArray:
    """Moments to show, in s after the start; the last one is the end or the next after it."""
    return np.arange(int(np.ceil(duration * rate - 1e-9)) + 1) / rate


def scene_extent(model: RobotModel, q: FloatArray) -> tuple[FloatArray, float]:
    """Middle and size, in m, of the box around a robot's bodies and contact points.

    Args:
        model: The robot.
        q: Its configuration, shape (nq,).
    """
    links = model.links
    points = [links.position(contact.frame, contact.point) for contact in contacts(model)]
    if isinstance(links, MultibodyExpressions):
        bodies = (links.plant.get_body(BodyIndex(i)) for i in range(links.plant.num_bodies()))
        points += [links.position(body.body_frame()) for body in bodies]
    function = TracedFunction(
        "scene",
        {"q": links.q, "parameters": model.dae.parameter_symbol},
        {"points": ca.horzcat(ca.SX(3, 1), *points)},
    )
    places = function(q, model.dae.parameter_values)[0].reshape(3, -1, order="F")
    low, high = places.min(axis=1), places.max(axis=1)
    return (low + high) / 2, max(float(np.linalg.norm(high - low)), 1e-3)


def _axes(direction: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """A right-handed frame whose z axis is a unit vector."""
    first, _ = surfaces.tangents(direction)
    return first, np.cross(direction, first), direction


def _torus(
    surface: surfaces.Torus, center: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    ring, tube = np.meshgrid(np.linspace(0, 2 * np.pi, 61), np.linspace(0, 2 * np.pi, 31))
    x, y, z = _axes(np.array(surface.axis))
    radial = surface.major_radius + surface.minor_radius * np.cos(tube)
    points = (
        center[:, None, None]
        + x[:, None, None] * radial * np.cos(ring)
        + y[:, None, None] * radial * np.sin(ring)
        + z[:, None, None] * surface.minor_radius * np.sin(tube)
    )
    return tuple(np.asfortranarray(component) for component in points)  # type: ignore[return-value]
