"""The robot of a scenario: a file, those that it names, and changes of it.

Meshcat copies meshes, and the files that they name, into its HTML page. A model from an untrusted
source could name any file of this machine. So geometry is read from the model's folder and packages
alone, and from folders that the user names.

Drake's renderer draws .obj and .gltf; its Meshcat draws .dae as well. So a .dae becomes a .gltf,
with its own colors and textures, and any other mesh an .obj, by the optional package trimesh.
"""

import atexit
import json
import os
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, Any, Literal
from urllib.parse import unquote

import numpy as np
from pydantic import AfterValidator, Field, ValidationInfo
from pydrake.common import GetDrakePath
from pydrake.multibody.parsing import PackageMap

from drake_dae.arrays import positive
from drake_dae.errors import ModelError
from drake_dae.files import check_file, read_mesh
from drake_dae.robots import Load, Vector
from drake_dae.scenario.form import FileName, at, expected, in_folder
from drake_dae.scenario.robot_file.read_by_drake import read_xml
from drake_dae.scenario.shipped import FOLDER


@dataclass(frozen=True)
class Pose:
    """The pose of a frame relative to another one, as in Drake's model directives.

    Attributes:
        translation: The position of its origin, m.
        rpy_deg: Roll, pitch and yaw, in degrees.
    """

    translation: Vector = (0.0, 0.0, 0.0)
    rpy_deg: Vector = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class RobotPlacement:
    """The placement of a robot whose file does not fix it to the world.

    Attributes:
        weld: A link without a joint to a parent, or a frame on it: "base_link", or
            "left::base_link".
        pose: The pose of that frame in the world.
    """

    weld: str
    pose: Pose = Pose()


@dataclass(frozen=True)
class Payload:
    """A point mass attached to a robot.

    Attributes:
        frame: Name of the frame to which it is attached.
        mass: Its mass, in kg; the parameter "<name>.mass".
        point: Its position in the frame, m.
        name: The name of its body.
    """

    frame: str
    mass: float
    point: Vector = (0.0, 0.0, 0.0)
    name: str = "payload"

    def __post_init__(self) -> None:
        positive("the mass of a payload", self.mass)


def _robot_file(name: str, info: ValidationInfo) -> str:
    return name if name.startswith("package://") else in_folder(name, info)


RobotFile = Annotated[str, AfterValidator(_robot_file), expected("the name of a file")]
Actuators = Annotated[
    Literal["all"] | list[str] | dict[str, Annotated[float, Field(gt=0.0)] | None] | None,
    expected(
        "all, a list of joints, or joints with effort limits in N m or N, positive, or nothing for "
        "that of the file"
    ),
]
LeftOut = Annotated[
    str,
    Field(pattern="^[^/]+/[^/]|^inertia$|^empty_limits$"),
    expected('"<parent>/<name>" of an element or attribute, inertia, or empty_limits'),
]


@dataclass(frozen=True)
class Robot:
    """A robot's file that Drake's Parser reads, with changes.

    Meshes that Drake cannot read, such as collision meshes in .stl or .dae, are left out: no
    equation needs them. A joint that mimics another one becomes a constraint "<joint>_coupler". In
    each closed loop of joints one joint, if possible one without motor, becomes a constraint of the
    joint's name.

    Attributes:
        file: A URDF, SDFormat or model-directives file, relative to the scenario, or
            "package://drake_dae_models/<file>" for a shipped one.
        packages: Name -> folder, relative to the scenario, of a package in "package://<name>/...".
            Packages are found without this key if their package.xml is in a folder above the file
            that names them, or in a folder of the package's name in one of these, or in
            ROS_PACKAGE_PATH.
        free: Names of bodies, "object" or "puck::object", that have no joint or that the file fixes
            to the world. They get a joint in roll, pitch and yaw, with the positions "object_qx",
            "_qy", "_qz", "_x", "_y", "_z". A "floating" joint of the file gets such positions as
            well, instead of a quaternion.
        base: The link that is welded to the world, if the file does not weld it, or welds it at
            another pose.
        locked: Joint name -> constant position in rad or m, for revolute and prismatic joints;
            joints coupled to it are locked as well. The rest of the scenario must not name locked
            joints.
        actuators: The driven joints, if they differ from those of the file: a list of names, or
            name -> effort limit in N m or N, or "all" revolute and prismatic joints that mimic no
            other. Without a number the limit is that of the file. Controls have this order, after
            those of the file's own actuators.
        leave_out: What is left out of the file: elements and attributes by "<parent>/<name>", as
            "joint/stiffness" or "equality/weld", and of one type of joints by "<type>/<name>", as
            "universal/spring_stiffness". Drake reads not all that a file says; what of it changes
            the equations is an error until it is named here. Besides, inertia: impossible
            moments of inertia, which the nearest possible ones replace; empty_limits: position
            limits that are empty intervals, such as 0 to 0.
        payloads: Masses attached to the robot, known to plant and law.
        known_forces: Known forces on frames; "<name>.force" is zero unless it is in `exogenous` or
            `plant.parameters`. And friction of joints.
    """

    file: RobotFile
    packages: dict[str, FileName] = field(default_factory=dict)
    free: list[str] = field(default_factory=list)
    base: RobotPlacement | None = None
    locked: dict[str, float] = field(default_factory=dict)
    actuators: Actuators = None
    leave_out: list[LeftOut] = field(default_factory=list)
    payloads: list[Payload] = field(default_factory=list)
    known_forces: list[Load] = field(default_factory=list)

    @property
    def title(self) -> str:
        """The robot's name in messages and systems: "two_arms" for "two_arms.dmd.yaml"."""
        return Path(self.file).name.split(".")[0]


