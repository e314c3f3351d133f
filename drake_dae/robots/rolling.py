"""Blades, wheels and balls: nonholonomic constraints."""

from abc import abstractmethod
from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar

import casadi as ca
import numpy as np
from pydrake.math import RigidTransform

from drake_dae.arguments import checked
from drake_dae.arrays import FloatArray
from drake_dae.dae import Parameter, Signal, signals
from drake_dae.errors import ModelError
from drake_dae.robots.constraint import Constraint
from drake_dae.robots.links import Application, Frames, Kinematics
from drake_dae.robots.surface import Surface, Vector, unit_vector
from drake_dae.trace.expressions import length_of


class _RestingPoint(Constraint):
    """A point of a frame, at a contact, that has no velocity along some directions."""

    frame: str

    @abstractmethod
    def _contact(self, kinematics: Kinematics) -> tuple[ca.SX, ca.SX, ca.SX]:
        """The point in m, its velocity in m/s, (3, 1) each, and the directions, shape (3, m)."""

    def rate(self, kinematics: Kinematics) -> ca.SX:
        _, velocity, directions = self._contact(kinematics)
        return ca.mtimes(directions.T, velocity)

    def applications(self, kinematics: Kinematics) -> tuple[Application, ...]:
        point, _, directions = self._contact(kinematics)
        return (Application(point, directions, ca.SX(3, directions.shape[1]), self.frame),)


@checked(ModelError)
@dataclass(frozen=True)
class Blade(_RestingPoint):
    """A blade or a free wheel: a point of a frame has no velocity along an axis of it:

        0 = s(q) . p_W'(q, v),

    with the axis s in the world. It is nonholonomic (r = 1): all positions can be reached. The
    constraint force is the side force in N that the ground exerts on the frame at the point,
    positive along the axis; the ground gets the opposite.

    It does not restrict the height; use a joint or a `PointOnSurface` for that. Two blades on one
    axle are redundant.

    Attributes:
        frame: Name of the frame.
        axis: The axis in the frame along which the point does not move, of any length, shape (3,).
        point: The point in the frame, m, shape (3,).
        name: The name of the constraint, the prefix of its force and its speed.
    """

    frame: str
    axis: Vector = (0.0, 1.0, 0.0)
    point: Vector = (0.0, 0.0, 0.0)
    name: str = "blade"
    force_units: ClassVar = {"side_force": "N"}
    residual_units: ClassVar = {"side_speed": "m/s"}

    def __post_init__(self) -> None:
        object.__setattr__(self, "axis", unit_vector("axis", self.axis))

    def _contact(self, kinematics: Kinematics) -> tuple[ca.SX, ca.SX, ca.SX]:
        point = kinematics.position(self.frame, self.point)
        side = ca.mtimes(kinematics.rotation(self.frame), ca.SX(self.axis))
        return point, kinematics.velocity(self.frame, self.point), side


@checked(ModelError)
@dataclass(frozen=True)
class RollingWheel(_RestingPoint):
    """A wheel rolls on level ground: its contact point has no velocity along the ground:

        0 = f . v_c,  0 = s . v_c,    v_c = p_W' - radius (w x u),

    with the center p_W, the wheel's angular velocity w, the unit vector u from the contact point to
    the center, in the wheel's plane, the heading f = axle x n / |axle x n|, and s = n x f, which is
    the axle of an upright wheel (r = 1, nonholonomic). The constraint forces are the traction and
    the side force in N that the ground exerts on the wheel at the contact point, positive along f
    and s; the ground gets the opposite. Positive rotation about the axle moves the wheel forward.
    The parameter "<name>.radius" is the radius.

    It does not restrict the height: for a floating base, keep the center of each wheel there by a
    `PointOnSurface`. For a second wheel on the same axle set holds_side = False.

    Attributes:
        frame: Name of a frame on the wheel.
        radius: Its radius, m, positive.
        axle: The axle in the frame, of any length, toward the left of the forward direction, shape
            (3,).
        center: Its center in the frame, m, shape (3,).
        normal: The normal n of the ground, in the world, up, of any length, shape (3,).
        holds_side: Whether sideways motion of the wheel is constrained.
        name: The name of the constraint, the prefix of its forces and its parameter.
    """

    frame: str
    radius: float
    axle: Vector = (0.0, 1.0, 0.0)
    center: Vector = (0.0, 0.0, 0.0)
    normal: Vector = (0.0, 0.0, 1.0)
    holds_side: bool = True
    name: str = "wheel"

    def __post_init__(self) -> None:
        for name in ("axle", "normal"):
            object.__setattr__(self, name, unit_vector(name, getattr(self, name)))
        super().__post_init__()

    @cached_property
    def parameters(self) -> tuple[Parameter, ...]:
        return (Parameter(f"{self.name}.radius", np.array([self.radius]), "m", positive=True),)

    @property
    def force_signals(self) -> tuple[Signal, ...]:
        kinds = ("traction", "side_force") if self.holds_side else ("traction",)
        return signals([f"{self.name}.{kind}" for kind in kinds], "N")

    @property
    def residual_signals(self) -> tuple[Signal, ...]:
        kinds = ("slip", "side_speed") if self.holds_side else ("slip",)
        return signals([f"{self.name}.{kind}" for kind in kinds], "m/s")

    def _contact(self, kinematics: Kinematics) -> tuple[ca.SX, ca.SX, ca.SX]:
        n = ca.SX(self.normal)
        axle = ca.mtimes(kinematics.rotation(self.frame), ca.SX(self.axle))
        along = ca.cross(axle, n)
        f = along / length_of(along)
        lever = self.parameters[0].symbol * ca.cross(f, axle)
        spin = kinematics.angular_velocity(self.frame)
        velocity = kinematics.velocity(self.frame, self.center) - ca.cross(spin, lever)
        point = kinematics.position(self.frame, self.center) - lever
        return point, velocity, ca.horzcat(f, ca.cross(n, f)) if self.holds_side else f


