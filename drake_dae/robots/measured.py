"""A measured surface: heights over a plane, from a table or from a mesh, as a smooth function."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from math import ceil
from pathlib import Path
from typing import ClassVar

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from drake_dae.arguments import checked
from drake_dae.arrays import FloatArray, brief, numbers, positive, show, vector
from drake_dae.dae import Signal
from drake_dae.errors import ModelError
from drake_dae.files import MESHES, check_file, read_mesh, read_text
from drake_dae.robots.surface import Pair, Surface, Vector, tangents

CELLS, BEYOND = 16, 3  # Bells along the longer side, and beyond each edge, for a fit there.
MOST_LENGTH = 1e9  # The largest height and length in m.
LEAST, CALM = np.logspace(-8, -2, 7), 1.5
"""Relative singular values below which the data do not determine a component. The smallest is taken
with which the surface stays near the plane beyond its edges: by CALM times the range of heights."""


@checked(ModelError)
@dataclass(frozen=True)
class MeasuredSurface(Surface):
    """Heights over a plane, phi = (z - h(x, y)) / sqrt(1 + h_x^2 + h_y^2) to first order, smoothed:

        h(x, y) = c_0 + c_1 x + c_2 y + sum_r a_r(x) b_r(y),

    a plane and sums a_r, b_r of bell curves, by least squares, with derivatives of all orders. z is
    along the normal, x and y along `tangents(normal)`. Beyond its edges the surface approaches the
    plane. Of a mesh it is the side that is seen along the normal, without holes and overhangs.

    Attributes:
        size: The lengths of the rectangle, m, shape (2,); None for all of a mesh.
        heights: Heights above the plane through `point`, shape (r, c), with rows along x.
        file: A file instead: a table (.csv), or a mesh for trimesh.
        point: The middle of a table, or the origin of a mesh, whose axes are the world's, m.
        normal: The direction of the heights and of the free side, of any length, shape (3,).
        scale: The length of a unit of the heights, or of the mesh, m.
        resolution: The distance of the bells, m, at first a sixteenth of a side; finer is smoothed.

    Raises:
        ModelError: There are no data, or they cannot be read; a mesh has a hole or an overhang.
    """

    size: Pair | None = None
    heights: ArrayLike | None = None
    file: str | Path | None = None
    point: Vector = (0.0, 0.0, 0.0)
    normal: Vector = (0.0, 0.0, 1.0)
    scale: float = 1.0
    resolution: float | None = None

    coordinate_signals: ClassVar = (Signal("along", "m"), Signal("across", "m"))

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.size is not None:
            lengths = vector("size", self.size, 2).tolist()
            object.__setattr__(self, "size", tuple(positive("size", length) for length in lengths))
        positive("scale", self.scale)
        if self.resolution is not None:
            positive("resolution", self.resolution)
        if (self.heights is None) == (self.file is None):
            raise ModelError("give either heights, row by row, or a file with them")
        if self.heights is not None:
            rows = _table("heights", self.heights).tolist()
            object.__setattr__(self, "heights", tuple(map(tuple, rows)))
        _ = self.fit  # Data that cannot be read are told here.

    @cached_property
    def fit(self) -> "_Fit":
        """The least-squares fit of the data."""
        if self.file is not None and Path(self.file).suffix.lower() in MESHES:
            x, y, heights = _mesh_heights(self, Path(self.file))
        else:
            if self.size is None:
                raise ModelError("a table of heights needs its size, two lengths in m")
            rows = self.heights if self.file is None else _read_table(Path(self.file))
            heights = self.scale * np.array(rows)
            counts = zip(self.size, heights.shape[::-1], strict=True)
            x, y = (length * np.linspace(-0.5, 0.5, count) for length, count in counts)
        if not (largest := float(np.max(np.abs(heights)))) <= MOST_LENGTH:
            raise ModelError(f"heights of {largest:.3g} m are no surface; is the scale right?")
        distance = max(x[1] - x[0], y[1] - y[0], max(np.ptp(x), np.ptp(y)) / CELLS)
        flat = np.stack([np.ones_like(heights), 0 * heights + x, 0 * heights + y[:, None]], axis=-1)
        plane = np.linalg.lstsq(flat.reshape(-1, 3), heights.ravel())[0].astype(float)
        rest = heights - flat @ plane
        places, widths, at, beyond = [], [], [], []
        for side in (x, y):
            length = side[-1] - side[0]
            count = max(ceil(length / (self.resolution or distance) - 1e-9), 1)
            widths.append(width := float(length / count))
            places.append(place := side[0] + width * np.arange(-BEYOND, count + BEYOND + 1))
            around = np.linspace(place[0] - 3 * width, place[-1] + 3 * width, 3 * place.size)
            at.append(_bells(side, place, width))
            beyond.append(_bells(around, place, width))
        spectra = [np.linalg.svd(bells, full_matrices=False) for bells in at]
        for least in LEAST:
            # Orthonormal values at the data, and the bells' factors for them.
            pairs = [(spectrum, spectrum[1] > least * spectrum[1][0]) for spectrum in spectra]
            basis_x, basis_y = (values[:, k] for (values, _, _), k in pairs)
            to_x, to_y = (factors[k].T / sizes[k] for (_, sizes, factors), k in pairs)
            shares = basis_y.T @ rest @ basis_x
            outside = beyond[1] @ (to_y @ shares @ to_x.T) @ beyond[0].T
            if np.max(np.abs(outside)) <= CALM * np.ptp(rest):
                break
        # In heights and not in factors, which magnify the round-off of the data a million times.
        left, sizes, right = np.linalg.svd(shares, full_matrices=False)
        a, b = to_x @ right.T, to_y @ (left * sizes)
        terms_a, terms_b = at[0] @ a, at[1] @ b
        # A wave along one axis takes one term; others are below the residual, or round-off.
        rms = float(np.sqrt(np.mean((rest - terms_b @ terms_a.T) ** 2)))
        added = np.max(np.abs(terms_a), axis=0) * np.max(np.abs(terms_b), axis=0)
        n = int(np.sum(np.cumsum(added[::-1])[::-1] > max(0.1 * rms, 1e-10 * float(np.ptp(rest)))))
        largest = float(np.max(np.abs(rest - terms_b[:, :n] @ terms_a[:, :n].T)))
        extent = np.column_stack([x[[0, -1]], y[[0, -1]]])
        return _Fit(extent, plane, places, widths, (a[:, :n], b[:, :n]), largest)

    def distance(self, offset: ca.SX) -> ca.SX:
        x, y = ca.vertsplit(self.coordinates(offset))
        height, slope_x, slope_y = self.fit.height(x, y)
        z = ca.dot(ca.DM(self.normal), offset)
        return (z - height) / ca.sqrt(1 + slope_x**2 + slope_y**2)

    def coordinates(self, offset: ca.SX) -> ca.SX:
        return ca.vertcat(*[ca.dot(ca.DM(t), offset) for t in tangents(self.normal)])

    @property
    def extent(self) -> FloatArray:
        return self.fit.extent

    @property
    def remark(self) -> str:
        source = f" '{Path(self.file).name}'" if self.file else ""
        off, width = 1e3 * self.fit.largest, 1e3 * max(self.fit.widths)
        smoothed = f"details finer than {width:.2g} mm are smoothed away"
        return f"MeasuredSurface{source} is off its data by at most {off:.2g} mm; {smoothed}"

    def _patch(
        self, center: FloatArray, size: float, rows: FloatArray, columns: FloatArray
    ) -> FloatArray:
        sides = zip(self.extent.T, (rows, columns), strict=True)
        x, y = (side.mean() + np.ptp(side) * part for side, part in sides)
        along, across = tangents(self.normal)
        level = x[:, None, None] * along + y[:, None] * across
        return level + self.fit.heights(x, y).T[..., None] * np.array(self.normal)


@dataclass(frozen=True, eq=False)
class _Fit:
    """A plane, and bells exp(-(x - x_j)^2 / 2 d^2), d apart: they span polynomials to 1e-8."""

    extent: FloatArray  # The first and last x and y of the data, shape (2, 2).
    plane: FloatArray  # c_0, c_1, c_2.
    places: Sequence[FloatArray]  # x_j, along x and along y.
    widths: Sequence[float]
    factors: Sequence[FloatArray]  # Of the bells in a_r, shape (kx, r), and b_r, shape (ky, r).
    largest: float  # The largest distance of the data from h.

    def height(self, x: ca.SX, y: ca.SX) -> tuple[ca.SX, ca.SX, ca.SX]:
        """h at a place, dh/dx and dh/dy."""
        sums: list[ca.SX] = []
        for i, value in enumerate((x, y)):
            off = (value - ca.DM(self.places[i])) / self.widths[i]
            bells = ca.exp(-(off**2) / 2)
            both = ca.horzcat(bells, -off / self.widths[i] * bells)
            sums += ca.horzsplit(ca.mtimes(ca.DM(self.factors[i].T), both))
        a, da, b, db = sums
        base, slope_x, slope_y = (float(c) for c in self.plane)
        height = base + slope_x * x + slope_y * y + ca.dot(a, b)
        return height, slope_x + ca.dot(da, b), slope_y + ca.dot(a, db)

    def heights(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """h on a grid, shape (len(y), len(x))."""
        bells = zip((x, y), self.places, self.widths, self.factors, strict=True)
        a, b = (_bells(values, places, width) @ factors for values, places, width, factors in bells)
        return self.plane[0] + self.plane[1] * x + self.plane[2] * y[:, None] + b @ a.T


def _bells(values: FloatArray, places: FloatArray, width: float) -> FloatArray:
    return np.asarray(np.exp(-(((values[:, None] - places) / width) ** 2) / 2))


def _read_table(file: Path) -> FloatArray:
    """The heights in a .csv file, first row lowest."""
    check_file(file, ModelError)
    try:
        if file.suffix.lower() != ".csv":
            raise ValueError("its name ends with neither")
        text = read_text(file)
        mark = next((mark for mark in ";\t," if mark in text), None)
        rows = np.loadtxt(text.splitlines(), delimiter=mark, ndmin=2)
    except (OSError, ValueError) as error:
        what = f"'{file.name}' is no table of heights (.csv) and no mesh ({', '.join(MESHES)})"
        raise ModelError(f"{what}: {brief(str(error))}") from None
    return _table(f"'{file.name}'", rows)


def _table(what: str, rows: ArrayLike) -> FloatArray:
    heights = numbers(what, rows)
    if heights.ndim != 2 or min(heights.shape) < 2:
        raise ModelError(f"{what}: heights are two rows of two at least, got {heights.shape}")
    for row, column in np.argwhere(~np.isfinite(heights))[:1] + 1:
        raise ModelError(f"{what}: row {row}, column {column} is no height")
    return heights


def _mesh_heights(surface: MeasuredSurface, file: Path) -> tuple[FloatArray, ...]:
    """Places x and y, and the heights of a mesh there, shape (len(y), len(x))."""
    vertices, triangles = read_mesh(file)
    axes = np.column_stack([*tangents(surface.normal), np.array(surface.normal)])
    vertices = surface.scale * vertices @ axes
    low, high = vertices[:, :2].min(axis=0), vertices[:, :2].max(axis=0)
    lengths = high - low if surface.size is None else np.array(surface.size)
    if not np.all((lengths > 0.0) & (lengths < MOST_LENGTH)):
        raise ModelError(f"the mesh is {show(lengths)} m wide, which is no surface of a robot")
    distance = surface.resolution or float(np.max(lengths)) / CELLS
    counts = [2 * max(ceil(n / distance), 4) + 1 for n in lengths]
    sides = zip((low + high) / 2, lengths, counts, strict=True)
    x, y = (middle + length * np.linspace(-0.5, 0.5, count) for middle, length, count in sides)
    corners, extent = vertices[triangles], float(np.max(np.ptp(vertices, axis=0)))
    edges = corners[:, 1:] - corners[:, :1]
    areas = edges[:, 0, 0] * edges[:, 1, 1] - edges[:, 0, 1] * edges[:, 1, 0]
    facing = areas * np.linalg.det(axes) / extent**2  # A reflection turns all triangles.
    seen = facing > 1e-12 if np.any(facing > 1e-12) else facing < -1e-12
    lowest, highest = (end(corners[..., 1], axis=1) for end in (np.min, np.max))
    heights, depth = np.empty((2, len(y), len(x)))
    for row, level in enumerate(y):
        crossed = seen & (lowest < level + 1e-9 * extent) & (highest > level - 1e-9 * extent)
        first, (one, other) = corners[crossed, 0], edges[crossed].swapaxes(0, 1)
        across, up = x[:, None] - first[:, 0], level - first[:, 1]
        s = (across * other[:, 1] - up * other[:, 0]) / areas[crossed]
        t = (one[:, 0] * up - one[:, 1] * across) / areas[crossed]
        inside = (s > -1e-9) & (t > -1e-9) & (s + t < 1 + 1e-9)
        found = first[:, 2] + s * one[:, 2] + t * other[:, 2]
        heights[row] = np.max(found, axis=1, initial=-np.inf, where=inside)
        depth[row] = heights[row] - np.min(found, axis=1, initial=np.inf, where=inside)
    hole = "has a hole; give a size that it covers"
    fold = "overlaps itself; choose another normal or size"
    for bad, what in ((np.isinf(heights), hole), (depth > 1e-6 * extent, fold)):
        for row, column in np.argwhere(bad)[:1]:
            place = show([x[column], y[row]])
            raise ModelError(f"at {place} m across the normal the mesh {what}")
    return x, y, heights
