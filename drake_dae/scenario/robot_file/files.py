"""The files that a robot's files name: packages as ROS finds them, and meshes that can be drawn.

Meshcat copies meshes, and the files that they name, into its HTML page. A model from an untrusted
source could name any file of this machine, and the page would disclose it. So geometry is read from
the model's folder and packages alone, and from folders that the user names.

Drake's renderer draws .obj and .gltf; its Meshcat draws .dae as well. So a .dae becomes a .gltf,
with its own colors and textures, and any other mesh an .obj, by the optional package trimesh.
"""

import atexit
import json
import os
import warnings
from collections.abc import Iterator
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any
from urllib.parse import unquote

import numpy as np
from pydrake.common import GetDrakePath
from pydrake.multibody.parsing import PackageMap

from drake_dae.errors import ModelError
from drake_dae.files import check_file, read_mesh
from drake_dae.scenario.form import at
from drake_dae.scenario.robot_file.robot import Robot
from drake_dae.scenario.robot_file.xml_tree import read_xml
from drake_dae.scenario.shipped import FOLDER


class RobotFiles:
    """The file of a robot, and those that it names.

    A package is a folder above the file that names it, or a folder of its name in one of these,
    if it has a package.xml with the name; or it is in ROS_PACKAGE_PATH or AMENT_PREFIX_PATH. What
    is found is added to the `packages` of Drake's parser.
    """

    def __init__(self, robot: Robot, packages: PackageMap) -> None:
        self.missing: set[str] = set()
        self.packages = packages
        packages.AddPackageXml(str(FOLDER / "models" / "package.xml"))
        for name, folder in robot.packages.items():
            with at(f"robot.packages.{name}"):
                try:
                    packages.Add(name, folder)
                except RuntimeError as error:
                    raise ModelError(f"no package in '{folder}': {error}") from None
        cache_folder = os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")
        self._folders = [FOLDER / "models", *map(Path, robot.packages.values())]
        self._folders += [Path(GetDrakePath()), Path(cache_folder) / "drake" / "package_map"]
        main = Path(robot.file)
        if "://" in robot.file:
            main = self.needed(robot.file, Path())
        if "\0" in str(main) or not main.is_file():
            raise ModelError(
                f"no file '{main}'; a relative path starts in the scenario's folder, that of a "
                "shipped scenario in the working directory"
            )
        own = main.resolve().parent
        inside = (path for path in (own, *own.parents) if (path / "package.xml").is_file())
        self._folders.append(next(inside, own))
        self.main = main

    def find(self, name: str, file: Path) -> Path | None:
        """The path of a URL or a name in a file; None if its package is unknown."""
        scheme, _, rest = name.rpartition("://")
        if not scheme:
            return file.resolve().parent / name
        if scheme == "file":
            return Path(unquote(rest))
        rest = rest.lstrip("/")
        package = rest.split("/")[0]
        if scheme not in ("package", "model") or package in self.missing:
            return None
        if not self.packages.Contains(package):
            folder = self._folder_of(package, file)
            if folder is None:
                self.missing.add(package)
                return None
            self.packages.Add(package, str(folder))
            self._folders.append(folder)
        try:
            return Path(self.packages.ResolveUrl(f"package://{rest}"))
        except RuntimeError:
            return None

    def _folder_of(self, package: str, file: Path) -> Path | None:
        for above in file.resolve().parents if file.name else ():
            for folder in (above, above / package):
                if _package_name(folder) == package:
                    return folder
        ros = PackageMap.MakeEmpty()
        if os.environ.get("ROS_PACKAGE_PATH"):
            ros.PopulateFromRosPackagePath()
        if os.environ.get("AMENT_PREFIX_PATH"):
            ros.PopulateFromEnvironment("AMENT_PREFIX_PATH")
        return Path(ros.GetPath(package)) if ros.Contains(package) else None

    def needed(self, name: str, file: Path) -> Path:
        """The path of a URL or a name in a file."""
        path = self.find(name, file)
        if path is None:
            package = name.split("://")[-1].split("/")[0]
            raise ModelError(
                f"unknown package '{package}' in '{name}': it is neither beside the file, as a "
                "folder with a package.xml, nor in ROS_PACKAGE_PATH or AMENT_PREFIX_PATH; name its "
                f"folder under robot.packages, as packages: {{{package}: <folder>}}, so that "
                f"package://{package}/a is <folder>/a"
            )
        return path

    def holds(self, file: Path) -> bool:
        """Whether a file, and those that it names directly or through others, are of the robot."""
        folders = [folder.resolve() for folder in self._folders]
        waiting, checked = [file], set[Path]()
        while waiting:
            current = waiting.pop()
            try:
                real = current.resolve()
                is_file = current.is_file()
            except (OSError, RuntimeError, ValueError):  # A cycle of links, or an invalid path.
                return False
            if not any(real.is_relative_to(folder) for folder in folders):
                return False
            if is_file and current not in checked:
                checked.add(current)
                for name in _references(current):
                    # Percent encoding is decoded by some parsers, and not by Drake's.
                    spelled = {name, unquote(name)}
                    if any(":/" in one for one in spelled):
                        return False
                    waiting += [current.parent / one for one in spelled]
        return True


