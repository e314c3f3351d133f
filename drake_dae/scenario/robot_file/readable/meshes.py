"""Copies of a robot's files that Drake can read: without some meshes, with possible inertias.

Vendors use .stl or .dae for collision geometry, which a MultibodyPlant with a SceneGraph rejects,
and MJCF uses .stl for all meshes. The equations need no meshes, so unreadable meshes are left out.
"""

import re
from collections.abc import Collection
from dataclasses import dataclass, field
from pathlib import Path

from pydrake.geometry import Mesh
from pydrake.multibody.parsing import (
    FlattenModelDirectives,
    LoadModelDirectives,
    PackageMap,
    Parser,
    ProcessModelDirectives,
)

from drake_dae.errors import ModelError
from drake_dae.scenario.robot_file.readable.converted import as_gltf, as_obj
from drake_dae.scenario.robot_file.readable.inertias import RepairedInertia, possible_inertias
from drake_dae.scenario.robot_file.readable.markup import blank, without_comments
from drake_dae.scenario.robot_file.readable.mjcf import without_assets
from drake_dae.scenario.robot_file.readable.placing import (
    FloatingJoint,
    floating_joints,
    released,
    world_links,
)
from drake_dae.scenario.robot_file.readable.urdf import as_meant

_COLLISION = re.compile(r"<collision\b[^<]*?(?:/>|>.*?</collision\s*>)", re.DOTALL)
_FILE = {
    ".urdf": re.compile(r"(<(?:mesh|texture)\b[^>]*?\bfilename\s*=\s*[\"']\s*)([^\"']+)()"),
    ".sdf": re.compile(r"(<uri>\s*)([^<]*?)(\s*</uri>)"),
}
"""Suffix of a file -> pattern of the text before a file's name, the name, and the text after it."""

_MESH = {
    ".urdf": re.compile(r"(<mesh\b[^>]*?\bfilename\s*=\s*[\"']\s*)([^\"']+)()"),
    ".sdf": re.compile(r"(<mesh\b[^>]*>(?:(?!</mesh).)*?<uri>\s*)([^<]*?)(\s*</uri>)", re.DOTALL),
}
"""Suffix of a file -> the same pattern, for meshes only."""

DRAWN = (".obj", ".gltf", ".dae")
"""The kinds of mesh that Drake's Meshcat draws; its renderer draws the first two."""


@dataclass(frozen=True)
class ReadableCopies:
    """Copies of the user's files, which Drake reads instead of these.

    Attributes:
        leave_out: The key `leave_out` of the scenario.
        placed: The links that the scenario welds or makes free, "base" or "left::base".
        drawn: Whether visual meshes are converted to those that can be drawn everywhere.
        originals: A copy -> its original, with the same lines.
        left_out: The omitted meshes.
        repaired: The replaced inertias.
        floating: Model instance, or "" for a single file -> its floating joints.
    """

    leave_out: Collection[str]
    placed: Collection[str] = ()
    drawn: bool = True
    originals: dict[Path, Path] = field(default_factory=dict)
    left_out: list[Path] = field(default_factory=list)
    repaired: list[RepairedInertia] = field(default_factory=list)
    floating: dict[str, list[FloatingJoint]] = field(default_factory=dict)

    def named(self, text: str) -> str:
        """Replaces the names of copies in a message of Drake's parser by those of the originals."""
        for copy, original in self.originals.items():
            text = text.replace(str(copy), str(original))
        return text


def add_models(file: Path, parser: Parser, folder: Path, copies: ReadableCopies) -> dict[str, Path]:
    """Adds the models of a file to a plant, without the meshes that Drake cannot read.

    Args:
        file: A file that Drake's Parser reads.
        parser: A parser with the packages, for the plant.
        folder: An empty folder for the copies.
        copies: The record of copies, empty; it is filled, also if Drake rejects the files.

    Returns:
        Model instance of the directives -> its file, or "" -> the file itself.

    Raises:
        ModelError: The mass of a body is computed from a mesh that Drake cannot read.
        RuntimeError: Drake rejects the files; the message names copies.
    """
    packages = parser.package_map()
    has_geometry = parser.plant().geometry_source_is_registered()
    if not file.name.endswith((".dmd.yaml", ".dmd.yml")):
        copy, _ = _readable(file, packages, folder, copies, has_geometry, "", copies.placed)
        parser.AddModels(str(copy))
        return {"": file}
    directives = FlattenModelDirectives(LoadModelDirectives(str(file)), packages)
    welds = (directive.add_weld for directive in directives.directives)
    placed = [*copies.placed, *(weld.child for weld in welds if weld is not None)]
    models: dict[str, Path] = {}
    standing: dict[Path, str] = {}
    for directive in directives.directives:
        if directive.add_model is not None:
            name = directive.add_model.name
            models[name] = model = Path(packages.ResolveUrl(directive.add_model.file))
            links = [link.removeprefix(f"{name}::") for link in placed]
            copy, fixed = _readable(model, packages, folder, copies, has_geometry, name, links)
            if copy != model:
                directive.add_model.file = copy.as_uri()
            if fixed and model in standing:
                raise ModelError(
                    f"models '{standing[model]}' and '{name}' stand in one place: '{model.name}' "
                    f"fixes its link '{fixed[0]}' to the world. Say where another one stands by "
                    f"add_weld: {{parent: world, child: {name}::{fixed[0]}, X_PC: ...}}, in the "
                    "place of the joint in the file"
                )
            if fixed:
                standing[model] = name
    if copies.originals:
        ProcessModelDirectives(directives, parser)
    else:
        parser.AddModels(str(file))
    return models


