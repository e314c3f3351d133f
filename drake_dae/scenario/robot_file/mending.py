"""Copies of a robot's files, mended so that Drake's parser reads them as their authors mean them.

A copy has possible inertias, and geometry that can be read and drawn; it lacks what Drake does not
read. What changed on the way is collected, and so is what is lost.
"""

from collections import Counter, defaultdict
from collections.abc import Collection, Iterator
from dataclasses import dataclass, field
from itertools import count
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element, SubElement

import numpy as np
from pydrake.multibody.tree import RotationalInertia

from drake_dae.arrays import FloatArray, number_in
from drake_dae.errors import ModelError
from drake_dae.scenario.robot_file import mjcf
from drake_dae.scenario.robot_file.files import DRAWN, RobotFiles, drawable, has_hull
from drake_dae.scenario.robot_file.read_by_drake import DRIVES, READ_BY_DRAKE, take_lost
from drake_dae.scenario.robot_file.xml_tree import read_xml, write_xml

_TYPES = {
    ".urdf": ("revolute", "continuous", "prismatic", "planar", "floating", "fixed"),
    ".sdf": ("revolute", "continuous", "prismatic", "universal", "ball", "screw", "fixed"),
    ".xml": ("hinge", "slide", "ball", "free"),
}
"""Suffix of a file -> the types of joints that Drake reads."""

_EMPTY = "shapes of size 0 are left out"

_MOST_INCLUDED = 1000
"""The largest number of files that an MJCF file includes: each may include another one twice."""


def _lists() -> dict[str, list[str]]:
    return defaultdict(list)


