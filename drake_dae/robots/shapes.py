"""Surfaces given by a form or a formula: planes, spheres, cylinders, ellipsoids, tori, F(p) = 0."""

from collections.abc import Callable, Mapping
from copy import copy
from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import ClassVar, Self

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike
from pydrake import geometry
from pydrake.math import RigidTransform, RotationMatrix

from drake_dae.arguments import checked
from drake_dae.arrays import positive
from drake_dae.dae import Signal
from drake_dae.errors import ModelError
from drake_dae.robots.surface import (
    PosedShape,
    Surface,
    Vector,
    axes_along,
    mesh_of_grid,
    normalized,
    tangents,
)
from drake_dae.trace.expressions import check_names, length_of, parse_formula, result_of

_SOLID_LENGTH = 100.0
"""The length of the solid of a cylinder, in m: its ends are out of the reach of a robot."""

_TAKEN = (
    *("position", "rpy", "force", "distance"),
    *("friction", "stiction_tolerance", "viscous_friction"),
)
"""Names that constraints use for their own parameters and signals."""


@checked(ModelError)
@dataclass(frozen=True)
class Plane(Surface):
    """A plane: phi = n . (p - point). Its coordinates are along `tangents(n)`, in m.

    Attributes:
        point: A point of the plane, m, shape (3,).
        normal: The direction n toward the free side, of any length, shape (3,).
    """

    point: Vector
    normal: Vector
    coordinate_signals: ClassVar = (Signal("along", "m"), Signal("across", "m"))
    has_exact_distance: ClassVar = True

    def distance(self, offset: ca.SX) -> ca.SX:
        return ca.dot(ca.DM(self.normal), offset)

    def coordinates(self, offset: ca.SX) -> ca.SX:
        return ca.vertcat(*[ca.dot(ca.DM(t), offset) for t in tangents(self.normal)])

    def picture(self, center: ArrayLike, size: float) -> PosedShape:
        normal, thickness = np.array(self.normal), 0.01 * size
        foot = center - np.dot(center, normal) * normal
        # The upper side of a thin box.
        pose = RigidTransform(RotationMatrix(axes_along(normal)), foot - thickness / 2 * normal)
        return PosedShape(geometry.Box(size, size, thickness), pose)

    def solids(self) -> tuple[PosedShape, ...]:
        pose = RigidTransform(RotationMatrix(axes_along(self.normal)), np.zeros(3))
        return (PosedShape(geometry.HalfSpace(), pose),)


@checked(ModelError)
@dataclass(frozen=True)
class Sphere(Surface):
    """A sphere: phi = |p - center| - radius; its negative if `inside`.

    Its coordinates are longitude and latitude about the axis in rad, singular on it.

    Attributes:
        center: Its center, m, shape (3,).
        radius: Its radius, m.
        axis: The axis of longitude and latitude, of any length, shape (3,).
        inside: Whether the free side is the inside.
    """

    center: Vector
    radius: float
    axis: Vector = (0.0, 0.0, 1.0)
    inside: bool = False
    coordinate_signals: ClassVar = (Signal("longitude", "rad"), Signal("latitude", "rad"))
    has_exact_distance: ClassVar = True

    def distance(self, offset: ca.SX) -> ca.SX:
        return _side(length_of(offset) - self.radius, self.inside)

    def coordinates(self, offset: ca.SX) -> ca.SX:
        x, y, z = _components(self.axis, offset)
        return ca.vertcat(ca.atan2(y, x), ca.atan2(z, ca.sqrt(x**2 + y**2)))

    def picture(self, center: ArrayLike, size: float) -> PosedShape:
        return PosedShape(geometry.Sphere(self.radius), RigidTransform())

    def solids(self) -> tuple[PosedShape, ...]:
        return () if self.inside else (self.picture(self.center, self.radius),)


