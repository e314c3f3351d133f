"""Surfaces from data, as heights over a plane: height maps and meshes."""

from abc import abstractmethod
from dataclasses import dataclass
from functools import lru_cache
from math import ceil
from pathlib import Path
from typing import Any, ClassVar

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike
from pydrake.math import RigidTransform

from drake_dae.arguments import checked
from drake_dae.arrays import FloatArray, brief, positive
from drake_dae.dae.system.signals import Signal
from drake_dae.errors import ModelError
from drake_dae.robots.surfaces.height_file import height_table, read_heights
from drake_dae.robots.surfaces.mesh_file import heights_of_mesh, read_mesh
from drake_dae.robots.surfaces.picture import PosedShape, mesh_of_grid
from drake_dae.robots.surfaces.relief import CELLS, Relief, fit_relief
from drake_dae.robots.surfaces.surface import (
    Pair,
    Surface,
    Vector,
    tangents,
    triple,
    unit_vector,
)

MOST_LENGTH = 1e9
"""The largest height and distance of a vertex, in m."""


class _Map(Surface):
    """Heights h over a plane, phi = (z - h(x, y)) / sqrt(1 + h_x^2 + h_y^2).

    This is the distance to first order, with x and y along `tangents(normal)`, z along the normal.
    """

    point: Vector
    normal: Vector
    relief: Relief
    coordinate_signals: ClassVar = (Signal("along", "m"), Signal("across", "m"))

    @property
    def position(self) -> Vector:
        return self.point

    def distance(self, offset: ca.SX) -> ca.SX:
        x, y = ca.vertsplit(self.coordinates(offset))
        height, slope_x, slope_y = self.relief.height(x, y)
        z = ca.dot(ca.DM(self.normal), offset)
        return (z - height) / ca.sqrt(1 + slope_x**2 + slope_y**2)

    def coordinates(self, offset: ca.SX) -> ca.SX:
        return ca.vertcat(*[ca.dot(ca.DM(t), offset) for t in tangents(self.normal)])

    @property
    def extent(self) -> FloatArray:
        return np.column_stack([self.relief.x, self.relief.y])

    @property
    @abstractmethod
    def remark(self) -> str:
        """The deviation from its data, as text."""

    def picture(self, center: ArrayLike, size: float) -> PosedShape:
        even = np.linspace(-0.5, 0.5, 3 * CELLS + 1)
        grid = self._piece(np.zeros(3), size, (even, even))
        return PosedShape(mesh_of_grid(grid.swapaxes(0, 1)), RigidTransform())

    def _lengths(self, size: float) -> Pair:
        return float(np.ptp(self.relief.x)), float(np.ptp(self.relief.y))

    def _piece(
        self, center: FloatArray, size: float, places: tuple[FloatArray, FloatArray]
    ) -> FloatArray:
        x, y = (
            side.mean() + np.ptp(side) * part
            for side, part in zip((self.relief.x, self.relief.y), places, strict=True)
        )
        along, across = tangents(self.normal)
        level = x[:, None, None] * along + y[:, None] * across
        return level + self.relief.heights(x, y).T[..., None] * np.array(self.normal)

    def _remark_of(self, source: str) -> str:
        width = max(bells.width for bells in self.relief.bells)
        return (
            f"{source}: the largest and rms distances of the surface from the data are "
            f"{_millimetres(self.relief.largest)} and {_millimetres(self.relief.rms)}; details "
            f"finer than {_millimetres(width)} are smoothed away"
        )


@checked(ModelError)
@dataclass(frozen=True)
class HeightMap(_Map):
    """Heights on a grid over a plane, from a table or a file, smoothed.

    The surface is a least-squares fit of a plane and bell curves to the heights: it has derivatives
    of all orders, which laws for flexible joints and motors need; `remark` has its deviation.
    Beyond the edges it approaches the plane. Its coordinates are along `tangents(normal)` in m: for
    the normal z along x and y, for a wall sideways and upward.

    Attributes:
        size: The lengths of the map along its coordinates, m, shape (2,).
        heights: Heights in m above the plane through `point`, row by row: a row is along the first
            coordinate, and the rows follow each other along the second; shape (r, c).
        file: A file with the heights instead: .csv, .npy, or .png (black is 0, white is 1, seen
            from above with the second coordinate upward).
        point: The middle of the map, m, shape (3,).
        normal: The direction of the heights and of the free side, of any length, shape (3,).
        scale: The length of a unit of the heights, m.
        resolution: The distance of the bell curves, m; finer details are smoothed. If None, a
            sixteenth of the longer side, but no less than the heights are apart.

    Raises:
        ModelError: There are no heights, or both a table and a file, or they cannot be read.
    """

    size: Pair
    heights: ArrayLike | None = None
    file: str | Path | None = None
    point: Vector = (0.0, 0.0, 0.0)
    normal: Vector = (0.0, 0.0, 1.0)
    scale: float = 1.0
    resolution: float | None = None

    def __post_init__(self) -> None:
        _check(self)
        if (self.heights is None) == (self.file is None):
            raise ModelError("give either heights, row by row, or a file with them")
        if self.heights is not None:
            rows = tuple(map(tuple, height_table("heights", self.heights).tolist()))
            object.__setattr__(self, "heights", rows)
            relief = _table_relief(rows, self.size, self.scale, self.resolution)
        else:
            source = _stamp(Path(str(self.file)))
            relief = _file_relief(source, self.size, self.scale, self.resolution)
        object.__setattr__(self, "relief", relief)

    @property
    def remark(self) -> str:
        return self._remark_of(f"HeightMap '{Path(self.file).name}'" if self.file else "HeightMap")


