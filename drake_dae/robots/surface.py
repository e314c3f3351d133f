"""The contract of a surface, its meshes, and directions on it."""

import warnings
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Literal, Self

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike
from pydrake.common import MemoryFile
from pydrake.geometry import InMemoryMesh, Mesh, Shape, SurfaceTriangle, TriangleSurfaceMesh
from pydrake.math import RigidTransform

from drake_dae.arrays import FloatArray, positive, show, vector
from drake_dae.dae import Parameter, Signal, as_expression
from drake_dae.errors import ModelError
from drake_dae.trace.expressions import length_of
from drake_dae.trace.functions import TracedFunction
from drake_dae.trace.numerics import NewtonModel, newton, shortest_steps

_SAG, _MOST, _LEAST = 2.5e-6, 60, 4
"""The wanted distance in m of a facet's edge from the surface; the largest and the least number of
facets along each side."""

_RIM, _APEX = 1.2, 2.0
"""The width of the outermost facets, where the pressure falls, relative to the depth; the depth of
the lowest vertex, relative to the longer side."""

_TETRAHEDRA = np.array([*"013701750273026704570476", *"45784768"], dtype=int).reshape(-1, 4)
"""Of each cell: its corners have the bits row, column, below; 8 is the lowest vertex."""


@dataclass(frozen=True, eq=False)
class PosedShape:
    """A shape or a mesh of Drake, and its pose in the world."""

    form: Shape | TriangleSurfaceMesh
    pose: RigidTransform

    def moved(self, pose: RigidTransform) -> "PosedShape":
        """The same form with its world frame moved to a pose."""
        return PosedShape(self.form, pose @ self.pose)


def mesh_of_grid(points: FloatArray) -> TriangleSurfaceMesh:
    """Two triangles in each cell of a grid, shape (r, c, 3), whose corners are all finite."""
    number = np.arange(points[..., 0].size).reshape(points.shape[:2])
    a, b, c, d = number[:-1, :-1], number[:-1, 1:], number[1:, 1:], number[1:, :-1]
    halves = [np.stack(part, axis=-1).reshape(-1, 3) for part in ((a, b, c), (a, c, d))]
    flat = points.reshape(-1, 3)
    whole = np.all(np.isfinite(flat[[a.ravel(), b.ravel(), c.ravel(), d.ravel()]]), axis=(0, 2))
    used, renumbered = np.unique(np.vstack([half[whole] for half in halves]), return_inverse=True)
    triangles = [SurfaceTriangle(*map(int, row)) for row in renumbered.reshape(-1, 3)]
    return TriangleSurfaceMesh(triangles, list(flat[used]))


Letter = Literal["x", "y", "z"]
LETTERS: tuple[Letter, ...] = ("x", "y", "z")
Pair = tuple[float, float]
Vector = tuple[float, float, float]

EVEN = np.linspace(-0.5, 0.5, 25)
"""The places of the points of a mesh along each side."""


