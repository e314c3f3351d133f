"""A plane that ends: a plate with edges, and with a hole."""

from dataclasses import dataclass
from functools import reduce
from itertools import pairwise, product
from math import cos, sin, sqrt, tan
from typing import ClassVar

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike
from pydrake.geometry import Box, SurfaceTriangle, TriangleSurfaceMesh
from pydrake.math import RigidTransform, RotationMatrix

from drake_dae.arguments import checked
from drake_dae.arrays import FloatArray, positive, vector
from drake_dae.errors import ModelError
from drake_dae.robots.surfaces.picture import PosedShape
from drake_dae.robots.surfaces.surface import Pair, Vector, tangents
from drake_dae.robots.surfaces.surfaces import Plane

SIDES = 48
"""The number of flat sides of a hole, which touch its circle from outside: at the corners between
them it is wider by 0.2 % of its radius."""

STRIPS = 48
"""The number of strips of the face on each side of a hole."""

CUBE = ((0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3))
"""The corners of the sides of a cube, counterclockwise from outside."""

TINY = 1e-12
"""A length in m that counts as 0."""


@checked(ModelError)
@dataclass(frozen=True)
class Hole:
    """A round hole through a plate, normal to it.

    Attributes:
        radius: Its radius, m.
        center: Its center on the plate, in the coordinates of the plate, m, shape (2,).
        chamfer: The width and depth of its chamfer of 45 degrees, m; 0 for a sharp edge.

    Raises:
        ModelError: A number is not valid.
    """

    radius: float
    center: Pair = (0.0, 0.0)
    chamfer: float = 0.0

    def __post_init__(self) -> None:
        positive("hole: radius", self.radius)
        x, y = vector("hole: center", self.center, 2)
        object.__setattr__(self, "center", (float(x), float(y)))
        if not 0.0 <= self.chamfer < np.inf:
            raise ModelError(f"hole: chamfer must be 0 or more, got {self.chamfer:g}")


