"""Surfaces given by data, as heights over a plane: a height map, a mesh."""

import csv
import struct
from abc import abstractmethod
from dataclasses import dataclass
from functools import lru_cache
from io import BytesIO
from math import ceil, prod
from pathlib import Path
from typing import Any, ClassVar

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydrake.math import RigidTransform

from drake_dae.arguments import checked
from drake_dae.arrays import FloatArray, brief, number_in, numbers, positive
from drake_dae.dae.system.signals import Signal
from drake_dae.errors import ModelError, describe_os_error
from drake_dae.files import read_bytes
from drake_dae.robots.surfaces.mesh_file import heights_of_mesh, read_mesh
from drake_dae.robots.surfaces.picture import Picture, mesh_of_grid
from drake_dae.robots.surfaces.relief import CELLS, Relief, fit_relief
from drake_dae.robots.surfaces.surface import Surface, Vector, tangents, triple, unit_vector

Pair = tuple[float, float]

MOST_HEIGHTS = 10_000_000
"""A map has no more heights: a fit to them takes a gigabyte."""

MOST_LENGTH = 1e9
"""No height and no vertex is farther away, in m."""


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
        """How far it is off its data."""

    def picture(self, center: ArrayLike, size: float) -> Picture:
        sides = self.relief.x, self.relief.y
        x, y = (np.linspace(side[0], side[1], 3 * CELLS + 1) for side in sides)
        along, across = tangents(self.normal)
        places = x[:, None] * along + y[:, None, None] * across
        points = places + self.relief.heights(x, y)[..., None] * np.array(self.normal)
        return Picture(mesh_of_grid(points), RigidTransform())

    def _told(self, source: str) -> str:
        width = max(bells.width for bells in self.relief.bells)
        return (
            f"{source}: the surface is off the data by {_millimetres(self.relief.largest)} at most "
            f"and {_millimetres(self.relief.rms)} rms; what is finer than {_millimetres(width)} is "
            "smoothed away"
        )


@checked(ModelError)
@dataclass(frozen=True)
class HeightMap(_Map):
    """Heights on a grid over a plane, from a table or a file, made smooth.

    The surface is the sum of a plane and of bell curves that is closest to the heights: it has
    derivatives of all orders, which laws behind springs and motors need, and is off the heights by
    what `remark` says. Beyond the edges it goes over to the plane. Its coordinates are along
    `tangents(normal)` in m: for the normal z along x and y, for a wall sideways and upward.

    Attributes:
        size: The lengths of the map along its coordinates, m, shape (2,).
        heights: Heights in m above the plane through `point`, row by row: a row goes along the
            first coordinate, the rows follow along the second; shape (r, c).
        file: A file with the heights instead: .csv, or .npy, or .png, where black is 0 and white is
            1, and which is seen from above, its second coordinate upward.
        point: The middle of the map, m, shape (3,).
        normal: The direction of the heights, which is the free side, of any length, shape (3,).
        scale: The length of a unit of the heights, m.
        resolution: What is finer is smoothed away, m: the distance of the bell curves. If None, a
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
            rows = tuple(map(tuple, _table("heights", self.heights).tolist()))
            object.__setattr__(self, "heights", rows)
            found = _table_relief(rows, self.size, self.scale, self.resolution)
        else:
            source = _stamp(Path(str(self.file)))
            found = _file_relief(source, self.size, self.scale, self.resolution)
        object.__setattr__(self, "relief", found)

    @property
    def remark(self) -> str:
        return self._told(f"HeightMap '{Path(self.file).name}'" if self.file else "HeightMap")


@checked(ModelError)
@dataclass(frozen=True)
class MeshSurface(_Map):
    """The side of a mesh that is seen along a normal, as heights over a plane, made smooth.

    Rays against the normal sample the mesh over a rectangle, and a smooth surface is fitted to what
    they hit; see `HeightMap`. So the mesh must cover the rectangle, and must not lie over itself
    there: an overhang has no single height. A steep step is smoothed over; `remark` tells by how
    much. To meet a mesh from several sides take several surfaces.

    Attributes:
        file: A mesh: .obj, or .stl and others that the package trimesh reads.
        point: Where the origin of the mesh stands in the world, m, shape (3,); its axes are the
            world's.
        normal: The free side, and where the rays come from, of any length, shape (3,).
        middle: The middle of the rectangle along `tangents(normal)` from the origin of the mesh, m,
            shape (2,); that of the mesh if None.
        size: The lengths of the rectangle, m, shape (2,); those of the mesh if None.
        scale: The length of a unit of the mesh, m: 0.001 for millimetres.
        resolution: What is finer is smoothed away, m: the distance of the bell curves. If None, a
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
        found = _mesh_relief(source, self.normal, rectangle, self.scale, self.resolution)
        object.__setattr__(self, "relief", found)

    @property
    def remark(self) -> str:
        return self._told(f"MeshSurface '{Path(self.file).name}'")


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
"""A file, when it was changed last, and how long it is: a fit is kept as long as these stay."""


