"""Checks from which files a robot's geometry is read.

Meshcat copies meshes, and the files that they name, into its HTML page. A model from an untrusted
source could name any file of this machine, and the page would disclose it.
"""

import json
import os
import re
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any
from urllib.parse import unquote

from pydrake.common import GetDrakePath
from pydrake.geometry import Role, SceneGraph

from drake_dae.errors import ModelError
from drake_dae.scenario.robot_file.readable.converted import ORIGINALS

# Matches more than the formats permit, since their parsers do: options and line ends before a name.
_MATERIAL_LIBRARY = re.compile(r"mtllib\s+([^\r\n]+)")
_TEXTURE = re.compile(r"(?:map_|bump|disp|decal|norm|refl)[^\r\n]*[\r\n]*[^\r\n]*", re.IGNORECASE)
_COLLADA_IMAGE = re.compile(r"<(?:\w+:)?(?:init_from|ref)\b[^>]*>\s*([^<]+?)\s*<")
_SCHEME = re.compile(r"[A-Za-z][A-Za-z0-9+.-]+:/")

_OUTSIDE = (
    "which is outside of the model's package or folder: it would be copied into the animation. "
    "Move it there, or name its folder under robot.packages"
)


def package_folder(model: Path) -> Path:
    """The folder from which a model's file may read: that of its package, or its own if in none."""
    folder = model.resolve().parent
    packages = (path for path in (folder, *folder.parents) if (path / "package.xml").is_file())
    return next(packages, folder)


def check_resources(scene_graph: SceneGraph, folders: Iterable[Path]) -> None:
    """Checks that meshes, textures and the files that they name are inside of some folders.

    Symbolic links are resolved. Drake's own packages are always allowed.

    Args:
        scene_graph: The scene graph with the geometry of the robot, not drawn yet.
        folders: The folders of the model and its packages.

    Raises:
        ModelError: A file is outside; the message has the link, the file, and the file it names.
    """
    allowed = [folder.resolve() for folder in (*folders, *_drake_folders())]
    inspector = scene_graph.model_inspector()
    for geometry in inspector.GetAllGeometryIds():
        body = inspector.GetName(inspector.GetFrameId(geometry)).split("::")[-1]
        source = getattr(inspector.GetShape(geometry), "source", None)
        files = []
        if source is not None and source().is_path():
            files.append(Path(source().path()))
        for role in (Role.kPerception, Role.kIllustration):
            properties = inspector.GetProperties(geometry, role)
            if properties is not None and properties.HasProperty("phong", "diffuse_map"):
                files.append(Path(properties.GetProperty("phong", "diffuse_map")))
        for file in files:
            file = ORIGINALS.get(file, file)
            if not _is_within(file, allowed):
                raise ModelError(f"link '{body}' names the file '{file}', {_OUTSIDE}")
            _check_references(body, file, allowed)


def _check_references(body: str, file: Path, allowed: list[Path]) -> None:
    """Checks the files that a file names, directly or through other files."""
    waiting, seen = [file], set()
    while waiting:
        current = waiting.pop()
        if current in seen or not current.is_file():
            continue
        seen.add(current)
        for name in _references(current):
            if name.lower().startswith("data:"):
                continue
            # Percent encoding is decoded by some parsers, and not by Drake's.
            for spelled in {name, unquote(name)}:
                target = current.parent / spelled
                if _SCHEME.match(spelled) or not _is_within(target, allowed):
                    raise ModelError(
                        f"link '{body}' has the mesh '{file}', in which '{current.name}' names "
                        f"'{name}', {_OUTSIDE}"
                    )
                waiting.append(target)


def _references(file: Path) -> Iterator[str]:
    """The names of files in a mesh or a material."""
    kind = file.suffix.lower()
    if kind not in (".gltf", ".obj", ".mtl", ".dae"):
        return
    text = file.read_bytes().decode("utf-8", errors="replace")
    if kind == ".gltf":
        try:
            yield from _uris(json.loads(text, object_pairs_hook=list))
        except (ValueError, RecursionError):
            raise ModelError(f"the mesh '{file}' is not JSON, as glTF has to be") from None
    elif kind == ".obj":
        for names in _MATERIAL_LIBRARY.findall(text):
            yield from {names.strip(), *names.split()}
    elif kind == ".mtl":
        for line in _TEXTURE.findall(text):
            yield from line.split()
    else:
        yield from _COLLADA_IMAGE.findall(text)


def _uris(data: Any) -> Iterator[str]:
    """The entries "uri" of buffers, images and extensions.

    Args:
        data: JSON, with objects as lists of (key, value): a key may occur twice.
    """
    if isinstance(data, tuple) and data[0] == "uri" and isinstance(data[1], str):
        yield data[1]
    elif isinstance(data, (list, tuple)):
        for part in data:
            yield from _uris(part)


def _is_within(file: Path, folders: list[Path]) -> bool:
    try:
        real = file.resolve()
    except (OSError, RuntimeError, ValueError):  # A cycle of symbolic links, or an invalid path.
        return False
    return any(real.is_relative_to(folder) for folder in folders)


def _drake_folders() -> Iterator[Path]:
    """The folders of Drake's packages, installed and downloaded."""
    yield Path(GetDrakePath())
    cache = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    yield Path(cache) / "drake" / "package_map"
