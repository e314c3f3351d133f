"""Meshes for pages that carry all that they draw: coarser ones in the place of large ones."""

import warnings
from pathlib import Path

import numpy as np
from pydrake.common import MemoryFile
from pydrake.geometry import InMemoryMesh, Mesh, Role, SceneGraph, SourceId

from drake_dae.arrays import listed
from drake_dae.errors import GeometryWarning, ModelError
from drake_dae.files import read_mesh

MOST_BYTES = 2 << 20  # of all meshes of a page

_CELLS = (128, 96, 64, 48, 32, 24, 16, 12, 8, 6, 4)


def shrink_meshes(scene: SceneGraph, source: SourceId) -> None:
    """Draws meshes of a source coarser, to `MOST_BYTES` together; leaves out what is unreadable."""
    inspector, sizes = scene.model_inspector(), {}
    for geometry in inspector.GetAllGeometryIds(Role.kIllustration):
        shape = inspector.GetShape(geometry)
        if isinstance(shape, Mesh) and shape.source().is_path():
            file = Path(shape.source().path())
            sizes[geometry] = file.stat().st_size if file.is_file() else 0
    total, left, changed = sum(sizes.values()), MOST_BYTES, dict[str, None]()
    if total <= MOST_BYTES:
        return
    for number, geometry in enumerate(sorted(sizes, key=lambda each: sizes[each])):
        size, share = sizes[geometry], left // (len(sizes) - number)
        if size > share:
            mesh = inspector.GetShape(geometry)
            file, size = Path(mesh.source().path()), 0
            text = _coarser(file, share)
            if text is None:
                scene.RemoveRole(source, geometry, Role.kIllustration)
            else:
                data = InMemoryMesh(mesh_file=MemoryFile(text, ".obj", file.name))
                scene.ChangeShape(source, geometry, Mesh(data, mesh.scale3()))
                size = len(text)
            changed[file.name] = None
        left -= size
    warnings.warn(
        f"meshes of {total / 2**20:.3g} MB are drawn coarser in the page, with "
        f"{(MOST_BYTES - left) / 2**20:.2g} MB: {listed(changed)[1:-1]}",
        GeometryWarning,
        stacklevel=2,
    )


def _coarser(file: Path, most: int) -> str | None:
    """The text of an .obj of at most so many bytes, or None: the vertices in a grid's cell join."""
    try:
        vertices, triangles = read_mesh(file)
    except ModelError:
        return None
    if file.suffix.lower() in (".gltf", ".glb"):  # In which y is upward.
        vertices = vertices @ np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
    low, length = vertices.min(axis=0), float(np.ptp(vertices, axis=0).max())
    for cells in _CELLS:
        places = ((vertices - low) / (length / cells or 1.0)).astype(int)
        _, cluster, count = np.unique(places, axis=0, return_inverse=True, return_counts=True)
        cluster = cluster.ravel()
        points = np.column_stack([np.bincount(cluster, x) / count for x in vertices.T])
        a, b, c = cluster[triangles].T
        faces = np.unique(cluster[triangles][(a != b) & (b != c) & (c != a)], axis=0) + 1
        if 30 * len(points) + 15 * len(faces) > most:
            continue
        # No normals: Meshcat computes them.
        rows = ["v {:.5g} {:.5g} {:.5g}\n".format(*point) for point in points.tolist()]
        text = "".join([*rows, *("f {} {} {}\n".format(*face) for face in faces.tolist())])
        if len(text) <= most:
            return text
    return None