class Surface(ABC):
    """A smooth surface in the world.

    Points are given as offsets from its reference point, so that its position can be a parameter.

    1. `position` is the default position of the reference point: an attribute `point` or `center`.
    2. `distance` is the signed distance of a point, to first order around the surface: zero on it,
       positive on the free side, with a gradient of length one on the surface. So the constraint
       force of `PointOnSurface` is the normal force in newtons. It is smooth around the surface.
    3. `coordinates` are coordinates along the surface, one row for each of `coordinate_signals`;
       with the distance they determine a point, except at poles. A surface may have none.
    4. `has_exact_distance` says whether the distance is exact also off the surface: its gradient
       has length one there.
    5. `picture` is the surface around a point. By default it is drawn from its distance; surfaces
       with a known shape return that.
    6. `shape` are named numbers of its form that may vary; most surfaces have none. `shaped` is the
       same surface with other values, numbers or symbols.
    7. `solids` are Drake shapes that together fill the side opposite to the free one, for Drake's
       own contact; convex if there are several. A surface may have none. `layer` is a mesh below a
       piece of any smooth surface, for hydroelastic contact.
    8. `remark` describes its approximations, if any, and `extent` is the range of coordinates in
       which it is defined, shape (2, 2), if that is bounded.
    """

    coordinate_signals: ClassVar[tuple[Signal, ...]] = ()
    has_exact_distance: ClassVar[bool] = False

    def __post_init__(self) -> None:
        """Points become tuples of floats, and directions unit vectors; radii are positive."""
        for names, convert in (
            (("point", "center", "semi_axes"), triple),
            (("normal", "axis", "zero"), unit_vector),
            (("radius", "minor_radius", "major_radius"), positive),
        ):
            for name in names:
                if getattr(self, name, None) is not None:
                    object.__setattr__(self, name, convert(name, getattr(self, name)))

    @property
    def position(self) -> Vector:
        """The default position of the reference point in the world, m, shape (3,)."""
        return getattr(self, "point", None) or self.center  # type: ignore[attr-defined]

    @abstractmethod
    def distance(self, offset: ca.SX) -> ca.SX:
        """The signed distance in m of a point relative to the reference point, shape (3, 1)."""

    def coordinates(self, offset: ca.SX) -> ca.SX:
        """Coordinates along the surface of such a point, one row for each signal."""
        return ca.SX(0, 1)

    @property
    def shape(self) -> Mapping[str, float]:
        """The numbers of its form that may vary: name -> default."""
        return {}

    def shaped(self, values: ca.SX) -> Self:
        """The same surface with other numbers of `shape`, numbers or symbols, shape (k, 1)."""
        return self

    @property
    def remark(self) -> str:
        return ""

    @property
    def extent(self) -> FloatArray | None:
        return None

    def unit_normal(self, offset: ca.SX) -> ca.SX:
        """The gradient of the distance at such a point, shape (3, 1): the normal on the surface."""
        p = ca.SX.sym("p", 3)
        return ca.substitute(ca.gradient(self.distance(p), p), p, offset)

    def picture(self, center: ArrayLike, size: float) -> PosedShape | None:
        """The visible form, with its reference point at the origin.

        `center` is a point of interest, relative to the reference point, and `size` the size of the
        piece to draw if it is unbounded, m. Warns and draws nothing where Newton's method finds no
        point of the surface near the center.
        """
        grid = self._patch(np.asarray(center, float), size, EVEN, EVEN)
        if np.all(np.isfinite(grid), axis=2).sum() < 3:
            warnings.warn(
                f"{type(self).__name__}: no point of it is found within {size:.3g} m of "
                f"{show(center)}, relative to its reference point; it is not drawn",
                stacklevel=2,
            )
            return None
        return PosedShape(mesh_of_grid(grid), RigidTransform())

    def solids(self) -> tuple[PosedShape, ...]:
        """The solids below the surface, with its reference point at the origin; () for none."""
        return ()

    def layer(self, center: ArrayLike, size: float, depth: float) -> PosedShape:
        """A layer of tetrahedra below a piece of the surface; `center` and `size` as of `picture`.

        The pressure of a hydroelastic mesh is linear in each tetrahedron, zero on its boundary, and
        the modulus where a vertex is farthest from it: at `depth`, so that it is that of a half
        space. One vertex is far below.
        """
        place, ends = np.asarray(center, float), []
        even = self._whole_patch(place, size, EVEN, EVEN)
        lengths = (size, size) if self.extent is None else np.ptp(self.extent, axis=0)
        for axis, length in enumerate(lengths):
            bend = np.linalg.norm(np.diff(even, 2, axis=axis), axis=-1).max() / 8.0
            needed = np.ceil((EVEN.size - 1) * (bend / _SAG) ** 0.5)
            if not (rim := _RIM * depth / length) < 0.25:
                raise ModelError(
                    f"a piece of {length:.3g} m is too short for a layer of {depth:g} m, whose "
                    f"rims take {2 * _RIM * depth:.3g} m; use a smaller plant.thickness, or a "
                    "larger plant.piece"
                )
            inner = np.linspace(rim - 0.5, 0.5 - rim, int(np.clip(needed, _LEAST, _MOST)) + 1)
            ends.append(np.concatenate([[-0.5], inner, [0.5]]))
        grid, function = self._whole_patch(place, size, *ends), self._linear()
        flat = grid.reshape(-1, 3)
        normals = np.array([function(point)[1] for point in flat])
        mean = normals.mean(axis=0)
        apex = flat.mean(axis=0) - _APEX * np.ptp(flat, axis=0).max() * mean / np.linalg.norm(mean)
        points = np.vstack([np.stack([flat, flat - depth * normals], axis=1).reshape(-1, 3), apex])
        number = np.arange(len(points) - 1).reshape(*grid.shape[:2], 2)
        cut = slice(None, -1), slice(1, None)
        corners = [number[cut[k & 1], cut[k >> 1 & 1], k >> 2].ravel() for k in range(8)]
        corners.append(np.full(corners[0].size, len(points) - 1))
        tetrahedra = np.stack(corners, axis=-1)[:, _TETRAHEDRA].reshape(-1, 4)
        edges = grid[1, 0] - grid[0, 0], grid[0, 1] - grid[0, 0], -normals[0]
        if np.linalg.det(edges) < 0.0:
            tetrahedra = tetrahedra[:, [0, 1, 3, 2]]
        if not np.all(np.linalg.det(points[tetrahedra[:, 1:]] - points[tetrahedra[:, :1]]) > 0.0):
            raise ModelError(
                "the surface is too curved for one layer; give a smaller piece (plant.piece)"
            )
        count = len(tetrahedra)
        lines = ["# vtk DataFile Version 3.0", "layer", "ASCII", "DATASET UNSTRUCTURED_GRID"]
        lines += [f"POINTS {len(points)} double"]
        lines += [f"{x:.12g} {y:.12g} {z:.12g}" for x, y, z in points]
        lines += [f"CELLS {count} {5 * count}"]
        lines += ["4 " + " ".join(map(str, row)) for row in tetrahedra.tolist()]
        lines += [f"CELL_TYPES {count}", *["10"] * count, ""]
        file = MemoryFile("\n".join(lines), ".vtk", "layer")
        return PosedShape(Mesh(mesh_data=InMemoryMesh(mesh_file=file)), RigidTransform())

    def _whole_patch(self, *arguments: Any) -> FloatArray:
        grid = self._patch(*arguments)
        if not np.all(np.isfinite(grid)):
            raise ModelError("the surface ends within the piece; use a smaller plant.piece")
        return grid

    def _linear(self) -> TracedFunction:
        """A point -> its distance, and the gradient of the distance."""
        p = ca.SX.sym("p", 3)
        distance = self.distance(p)
        outputs = {"distance": distance, "gradient": ca.gradient(distance, p)}
        return TracedFunction("distance", {"offset": p}, outputs)

    def _patch(
        self, center: FloatArray, size: float, rows: FloatArray, columns: FloatArray
    ) -> FloatArray:
        """A grid of the tangent plane, projected onto the surface; NaN where there is none.

        Shape (r, c, 3); the places of rows and columns along the sides are from -1/2 to 1/2.
        """
        function = self._linear()

        def linearize(point: FloatArray) -> NewtonModel | None:
            return shortest_steps(function(point)[1][None], lambda x: function(x)[0])

        def foot(point: FloatArray) -> FloatArray:
            nearest, solved = newton(point, linearize)
            near = solved and np.linalg.norm(nearest - point) <= size
            return nearest if near else np.full(3, np.nan)

        middle = foot(center)
        if not np.all(np.isfinite(middle)):
            middle = center
        # At a tip or on an axis the distance has no gradient; there is one next to it.
        for place in (middle, middle + size * np.array([0.07, 0.11, 0.13])):
            normal = function(place)[1].copy()
            if np.all(np.isfinite(normal)) and normal.any():
                first, second = tangents(normal / np.linalg.norm(normal))
                along, across = size * first, size * second
                grid = [[foot(middle + a * along + b * across) for b in columns] for a in rows]
                return np.array(grid)
        return np.full((1, 1, 3), np.nan)


