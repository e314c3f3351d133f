"""Converts meshes that Drake cannot read, or not draw everywhere, by the optional package trimesh.

Drake's renderer draws .obj and .gltf; its Meshcat draws .dae as well. So a .dae is converted to a
.gltf, with its own colors and textures, and any other mesh to an .obj, which gets the color that
the robot's file states.
"""

import re
import warnings
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from drake_dae.errors import ModelError
from drake_dae.robots.surfaces.measured import read_mesh

ORIGINALS: dict[Path, Path] = {}
"""A converted mesh -> its original."""

_UPWARD = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
"""The transformation from z upward to y upward, the convention of .gltf."""

_UNIT = re.compile(rb"<unit\b[^>]*?\bmeter\s*=\s*[\"']\s*([-+.0-9eE]+)")


def as_obj(mesh: Path) -> Path | None:
    """Converts a mesh to an .obj in the same unit, in a file that is removed when Python exits.

    Returns:
        The file; None if the mesh cannot be read, or trimesh is not installed.
    """
    return _copy(mesh, ".obj")


def as_gltf(mesh: Path) -> Path | None:
    """Converts a .dae to a .gltf in m with its colors, in a file that is removed at exit.

    As in ROS, the unit in the file is used, and the upward axis in the file is ignored.

    Returns:
        The file; None if the mesh cannot be read, or trimesh or pycollada is not installed.
    """
    return _copy(mesh, ".gltf")


def _copy(mesh: Path, kind: str) -> Path | None:
    try:
        status = mesh.resolve().stat()
    except (OSError, ValueError):
        return None
    return _converted(mesh.resolve(), kind, status.st_mtime_ns, status.st_size)


@cache
def _converted(mesh: Path, kind: str, changed: int, size: int) -> Path | None:
    try:
        text = _gltf(mesh) if kind == ".gltf" else _obj(mesh)
    except ModelError:
        return None
    copy = Path(_folder().name).resolve() / str(len(ORIGINALS)) / f"{mesh.stem}{kind}"
    copy.parent.mkdir()
    copy.write_bytes(text)
    ORIGINALS[copy] = mesh
    return copy


def _obj(mesh: Path) -> bytes:
    """The text of an .obj, with the normal of each triangle, which Drake's renderer needs."""
    vertices, triangles = read_mesh(mesh)
    corners = vertices[triangles]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    normals /= np.where(lengths > 0.0, lengths, 1.0)
    rows = [
        *("v {:.9g} {:.9g} {:.9g}\n".format(*vertex) for vertex in vertices.tolist()),
        *("vn {:.5g} {:.5g} {:.5g}\n".format(*normal) for normal in normals.tolist()),
        *(
            f"f {i}//{number} {j}//{number} {k}//{number}\n"
            for number, (i, j, k) in enumerate((triangles + 1).tolist(), start=1)
        ),
    ]
    return "".join(rows).encode("ascii")


def _gltf(mesh: Path) -> bytes:
    if find_spec("collada") is None or find_spec("trimesh") is None:
        raise ModelError(f"'{mesh.name}': pip install 'drake_dae[meshes]' converts it")
    import trimesh

    try:
        with warnings.catch_warnings():
            # pycollada sets the shape of arrays, which NumPy 2.5 deprecates.
            warnings.simplefilter("ignore", DeprecationWarning)
            scene: Any = trimesh.load_scene(mesh)
        if scene.is_empty:
            raise ModelError(f"no mesh in '{mesh.name}'")
        unit = _UNIT.search(mesh.read_bytes())
        scene.apply_transform(_UPWARD @ np.diag([*[float(unit[1]) if unit else 1.0] * 3, 1.0]))
        written: Any = scene.export(file_type="gltf", merge_buffers=True, embed_buffers=True)
        return bytes(written["model.gltf"])
    except Exception as error:  # Neither package has exceptions of its own.
        raise ModelError(f"no mesh in '{mesh.name}': {error}") from None


@cache
def _folder() -> "TemporaryDirectory[str]":
    return TemporaryDirectory(prefix="drake_dae_meshes_")