@dataclass
class Mender:
    """Makes mended copies of files. A "model" is the name of a model instance, "" for a lone robot.

    Attributes:
        files: The files that they name.
        leave_out: The key `robot.leave_out`.
        drives: Whether the file's motors count, since the scenario names no driven joints.
        has_geometry, drawn: Whether geometry is read, and converted to such that can be drawn.
        folder: An empty folder for the copies; None makes none.
        omitted, changed, lost: What of the geometry is left out, what else changed, and what is
            lost -> where.
        originals: Copy -> its file.
        joints: "effort" limit, "armature", "follows" (leader, ratio, offset), position at which it
            "stands", "parent" of SDFormat -> (model, joint) -> value.
        floating: Model, name, parent, child, and x, y, z, roll, pitch, yaw of floating joints.
        crossed: (model, link) of which visual geometry is left out.
    """

    files: RobotFiles
    leave_out: Collection[str] = ()
    drives: bool = True
    has_geometry: bool = True
    drawn: bool = True
    folder: Path | None = None
    omitted: dict[str, list[str]] = field(default_factory=_lists)
    changed: dict[str, list[str]] = field(default_factory=_lists)
    lost: dict[str, list[str]] = field(default_factory=_lists)
    originals: dict[Path, Path] = field(default_factory=dict)
    joints: dict[str, dict[tuple[str, str], Any]] = field(default_factory=lambda: defaultdict(dict))
    floating: list[tuple[str, str, str, str, FloatArray]] = field(default_factory=list)
    crossed: set[tuple[str, str]] = field(default_factory=set)

    def copy(
        self,
        file: Path,
        model: str = "",
        placed: Collection[str] = (),
        within: tuple[Path, ...] = (),
    ) -> Path:
        """A mended copy of a file; one that is neither URDF, SDFormat nor MJCF stays.

        `placed` are links that the scenario places, so that no joint fixes them to the world, and
        `within` the files that include this one.
        """
        kind, own = file.suffix, (*within, file.resolve())
        if kind not in READ_BY_DRAKE:
            return file
        root = _read(file, within)
        if kind == ".xml":
            _include(root, file, own, count(1))
            mjcf.prepare(root, file)
        parents = {child: parent for parent in root.iter() for child in parent}

        def place(node: Element) -> str:
            """The line and name of an element, or of that to which it belongs."""
            line = getattr(node, "line", 0)
            while not node.get("name") and node in parents:
                node = parents[node]
            return f"{file.name}{f':{line}' * bool(line)}: {node.tag} '{node.get('name', '')}'"

        for node in root.iter():
            for value in (*node.attrib.values(), node.text or ""):
                if "$(" in value or "${" in value:
                    text = (
                        f"{place(node)}: '{value.strip()}' is a template: xacro FILE -o robot.urdf"
                    )
                    raise ModelError(f"{text} writes the URDF")
                if number_in(value.replace(",", ".", 1)) is not None and "," in value:
                    raise ModelError(f"{place(node)}: '{value}': numbers have a point, no comma")
        # Only the armature of joints without motor is lost.
        for part, node in take_lost(root, kind, {*self.leave_out} - {mjcf.ARMATURE}):
            if self.drives or not part.startswith(DRIVES):
                self.lost[part].append(place(node))
        for inertial in root.iter("inertial"):
            if text := mend_inertia(inertial, kind, place(inertial)):
                if "inertia" not in self.leave_out:
                    self.lost["inertia"].append(text)
                self.changed["moments of inertia of no body become possible ones"].append(text)
        for joint in root.iter("joint"):
            self._check_joint(joint, kind, place(joint))
        if kind == ".urdf":
            self._mend_urdf(root, file, model, placed)
        elif kind == ".sdf":
            self._mend_sdf(root, file, model, placed, own)
        else:
            self._mend_mjcf(root, file, model, placed)
        if self.folder is None:
            return file
        copy = self.folder / str(len(self.originals)) / file.name
        copy.parent.mkdir()
        copy.write_text(write_xml(root), "utf-8")
        self.originals[copy] = file
        return copy

    def _check_joint(self, joint: Element, kind: str, place: str) -> None:
        """Checks the type of a joint, and removes limits that Drake refuses."""
        name = joint.get("type", "hinge" if kind == ".xml" else "")
        if name and name not in _TYPES[kind]:
            raise ModelError(
                f"{place}: no joint of type '{name}' is read, but {', '.join(_TYPES[kind])}; two "
                "joints that move together are a !JointCoupler under constraints"
            )
        # Drake damps no free body, and limits no ball joint.
        part = {"free": "damping", "ball": "range"}.get(name, "") if kind == ".xml" else ""
        values = [number_in(word) for word in joint.attrib.pop(part, "").split()]
        if any(values) and (part == "damping" or joint.get("limited") != "false"):
            self.lost[f"joint/{part}"].append(place)
        for owner in (joint, *(joint.find(way) for way in ("limit", "axis/limit", "axis2/limit"))):
            if owner is None:
                continue
            sides = [owner.get(side) or owner.findtext(side) or "" for side in ("lower", "upper")]
            bounds = [number_in(word) for word in owner.get("range", "").split() or sides]
            low, high = bounds if len(bounds) == 2 else (None, None)
            is_reversed = low is not None and high is not None and low > high
            if is_reversed and name != "continuous" and "empty_limits" not in self.leave_out:
                self.lost["empty_limits"].append(f"{place}: limits from {low:g} to {high:g}")
            for key in ("range", "lower", "upper") if is_reversed or name == "continuous" else ():
                owner.attrib.pop(key, None)
                _remove(owner, key)

    def _mesh(self, name: str, path: Path | None, collides: bool, drawn_as: tuple[str, ...]) -> str:
        """The file of a mesh as Drake reads it; "" if it is left out."""
        if self.folder is None:
            return str(path or "")
        drawn, why = path, ""
        if path is None:
            why = (
                "is in a package neither near nor in ROS_PACKAGE_PATH or AMENT_PREFIX_PATH "
                "(robot.packages can name its folder)"
            )
        elif not path.is_file():
            why = "is not there"
        elif not self.files.holds(path):
            why = "is outside of the model's folder or package (robot.packages can name its folder)"
        elif drawn_as and (drawn := drawable(path, drawn_as)) is None:
            why = "cannot be converted (pip install 'drake_dae[meshes]' converts more)"
        elif collides and drawn is not None and not has_hull(drawn):
            why = "cannot be read by Drake"
        if why:
            items = self.omitted[f"geometry that {why} is left out; no equation needs it"]
            items.append(f"'{name if path is None else Path(name).name}'")
        return "" if why else str(drawn)

    def _mend_shapes(self, link: Element, file: Path, model: str) -> None:
        """Leaves out what of a link's geometry Drake cannot take, in URDF and SDFormat."""
        name = link.get("name", "")
        for shape in [*link.iterfind("visual"), *link.iterfind("collision")]:
            is_visual, meshes = shape.tag == "visual", [*_files(shape)]
            sizes = [
                size
                for form in (() if meshes else shape.iterfind("geometry/*"))
                for key in ("size", "radius", "length", "radii")
                for size in (form.get(key) or form.findtext(key) or "1").split()
            ]
            is_empty = any((number_in(size) or 0.0) <= 0.0 for size in sizes)
            if is_empty or not self.has_geometry:
                if self.has_geometry:
                    self.omitted[_EMPTY].append(f"of '{name}'")
                link.remove(shape)
                continue
            for owner, key in meshes:
                text = (owner.get(key, "") if key else owner.text or "").strip()
                drawn_as = DRAWN if is_visual and self.drawn else ()
                path = self._mesh(text, self.files.find(text, file), not is_visual, drawn_as)
                if key:
                    owner.set(key, path)
                else:
                    owner.text = path
                if not path:
                    link.remove(shape)
                    self.crossed |= {(model, name)} if is_visual else set()
            for material in shape.iterfind("material"):
                for texture in [t for t in material if t.tag in ("texture", "drake:diffuse_map")]:
                    self.omitted["textures are left out"].append(f"of '{name}'")
                    material.remove(texture)

    def _follow(self, model: str, joint: Element, tag: str) -> None:
        """Notes whether a joint follows another one, unless Drake reports what is wrong."""
        name = joint.get("name", "")
        for mimic in [part for part in joint if part.tag == tag]:
            ratio = number_in(mimic.get("multiplier", "1"))
            offset = number_in(mimic.get("offset", "0"))
            if joint.get("type") in ("planar", "floating", "universal", "ball"):
                self.lost[f"joint/{tag}"].append(f"joint '{name}'")
            elif ratio == 0.0 and offset is not None:
                self.changed["joints that follow others with multiplier 0 stand"] += [f"'{name}'"]
                self.joints["stands"][model, name] = offset
                joint.remove(mimic)
            elif ratio is not None and offset is not None:
                self.joints["follows"][model, name] = (mimic.get("joint", ""), ratio, offset)

    def _mend_urdf(self, root: Element, file: Path, model: str, placed: Collection[str]) -> None:
        root.attrib.setdefault("name", file.stem)
        for link in root.iterfind("link"):
            self._mend_shapes(link, file, model)
        _take_first_colours(root)
        still: set[str | None] = set()  # Joints that Drake drives not: their effort limit is 0.
        for joint in root.findall("joint"):
            name, kind = joint.get("name", ""), joint.get("type")
            ends = joint.find("parent"), joint.find("child")
            parent, child = ("" if end is None else str(end.get("link", "")) for end in ends)
            if parent == "world" and child in placed and kind in ("fixed", "floating"):
                root.remove(joint)
            elif kind == "floating":
                root.remove(joint)
                origin = joint.find("origin")
                pose = {} if origin is None else origin.attrib
                text = f"{pose.get('xyz', '0 0 0')} {pose.get('rpy', '0 0 0')}"
                numbers = [number_in(word) for word in text.split()]
                if len(numbers) != 6 or None in numbers:
                    raise ModelError(f"joint '{name}': its origin is six numbers, got '{text}'")
                self.floating.append((model, name, parent, child, np.array(numbers, float)))
            if kind == "fixed":
                _remove(joint, "mimic")
            self._follow(model, joint, "mimic")
            for limit in joint.iterfind("limit"):
                effort = number_in(limit.get("effort", "")) or 0.0
                if effort > 0.0:
                    self.joints["effort"][model, name] = effort
                elif "effort" in limit.attrib:  # Many authors write 0 for an unknown limit.
                    still.add(name)
        moving = {j.get("name") for j in root.iterfind("joint") if j.get("type") != "fixed"}
        count = Counter[str]()
        for transmission in root.findall("transmission"):
            driven = {joint.get("name") for joint in transmission.iterfind("joint")}
            has_type = "type" in transmission.attrib or transmission.find("type") is not None
            if driven & still and self.drives:
                self.lost["transmission/joint"] += [f"joint '{one}': effort 0" for one in driven]
            if not has_type or not driven & moving:
                root.remove(transmission)
                continue
            for actuator in transmission.iterfind("actuator"):  # Their names may be equal.
                name = actuator.get("name", "")
                count[name] += 1
                actuator.set("name", f"{name}_{count[name]}" if count[name] > 1 else name)

    def _mend_sdf(
        self,
        root: Element,
        file: Path,
        model: str,
        placed: Collection[str],
        within: tuple[Path, ...],
    ) -> None:
        for uri in root.iterfind(".//include/uri"):
            path = self.files.find((uri.text or "").strip(), file)
            if path is not None and path.is_dir():
                path = next(iter(sorted(path.glob("*.sdf"))), None)
            if path is not None and path.is_file():
                uri.text = self.copy(path, model, (), within).resolve().as_uri()
        for number, body in enumerate(root.iter("model")):
            body.attrib.setdefault("name", file.stem + f"_{number}" * bool(number))
            for link in body.iterfind("link"):
                self._mend_shapes(link, file, model)
            for joint in body.findall("joint"):
                parent, child = (joint.findtext(end, "").strip() for end in ("parent", "child"))
                if parent == "world" and joint.get("type") == "fixed" and child in placed:
                    body.remove(joint)
                self.joints["parent"][model, joint.get("name", "")] = parent
                self._follow(model, joint, "drake:mimic")

    def _mend_mjcf(self, root: Element, file: Path, model: str, placed: Collection[str]) -> None:
        if not (self.has_geometry and self.drawn):
            mjcf.remove_geometry(root, collides=not self.has_geometry)
        refused: dict[str, str] = {}
        used = mjcf.colliding_meshes(root) if self.has_geometry else set[str]()
        for mesh, path in mjcf.mesh_files(root, file):
            name = mesh.get("file", "")
            mesh.set("file", self._mesh(name, path, mesh.get("name") in used, (".obj",)))
            if not mesh.get("file"):
                refused[mesh.get("name", "")] = name
        crossed, empty = mjcf.remove_shapes(root, refused)
        self.crossed |= {(model, body) for body in crossed if self.has_geometry}
        if empty:
            self.omitted[_EMPTY] += [f"of '{body}'" for body in empty]
        for name, armature in mjcf.armatures(root):
            if name:
                self.joints["armature"][model, name] = armature
            elif mjcf.ARMATURE not in self.leave_out:
                self.lost[mjcf.ARMATURE].append(f"{file.name}: of a joint that no motor can drive")
        for name, joint in mjcf.floating_bodies(root, placed):
            self.floating.append((model, joint, "world", name, np.zeros(6)))


