"""Meshes from files, and their heights along an axis."""

import re
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydrake.geometry import ReadObjToTriangleSurfaceMesh

from drake_dae.arrays import FloatArray, brief, number_in, show
from drake_dae.errors import ModelError, describe_os_error
from drake_dae.files import read_bytes

Triangles = NDArray[np.int64]


def read_mesh(file: Path) -> tuple[FloatArray, Triangles]:
    """The vertices of a mesh, shape (n, 3), in its unit, and its triangles, shape (k, 3).

    Raises:
        ModelError: It cannot be read.
    """
    try:
        read_bytes(file)  # A pipe or a device would block the readers below.
    except OSError as error:
        raise ModelError(describe_os_error(error)) from None
    is_obj = file.suffix.lower() == ".obj"
    vertices, triangles = _read_obj(file) if is_obj else _read_other(file)
    if triangles.size == 0 or not np.all(np.isfinite(vertices)):
        raise ModelError(f"no mesh in '{file.name}': it has no triangles, or no numbers")
    named = triangles.min(), triangles.max()
    if named[0] < 0 or named[1] >= len(vertices):
        raise ModelError(
            f"no mesh in '{file.name}': a triangle names a vertex beyond the {len(vertices)} there "
            "are"
        )
    return vertices, triangles


def _read_obj(file: Path) -> tuple[FloatArray, Triangles]:
    """An .obj file, read by Drake."""
    check_obj(file)
    try:
        mesh = ReadObjToTriangleSurfaceMesh(str(file))
    except (RuntimeError, SystemExit) as error:  # SystemExit for an assertion in Drake.
        raise ModelError(f"no mesh in '{file.name}': {brief(str(error))}") from None
    vertices = np.array([mesh.vertex(i) for i in range(mesh.num_vertices())], dtype=float)
    corners = [[triangle.vertex(i) for i in range(3)] for triangle in mesh.triangles()]
    return vertices, np.array(corners, dtype=np.int64)


def check_obj(file: Path) -> None:
    """Refuses an .obj file that Drake would read wrongly or crash on.

    Drake reads an invalid coordinate as zero, and does not check the range of indices.

    Raises:
        ModelError: A coordinate is not a finite number, or a face has an invalid vertex.
    """
    lines = read_bytes(file).decode("utf-8", errors="replace").split("\n")
    rows = [(number, line.split()) for number, line in enumerate(lines, start=1)]
    total = sum(words[:1] == ["v"] for _, words in rows)
    count = 0
    for number, words in rows:
        if words[:1] == ["v"]:
            count += 1
            if len(words) < 4 or any(number_in(word) is None for word in words[1:4]):
                text = f"a vertex has three numbers, got {brief(' '.join(words))}"
                raise ModelError(f"no mesh in '{file.name}': line {number}: {text}")
        elif words[:1] == ["f"]:
            for word in words[1:]:
                if not _is_vertex(word.split("/")[0], count, total):
                    text = f"a face names vertex '{word[:20]}' of {total}"
                    raise ModelError(f"no mesh in '{file.name}': line {number}: {text}")


def _is_vertex(word: str, before: int, total: int) -> bool:
    """Whether a vertex of a face is a valid index, from 1 or back from -1."""
    if not re.fullmatch(r"-?[0-9]{1,9}", word):
        return False
    return 1 <= int(word) <= total or -before <= int(word) <= -1


def _read_other(file: Path) -> tuple[FloatArray, Triangles]:
    """A file, read by the package trimesh."""
    try:
        import trimesh
    except ImportError:
        raise ModelError(
            f"'{file.name}': reading {file.suffix or 'it'} takes the package trimesh; "
            "pip install 'drake_dae[meshes]', or give the mesh as .obj"
        ) from None
    try:
        mesh: Any = trimesh.load(file, force="mesh")
        return np.array(mesh.vertices), np.array(mesh.faces)
    except Exception as error:  # trimesh has no exceptions of its own.
        raise ModelError(f"no mesh in '{file.name}': {brief(str(error))}") from None


def heights_of_mesh(
    vertices: FloatArray, triangles: Triangles, x: FloatArray, y: FloatArray
) -> FloatArray:
    """The height of a mesh over each point of a grid, shape (len(y), len(x)).

    Args:
        vertices: Vertices in m, the last coordinate upward, shape (n, 3).
        triangles: The vertices of each triangle, shape (k, 3).
        x: The coordinates of the columns, m, increasing.
        y: The coordinates of the rows, m, increasing.

    Raises:
        ModelError: The mesh does not cover a point, or has an overhang.
    """
    corners = vertices[triangles]
    edges = corners[:, 1:, :2] - corners[:, :1, :2]
    areas = edges[:, 0, 0] * edges[:, 1, 1] - edges[:, 0, 1] * edges[:, 1, 0]
    extent = float(np.max(np.ptp(vertices, axis=0)))
    upward = areas > 1e-12 * extent**2
    if not upward.any():  # A sheet with triangles of the opposite orientation.
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
        "the mesh overlaps itself and has no unique height; choose another normal, or a "
        "rectangle without the overhang, by middle and size",
    )
    return highest


def _refuse(bad: NDArray[np.bool_], x: FloatArray, y: FloatArray, what: str) -> None:
    places = np.argwhere(bad)
    if places.size:
        row, column = places[len(places) // 2]
        place = show([x[column], y[row]])
        raise ModelError(f"at {place} m along the axes across the normal {what}")
