"""Copies of a robot's files, mended so that Drake's parser reads them as their authors mean them.

A copy has possible inertias, and geometry that can be read and drawn; it lacks what Drake does not
read. What changed on the way is collected, and so is what is lost.
"""

import re
from collections import Counter, defaultdict
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np

from drake_dae.arrays import FloatArray, number_in
from drake_dae.errors import ModelError
from drake_dae.scenario.robot_file import mjcf
from drake_dae.scenario.robot_file.inertias import mend_inertia
from drake_dae.scenario.robot_file.meshes import DRAWN, all_within, drawable, has_hull
from drake_dae.scenario.robot_file.read_by_drake import DRIVES, READ_BY_DRAKE, take_lost
from drake_dae.scenario.robot_file.xml_tree import Node, read_xml, write_xml

MOST_FILES = 1000
"""The largest number of files of a robot, each counted as often as it is included."""

_TYPES = {
    ".urdf": ("revolute", "continuous", "prismatic", "planar", "floating", "fixed"),
    ".sdf": ("revolute", "continuous", "prismatic", "universal", "ball", "screw", "fixed"),
    ".xml": ("hinge", "slide", "ball", "free"),
}
"""Suffix of a file -> the types of joints that Drake reads."""

_EMPTY = "shapes of size 0 are left out"

_WITH_COMMA = re.compile(r"[-+.\deE\s]*\d,\d[-+.\deE,\s]*")