def _read(file: Path, within: tuple[Path, ...]) -> Element:
    if file.resolve() in within:
        names = " -> ".join(path.name for path in (*within, file))
        raise ModelError(f"'{file.name}' includes itself: {names}")
    return read_xml(file)


def _include(owner: Element, main: Path, within: tuple[Path, ...], number: Iterator[int]) -> None:
    """Puts the content of files that an MJCF file includes into the places of their names."""
    for index, node in reversed(list(enumerate(owner))):
        if node.tag != "include":
            _include(node, main, within, number)
            continue
        if next(number) > _MOST_INCLUDED:
            raise ModelError(f"'{main.name}' includes more than {_MOST_INCLUDED} files")
        file = main.parent / node.get("file", "")
        included = _read(file, within)
        _include(included, main, (*within, file.resolve()), number)
        for part in included.iter():
            part.line = 0  # type: ignore[attr-defined]
        owner[index : index + 1] = list(included)


def _remove(owner: Element, tag: str) -> None:
    for child in [child for child in owner if child.tag == tag]:
        owner.remove(child)


def _files(shape: Element) -> Iterator[tuple[Element, str]]:
    """The elements that name meshes, and the attribute that does; "" is the text, in SDFormat."""
    for owner in shape.iterfind("geometry/mesh"):
        if "filename" in owner.attrib:
            yield owner, "filename"
        else:
            yield from ((uri, "") for uri in [*owner.findall("uri")] or [owner])


