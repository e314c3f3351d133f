"""Mesh files, written by hand."""

from pathlib import Path

import numpy as np


def obj_of_grid(file: Path, x, y, heights) -> Path:
    """A sheet of two triangles in each cell of a grid, their fronts upward."""
    count = len(x)
    lines = [f"v {a} {b} {heights[j][i]}" for j, b in enumerate(y) for i, a in enumerate(x)]
    for j in range(len(y) - 1):
        for i in range(count - 1):
            a = j * count + i + 1
            lines += [f"f {a} {a + 1} {a + count + 1}", f"f {a} {a + count + 1} {a + count}"]
    file.write_text("\n".join(lines) + "\n")
    return file


def stl_of(file: Path, vertices, triangles) -> Path:
    """Triangles as a text in STL."""
    lines = ["solid s"]
    for triangle in triangles:
        lines += ["facet normal 0 0 0", "outer loop"]
        lines += [f"vertex {x} {y} {z}" for x, y, z in np.asarray(vertices)[list(triangle)]]
        lines += ["endloop", "endfacet"]
    file.write_text("\n".join([*lines, "endsolid s"]) + "\n")
    return file