def _package_name(folder: Path) -> str:
    """The name in a folder's package.xml; empty if there is none."""
    try:
        return (read_xml(folder / "package.xml").findtext("name") or "").strip()
    except ModelError:
        return ""


def _references(file: Path) -> Iterator[str]:
    """All that may name a file in a mesh or a material: parsers permit more than the formats."""
    kind = file.suffix.lower()
    if kind == ".dae":
        try:
            nodes = list(read_xml(file).iter())
        except ModelError:
            nodes = []
        tags = ("init_from", "ref")
        yield from ((n.text or "").strip() for n in nodes if n.tag.split(":")[-1] in tags)
    elif kind in (".gltf", ".obj", ".mtl"):
        check_file(file, ModelError)
        text = file.read_bytes().decode("utf-8", errors="replace").replace("\r", "\n")
        if kind == ".gltf":
            try:  # As lists of (key, value), since a key may occur twice.
                yield from _uris(json.loads(text, object_pairs_hook=list))
            except (ValueError, RecursionError):
                yield "/"  # Nobody knows what it names.
        elif kind == ".obj":
            for part in text.split("mtllib")[1:]:
                names = part.lstrip().split("\n")[0]
                yield from {names.strip(), *names.split()}
        else:
            lines = text.replace("\\\n", " ").split("\n")
            yield from (word for line in lines if line[:1] != "#" for word in line.split())


def _uris(data: Any) -> Iterator[str]:
    """The entries "uri" of buffers, images and extensions that are no data themselves."""
    if isinstance(data, tuple) and data[0] == "uri" and isinstance(data[1], str):
        yield from [data[1]] if not data[1].lower().startswith("data:") else []
    elif isinstance(data, (list, tuple)):
        for part in data:
            yield from _uris(part)


def drawable(mesh: Path, kinds: tuple[str, ...]) -> Path | None:
    """A mesh, or a copy until Python exits, of a kind that is drawn; None if there is none."""
    if mesh.suffix.lower() in kinds:
        return mesh
    is_scene = mesh.suffix.lower() == ".dae" and ".gltf" in kinds
    try:
        name, changed, size = check_file(mesh.resolve(), ModelError)
        return _converted(Path(name), ".gltf" if is_scene else ".obj", changed, size)
    except ModelError:  # Meshcat draws a .dae.
        return mesh if is_scene else None


@cache
def _converted(mesh: Path, kind: str, changed: int, size: int) -> Path:
    folder = Path(_folder().name).resolve()
    copy = folder / str(len(list(folder.iterdir()))) / f"{mesh.stem}{kind}"
    text = _gltf(mesh) if kind == ".gltf" else _obj(mesh)
    copy.parent.mkdir()
    copy.write_bytes(text)
    return copy


@cache
def _folder() -> "TemporaryDirectory[str]":
    folder = TemporaryDirectory(prefix="drake_dae_meshes_")
    atexit.register(folder.cleanup)
    return folder


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
    texts = (row * len(table) % tuple(table.ravel().tolist()) for row, table in tables)
    return "".join(texts).encode()


def _gltf(mesh: Path) -> bytes:
    """The .gltf in m of a .dae. As in ROS, the unit counts, and the upward axis does not."""
    if find_spec("collada") is None or find_spec("trimesh") is None:
        raise ModelError(f"'{mesh.name}': pip install 'drake_dae[meshes]' converts it")
    import trimesh

    units = [node for node in read_xml(mesh).iter() if node.tag.split(":")[-1] == "unit"]
    # From z upward to y upward, the convention of .gltf.
    upward = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
    try:
        unit = float(units[0].get("meter", "1")) if units else 1.0
        with warnings.catch_warnings():
            # pycollada sets the shape of arrays, which NumPy 2.5 deprecates.
            warnings.simplefilter("ignore", DeprecationWarning)
            scene: Any = trimesh.load_scene(mesh)
        if scene.is_empty:
            raise ModelError(f"no mesh in '{mesh.name}'")
        scene.apply_transform(upward @ np.diag([unit, unit, unit, 1.0]))
        written: Any = scene.export(file_type="gltf", merge_buffers=True, embed_buffers=True)
        return bytes(written["model.gltf"])
    except Exception as error:  # Neither package has exceptions of its own.
        raise ModelError(f"no mesh in '{mesh.name}': {error}") from None