@dataclass
class Mender:
    """Makes mended copies of files, and collects what is to be known of them.

    A "model" is the name of a model instance, or "" for a robot of a single file.

    Attributes:
        find: The file of a URL or path in a file; None if its package is unknown.
        folders: The folders from which geometry is read.
        leave_out: The key `robot.leave_out`.
        drives: Whether the file's motors count, since the scenario names no driven joints.
        has_geometry, drawn: Whether geometry is read, and converted to such that can be drawn.
        folder: An empty folder for the copies; None makes none.
        omitted, changed: What of the geometry is left out, and what else changed -> the items.
        lost: Part that is lost -> where.
        originals: Copy -> its file.
        efforts: (model, joint) -> effort limit in N m or N.
        armatures: (model, joint) -> rotor inertia at the joint, kg m^2 or kg.
        followers: (model, joint) -> the joint that it follows, the ratio, and the offset.
        standing: (model, joint) -> the position that a coupling gives it, in rad or m.
        floating: Model, name, parent, child and pose of floating joints: x, y and z in m, and
            roll, pitch and yaw in rad.
        crossed: (model, link) of which visual geometry is left out.
        parent_frames: (model, joint) -> the parent that an SDFormat file names.
        count: The number of files that were read.
    """

    find: Callable[[str, Path], Path | None]
    folders: list[Path]
    leave_out: Collection[str] = ()
    drives: bool = True
    has_geometry: bool = True
    drawn: bool = True
    folder: Path | None = None
    omitted: dict[str, list[str]] = field(default_factory=lambda: defaultdict(list))
    changed: dict[str, list[str]] = field(default_factory=lambda: defaultdict(list))
    lost: dict[str, list[str]] = field(default_factory=lambda: defaultdict(list))
    originals: dict[Path, Path] = field(default_factory=dict)
    efforts: dict[tuple[str, str], float] = field(default_factory=dict)
    armatures: dict[tuple[str, str], float] = field(default_factory=dict)
    followers: dict[tuple[str, str], tuple[str, float, float]] = field(default_factory=dict)
    standing: dict[tuple[str, str], float] = field(default_factory=dict)
    floating: list[tuple[str, str, str, str, FloatArray]] = field(default_factory=list)
    crossed: set[tuple[str, str]] = field(default_factory=set)
    parent_frames: dict[tuple[str, str], str] = field(default_factory=dict)
    count: int = 0

    def copy(
        self,
        file: Path,
        model: str = "",
        placed: Collection[str] = (),
        within: tuple[Path, ...] = (),
    ) -> Path:
        """A mended copy of a file.

        Args:
            file: The file; what is neither URDF, SDFormat nor MJCF stays.
            model: Its model.
            placed: Links that the scenario places: joints that fix them to the world are removed.
            within: The files that include this one.
        """
        kind, own = file.suffix, (*within, file.resolve())
        if kind not in READ_BY_DRAKE:
            return file
        root = self._read(file, within)
        if kind == ".xml":
            self._include(root, file, own)
            mjcf.prepare(root, file)
        parents = {child: parent for parent in root.iter() for child in parent}

        def place(node: Element) -> str:
            """The line and name of an element, or of that to which it belongs."""
            line = getattr(node, "line", 0)
            while not node.get("name") and node in parents:
                node = parents[node]
            return f"{file.name}{f':{line}' * bool(line)}: {node.tag} '{node.get('name', '')}'"

        _check_values(root, place)
        armature = {mjcf.ARMATURE}  # Only that of joints without motor is lost.
        for part, node in take_lost(root, kind, set(self.leave_out) - armature):
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

    def _read(self, file: Path, within: tuple[Path, ...]) -> Node:
        if file.resolve() in within:
            names = " -> ".join(path.name for path in (*within, file))
            raise ModelError(f"'{file.name}' includes itself: {names}")
        self.count += 1
        if self.count > MOST_FILES:
            raise ModelError(f"'{within[0].name}' includes more than {MOST_FILES} files")
        return read_xml(file)

    def _check_joint(self, joint: Element, kind: str, place: str) -> None:
        """Checks the type of a joint, and removes limits that Drake refuses."""
        name = joint.get("type", "hinge" if kind == ".xml" else "")
        if name and name not in _TYPES[kind]:
            raise ModelError(
                f"{place}: no joint of type '{name}' is read, but {', '.join(_TYPES[kind])}; two "
                "joints that move together are a !JointCoupler under constraints"
            )
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

    def _mesh(
        self, path: Path | None, name: str, collides: bool, kinds: tuple[str, ...]
    ) -> Path | None:
        """The file of a mesh as Drake reads it; None if it is left out."""
        if self.folder is None:
            return path
        drawn, why = path, ""
        if path is None:
            why = (
                "is in a package neither near nor in ROS_PACKAGE_PATH or AMENT_PREFIX_PATH "
                "(robot.packages can name its folder)"
            )
        elif not path.is_file():
            why = "is not there"
        elif not all_within(path, self.folders):
            why = "is outside of the model's folder or package (robot.packages can name its folder)"
        elif kinds and (drawn := drawable(path, kinds)) is None:
            why = "cannot be converted (pip install 'drake_dae[meshes]' converts more)"
        elif collides and drawn is not None and not has_hull(drawn):
            why = "cannot be read by Drake"
        if not why:
            return drawn
        items = self.omitted[f"geometry that {why} is left out; no equation needs it"]
        items.append(f"'{name if path is None else Path(name).name}'")
        return None

    def _mend_shapes(self, link: Element, file: Path, model: str) -> None:
        """Leaves out what of a link's geometry Drake cannot take, in URDF and SDFormat."""
        name = link.get("name", "")
        for shape in [*link.iterfind("visual"), *link.iterfind("collision")]:
            is_visual, meshes = shape.tag == "visual", list(_files(shape, "geometry", ("mesh",)))
            sizes = [
                size
                for form in (() if meshes else shape.iterfind("geometry/*"))
                for key in ("size", "radius", "length", "radii")
                for size in (form.get(key) or form.findtext(key) or "1").split()
            ]
            if self.has_geometry and any((number_in(size) or 0.0) <= 0.0 for size in sizes):
                self.omitted[_EMPTY].append(f"of '{name}'")
                link.remove(shape)
            elif not self.has_geometry:
                link.remove(shape)
            for owner, key in meshes if self.has_geometry else ():
                text = _text(owner, key)
                kinds = DRAWN if is_visual and self.drawn else ()
                path = self._mesh(self.find(text, file), text, not is_visual, kinds)
                _set_text(owner, key, str(path))
                if path is None:
                    link.remove(shape)
                    self.crossed |= {(model, name)} if is_visual else set()
            for owner, key in _files(shape, "material", ("texture", "drake:diffuse_map")):
                path = self.find(_text(owner, key), file)
                if path is not None and path.is_file() and all_within(path, self.folders):
                    _set_text(owner, key, str(path))
                else:
                    self.omitted["textures are left out"].append(f"'{_text(owner, key)}'")
                    for material in shape.iterfind("material"):
                        _remove(material, owner.tag)

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
                self.standing[model, name] = offset
                joint.remove(mimic)
            elif ratio is not None and offset is not None:
                self.followers[model, name] = (mimic.get("joint", ""), ratio, offset)

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
                    self.efforts[model, name] = effort
                elif "effort" in limit.attrib:  # Many authors write 0 for an unknown limit.
                    still.add(name)
        moving = [joint for joint in root.iterfind("joint") if joint.get("type") != "fixed"]
        joints, count = {joint.get("name") for joint in moving}, Counter[str]()
        for transmission in root.findall("transmission"):
            driven = {joint.get("name") for joint in transmission.iterfind("joint")}
            has_type = "type" in transmission.attrib or transmission.find("type") is not None
            if driven & still and self.drives:
                self.lost["transmission/joint"] += [
                    f"joint '{joint}': effort 0" for joint in driven
                ]
            if not has_type or not driven & joints:
                root.remove(transmission)
                continue
            for actuator in transmission.iterfind("actuator"):  # Their names may be equal.
                count[actuator.get("name", "")] += 1
                if (number := count[actuator.get("name", "")]) > 1:
                    actuator.set("name", f"{actuator.get('name', '')}_{number}")

    def _mend_sdf(
        self,
        root: Element,
        file: Path,
        model: str,
        placed: Collection[str],
        within: tuple[Path, ...],
    ) -> None:
        for uri in root.iterfind(".//include/uri"):
            path = self.find((uri.text or "").strip(), file)
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
                self.parent_frames[model, joint.get("name", "")] = parent
                self._follow(model, joint, "drake:mimic")

    def _include(self, owner: Element, main: Path, within: tuple[Path, ...]) -> None:
        """Puts the content of files that an MJCF file includes into the places of their names."""
        for index, node in reversed(list(enumerate(owner))):
            if node.tag != "include":
                self._include(node, main, within)
                continue
            file = main.parent / node.get("file", "")
            included = self._read(file, within)
            self._include(included, main, (*within, file.resolve()))
            for part in included.iter():
                part.line = 0  # type: ignore[attr-defined]
            owner[index : index + 1] = list(included)

    def _mend_mjcf(self, root: Element, file: Path, model: str, placed: Collection[str]) -> None:
        if not (self.has_geometry and self.drawn):
            mjcf.remove_geometry(root, collides=not self.has_geometry)
        refused: dict[str, str] = {}
        used = mjcf.colliding_meshes(root) if self.has_geometry else set[str]()
        for mesh, path in mjcf.mesh_files(root, file):
            name = mesh.get("file", "")
            readable = self._mesh(path, name, mesh.get("name") in used, (".obj",))
            mesh.set("file", str(readable))
            if readable is None:
                refused[mesh.get("name", "")] = name
        crossed, empty = mjcf.remove_shapes(root, refused)
        self.crossed |= {(model, body) for body in crossed if self.has_geometry}
        if empty:
            self.omitted[_EMPTY] += [f"of '{body}'" for body in empty]
        for name, armature in mjcf.armatures(root):
            if name:
                self.armatures[model, name] = armature
            elif mjcf.ARMATURE not in self.leave_out:
                self.lost[mjcf.ARMATURE].append(f"{file.name}: of a joint that no motor can drive")
        for name, joint in mjcf.floating_bodies(root, placed):
            self.floating.append((model, joint, "world", name, np.zeros(6)))


