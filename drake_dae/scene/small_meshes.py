"""Meshes for pages that carry all that they draw: coarser ones in the place of large ones."""

import warnings
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from pydrake.common import MemoryFile
from pydrake.geometry import GeometryId, InMemoryMesh, Mesh, Role, SceneGraph, SourceId

from drake_dae.arrays import FloatArray
from drake_dae.errors import GeometryWarning, ModelError
from drake_dae.files import read_mesh

MOST_BYTES = 2 << 20
"""The largest size of all meshes of a page."""

_CELLS = (128, 96, 64, 48, 32, 24, 16, 12, 8, 6, 4)


def shrink_meshes(scene: SceneGraph, source: SourceId) -> None:
    """Replaces meshes that are drawn, so that all together have at most `MOST_BYTES`.

    A mesh is coarsened by joining the vertices in each cell of a grid. One that cannot be read is
    left out. A warning says so.

    Args:
        scene: The geometry; changed.
        source: The source of the meshes.
    """
    sizes = dict(sorted(_drawn_meshes(scene), key=lambda item: item[1]))
    total, left = sum(sizes.values()), MOST_BYTES
    if total <= MOST_BYTES:
        return
    changed = []
    for number, (geometry, size) in enumerate(sizes.items()):
        share = left // (len(sizes) - number)
        if size > share:
            mesh = scene.model_inspector().GetShape(geometry)
            file, size = Path(mesh.source().path()), 0
            text = _coarser(file, share)
            if text is None:
                scene.RemoveRole(source, geometry, Role.kIllustration)
            else:
                data = InMemoryMesh(mesh_file=MemoryFile(text, ".obj", file.name))
                scene.ChangeShape(source, geometry, Mesh(data, mesh.scale3()))
                size = len(text)
            changed.append(file.name)
        left -= size
    names = list(dict.fromkeys(changed))
    more = f" and {len(names) - 8} more" if len(names) > 8 else ""
    warnings.warn(
        f"meshes of {total / 2**20:.3g} MB are drawn coarser in the page, with "
        f"{(MOST_BYTES - left) / 2**20:.2g} MB: {', '.join(names[:8])}{more}",
        GeometryWarning,
        stacklevel=2,
    )


def _drawn_meshes(scene: SceneGraph) -> Iterator[tuple[GeometryId, int]]:
    """The meshes that are drawn, and the sizes of their files in bytes."""
    inspector = scene.model_inspector()
    for geometry in inspector.GetAllGeometryIds(Role.kIllustration):
        shape = inspector.GetShape(geometry)
        if isinstance(shape, Mesh) and shape.source().is_path():
            file = Path(shape.source().path())
            yield geometry, file.stat().st_size if file.is_file() else 0


def _coarser(file: Path, most: int) -> str | None:
    """The text of an .obj of at most so many bytes; None if the mesh cannot be read."""
    try:
        vertices, triangles = read_mesh(file)
    except ModelError:
        return None
    if file.suffix.lower() in (".gltf", ".glb"):  # In which y is upward.
        vertices = vertices @ np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
    for cells in _CELLS:
        points, faces = _clustered(vertices, triangles, cells)
        if 30 * len(points) + 15 * len(faces) > most:
            continue
        # No normals: Meshcat computes them.
        rows = ["v {:.5g} {:.5g} {:.5g}\n".format(*point) for point in points.tolist()]
        rows += ["f {} {} {}\n".format(*face) for face in (faces + 1).tolist()]
        text = "".join(rows)
        if len(text) <= most:
            return text
    return None


def _clustered(
    vertices: FloatArray, triangles: np.ndarray, cells: int
) -> tuple[FloatArray, np.ndarray]:
    """A mesh whose vertices in each cell of a grid are one, with so many cells along its length."""
    low = vertices.min(axis=0)
    size = float(np.ptp(vertices, axis=0).max()) / cells or 1.0
    places, cluster = np.unique(((vertices - low) / size).astype(int), axis=0, return_inverse=True)
    cluster = cluster.ravel()
    count = np.bincount(cluster, minlength=len(places))[:, None]
    points = np.column_stack(
        [np.bincount(cluster, column, minlength=len(places)) for column in vertices.T]
    )
    faces = cluster[triangles]
    first, second, third = faces.T
    kept = (first != second) & (second != third) & (third != first)
    return points / count, np.unique(faces[kept], axis=0)