def _readable(
    file: Path,
    packages: PackageMap,
    folder: Path,
    copies: ReadableCopies,
    has_geometry: bool,
    instance: str,
    placed: Collection[str],
) -> tuple[Path, list[str]]:
    """The file or its readable copy, and the links that it fixes to the world."""
    if not (file.suffix in _FILE or _is_mjcf(file)) or not file.is_file():
        return file, []
    plain = without_comments(file.read_text("utf-8", errors="replace"))
    text = released(plain, file, placed)
    fixed = world_links(text, file)
    text, floating = floating_joints(text, file)
    copies.floating[instance] = [joint for joint in floating if joint.child not in placed]
    if file.suffix == ".urdf":
        text = as_meant(text, "empty_limits" in copies.leave_out)
    text, repaired = possible_inertias(text, file)
    copies.repaired.extend(repaired)
    left_out: list[Path] = []
    if _is_mjcf(file):  # Drake reads the meshes of MJCF even if they are not registered.
        text, left_out = without_assets(text, file)
    elif has_geometry:
        text, left_out = _without_collisions(text, file, packages)
        text = _with_visuals(text, file, packages) if copies.drawn else text
    if text == plain:
        return file, fixed
    if not _is_mjcf(file):  # Absolute names, since the copy is in another folder.
        name = _FILE[file.suffix]
        text = name.sub(lambda match: match[1] + _absolute(match[2], file) + match[3], text)
    copies.left_out.extend(left_out)
    copy = folder / str(len(copies.originals)) / file.name
    copy.parent.mkdir()
    copy.write_text(text, "utf-8")
    copies.originals[copy] = file
    return copy, fixed


def _is_mjcf(file: Path) -> bool:
    return file.suffix == ".xml"


def _without_collisions(text: str, file: Path, packages: PackageMap) -> tuple[str, list[Path]]:
    """A URDF or SDFormat file without its unreadable collision meshes, and these meshes."""
    name, left_out = _FILE[file.suffix], []

    def without_refused(collision: re.Match[str]) -> str:
        meshes = [_resolved(match[2], file, packages) for match in name.finditer(collision[0])]
        refused = [mesh for mesh in meshes if mesh is not None and _is_refused(mesh)]
        left_out.extend(refused)
        return blank(collision) if refused else collision[0]

    return _COLLISION.sub(without_refused, text), left_out


def _with_visuals(text: str, file: Path, packages: PackageMap) -> str:
    """Replaces meshes that cannot be drawn everywhere by drawable copies, if there are any."""

    def drawn(match: re.Match[str]) -> str:
        mesh = _resolved(match[2], file, packages)
        if mesh is None or mesh.suffix.lower() in DRAWN[:2]:
            return match[0]
        copy = as_gltf(mesh) if mesh.suffix.lower() == ".dae" else as_obj(mesh)
        return match[0] if copy is None else f"{match[1]}{copy}{match[3]}"

    return _MESH[file.suffix].sub(drawn, text)


def _absolute(name: str, file: Path) -> str:
    return name if re.match(r"[A-Za-z]\w*:", name) else str(file.parent.resolve() / name)


def _resolved(name: str, file: Path, packages: PackageMap) -> Path | None:
    """The path of a mesh; None if its package is unknown, which Drake reports."""
    name = _absolute(name, file)
    try:
        return Path(packages.ResolveUrl(name) if "://" in name else name)
    except RuntimeError:
        return None


def _is_refused(mesh: Path) -> bool:
    """Whether Drake cannot compute the convex hull that a collision needs."""
    if not mesh.is_file():
        return False
    try:
        Mesh(str(mesh)).GetConvexHull()
    except RuntimeError:
        return True
    return False