def _check_values(root: Element, place: Callable[[Element], str]) -> None:
    """Checks for templates, and for commas in numbers, at which Drake ends to read."""
    for node in root.iter():
        for value in (*node.attrib.values(), (node.text or "").strip()):
            if "$(" in value or "${" in value:
                raise ModelError(
                    f"{place(node)}: '{value}': this is a template, of which xacro writes the "
                    "URDF, as xacro FILE -o robot.urdf"
                )
            if "," in value and _WITH_COMMA.fullmatch(value.strip()):
                raise ModelError(
                    f"{place(node)}: '{value.strip()}': numbers have a point and no comma, and "
                    "blanks between them"
                )


def _remove(owner: Element, tag: str) -> None:
    for child in owner.findall(tag) if ":" not in tag else [c for c in owner if c.tag == tag]:
        owner.remove(child)


def _files(shape: Element, way: str, tags: Collection[str]) -> Iterator[tuple[Element, str]]:
    """The elements that name files, and the attribute that does; "" is the text, in SDFormat."""
    for owner in (part for holder in shape.iterfind(way) for part in holder if part.tag in tags):
        uris = [*owner.findall("uri")] or [owner]
        yield from ((owner, "filename") for _ in uris[:1] if "filename" in owner.attrib)
        yield from ((uri, "") for uri in uris if "filename" not in owner.attrib)


def _text(owner: Element, key: str) -> str:
    return (owner.get(key, "") if key else owner.text or "").strip()


def _set_text(owner: Element, key: str, value: str) -> None:
    if key:
        owner.set(key, value)
    else:
        owner.text = value


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
            name = material.get("name", "")
            if name and name in colours:
                material[:] = colours[name]
            elif not len(material):
                owner.remove(material)