def with_parameters(name: str, surface: Surface) -> tuple[Surface, tuple[Parameter, ...]]:
    """A surface with symbols for its shape numbers, and these as parameters "<name>.<number>"."""
    numbers = tuple(Parameter(f"{name}.{key}", np.array([n])) for key, n in surface.shape.items())
    if not numbers:
        return surface, ()
    return surface.shaped(ca.vertcat(*(number.symbol for number in numbers))), numbers


def tangents(normal: ArrayLike) -> tuple[FloatArray, FloatArray]:
    """Two unit vectors normal to a unit vector, the second upward; x and y for a level plane."""
    n = np.asarray(normal, dtype=float)
    if abs(n[2]) < 0.9:
        second = np.array([0.0, 0.0, 1.0]) - n[2] * n
        second /= np.linalg.norm(second)
        return np.cross(n, second), second
    first = np.array([1.0, 0.0, 0.0]) - n[0] * n
    first /= np.linalg.norm(first)
    return first, np.cross(n, first)


def axes_along(direction: ArrayLike) -> FloatArray:
    """A rotation, shape (3, 3), whose z axis is a unit vector."""
    z = np.asarray(direction, dtype=float)
    x, _ = tangents(z)
    return np.column_stack([x, np.cross(z, x), z])


def rotation_of(rpy: ca.SX) -> ca.SX:
    """The rotation matrix Rz(yaw) Ry(pitch) Rx(roll) of Drake's RollPitchYaw, shape (3, 3)."""
    (cr, cp, cy), (sr, sp, sy) = (ca.vertsplit(part) for part in (ca.cos(rpy), ca.sin(rpy)))
    return ca.blockcat(
        [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
            [-sp, cp * sr, cp * cr],
        ]
    )


def triple(name: str, value: ArrayLike) -> Vector:
    """Three finite numbers as a tuple."""
    x, y, z = vector(name, value, 3).tolist()
    return x, y, z


def unit_vector(name: str, value: ArrayLike) -> Vector:
    """A direction of any length, normalized; one of zero length raises ModelError."""
    array = np.array(triple(name, value))
    length = float(np.linalg.norm(array))
    if length == 0.0:
        raise ModelError(f"{name} must not be zero")
    # A unit vector is not changed, so that saved values are read back equal.
    return triple(name, array if abs(length - 1.0) < 1e-15 else array / length)


def normalized(function: Callable[[ca.SX], ca.SX], offset: ca.SX) -> ca.SX:
    """F / |grad F| at a point: the distance from F = 0 to first order."""
    p = ca.SX.sym("p", 3)
    value = as_expression("an ImplicitSurface", "its function", function(p))
    if value.shape != (1, 1):
        raise ModelError(f"a surface function returns one number, this one has {value.shape}")
    quotient = value / length_of(ca.gradient(value, p))
    return ca.substitute(quotient, p, offset)
