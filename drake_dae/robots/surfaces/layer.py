"""A layer of tetrahedra below a surface, for Drake's hydroelastic contact."""

from itertools import permutations

import numpy as np
from pydrake.common import MemoryFile
from pydrake.geometry import InMemoryMesh, Mesh
from pydrake.math import RigidTransform

from drake_dae.arrays import FloatArray
from drake_dae.dae import Indices
from drake_dae.errors import ModelError
from drake_dae.robots.surfaces.picture import PosedShape
from drake_dae.trace.functions import TracedFunction

_SAG = 2.5e-6
"""The wanted distance in m of a facet's edge from the surface."""

_MOST, _LEAST = 60, 4
"""The largest and the least number of facets along each side; 60 take some seconds."""

_RIM = 1.2
"""The width of the outermost facets, where the pressure falls, relative to the depth."""

_APEX = 2.0
"""The depth of the lowest vertex, relative to the longer side."""


def facets_needed(grid: FloatArray) -> tuple[int, int]:
    """The numbers of facets along the rows and the columns of a grid, from its curvature.

    Args:
        grid: Points on the surface, equally spaced along each side, shape (r, c, 3).

    Raises:
        ModelError: The surface ends within the grid.
    """
    _check_whole(grid)

    def count(points: FloatArray) -> int:
        bend = np.linalg.norm(np.diff(points, 2, axis=0), axis=-1).max() / 8.0
        cells = (len(points) - 1) * (bend / _SAG) ** 0.5
        return int(np.clip(np.ceil(cells), _LEAST, _MOST))

    return count(grid), count(grid.swapaxes(0, 1))


def sides(facets: int, length: float, depth: float) -> FloatArray:
    """Places along a side, from -1/2 to 1/2 of its length, shape (facets + 3,).

    The outermost facets are as wide as the layer is deep, so that the pressure is that of the
    surface everywhere else.

    Raises:
        ModelError: The side is too short for that.
    """
    rim = _RIM * depth / length
    if not rim < 0.25:
        raise ModelError(
            f"a piece of {length:.3g} m is too short for a layer of {depth:g} m, whose rims take "
            f"{2 * _RIM * depth:.3g} m; use a smaller plant.thickness, or a larger plant.piece"
        )
    inner = np.linspace(rim - 0.5, 0.5 - rim, facets + 1)
    return np.concatenate([[-0.5], inner, [0.5]])


def layer_below(grid: FloatArray, surface: TracedFunction, depth: float) -> PosedShape:
    """A layer below the points of a grid.

    The pressure of a hydroelastic mesh is linear in each tetrahedron, zero on its boundary, and the
    modulus where a vertex is farthest from it. Here these are the points at `depth` below the grid,
    so that the pressure is modulus times depth / thickness, as in a half space. They are joined to
    one vertex far below.

    Args:
        grid: Points on the surface, in m, shape (r, c, 3).
        surface: Point -> distance and its gradient.
        depth: The thickness of the compliant layer, in m.

    Raises:
        ModelError: There is no surface at some points, or it is too curved.
    """
    rows, columns = grid.shape[:2]
    _check_whole(grid)
    normals = np.array([surface(point)[1] for point in grid.reshape(-1, 3)]).reshape(grid.shape)
    middle, mean = grid.reshape(-1, 3).mean(axis=0), normals.reshape(-1, 3).mean(axis=0)
    longest = float(max(np.ptp(grid.reshape(-1, 3), axis=0)))
    apex = middle - _APEX * longest * mean / np.linalg.norm(mean)
    points = np.vstack([np.stack([grid, grid - depth * normals], axis=2).reshape(-1, 3), apex])
    number = np.arange(2 * rows * columns).reshape(rows, columns, 2)

    def corners(level: int) -> list[Indices]:
        """The corners of all cells, by the bits of row, column and level."""
        cut = [slice(None, -1), slice(1, None)]
        return [number[cut[k & 1], cut[k >> 1 & 1], k >> 2 & 1 or level].ravel() for k in range(8)]

    cell, below = corners(0), corners(1)
    ways = [np.cumsum([0, *way]).tolist() for way in permutations((1, 2, 4))]
    upper = [np.column_stack([cell[k] for k in way]) for way in ways]
    last = np.full(cell[0].size, len(points) - 1)
    lower = [np.column_stack([below[0], below[b], below[3], last]) for b in (1, 2)]
    tetrahedra = np.vstack([*upper, *lower])
    volumes = np.linalg.det(points[tetrahedra[:, 1:]] - points[tetrahedra[:, :1]])
    # The signs that they have without folds: those of the row, the column and the way down.
    parity = [np.linalg.det(np.eye(3)[[bit >> 1 for bit in np.diff(way)]]) for way in ways]
    down = np.linalg.det([grid[1, 0] - grid[0, 0], grid[0, 1] - grid[0, 0], -normals[0, 0]])
    signs = np.repeat([*parity, 1.0, -1.0], cell[0].size) * down
    if not np.all(volumes * signs > 0.0):
        raise ModelError(
            "the surface is too curved for one layer; give a smaller piece (plant.piece)"
        )
    turned = volumes < 0.0
    tetrahedra[turned] = tetrahedra[turned][:, [0, 2, 1, 3]]
    return PosedShape(_mesh(points, tetrahedra), RigidTransform())


def _check_whole(grid: FloatArray) -> None:
    if not np.all(np.isfinite(grid)):
        raise ModelError("the surface ends within the piece; use a smaller plant.piece")


def _mesh(points: FloatArray, tetrahedra: Indices) -> Mesh:
    lines = ["# vtk DataFile Version 3.0", "layer", "ASCII", "DATASET UNSTRUCTURED_GRID"]
    lines += [
        f"POINTS {len(points)} double",
        *(f"{x:.12g} {y:.12g} {z:.12g}" for x, y, z in points),
    ]
    lines += [f"CELLS {len(tetrahedra)} {5 * len(tetrahedra)}"]
    lines += ["4 " + " ".join(map(str, row)) for row in tetrahedra.tolist()]
    lines += [f"CELL_TYPES {len(tetrahedra)}", *["10"] * len(tetrahedra), ""]
    file = MemoryFile("\n".join(lines), ".vtk", "layer")
    return Mesh(mesh_data=InMemoryMesh(mesh_file=file))
