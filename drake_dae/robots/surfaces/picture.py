"""The visible form of a surface."""

from dataclasses import dataclass

import numpy as np
from pydrake.geometry import Shape, SurfaceTriangle, TriangleSurfaceMesh
from pydrake.math import RigidTransform

from drake_dae.arrays import FloatArray


@dataclass(frozen=True, eq=False)
class PosedShape:
    """A form with a pose in the world.

    Attributes:
        form: A shape or a mesh of Drake.
        pose: The pose of the form's own frame.
    """

    form: Shape | TriangleSurfaceMesh
    pose: RigidTransform

    def moved(self, pose: RigidTransform) -> "PosedShape":
        """The same form with its world frame moved to a pose."""
        return PosedShape(self.form, pose @ self.pose)


def mesh_of_grid(points: FloatArray) -> TriangleSurfaceMesh:
    """Two triangles in each cell of a grid of points, m, shape (r, c, 3).

    A cell with a corner that is not finite is left out.
    """
    rows, columns = points.shape[:2]
    number = np.arange(rows * columns).reshape(rows, columns)
    a, b, c, d = (
        part.ravel()
        for part in (number[:-1, :-1], number[:-1, 1:], number[1:, 1:], number[1:, :-1])
    )
    flat = points.reshape(-1, 3)
    finite = np.all(np.isfinite(flat), axis=1)
    whole = finite[a] & finite[b] & finite[c] & finite[d]
    corners = np.vstack([np.column_stack([a, b, c])[whole], np.column_stack([a, c, d])[whole]])
    used, renumbered = np.unique(corners, return_inverse=True)
    triangles = [SurfaceTriangle(*map(int, row)) for row in renumbered.reshape(-1, 3)]
    return TriangleSurfaceMesh(triangles, list(flat[used]))