@checked(ModelError)
@dataclass(frozen=True)
class RollingBall(_RestingPoint):
    """A ball rolls on a surface without slip or separation:

        phi(q) = distance(p_W) - radius,    0 = t_1 . v_c,  0 = t_2 . v_c,
        v_c = p_W' - radius (w x n),

    with the center p_W, the angular velocity w, the unit normal n at the center, and the tangents
    t_1, which is `along` projected onto the tangent plane and normalized, and t_2 = n x t_1. The
    first row restricts positions (r = 2), the others velocities alone (r = 1): together the ball's
    material point at the contact rests. The constraint forces are the normal force and the two
    rolling frictions in N that the surface exerts on the ball at the contact; the normal force is
    unilateral, and the surface gets the opposite. The ball can spin about n. The parameters
    "<name>.position" and "<name>.radius" are the position of the surface and the radius.

    The surface must have an exact distance function, as planes, spheres, cylinders and tori do.
    Check that friction can provide the rolling forces.

    Attributes:
        frame: Name of a frame on the ball.
        surface: A surface fixed in the world with an exact distance function.
        radius: The ball's radius, m, positive.
        center: Its center in the frame, m, shape (3,).
        along: A direction in the world that is never parallel to the normal, of any length, shape
            (3,).
        name: The name of the constraint, the prefix of its forces and its parameters.
    """

    frame: str
    surface: Surface
    radius: float
    center: Vector = (0.0, 0.0, 0.0)
    along: Vector = (1.0, 0.0, 0.0)
    name: str = "ball"
    force_units: ClassVar = {"force": "N", "friction_1": "N", "friction_2": "N"}
    residual_units: ClassVar = {"distance": "m", "slip_1": "m/s", "slip_2": "m/s"}
    is_unilateral: ClassVar[tuple[bool, ...]] = (True, False, False)

    def __post_init__(self) -> None:
        if not self.surface.has_exact_distance:
            raise ModelError(
                f"a ball cannot roll on {type(self.surface).__name__}, whose distance is right to "
                "first order only; use Plane, Sphere, Cylinder or Torus"
            )
        object.__setattr__(self, "along", unit_vector("along", self.along))
        super().__post_init__()

    @cached_property
    def parameters(self) -> tuple[Parameter, ...]:
        return (
            Parameter(f"{self.name}.position", np.array(self.surface.position), "m"),
            Parameter(f"{self.name}.radius", np.array([self.radius]), "m", positive=True),
        )

    @property
    def coordinate_signals(self) -> tuple[Signal, ...]:
        coordinates = self.surface.coordinate_signals
        return tuple(Signal(f"{self.name}.{signal.name}", signal.unit) for signal in coordinates)

    def residual(self, frames: Frames) -> ca.SX:
        return self.surface.distance(self._offset(frames)) - self.parameters[1].symbol

    def coordinates(self, frames: Frames) -> ca.SX:
        return self.surface.coordinates(self._offset(frames))

    def surface_at(self, values: FloatArray) -> Surface:
        return self.surface

    def placement(self, values: FloatArray) -> RigidTransform:
        return RigidTransform(values[:3])

    def _offset(self, frames: Frames) -> ca.SX:
        """The center relative to the surface's position, m, shape (3, 1)."""
        return frames.position(self.frame, self.center) - self.parameters[0].symbol

    def _contact(self, kinematics: Kinematics) -> tuple[ca.SX, ca.SX, ca.SX]:
        n, along = self.surface.unit_normal(self._offset(kinematics)), ca.SX(self.along)
        across = along - n * ca.dot(n, along)
        first = across / length_of(across)
        lever = self.parameters[1].symbol * n
        spin = kinematics.angular_velocity(self.frame)
        velocity = kinematics.velocity(self.frame, self.center) - ca.cross(spin, lever)
        point = kinematics.position(self.frame, self.center) - lever
        return point, velocity, ca.horzcat(n, first, ca.cross(n, first))