@checked(ModelError)
@dataclass(frozen=True)
class Cylinder(Surface):
    """A cylinder without ends: phi = distance from the axis - radius; its negative if `inside`.

    Its coordinates are the angle about the axis in rad, and the distance along it in m.

    Attributes:
        point: A point of the axis, m, shape (3,).
        axis: The direction of the axis, of any length, shape (3,).
        radius: Its radius, m.
        inside: Whether the free side is the inside.
        zero: The direction of angle 0, normal to the axis; None for the first of `tangents(axis)`.
            The angle jumps on the opposite side, so choose it towards the robot.
    """

    point: Vector
    axis: Vector
    radius: float
    inside: bool = False
    zero: Vector | None = None
    coordinate_signals: ClassVar = (Signal("angle", "rad"), Signal("along", "m"))
    has_exact_distance: ClassVar = True

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.zero is not None and np.linalg.norm(np.cross(self.zero, self.axis)) < 1e-6:
            raise ModelError(f"zero must not lie along the axis, got {self.zero}")

    def distance(self, offset: ca.SX) -> ca.SX:
        x, y, _ = _components(self.axis, offset)
        return _side(length_of(ca.vertcat(x, y)) - self.radius, self.inside)

    def coordinates(self, offset: ca.SX) -> ca.SX:
        x, y, z = _components(self.axis, offset, self.zero)
        return ca.vertcat(ca.atan2(y, x), z)

    def picture(self, center: ArrayLike, size: float) -> PosedShape:
        axis = np.array(self.axis)
        pose = RigidTransform(RotationMatrix(axes_along(axis)), np.dot(center, axis) * axis)
        return PosedShape(geometry.Cylinder(self.radius, size), pose)

    def solids(self) -> tuple[PosedShape, ...]:
        return () if self.inside else (self.picture(np.zeros(3), _SOLID_LENGTH),)


@checked(ModelError)
@dataclass(frozen=True)
class Ellipsoid(Surface):
    """An ellipsoid: phi = F / |grad F| with F = (x/a)^2 + (y/b)^2 + (z/c)^2 - 1.

    This is the distance to first order; its negative if `inside`. The coordinates are longitude and
    latitude of the scaled sphere in rad, singular on the z axis.

    Attributes:
        center: Its center, m, shape (3,).
        semi_axes: a, b, c along the world's axes, m, shape (3,).
        inside: Whether the free side is the inside.
    """

    center: Vector
    semi_axes: Vector
    inside: bool = False
    coordinate_signals: ClassVar = (Signal("longitude", "rad"), Signal("latitude", "rad"))

    def __post_init__(self) -> None:
        super().__post_init__()
        for length in self.semi_axes:
            positive("semi_axes", length)

    def distance(self, offset: ca.SX) -> ca.SX:
        return _side(
            normalized(lambda p: ca.sumsqr(p / ca.DM(self.semi_axes)) - 1.0, offset), self.inside
        )

    def coordinates(self, offset: ca.SX) -> ca.SX:
        x, y, z = ca.vertsplit(offset / ca.DM(self.semi_axes))
        return ca.vertcat(ca.atan2(y, x), ca.atan2(z, ca.sqrt(x**2 + y**2)))

    def picture(self, center: ArrayLike, size: float) -> PosedShape:
        return PosedShape(geometry.Ellipsoid(*self.semi_axes), RigidTransform())


