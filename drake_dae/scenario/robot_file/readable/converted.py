"""Meshes that Drake neither reads nor draws, converted to .obj by the optional package trimesh."""

from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

from drake_dae.errors import ModelError
from drake_dae.robots.surfaces.mesh_file import read_mesh

ORIGINALS: dict[Path, Path] = {}
"""A converted mesh -> its original."""


def as_obj(mesh: Path) -> Path | None:
    """The mesh as an .obj in the same unit, in a file that lasts as long as this process.

    Returns:
        The file; None if the mesh cannot be read, or trimesh is not installed.
    """
    try:
        found = mesh.resolve().stat()
    except (OSError, ValueError):
        return None
    return _converted(mesh.resolve(), found.st_mtime_ns, found.st_size)


@cache
def _converted(mesh: Path, changed: int, size: int) -> Path | None:
    try:
        vertices, triangles = read_mesh(mesh)
    except ModelError:
        return None
    copy = Path(_folder().name).resolve() / str(len(ORIGINALS)) / f"{mesh.stem}.obj"
    copy.parent.mkdir()
    places = (f"v {x:.9g} {y:.9g} {z:.9g}\n" for x, y, z in vertices.tolist())
    corners = (f"f {i} {j} {k}\n" for i, j, k in (triangles + 1).tolist())
    copy.write_text("".join((*places, *corners)), "ascii")
    ORIGINALS[copy] = mesh
    return copy


@cache
def _folder() -> "TemporaryDirectory[str]":
    return TemporaryDirectory(prefix="drake_dae_meshes_")