def _take_first_colours(root: Element) -> None:
    """Writes the first colour of each name of a material into all materials of that name.

    Some vendors define several colours for a name, of which other parsers use one and Drake none,
    or use a name before they define its colour, or never define it.
    """
    colours: dict[str, list[Element]] = {}
    for material in root.iter("material"):
        if len(material):
            colours.setdefault(material.get("name", ""), list(material))
    for owner in list(root.iter()):
        for material in owner.findall("material"):
            if colour := colours.get(material.get("name", "")):
                material[:] = colour if material.get("name") else material[:]
            elif not len(material):
                owner.remove(material)


_ENTRIES = ("ixx", "iyy", "izz", "ixy", "ixz", "iyz")
_ROWS, _COLUMNS = [0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]


def nearest_inertia(inertia: FloatArray) -> FloatArray:
    """The possible inertia nearest to a symmetric matrix in the Frobenius norm, shape (3, 3).

    The moments d of a body are d_i = s_j + s_k with the second moments s >= 0 along the principal
    axes. The nearest inertia has the same axes, and the s >= 0 for which d is nearest.
    """
    from scipy.optimize import nnls  # Imported here, since few runs need it.

    moments, axes = np.linalg.eigh(inertia)
    second, _ = nnls(np.ones((3, 3)) - np.eye(3), moments)
    second = np.maximum(second, 1e-9 * second.sum())  # None is negative by round-off.
    return np.asarray((axes * (second.sum() - second)) @ axes.T)