def _stamp(file: Path) -> _Source:
    try:
        found = file.stat()
    except (OSError, ValueError):  # A null byte.
        raise ModelError(f"no file '{file}'") from None
    return str(file), found.st_mtime_ns, found.st_size


@lru_cache(maxsize=16)
def _table_relief(
    rows: tuple[tuple[float, ...], ...], size: Pair, scale: float, resolution: float | None
) -> Relief:
    return _map_relief(np.array(rows), size, scale, resolution)


@lru_cache(maxsize=16)
def _file_relief(source: _Source, size: Pair, scale: float, resolution: float | None) -> Relief:
    return _map_relief(_read_heights(Path(source[0])), size, scale, resolution)


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
    seen = scale * vertices @ axes
    if np.linalg.det(axes) < 0.0:
        triangles = triangles[:, ::-1]  # A mirror shows their backs.
    low, high = seen[:, :2].min(axis=0), seen[:, :2].max(axis=0)
    middle = (low + high) / 2 if rectangle[0] is None else np.array(rectangle[0])
    size = high - low if rectangle[1] is None else np.array(rectangle[1])
    if not np.all(size > 0.0):
        raise ModelError(f"the mesh has no extent across the normal {normal}; choose another one")
    resolution = resolution or float(np.max(size)) / CELLS
    x, y = (
        _along(center, length, 2 * max(ceil(length / resolution), 4) + 1)
        for center, length in zip(middle, size, strict=True)
    )
    return fit_relief(x, y, heights_of_mesh(seen, triangles, x, y), resolution)


def _check_lengths(what: str, lengths: FloatArray) -> None:
    largest = float(np.max(np.abs(lengths)))
    if not largest <= MOST_LENGTH:
        raise ModelError(
            f"{what} of up to {largest:.3g} m are no surface of a robot; is the scale right?"
        )


def _along(middle: float, length: float, count: int) -> FloatArray:
    return middle + length * np.linspace(-0.5, 0.5, count)


def _read_heights(file: Path) -> FloatArray:
    """The heights in a file, first row lowest."""
    readers = {".csv": _read_csv, ".npy": _read_npy, ".png": _read_png}
    if file.suffix.lower() not in readers:
        raise ModelError(f"'{file.name}' is no .csv, .npy or .png")
    try:
        rows = readers[file.suffix.lower()](read_bytes(file))
    except OSError as error:
        raise ModelError(describe_os_error(error)) from None
    except Exception as error:  # Those of NumPy, whose headers are Python, and of Pillow are many.
        text = " ".join(str(error).split())[:200]
        raise ModelError(f"'{file.name}' has no table of heights: {text}") from None
    return _table(f"'{file.name}'", rows)


