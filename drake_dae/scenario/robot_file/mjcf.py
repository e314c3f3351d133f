"""The meshes of an MJCF file that Drake cannot read, left out of it."""

import re
from pathlib import Path
from xml.etree import ElementTree

from drake_dae.errors import ModelError

_MESH = re.compile(r"<mesh\b([^>]*?)(?:/>|>\s*</mesh\s*>)")
_GEOM = re.compile(r"<geom\b([^>]*?)(?:/>|>\s*</geom\s*>)")
_READ = ".obj"


def without_assets(text: str, file: Path) -> tuple[str, list[Path]]:
    """A file without its meshes that are no .obj, and without the geometry that is made of them.

    Args:
        text: The text of the file, without comments.
        file: Where it is.

    Returns:
        The text, with the same lines and names of the other meshes that lead there from anywhere;
        and the meshes that are left out.

    Raises:
        ModelError: A body has its mass from such a mesh.
    """
    try:
        root = ElementTree.fromstring(text)
    except ElementTree.ParseError:
        return text, []  # Drake says what is wrong.
    folder = file.resolve().parent
    for compiler in root.iter("compiler"):
        folder = file.resolve().parent / compiler.get("meshdir", compiler.get("assetdir", ""))
    refused = {
        mesh.get("name", Path(mesh.get("file", "")).stem): folder / mesh.get("file", "")
        for mesh in root.iter("mesh")
        if mesh.get("file") and Path(mesh.get("file", "")).suffix.lower() != _READ
    }
    if not refused:
        return text, []
    _check_masses(root, refused)

    def asset(found: re.Match[str]) -> str:
        name = _attribute(found[1], "file")
        if name is None:
            return found[0]
        if Path(name).suffix.lower() != _READ:
            return "\n" * found[0].count("\n")
        return found[0].replace(name, str(folder / name))

    def geometry(found: re.Match[str]) -> str:
        is_gone = _attribute(found[1], "mesh") in refused
        return "\n" * found[0].count("\n") if is_gone else found[0]

    return _GEOM.sub(geometry, _MESH.sub(asset, text)), list(refused.values())


def _check_masses(root: ElementTree.Element, refused: dict[str, Path]) -> None:
    """Refuses a body that weighs what its meshes do."""
    always = any(one.get("inertiafromgeom") == "true" for one in root.iter("compiler"))
    for body in root.iter("body"):
        if body.find("inertial") is not None and not always:
            continue
        for geom in body.iterfind("geom"):
            mesh = refused.get(geom.get("mesh", ""))
            if mesh is not None and geom.get("mass") not in ("0", "0.0"):
                name = body.get("name", "")
                raise ModelError(
                    f"body '{name}' has its mass from the mesh '{mesh.name}', which Drake cannot "
                    f"read; give the body an <inertial>, or the mesh as {_READ}"
                )


def _attribute(attributes: str, name: str) -> str | None:
    found = re.search(rf"\b{name}\s*=\s*[\"']([^\"']*)", attributes)
    return found and found[1]