@checked(ModelError)
@dataclass(frozen=True)
class Torus(Surface):
    """A torus: phi = distance from the ring - minor radius; its negative if `inside`.

    Its coordinates are the angle along the ring and the angle around the tube (0 outermost) in rad.

    Attributes:
        center: Its center, m, shape (3,).
        axis: The axis of the ring, of any length, shape (3,).
        major_radius: The radius of the ring, m.
        minor_radius: The radius of the tube, m, less than the major one.
        inside: Whether the free side is inside the tube.
    """

    center: Vector
    axis: Vector
    major_radius: float
    minor_radius: float
    inside: bool = False
    coordinate_signals: ClassVar = (Signal("ring_angle", "rad"), Signal("tube_angle", "rad"))
    has_exact_distance: ClassVar = True

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.major_radius > self.minor_radius:
            raise ModelError(
                f"major_radius {self.major_radius} must exceed minor_radius {self.minor_radius}"
            )

    def distance(self, offset: ca.SX) -> ca.SX:
        x, y, z = _components(self.axis, offset)
        radial = ca.sqrt(x**2 + y**2) - self.major_radius
        return _side(ca.sqrt(radial**2 + z**2) - self.minor_radius, self.inside)

    def coordinates(self, offset: ca.SX) -> ca.SX:
        x, y, z = _components(self.axis, offset)
        return ca.vertcat(ca.atan2(y, x), ca.atan2(z, ca.sqrt(x**2 + y**2) - self.major_radius))

    def picture(self, center: ArrayLike, size: float) -> PosedShape:
        ring, tube = np.meshgrid(np.linspace(0, 2 * np.pi, 61), np.linspace(0, 2 * np.pi, 31))
        radial = self.major_radius + self.minor_radius * np.cos(tube)
        height = self.minor_radius * np.sin(tube)
        points = np.stack([radial * np.cos(ring), radial * np.sin(ring), height], axis=-1)
        pose = RigidTransform(RotationMatrix(axes_along(self.axis)), np.zeros(3))
        return PosedShape(mesh_of_grid(points), pose)


@checked(ModelError)
@dataclass(frozen=True)
class ImplicitSurface(Surface):
    """Any smooth surface F(p) = 0: phi = F / |grad F|, the distance to first order.

    The gradient has length one on the surface.

    Attributes:
        function: F relative to `point` in the world's axes, positive on the free side, of any
            scale, with a nonzero gradient on the surface. A formula of x, y, z in m, pi and the
            parameters, as "z - a*sin(x)**2" (see `parse_formula`); or a function of a CasADi column
            p of shape (3, 1), and of a namespace of the parameters if there are any.
        point: The origin of p in the world, m, shape (3,).
        parameters: Name -> number in F, in the unit of F. They become parameters
            "<constraint>.<name>" of a constraint.

    Raises:
        ModelError: The formula cannot be read; the message has the place.
    """

    function: Callable[..., ca.SX] | str
    point: Vector = (0.0, 0.0, 0.0)
    parameters: Mapping[str, float] = field(default_factory=dict, hash=False)
    _shape: ca.SX = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        super().__post_init__()
        object.__setattr__(self, "parameters", dict(self.parameters))
        object.__setattr__(self, "_shape", ca.SX(ca.DM(list(self.parameters.values()))))
        check_names(self.parameters, (*"xyz", *_TAKEN))
        if isinstance(self.function, str):
            value = self._function(ca.SX.sym("p", 3))
            if value.is_constant():
                raise ModelError(f"formula '{self.function}' has none of x, y and z: no surface")

    @property
    def shape(self) -> Mapping[str, float]:
        return self.parameters

    def shaped(self, values: ca.SX) -> Self:
        changed = copy(self)
        object.__setattr__(changed, "_shape", values)
        return changed

    def distance(self, offset: ca.SX) -> ca.SX:
        return normalized(self._function, offset)

    def _function(self, p: ca.SX) -> ca.SX:
        """F at a point."""
        names = dict(zip(self.parameters, ca.vertsplit(self._shape), strict=True))
        if isinstance(self.function, str):
            return parse_formula(
                self.function, {**dict(zip("xyz", ca.vertsplit(p), strict=True)), **names}
            )
        more = [SimpleNamespace(**names)] if names else []
        return result_of("function", self.function, p, *more)


def _components(
    axis: Vector, offset: ca.SX, zero: Vector | None = None
) -> tuple[ca.SX, ca.SX, ca.SX]:
    """Components along tangents(axis), or along `zero` and across it, and along the axis."""
    first, second = tangents(axis)
    if zero is not None:
        first = np.array(zero) - np.dot(zero, axis) * np.array(axis)
        first /= np.linalg.norm(first)
        second = np.cross(axis, first)
    elif np.dot(np.cross(first, second), axis) < 0.0:
        first = -first
    x, y, z = (ca.dot(ca.DM(vector), offset) for vector in (first, second, np.array(axis)))
    return x, y, z


def _side(distance: ca.SX, inside: bool) -> ca.SX:
    return -distance if inside else distance
