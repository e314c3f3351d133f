"""Meshes of surfaces: what is drawn, and the layer that Drake's hydroelastic contact presses on."""

from dataclasses import dataclass

import numpy as np
from pydrake.common import MemoryFile
from pydrake.geometry import InMemoryMesh, Mesh, Shape, SurfaceTriangle, TriangleSurfaceMesh
from pydrake.math import RigidTransform

from drake_dae.arrays import FloatArray
from drake_dae.errors import ModelError
from drake_dae.trace.functions import TracedFunction

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


def facets_needed(grid: FloatArray) -> tuple[int, int]:
    """The numbers of facets along rows and columns of an even grid, from its curvature."""
    _check_whole(grid)
    counts = []
    for axis in (0, 1):
        bend = np.linalg.norm(np.diff(grid, 2, axis=axis), axis=-1).max() / 8.0
        cells = (grid.shape[axis] - 1) * (bend / _SAG) ** 0.5
        counts.append(int(np.clip(np.ceil(cells), _LEAST, _MOST)))
    return counts[0], counts[1]


def sides(facets: int, length: float, depth: float) -> FloatArray:
    """Places along a side, from -1/2 to 1/2 of its length, shape (facets + 3,)."""
    rim = _RIM * depth / length
    if not rim < 0.25:
        raise ModelError(
            f"a piece of {length:.3g} m is too short for a layer of {depth:g} m, whose rims take "
            f"{2 * _RIM * depth:.3g} m; use a smaller plant.thickness, or a larger plant.piece"
        )
    return np.concatenate([[-0.5], np.linspace(rim - 0.5, 0.5 - rim, facets + 1), [0.5]])


def layer_below(grid: FloatArray, surface: TracedFunction, depth: float) -> PosedShape:
    """A layer of tetrahedra below the points of a grid, shape (r, c, 3).

    The pressure of a hydroelastic mesh is linear in each tetrahedron, zero on its boundary, and the
    modulus where a vertex is farthest from it: at `depth` below the grid, so that it is that of a
    half space. One vertex is far below. `surface` gives distance and gradient at a point.
    """
    _check_whole(grid)
    flat = grid.reshape(-1, 3)
    normals = np.array([surface(point)[1] for point in flat])
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


def _check_whole(grid: FloatArray) -> None:
    if not np.all(np.isfinite(grid)):
        raise ModelError("the surface ends within the piece; use a smaller plant.piece")
