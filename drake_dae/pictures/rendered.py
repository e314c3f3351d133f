"""Conversion of shapes for Drake's renderer."""

import numpy as np
from pydrake.common import MemoryFile
from pydrake.geometry import InMemoryMesh, Mesh, Shape, TriangleSurfaceMesh


def rendered(form: Shape | TriangleSurfaceMesh) -> Shape:
    """Returns a shape that Drake renders; a triangle mesh becomes an .obj file in memory."""
    if isinstance(form, Shape):
        return form
    points = np.array(form.vertices())
    faces = np.array([[triangle.vertex(k) for k in range(3)] for triangle in form.triangles()])
    # The renderer needs normals at the vertices: the mean of the adjacent triangles' normals.
    corners, normals = points[faces], np.zeros_like(points)
    for k in range(3):
        edges = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
        np.add.at(normals, faces[:, k], np.cross(*edges))
    rows = [
        *("v {:.9g} {:.9g} {:.9g}".format(*point) for point in points),
        *("vn {:.9g} {:.9g} {:.9g}".format(*normal) for normal in normals),
        *("f " + " ".join(f"{k}//{k}" for k in face) for face in faces + 1),
    ]
    text = "\n".join(rows)
    return Mesh(InMemoryMesh(mesh_file=MemoryFile(text, ".obj", "surface")))