def mend_inertia(inertial: Element, kind: str, place: str) -> str:
    """Replaces an impossible inertia by the nearest possible one; says what it replaced, or ""."""
    words = _mass_and_entries(inertial, kind)
    numbers = [number_in(word) for word in words]
    if None in numbers:
        raise ModelError(f"{place}: mass and inertia are numbers, got {', '.join(words)}")
    if len(numbers) != 7:
        return ""  # Drake reports it.
    mass, entries = numbers[0] or 0.0, np.array(numbers[1:], float)
    if mass < 0.0:
        raise ModelError(f"{place}: a mass is positive, got {mass:g} kg")
    try:
        is_possible = RotationalInertia(*entries.tolist()).CouldBePhysicallyValid()
    except RuntimeError:
        is_possible = False
    if not np.any(entries) if mass == 0.0 else is_possible:
        return ""
    inertia = np.empty((3, 3))
    inertia[_ROWS, _COLUMNS] = inertia[_COLUMNS, _ROWS] = entries
    nearest = nearest_inertia(inertia) if mass > 0.0 else np.zeros((3, 3))
    before, after = np.linalg.eigvalsh(inertia), np.linalg.eigvalsh(nearest)
    if mass > 0.0 and not np.trace(nearest) > 0.0:
        raise ModelError(
            f"{place}: the moments of inertia are {before} kg m^2, and near these is none that a "
            f"body of {mass:g} kg can have; mend them"
        )
    written, matrix = (
        [repr(float(entry)) for entry in nearest[_ROWS, _COLUMNS]],
        inertial.find("inertia"),
    )
    if matrix is None:
        # A fullinertia cannot be combined with a quat, so a diagonal one remains diagonal.
        key = "fullinertia" if "fullinertia" in inertial.attrib else "diaginertia"
        inertial.set(key, " ".join(written[: 6 if key == "fullinertia" else 3]))
    else:
        matrix.clear()
        for key, entry in zip(_ENTRIES, written, strict=True):
            if kind == ".urdf":
                matrix.set(key, entry)
            else:
                SubElement(matrix, key).text = entry
    was, now = (", ".join(f"{d:.3g}" for d in moments) for moments in (before, after))
    change = 100.0 * np.linalg.norm(nearest - inertia) / np.linalg.norm(inertia)
    return f"{place}: ({was}) kg m^2, nearest possible ({now}), changed by {change:.2g} %"


def _mass_and_entries(inertial: Element, kind: str) -> list[str]:
    """Mass in kg, and xx, yy, zz, xy, xz and yz in kg m^2; fewer if some are missing."""
    if kind == ".xml":
        entries = inertial.get("fullinertia", inertial.get("diaginertia", "")).split()
        return [inertial.get("mass", "0"), *entries, *["0"] * 3][:7] if len(entries) > 2 else []
    mass, matrix = inertial.find("mass"), inertial.find("inertia")
    if matrix is None:
        return []
    if kind == ".urdf":
        weight = "0" if mass is None else mass.get("value", "0")
        return [weight, *(matrix.get(key, "0") for key in _ENTRIES)]
    # The defaults of SDFormat are those of the unit matrix.
    pairs = zip(_ENTRIES, "111000", strict=True)
    return [inertial.findtext("mass", "1"), *(matrix.findtext(key, one) for key, one in pairs)]
