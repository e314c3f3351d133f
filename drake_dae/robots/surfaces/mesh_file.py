"""Meshes from files, and what rays along an axis see of them."""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydrake.geometry import ReadObjToTriangleSurfaceMesh

from drake_dae.arrays import FloatArray, brief, show
from drake_dae.errors import ModelError

Triangles = NDArray[np.int64]


def read_mesh(file: Path) -> tuple[FloatArray, Triangles]:
    """The vertices of a mesh, shape (n, 3), in its unit, and its triangles, shape (k, 3).

    Raises:
        ModelError: It cannot be read.
    """
    if file.suffix.lower() == ".obj":
        try:
            mesh = ReadObjToTriangleSurfaceMesh(str(file))
        except RuntimeError as error:
            raise ModelError(f"no mesh in '{file.name}': {brief(str(error))}") from None
        vertices = np.array([mesh.vertex(i) for i in range(mesh.num_vertices())])
        corners = [[triangle.vertex(i) for i in range(3)] for triangle in mesh.triangles()]
        return vertices, np.array(corners)
    try:
        import trimesh
    except ImportError:
        raise ModelError(
            f"'{file.name}': reading {file.suffix or 'it'} takes the package trimesh; "
            "pip install 'drake_dae[meshes]', or give the mesh as .obj"
        ) from None
    try:
        found: Any = trimesh.load(file, force="mesh")
        vertices, triangles = np.array(found.vertices), np.array(found.faces)
    except Exception as error:  # It has no exceptions of its own.
        raise ModelError(f"no mesh in '{file.name}': {brief(str(error))}") from None
    if triangles.size == 0 or not np.all(np.isfinite(vertices)):
        raise ModelError(f"no mesh in '{file.name}': it has no triangles, or no numbers")
    return vertices, triangles


def heights_of_mesh(
    vertices: FloatArray, triangles: Triangles, x: FloatArray, y: FloatArray
) -> FloatArray:
    """The height of a mesh over each point of a grid, shape (len(y), len(x)).

    Args:
        vertices: Vertices in m, the last coordinate upward, shape (n, 3).
        triangles: The vertices of each triangle, shape (k, 3).
        x: Where the columns are, m, increasing.
        y: Where the rows are, m, increasing.

    Raises:
        ModelError: The mesh is not there, or lies over itself.
    """
    corners = vertices[triangles]
    edges = corners[:, 1:, :2] - corners[:, :1, :2]
    areas = edges[:, 0, 0] * edges[:, 1, 1] - edges[:, 0, 1] * edges[:, 1, 0]
    extent = float(np.max(np.ptp(vertices, axis=0)))
    upward = areas > 1e-12 * extent**2
    if not upward.any():  # A sheet whose triangles go the other way round.
        upward = areas < -1e-12 * extent**2
    lowest = np.full((len(y), len(x)), np.inf)
    highest = -lowest
    slack = 1e-9 * extent
    low, high = corners[..., :2].min(axis=1) - slack, corners[..., :2].max(axis=1) + slack
    first_x, last_x = np.searchsorted(x, low[:, 0]), np.searchsorted(x, high[:, 0], "right")
    first_y, last_y = np.searchsorted(y, low[:, 1]), np.searchsorted(y, high[:, 1], "right")
    for k in np.flatnonzero(upward & (first_x < last_x) & (first_y < last_y)):
        part = slice(first_y[k], last_y[k]), slice(first_x[k], last_x[k])
        along, across = np.meshgrid(x[part[1]], y[part[0]])
        offset = np.stack([along, across], axis=-1) - corners[k, 0, :2]
        (ax, ay), (bx, by) = edges[k]
        first = (offset[..., 0] * by - offset[..., 1] * bx) / areas[k]
        second = (ax * offset[..., 1] - ay * offset[..., 0]) / areas[k]
        inside = (first > -1e-9) & (second > -1e-9) & (first + second < 1 + 1e-9)
        rise = corners[k, 1:, 2] - corners[k, 0, 2]
        height = corners[k, 0, 2] + first * rise[0] + second * rise[1]
        lowest[part] = np.where(inside, np.minimum(lowest[part], height), lowest[part])
        highest[part] = np.where(inside, np.maximum(highest[part], height), highest[part])
    _refuse(
        ~np.isfinite(lowest),
        x,
        y,
        "the mesh is not below; choose a rectangle that it covers, by middle and size",
    )
    _refuse(
        highest - lowest > 1e-6 * extent,
        x,
        y,
        "the mesh lies over itself and has no single height; choose another normal, or a rectangle "
        "without the overhang, by middle and size",
    )
    return highest


def _refuse(bad: NDArray[np.bool_], x: FloatArray, y: FloatArray, what: str) -> None:
    places = np.argwhere(bad)
    if places.size:
        row, column = places[len(places) // 2]
        place = show([x[column], y[row]])
        raise ModelError(f"at {place} m along the axes across the normal {what}")
