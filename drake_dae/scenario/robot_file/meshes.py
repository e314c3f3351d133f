"""The meshes of a robot: which of its files may be read, and copies that can be drawn.

Meshcat copies meshes, and the files that they name, into its HTML page. A model from an untrusted
source could name any file of this machine, and the page would disclose it. So only files inside the
model's folder or package are read, and of packages that the user names.

Drake's renderer draws .obj and .gltf; its Meshcat draws .dae as well. So a .dae becomes a .gltf,
with its own colors and textures, and any other mesh an .obj, by the optional package trimesh.
"""

import json
import re
import warnings
from collections.abc import Iterable, Iterator
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any
from urllib.parse import unquote

import numpy as np
from pydrake.geometry import Mesh

from drake_dae.errors import ModelError
from drake_dae.files import check_file, read_mesh
from drake_dae.scenario.robot_file.xml_tree import read_xml

DRAWN: tuple[str, ...] = (".obj", ".gltf")
"""The kinds of mesh that Drake draws everywhere."""

_UPWARD = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
"""The transformation from z upward to y upward, the convention of .gltf."""

# Matches more than the formats permit, since their parsers do: options and line ends before a name.
_MATERIAL_LIBRARY = re.compile(r"mtllib\s+([^\r\n]+)")
_TEXTURE = re.compile(r"(?:map_|bump|disp|decal|norm|refl)[^\r\n]*[\r\n]*[^\r\n]*", re.IGNORECASE)


def is_within(file: Path, folders: Iterable[Path]) -> bool:
    """Whether a file is in one of some folders; symbolic links are resolved."""
    try:
        real = file.resolve()
    except (OSError, RuntimeError, ValueError):  # A cycle of symbolic links, or an invalid path.
        return False
    return any(real.is_relative_to(folder.resolve()) for folder in folders)


def all_within(file: Path, folders: Iterable[Path]) -> bool:
    """Whether a file, and those that it names directly or through others, are in some folders."""
    folders = list(folders)
    waiting, checked = [file], set[Path]()
    while waiting:
        current = waiting.pop()
        if not is_within(current, folders):
            return False
        if current in checked or not current.is_file():
            continue
        checked.add(current)
        for name in _references(current):
            # Percent encoding is decoded by some parsers, and not by Drake's.
            for spelled in {name, unquote(name)} if not name.lower().startswith("data:") else ():
                if re.match(r"[A-Za-z][\w+.-]+:/", spelled):
                    return False
                waiting.append(current.parent / spelled)
    return True


def _references(file: Path) -> Iterator[str]:
    """The names of files in a mesh or a material."""
    kind = file.suffix.lower()
    if kind == ".dae":
        try:
            tree = read_xml(file)
        except ModelError:
            return
        for node in tree.iter():
            if node.tag.split(":")[-1] in ("init_from", "ref"):
                yield (node.text or "").strip()
    elif kind in (".gltf", ".obj", ".mtl"):
        check_file(file, ModelError)
        text = file.read_bytes().decode("utf-8", errors="replace")
        if kind == ".gltf":
            try:  # As lists of (key, value), since a key may occur twice.
                yield from _uris(json.loads(text, object_pairs_hook=list))
            except (ValueError, RecursionError):
                yield "/"  # Nobody knows what it names.
        elif kind == ".obj":
            for names in _MATERIAL_LIBRARY.findall(text):
                yield from {names.strip(), *names.split()}
        else:
            for line in _TEXTURE.findall(text):
                yield from line.split()


def _uris(data: Any) -> Iterator[str]:
    """The entries "uri" of buffers, images and extensions."""
    if isinstance(data, tuple) and data[0] == "uri" and isinstance(data[1], str):
        yield data[1]
    elif isinstance(data, (list, tuple)):
        for part in data:
            yield from _uris(part)


def has_hull(mesh: Path) -> bool:
    """Whether Drake can compute the convex hull that a collision needs."""
    try:
        Mesh(str(mesh)).GetConvexHull()
    except RuntimeError:
        return False
    return True


def drawable(mesh: Path, kinds: tuple[str, ...] = DRAWN) -> Path | None:
    """A mesh, or a copy until Python exits, of a kind that is drawn; None if there is none."""
    if mesh.suffix.lower() in kinds:
        return mesh
    try:
        name, changed, size = check_file(mesh.resolve(), ModelError)
        is_scene = mesh.suffix.lower() == ".dae" and ".gltf" in kinds
        return _converted(Path(name), ".gltf" if is_scene else ".obj", changed, size)
    except ModelError:  # Meshcat draws a .dae.
        return mesh if mesh.suffix.lower() == ".dae" and ".gltf" in kinds else None


@cache
def _converted(mesh: Path, kind: str, changed: int, size: int) -> Path:
    text = _gltf(mesh) if kind == ".gltf" else _obj(mesh)
    folder = Path(_folder().name).resolve()
    copy = folder / str(len(list(folder.iterdir()))) / f"{mesh.stem}{kind}"
    copy.parent.mkdir()
    copy.write_bytes(text)
    return copy


@cache
def _folder() -> "TemporaryDirectory[str]":
    return TemporaryDirectory(prefix="drake_dae_meshes_")


def _obj(mesh: Path) -> bytes:
    """The text of an .obj, with the normal of each triangle, which Drake's renderer needs."""
    vertices, triangles = read_mesh(mesh)
    corners = vertices[triangles]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    normals /= np.where(lengths > 0.0, lengths, 1.0)
    numbers = np.arange(1, len(triangles) + 1)[:, None]
    faces = np.dstack([triangles + 1, np.broadcast_to(numbers, triangles.shape)])
    tables = (
        ("v %.9g %.9g %.9g\n", vertices),
        ("vn %.5g %.5g %.5g\n", normals),
        ("f %d//%d %d//%d %d//%d\n", faces),
    )
    return "".join(
        row * len(table) % tuple(table.ravel().tolist()) for row, table in tables
    ).encode()


def _gltf(mesh: Path) -> bytes:
    """The .gltf in m of a .dae. As in ROS, the unit counts, and the upward axis does not."""
    if find_spec("collada") is None or find_spec("trimesh") is None:
        raise ModelError(f"'{mesh.name}': pip install 'drake_dae[meshes]' converts it")
    import trimesh

    units = [node for node in read_xml(mesh).iter() if node.tag.split(":")[-1] == "unit"]
    try:
        unit = float(units[0].get("meter", "1")) if units else 1.0
        with warnings.catch_warnings():
            # pycollada sets the shape of arrays, which NumPy 2.5 deprecates.
            warnings.simplefilter("ignore", DeprecationWarning)
            scene: Any = trimesh.load_scene(mesh)
        if scene.is_empty:
            raise ModelError(f"no mesh in '{mesh.name}'")
        scene.apply_transform(_UPWARD @ np.diag([unit, unit, unit, 1.0]))
        written: Any = scene.export(file_type="gltf", merge_buffers=True, embed_buffers=True)
        return bytes(written["model.gltf"])
    except Exception as error:  # Neither package has exceptions of its own.
        raise ModelError(f"no mesh in '{mesh.name}': {error}") from None