@checked(ModelError)
@dataclass(frozen=True)
class MeshSurface(_Map):
    """The side of a mesh visible along a normal, as heights over a plane, smoothed.

    Rays against the normal sample the mesh over a rectangle, and a smooth surface is fitted to the
    hits; see `HeightMap`. So the mesh must cover the rectangle without overhangs. Steep steps are
    smoothed; `remark` has the deviation. For contact from several sides use several surfaces.

    Attributes:
        file: A mesh: .obj, or .stl and others that the package trimesh reads.
        point: The origin of the mesh in the world, m, shape (3,); its axes are the world's.
        normal: The direction of the free side, from which the rays come, of any length, shape (3,).
        middle: The center of the rectangle along `tangents(normal)` from the origin of the mesh, m,
            shape (2,); that of the mesh if None.
        size: The lengths of the rectangle, m, shape (2,); those of the mesh if None.
        scale: The length of a unit of the mesh, m: 0.001 for millimetres.
        resolution: The distance of the bell curves, m; finer details are smoothed. If None, a
            sixteenth of the longer side.

    Raises:
        ModelError: The mesh cannot be read, has a hole in the rectangle, or an overhang.
    """

    file: str | Path
    point: Vector = (0.0, 0.0, 0.0)
    normal: Vector = (0.0, 0.0, 1.0)
    middle: Pair | None = None
    size: Pair | None = None
    scale: float = 1.0
    resolution: float | None = None

    def __post_init__(self) -> None:
        _check(self)
        source = _stamp(Path(self.file))
        rectangle = self.middle, self.size
        relief = _mesh_relief(source, self.normal, rectangle, self.scale, self.resolution)
        object.__setattr__(self, "relief", relief)

    @property
    def remark(self) -> str:
        return self._remark_of(f"MeshSurface '{Path(self.file).name}'")


def _check(surface: Any) -> None:
    object.__setattr__(surface, "point", triple("point", surface.point))
    object.__setattr__(surface, "normal", unit_vector("normal", surface.normal))
    positive("scale", surface.scale)
    if surface.resolution is not None:
        positive("resolution", surface.resolution)
    for key in ("size", "middle"):
        pair = getattr(surface, key, None)
        if pair is None:
            continue
        if len(pair) != 2:
            raise ModelError(f"{key} must be two lengths, got {brief(pair)}")
        object.__setattr__(surface, key, (float(pair[0]), float(pair[1])))
        for length in pair if key == "size" else ():
            positive(key, length)


_Source = tuple[str, int, int]
"""A file, its modification time and its size: a fit is kept while these do not change."""


def _stamp(file: Path) -> _Source:
    try:
        status = file.stat()
    except (OSError, ValueError):  # A null byte.
        raise ModelError(f"no file '{file}'") from None
    return str(file), status.st_mtime_ns, status.st_size


@lru_cache(maxsize=16)
def _table_relief(
    rows: tuple[tuple[float, ...], ...], size: Pair, scale: float, resolution: float | None
) -> Relief:
    return _map_relief(np.array(rows), size, scale, resolution)


@lru_cache(maxsize=16)
def _file_relief(source: _Source, size: Pair, scale: float, resolution: float | None) -> Relief:
    return _map_relief(read_heights(Path(source[0])), size, scale, resolution)


def _map_relief(rows: FloatArray, size: Pair, scale: float, resolution: float | None) -> Relief:
    x, y = (_along(0.0, length, n) for length, n in zip(size, rows.shape[::-1], strict=True))
    apart = max(x[1] - x[0], y[1] - y[0])
    _check_lengths("heights", scale * rows)
    return fit_relief(x, y, scale * rows, resolution or max(apart, max(size) / CELLS))


@lru_cache(maxsize=16)
def _mesh_relief(
    source: _Source,
    normal: Vector,
    rectangle: tuple[Pair | None, Pair | None],
    scale: float,
    resolution: float | None,
) -> Relief:
    vertices, triangles = read_mesh(Path(source[0]))
    axes = np.column_stack([*tangents(normal), np.array(normal)])
    _check_lengths("vertices", scale * vertices)
    vertices_along = scale * vertices @ axes
    if np.linalg.det(axes) < 0.0:
        triangles = triangles[:, ::-1]  # A reflection would show the back sides.
    low, high = vertices_along[:, :2].min(axis=0), vertices_along[:, :2].max(axis=0)
    middle = (low + high) / 2 if rectangle[0] is None else np.array(rectangle[0])
    size = high - low if rectangle[1] is None else np.array(rectangle[1])
    if not np.all(size > 0.0):
        raise ModelError(f"the mesh has no extent across the normal {normal}; choose another one")
    resolution = resolution or float(np.max(size)) / CELLS
    x, y = (
        _along(center, length, 2 * max(ceil(length / resolution), 4) + 1)
        for center, length in zip(middle, size, strict=True)
    )
    return fit_relief(x, y, heights_of_mesh(vertices_along, triangles, x, y), resolution)


def _check_lengths(what: str, lengths: FloatArray) -> None:
    largest = float(np.max(np.abs(lengths)))
    if not largest <= MOST_LENGTH:
        raise ModelError(
            f"{what} of up to {largest:.3g} m are no surface of a robot; is the scale right?"
        )


def _along(middle: float, length: float, count: int) -> FloatArray:
    return middle + length * np.linspace(-0.5, 0.5, count)


def _millimetres(length: float) -> str:
    return f"{1e3 * length:.2g} mm"