@checked(ModelError)
@dataclass(frozen=True)
class Plate(Plane):
    """A rectangular plate with a plane face, and with a hole if given: a plane that ends.

    Laws and constraints that stay closed have the whole plane, phi = n . (p - point), without
    edges and without a hole. Unilateral plants have its face: a contact opens where its point
    leaves the face by an edge or over the hole, and closes on the face alone; there the sides of
    the plate are no contact, unless a constraint of their own has them. Compliant plants and
    Drake's contact have the whole plate: a tool beyond an edge, or in the hole, touches nothing or
    its sides.

    Attributes:
        point: The middle of the face, m, shape (3,).
        normal: The direction n toward the free side, of any length, shape (3,).
        half_widths: Half of its extent along each of `tangents(n)`, m, shape (2,).
        thickness: Its thickness, m.
        hole: A hole through it; None for none.

    Raises:
        ModelError: A length is not positive, or the hole with its chamfer does not fit the plate.
    """

    half_widths: Pair = (0.1, 0.1)
    thickness: float = 0.05
    hole: Hole | None = None
    ends: ClassVar[bool] = True

    def __post_init__(self) -> None:
        super().__post_init__()
        widths = vector("half_widths", self.half_widths, 2)
        object.__setattr__(self, "half_widths", tuple(widths.tolist()))
        for width in (*self.half_widths, self.thickness):
            positive("half_widths and thickness", width)
        hole = self.hole
        if hole is not None and not hole.chamfer < min(self._room(hole), self.thickness):
            raise ModelError(
                f"a hole with a radius of {hole.radius:g} m and a chamfer of {hole.chamfer:g} m at "
                f"{hole.center} does not fit a plate with the half_widths {self.half_widths} and a "
                f"thickness of {self.thickness:g} m"
            )

    @property
    def remark(self) -> str:
        ends = "edges" if self.hole is None else "edges and the hole"
        return f"the law has the whole plane of this Plate, without the {ends}"

    def clearance(self, offset: ca.SX) -> ca.SX:
        (x, y), z = ca.vertsplit(self.coordinates(offset)), self.distance(offset)
        middle, (a, b) = z + self.thickness / 2.0, self.half_widths
        beyond = [ca.fabs(x) - a, ca.fabs(y) - b, ca.fabs(middle) - self.thickness / 2.0]
        outside = _length(*(ca.fmax(part, 0) for part in beyond))
        box = outside + ca.fmin(reduce(ca.fmax, beyond), 0)
        if self.hole is None:
            return box
        center = self.hole.center
        inward = self.hole.radius - _length(x - center[0], y - center[1])
        return ca.fmax(box, _from_rim(inward, z, self.hole.chamfer))

    @property
    def whole(self) -> Plane:
        return Plane(self.point, self.normal)

    @property
    def opening(self) -> Pair | None:
        return None if self.hole is None else (self.hole.radius, self.hole.chamfer)

    def edges(self, offset: ca.SX) -> ca.SX:
        (x, y), (a, b) = ca.vertsplit(self.coordinates(offset)), self.half_widths
        sides = [a - x, a + x, b - y, b + y]
        if (hole := self.hole) is None:
            return ca.vertcat(*sides)
        rim, (u, v) = hole.radius + hole.chamfer, hole.center
        # To first order around the rim, and smooth also at its center.
        return ca.vertcat(*sides, ((x - u) ** 2 + (y - v) ** 2 - rim**2) / (2.0 * rim))

    def solids(self) -> tuple[PosedShape, ...]:
        # Drake finds balls in boxes exactly. Near edges of convex meshes its depth is off by a
        # factor of 2, and its normal by 60 degrees.
        (a, b), depth, hole = self.half_widths, self.thickness, self.hole
        if hole is None:
            return (self._box((-a, a), (-b, b), depth),)
        # The face: strips on both sides of the hole, with steps outside of its circle.
        boxes, (x, y), rim = list[PosedShape](), hole.center, hole.radius + hole.chamfer
        ends = [-b, *(y + rim * np.linspace(-1.0, 1.0, STRIPS + 1)).tolist(), b]
        for low, high in pairwise(ends):
            off = max(low - y, y - high, 0.0)
            gap = sqrt(rim**2 - off**2) if off < rim * (1.0 - TINY) else 0.0
            boxes += [self._box((-a, x - gap), (low, high), depth)]
            boxes += [self._box((x + gap, a), (low, high), depth)]
        return (*boxes, *self._sides(hole))

    def _sides(self, hole: Hole) -> list[PosedShape]:
        """The sides of a hole and its chamfer: boxes, tangential to their circles from outside."""
        boxes, chamfer, width = list[PosedShape](), hole.chamfer, 2.0 * tan(np.pi / SIDES)
        height, up = self.thickness - chamfer, np.array([0.0, 0.0, 1.0])
        behind = min(hole.radius / 4.0, self._room(hole))
        for angle in 2.0 * np.pi * np.arange(SIDES) / SIDES:
            out = np.array([cos(angle), sin(angle), 0.0])
            center = (hole.radius + behind / 2.0) * out - (chamfer + height / 2.0) * up
            sizes = (behind, width * hole.radius, height)
            boxes.append(self._posed(hole, center, out, up, sizes))
            if chamfer:
                slope, normal = (out + up) / sqrt(2.0), (up - out) / sqrt(2.0)
                center = (hole.radius + chamfer / 2.0) * out - (up + normal) * chamfer / 2.0
                sizes = (sqrt(2.0) * chamfer, width * (hole.radius + chamfer), chamfer)
                boxes.append(self._posed(hole, center, slope, normal, sizes))
        return boxes

    def _room(self, hole: Hole) -> float:
        """The least distance of a hole from the edges, m."""
        return float(np.min(np.array(self.half_widths) - np.abs(hole.center))) - hole.radius

    def _box(self, along: Pair, across: Pair, depth: float) -> PosedShape:
        """A box below the face with these ranges of coordinates."""
        middle = np.array([sum(along) / 2.0, sum(across) / 2.0, -depth / 2.0])
        sizes = (along[1] - along[0], across[1] - across[0], depth)
        return self._posed(
            None, middle, np.array([1.0, 0.0, 0.0]), np.array([0.0, 0.0, 1.0]), sizes
        )

    def _posed(
        self, hole: Hole | None, center: FloatArray, x: FloatArray, z: FloatArray, sizes: Vector
    ) -> PosedShape:
        """A box with its center, x axis and z axis along, across and normal to the plate."""
        axes = np.vstack([*tangents(self.normal), self.normal])
        place = center if hole is None else center + np.array([*hole.center, 0.0])
        x, z = x @ axes, z @ axes
        rotation = RotationMatrix(np.column_stack([x, np.cross(z, x), z]))
        return PosedShape(Box(*sizes), RigidTransform(rotation, place @ axes))

    def picture(self, center: ArrayLike, size: float) -> PosedShape:
        corners, triangles = list[FloatArray](), list[SurfaceTriangle]()
        cube = np.array(list(product((-0.5, 0.5), repeat=3)))
        for solid in self.solids():
            assert isinstance(solid.form, Box)
            first = len(corners)
            corners += list((solid.pose @ (cube * solid.form.size()).T).T)
            for p, q, r, s in CUBE:
                for corner in ((p, q, r), (p, r, s)):
                    triangles.append(SurfaceTriangle(*(first + number for number in corner)))
        return PosedShape(TriangleSurfaceMesh(triangles, corners), RigidTransform())


def _length(*parts: ca.SX) -> ca.SX:
    """The length of a vector; where it is 0, its gradient is 0."""
    return ca.sqrt(ca.fmax(ca.sumsqr(ca.vertcat(*parts)), TINY**2))


def _from_rim(inward: ca.SX, height: ca.SX, chamfer: float) -> ca.SX:
    """The signed distance from the rim of a hole, as of its section.

    Args:
        inward: How far inside the circle of the hole, m.
        height: How far above the face, m.
        chamfer: The width of the chamfer, m.
    """
    depth = reduce(ca.fmax, [inward, height, (inward + height + chamfer) / sqrt(2.0)])
    along = (height - inward + chamfer) / sqrt(2.0)
    along = ca.fmin(ca.fmax(along, 0), sqrt(2.0) * chamfer) / sqrt(2.0)
    distances = [
        _length(inward, ca.fmax(height + chamfer, 0)),  # From the side,
        _length(inward + along, height + chamfer - along),  # the chamfer,
        _length(ca.fmax(inward + chamfer, 0), height),  # and the face.
    ]
    return ca.if_else(depth > 0, reduce(ca.fmin, distances), depth)
