"""Changes an MJCF file so that Drake can read it: meshes as .obj, and bodies of mass 0."""

import re
from collections.abc import Iterator
from pathlib import Path
from xml.etree import ElementTree

from drake_dae.errors import ModelError
from drake_dae.scenario.robot_file.readable.converted import as_obj
from drake_dae.scenario.robot_file.readable.markup import blank, parsed

_MESH = re.compile(r"<mesh\b([^>]*?)(?:/>|>\s*</mesh\s*>)")
_GEOM = re.compile(r"<geom\b([^>]*?)(?:/>|>\s*</geom\s*>|>)")
_INERTIAL = re.compile(r"<inertial\b[^>]*?(?:/>|>\s*</inertial\s*>)")
_READ = ".obj"


def without_assets(text: str, file: Path) -> tuple[str, list[Path]]:
    """Converts meshes to .obj, and removes unreadable meshes with their geometry.

    MuJoCo accepts bodies of mass 0 that do not move, or move with others. The <inertial> of such a
    body is removed, and its geometry gets mass 0.

    Args:
        text: The text of the file, without comments.
        file: Its path.

    Returns:
        The text, with the same lines and absolute names of meshes; and the omitted meshes.

    Raises:
        ModelError: The mass of a movable body is computed from an omitted mesh.
    """
    root = parsed(text)
    whole, text = text, _without_mass(text, root)
    folder = file.resolve().parent
    for compiler in root.iter("compiler"):
        folder = file.resolve().parent / compiler.get("meshdir", compiler.get("assetdir", ""))
    named = {
        mesh.get("name", Path(mesh.get("file", "")).stem): folder / mesh.get("file", "")
        for mesh in root.iter("mesh")
        if mesh.get("file") and Path(mesh.get("file", "")).suffix.lower() != _READ
    }
    copies = {mesh: as_obj(mesh) for mesh in named.values()}
    refused = {name: mesh for name, mesh in named.items() if copies[mesh] is None}
    if not named and text == whole:
        return text, []
    _check_masses(root, refused)

    def asset(match: re.Match[str]) -> str:
        name = _attribute(match[1], "file")
        if name is None:
            return match[0]
        mesh = copies.get(folder / name, folder / name)
        return blank(match) if mesh is None else match[0].replace(name, str(mesh))

    def geometry(match: re.Match[str]) -> str:
        return blank(match) if _attribute(match[1], "mesh") in refused else match[0]

    return _GEOM.sub(geometry, _MESH.sub(asset, text)), list(refused.values())


def _without_mass(text: str, root: ElementTree.Element) -> str:
    """Rewrites bodies of mass 0 for Drake: without <inertial>, with geometry of mass 0."""
    if _takes_geometry(root):
        return text
    empty = {
        child
        for body in root.iter("body")
        if _weighs_nothing(body.find("inertial"))
        for child in body
        if child.tag in ("inertial", "geom")
    }
    inertials, geoms = root.iter("inertial"), root.iter("geom")

    def inertial(match: re.Match[str]) -> str:
        return blank(match) if next(inertials) in empty else match[0]

    def geom(match: re.Match[str]) -> str:
        if next(geoms) not in empty:
            return match[0]
        return re.sub(r"\bmass\s*=\s*[\"'][^\"']*[\"']", "", match[0]).replace(
            "<geom", '<geom mass="0"', 1
        )

    return _GEOM.sub(geom, _INERTIAL.sub(inertial, text)) if empty else text


def _takes_geometry(root: ElementTree.Element) -> bool:
    """Whether masses are computed from the geometry even if there is an <inertial>."""
    return any(element.get("inertiafromgeom") == "true" for element in root.iter("compiler"))


def _weighs_nothing(inertial: ElementTree.Element | None) -> bool:
    try:
        return inertial is not None and float(inertial.get("mass", "")) == 0.0
    except ValueError:
        return False  # The error is left to Drake.


def _moving(body: ElementTree.Element, moves: bool = False) -> Iterator[ElementTree.Element]:
    """The bodies in an element that joints can move."""
    for child in body.iterfind("body"):
        has_joint = child.find("joint") is not None or child.find("freejoint") is not None
        if moves or has_joint:
            yield child
        yield from _moving(child, moves or has_joint)


def _check_masses(root: ElementTree.Element, refused: dict[str, Path]) -> None:
    """Checks that no mass of a movable body is computed from omitted meshes."""
    always = _takes_geometry(root)
    for body in (body for world in root.iter("worldbody") for body in _moving(world)):
        if body.find("inertial") is not None and not always:
            continue
        for geom in body.iterfind("geom"):
            mesh = refused.get(geom.get("mesh", ""))
            if mesh is not None and geom.get("mass") not in ("0", "0.0"):
                name = body.get("name", "")
                raise ModelError(
                    f"body '{name}' has its mass from the mesh '{mesh.name}', which Drake cannot "
                    f"read; give the body an <inertial>, or the mesh as {_READ}, or let trimesh "
                    "read it, by pip install 'drake_dae[meshes]'"
                )


def _attribute(attributes: str, name: str) -> str | None:
    match = re.search(rf"\b{name}\s*=\s*[\"']([^\"']*)", attributes)
    return match and match[1]