def _read_csv(data: bytes) -> FloatArray:
    """Rows of numbers; semicolons, tabs, commas or blanks between them, whichever comes first here.

    Raises:
        ValueError: A cell is no number, or the rows have different lengths.
    """
    lines = [line.strip(" \r") for line in data.decode("utf-8-sig").splitlines()]
    lines = [line for line in lines if line.strip(" \t,;")]
    between = next((mark for mark in ";\t," if any(mark in line for line in lines)), None)
    rows = csv.reader(lines, delimiter=between) if between else map(str.split, lines)
    cells = [[cell.strip() for cell in row] for row in rows]
    if cells and all(not row[-1] for row in cells):
        cells = [row[:-1] for row in cells]  # A separator behind the last number, in each row.
    heights = [
        [_height(cell, row, column) for column, cell in enumerate(line, start=1)]
        for row, line in enumerate(cells, start=1)
    ]
    lengths = [len(row) for row in heights]
    if len(set(lengths)) > 1:
        other = next(i for i, length in enumerate(lengths) if length != lengths[0])
        raise ValueError(f"row 1 has {lengths[0]} heights, row {other + 1} has {lengths[other]}")
    return np.array(heights)


def _height(cell: str, row: int, column: int) -> float:
    """A cell as a number."""
    value = number_in(cell)
    if value is None:
        decimal = number_in(cell.replace(",", ".")) is not None
        hint = "; write decimals with a point" if decimal else ""
        got = f"'{cell[:20]}'" if cell else "an empty cell"
        raise ValueError(f"row {row}, column {column}: expected a number, got {got}{hint}")
    return value


def _read_npy(data: bytes) -> NDArray[Any]:
    """The array of an .npy file.

    Raises:
        ValueError: It holds something else, or claims more than there is.
    """
    file = BytesIO(data)
    if not data.startswith(b"\x93NUMPY"):
        raise ValueError("it does not begin as an .npy file")
    version = np.lib.format.read_magic(file)
    read = {(1, 0): np.lib.format.read_array_header_1_0}
    shape, _, kind = read.get(version, np.lib.format.read_array_header_2_0)(file)
    if kind.kind not in "iuf":
        raise ValueError(f"its entries are {kind}, and no real numbers")
    if prod(shape) * kind.itemsize > len(data):
        raise ValueError(f"it claims shape {shape}, which is more than it holds")
    file.seek(0)
    return np.load(file, allow_pickle=False)


def _read_png(data: bytes) -> NDArray[Any]:
    """The brightness of an image, its lowest row first.

    Raises:
        ValueError: It has more than `MOST_HEIGHTS` pixels.
    """
    from matplotlib.image import imread

    if data[:8] != b"\x89PNG\r\n\x1a\n" or len(data) < 24:
        raise ValueError("it does not begin as a .png file")
    width, height = struct.unpack(">II", data[16:24])
    if width * height > MOST_HEIGHTS:
        raise ValueError(f"{width} times {height} pixels; at most {MOST_HEIGHTS} are read")
    pixels = imread(BytesIO(data), format="png")[::-1].astype(float)
    return pixels if pixels.ndim == 2 else pixels[..., :3].mean(axis=2)


def _table(what: str, rows: ArrayLike) -> FloatArray:
    """Rows as an array.

    Raises:
        ModelError: They are no table of numbers, or too few.
    """
    heights = numbers(f"{what}: heights", rows)
    if heights.ndim != 2 or min(heights.shape) < 2:
        raise ModelError(
            f"{what}: two rows of two heights are the least, got shape {heights.shape}"
        )
    if heights.size > MOST_HEIGHTS:
        raise ModelError(f"{what}: {heights.size} heights; at most {MOST_HEIGHTS} are read")
    bad = np.argwhere(~np.isfinite(heights))
    if bad.size:
        row, column = bad[0] + 1
        raise ModelError(f"{what}: row {row}, column {column} is no height")
    return heights


def _millimetres(length: float) -> str:
    return f"{1e3 * length:.2g} mm"