_MOST_INCLUDED = 1000


class RobotFiles:
    """The file of a robot, and those that it names.

    A package is a folder above the file that names it, or a folder of its name in one of these,
    if it has a package.xml with the name; or it is in ROS_PACKAGE_PATH or AMENT_PREFIX_PATH. What
    is found is added to the `packages` of Drake's parser.
    """

    def __init__(self, robot: Robot, packages: PackageMap) -> None:
        self.missing: set[str] = set()
        self._within, self._included = list[Path](), 0
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
                try:
                    name = read_xml(folder / "package.xml").findtext("name", "")
                except ModelError:  # There is none.
                    continue
                if name.strip() == package:
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

    @contextmanager
    def within(self, file: Path) -> Iterator[None]:
        """Refuses that a file includes itself, while what it includes is read, or too many."""
        names = " -> ".join(path.name for path in (*self._within, file))
        if file.resolve() in self._within:
            raise ModelError(f"'{file.name}' includes itself: {names}")
        self._included += 1  # A file may include another one twice, and this one again.
        if self._included > _MOST_INCLUDED:
            raise ModelError(f"'{self.main.name}' includes more than {_MOST_INCLUDED} files")
        self._within.append(file.resolve())
        yield
        self._within.pop()

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
            pairs = list[tuple[str, Any]]()  # A key may occur twice.
            try:
                json.loads(text, object_pairs_hook=pairs.extend)
            except (ValueError, RecursionError):
                yield "/"  # Nobody knows what it names.
            uris = (value for key, value in pairs if key == "uri" and isinstance(value, str))
            yield from (uri for uri in uris if not uri.lower().startswith("data:"))
        elif kind == ".obj":
            for part in text.split("mtllib")[1:]:
                names = part.lstrip().split("\n")[0]
                yield from {names.strip(), *names.split()}
        else:
            lines = text.replace("\\\n", " ").split("\n")
            yield from (word for line in lines if line[:1] != "#" for word in line.split())


def drawable(mesh: Path, kinds: tuple[str, ...]) -> Path | None:
    """A mesh, or a copy until Python exits, of a kind that is drawn; None if there is none."""
    if mesh.suffix.lower() in kinds:
        return mesh
    is_scene = mesh.suffix.lower() == ".dae" and ".gltf" in kinds
    try:
        return _converted(is_scene, *check_file(mesh.resolve(), ModelError))
    except Exception:  # trimesh has no exceptions of its own. Meshcat draws a .dae.
        return mesh if is_scene else None


@cache
def _converted(is_scene: bool, name: str, changed: int, size: int) -> Path:
    mesh, folder = Path(name), Path(_folder().name).resolve()
    text = _gltf(mesh) if is_scene else _obj(mesh)
    suffix = ".gltf" if is_scene else ".obj"
    copy = folder / str(len(list(folder.iterdir()))) / f"{mesh.stem}{suffix}"
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
    import trimesh

    units = [node for node in read_xml(mesh).iter() if node.tag.split(":")[-1] == "unit"]
    unit = float(units[0].get("meter", "1")) if units else 1.0
    # From z upward to y upward, the convention of .gltf.
    upward = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
    with warnings.catch_warnings():
        # pycollada sets the shape of arrays, which NumPy 2.5 deprecates.
        warnings.simplefilter("ignore", DeprecationWarning)
        scene: Any = trimesh.load_scene(mesh)
    scene.apply_transform(upward @ np.diag([unit, unit, unit, 1.0]))
    if scene.is_empty:
        raise ModelError(f"no mesh in '{mesh.name}'")
    written: Any = scene.export(file_type="gltf", merge_buffers=True, embed_buffers=True)
    return bytes(written["model.gltf"])
