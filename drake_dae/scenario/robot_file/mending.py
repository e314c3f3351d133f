"""Copies of a robot's files, mended so that Drake's parser reads them as their authors mean them.

A copy has possible inertias, and geometry that can be read and drawn; it lacks what Drake does not
read. What changed on the way is collected, and so is what is lost.
"""

from collections import Counter, defaultdict
from collections.abc import Collection
from functools import cache
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element, SubElement

import numpy as np
from pydrake.geometry import Mesh
from pydrake.multibody.tree import RotationalInertia

from drake_dae.arrays import FloatArray, number_in
from drake_dae.errors import GeometryWarning, ModelError, RobotFileWarning
from drake_dae.scenario.robot_file import mjcf
from drake_dae.scenario.robot_file.files import RobotFiles, drawable
from drake_dae.scenario.robot_file.read_by_drake import DRIVES, READ_BY_DRAKE, take_lost
from drake_dae.scenario.robot_file.robot import Robot
from drake_dae.scenario.robot_file.xml_tree import check_included, read_xml, write_xml

_ROUND = {"radius": 1, "length": 1}
_SIZES = {"box": {"size": 3}, "sphere": {"radius": 1}, "cylinder": _ROUND, "capsule": _ROUND}
_SIZES |= {"ellipsoid": {}, "mesh": {}}
"""Shape -> how many numbers its sizes have, in URDF and SDFormat."""

_OF_MANY_AXES = ("planar", "floating", "universal", "ball", "free")
"""Types of joints that no motor drives, and that follow no other joint."""

_FLAT = 1e-8
"""A scale of a mesh up to which Drake takes none."""


class Mender:
    """Makes mended copies of files. A "model" is the name of a model instance, "" for a lone robot.

    `folder` is an empty one for the copies, None to make none; `shapes` has "read" if geometry is
    read, and "drawn" if it is converted to be drawn.
    """

    def __init__(
        self, files: RobotFiles, robot: Robot, folder: Path | None, shapes: Collection[str] = ()
    ) -> None:
        self.files, self.leave_out, self.folder = files, robot.leave_out, folder
        self.drives = robot.actuators is None  # Else the file's motors do not count.
        self.has_geometry, self.drawn = "read" in shapes, "drawn" in shapes
        # Category of a warning and its text -> what it concerns; part that is lost -> where.
        self.told: dict[tuple[type[Warning], str], list[str]] = defaultdict(list)
        self.lost: dict[str, list[str]] = defaultdict(list)
        self.originals: dict[Path, Path] = {}  # Copy -> its file.
        # "effort" limit, "armature", "follows" (leader, ratio, offset), "parent" of SDFormat ->
        # (model, joint) -> value.
        self.joints: dict[str, dict[tuple[str, str], Any]] = defaultdict(dict)
        # Joints that the copies lack: model, name, child, and the frame that is their origin.
        self.floating: list[tuple[str, str, str, str]] = []
        self.crossed: set[tuple[str, str]] = set()  # (model, link) without a visual shape.

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
        kind = file.suffix
        if kind not in READ_BY_DRAKE:
            return file
        check_included(file, within)
        root = read_xml(file)
        if kind == ".xml":
            for servo in mjcf.expand(root, file):
                text = "servos become motors without their gains: controls are efforts"
                self.tell(text, f"'{servo}'")
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
                    way = "is a template: xacro FILE -o robot.urdf writes the URDF"
                    raise ModelError(f"{place(node)}: '{value.strip()}' {way}")
                if "," in value and number_in(value.replace(",", ".", 1)) is not None:
                    raise ModelError(f"{place(node)}: '{value}': numbers have a point, no comma")
        # Only the armature of joints without motor is lost.
        for one in take_lost(root, kind, {*self.leave_out} - {mjcf.ARMATURE}):
            where = place(one.owner)
            if one.is_told:
                self.tell("Drake does not read, and leaves out", f"{where}: {one.part} {one.value}")
            else:
                self.lose(one.part, where)
        for inertial in root.iter("inertial"):
            if text := _mend_inertia(inertial, kind, place(inertial)):
                self.lose("inertia", text)
                self.tell("moments of inertia of no body become possible ones", text)
        for joint in root.iter("joint"):
            self._mend_limits(joint, place(joint))
        if kind == ".urdf":
            self._mend_urdf(root, file, model, placed)
        elif kind == ".sdf":
            for joint in root.iter("joint"):
                self._mend_axes(joint, place(joint))
            self._mend_sdf(root, file, model, placed, (*within, file.resolve()))
        else:
            self._mend_mjcf(root, file, model, placed)
        if self.folder is None:
            return file
        copy = self.folder / str(len(self.originals)) / file.name
        copy.parent.mkdir()
        copy.write_text(write_xml(root), "utf-8")
        self.originals[copy] = file
        return copy

    def tell(self, kind: str, item: str, category: type[Warning] = RobotFileWarning) -> None:
        self.told[category, kind].append(item)

    def lose(self, part: str, item: str) -> None:
        if part not in self.leave_out and (self.drives or not part.startswith(DRIVES)):
            self.lost[part].append(item)

    def _mend_limits(self, joint: Element, place: str) -> None:
        """Removes limits that Drake refuses, and those of joints that have none."""
        is_continuous = joint.get("type") == "continuous"
        for owner in (joint, *joint.iterfind("limit"), *joint.iterfind("*/limit")):
            sides = [owner.get(side) or owner.findtext(side) or "" for side in ("lower", "upper")]
            bounds = [number_in(word) for word in owner.get("range", "").split() or sides]
            low, high = bounds if len(bounds) == 2 else (None, None)
            is_reversed = low is not None and high is not None and low > high
            if is_reversed and not is_continuous:
                self.lose("empty_limits", f"{place}: limits from {low:g} to {high:g}")
            for key in ("range", "lower", "upper") if is_reversed or is_continuous else ():
                owner.attrib.pop(key, None)
                _remove(owner, key)

    def _follow(self, model: str, joint: Element, tag: str) -> None:
        """Takes out what a joint follows, unless Drake reports what is wrong."""
        name = joint.get("name", "")
        for mimic in [part for part in joint if part.tag == tag]:
            ratio = number_in(mimic.get("multiplier", "1"))
            offset = number_in(mimic.get("offset", "0"))
            if joint.get("type") in _OF_MANY_AXES:
                self.lose(f"joint/{tag}", f"joint '{name}'")
            elif ratio is not None and offset is not None and "joint" in mimic.attrib:
                joint.remove(mimic)
                self.joints["follows"][model, name] = (mimic.get("joint"), ratio, offset)
                if ratio == 0.0:
                    self.tell("joints that follow others with multiplier 0 stand", f"'{name}'")

    # Geometry.

    def _leave_out(self, why: str, item: str) -> None:
        text = f"geometry that {why} is left out; no equation needs it"
        self.tell(text, item, GeometryWarning)

    def _mesh(self, name: str, path: Path | None, collides: bool, kinds: tuple[str, ...]) -> str:
        """The file of a mesh as Drake reads it, of some kinds if any; "" if it is left out."""
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
        elif kinds and (drawn := drawable(path, kinds)) is None:
            why = "cannot be converted (pip install 'drake_dae[meshes]' converts more)"
        elif collides and drawn and not _has_hull(str(drawn), drawn.stat().st_mtime_ns):
            why = "cannot be read by Drake"
        if why:
            self._leave_out(why, f"'{name if path is None else Path(name).name}'")
        return "" if why else str(drawn)

    def _mend_shapes(self, link: Element, file: Path, model: str) -> None:
        """Leaves out what of a link's geometry Drake cannot take, in URDF and SDFormat."""
        name, kinds = link.get("name", ""), (".obj", ".gltf") if self.drawn else ()
        for shape in [*link.iterfind("visual"), *link.iterfind("collision")]:
            is_visual = shape.tag == "visual"
            faults = (_fault(form, file.suffix) for form in shape.iterfind("geometry/*"))
            if fault := next(filter(None, faults), ""):
                self._leave_out(fault, f"of '{name}'")
                link.remove(shape)
                continue
            for mesh in shape.iterfind("geometry/mesh"):
                uri = mesh.find("uri")
                text = mesh.get("filename", "") if uri is None else (uri.text or "").strip()
                found = self.files.find(text, file)
                path = self._mesh(text, found, not is_visual, kinds if is_visual else ())
                if uri is None:
                    mesh.set("filename", path)
                else:
                    uri.text = path
                if not path:
                    link.remove(shape)
                    self.crossed |= {(model, name)} if is_visual else set()
            for material in shape.iterfind("material"):
                if _remove(material, "texture") + _remove(material, "drake:diffuse_map"):
                    self.tell("textures are left out", f"of '{name}'", GeometryWarning)

    # URDF.

    def _mend_urdf(self, root: Element, file: Path, model: str, placed: Collection[str]) -> None:
        root.attrib.setdefault("name", file.stem)
        _remove(root, "mujoco")
        for link in root.iterfind("link") if self.has_geometry else ():
            self._mend_shapes(link, file, model)
        # Drake refuses names of several colours, of none, or of one that is defined later.
        colours: dict[Any, list[Element]] = {}
        for material in root.iter("material"):
            if len(material):
                colours.setdefault(material.get("name") or material, list(material))
        for owner in root.iter():
            for material in owner.findall("material"):
                material[:] = colours.get(material.get("name") or material, [])
                if not len(material):
                    owner.remove(material)
        moving, still = set[str | None](), set[str | None]()  # Still are those without a motor.
        for joint in (*root.findall("joint"), *root.findall("drake:joint")):
            name, kind = joint.get("name", ""), joint.get("type")
            ends = joint.find("parent"), joint.find("child")
            parent, child = ("" if end is None else end.get("link", "") for end in ends)
            if kind == "fixed":
                _remove(joint, "mimic")
            else:
                moving.add(name)
            if kind == "floating" or (kind == "fixed" and parent == "world" and child in placed):
                root.remove(joint)
            if kind == "floating" and not (parent == "world" and child in placed):
                origin = joint.find("origin")
                own = {"name": f"{name}_origin", "link": parent, "xyz": "0 0 0", "rpy": "0 0 0"}
                SubElement(root, "frame", own | ({} if origin is None else origin.attrib))
                self.floating.append((model, name, child, own["name"]))
            self._follow(model, joint, "mimic")
            still |= {name} if kind in _OF_MANY_AXES else set()
            for limit in joint.iterfind("limit[@effort]"):
                effort = number_in(limit.get("effort", "")) or 0.0
                if effort > 0.0:
                    self.joints["effort"][model, name] = effort
                else:  # Many authors write 0 for an unknown limit.
                    still.add(name)
        count = Counter[str]()
        for transmission in root.findall("transmission"):
            driven = {joint.get("name") for joint in transmission.iterfind("joint")}
            has_type = "type" in transmission.attrib or transmission.find("type") is not None
            for one in driven & still:
                why = "its effort is 0, or it has more than one axis"
                self.lose("transmission/joint", f"joint '{one}': {why}")
            if not has_type or not driven & moving or driven & still:
                root.remove(transmission)
                continue
            for actuator in transmission.iterfind("actuator"):  # Their names may be equal.
                name = actuator.get("name", "")
                count[name] += 1
                actuator.set("name", f"{name}_{count[name]}" if count[name] > 1 else name)

    # SDFormat.

    def _mend_axes(self, joint: Element, place: str) -> None:
        """Refuses two dampings, of which Drake reads one; writes the pitch of a screw in m."""
        axes = (part for part in joint if part.tag in ("axis", "axis2"))
        dampings = [axis.findtext("dynamics/damping", "0") for axis in axes]
        if len({*map(number_in, dampings)}) > 1:
            self.lose("axis2/damping", f"{place}: {' and '.join(dampings)}")
        pitch = joint.find("thread_pitch")
        if pitch is not None:  # In rad/m, of a thread that turns left.
            joint.remove(pitch)
            number = number_in(pitch.text or "")
            if number == 0.0:
                raise ModelError(f"{place}: with thread_pitch 0 it is no screw; mend the file")
            if number is not None and joint.find("screw_thread_pitch") is None:
                SubElement(joint, "screw_thread_pitch").text = repr(-2.0 * np.pi / number)

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
            for link in body.iterfind("link") if self.has_geometry else ():
                self._mend_shapes(link, file, model)
            for joint in body.findall("joint"):
                parent, child = (joint.findtext(end, "").strip() for end in ("parent", "child"))
                if parent == "world" and joint.get("type") == "fixed" and child in placed:
                    body.remove(joint)
                self.joints["parent"][model, joint.get("name", "")] = parent
                self._follow(model, joint, "drake:mimic")

    # MJCF, which says all where it means it.

    def _mend_mjcf(self, root: Element, file: Path, model: str, placed: Collection[str]) -> None:
        self._mend_geoms(root, file, model)
        if not self.has_geometry:
            _remove(root, "contact")
        kinds = {one.get("name", ""): one.get("type", "hinge") for one in root.iter("joint")}
        kinds |= {one.get("name", ""): "free" for one in root.iter("freejoint")}
        for owner in root.iterfind("actuator"):
            for motor in owner.findall("motor"):
                if (kind := kinds.get(motor.get("joint", ""))) in _OF_MANY_AXES:
                    owner.remove(motor)
                    name = motor.get("name", motor.get("joint"))
                    self.lose(f"{kind}/motor", f"{file.name}: motor '{name}'")
        for joint in root.iter("joint"):
            name, armature = joint.get("name", ""), number_in(joint.get("armature", ""))
            if armature and name and joint.get("type", "hinge") in ("hinge", "slide"):
                self.joints["armature"][model, name] = armature
            elif armature:
                self.lose(mjcf.ARMATURE, f"{file.name}: of a joint that no motor can drive")
        for name, free in mjcf.floating_bodies(root, placed):
            self.floating.append((model, free, name, "world"))

    def _mend_geoms(self, root: Element, file: Path, model: str) -> None:
        """Leaves out what of the geometry Drake cannot take, unless a body has its mass from it."""
        options = mjcf.compiler(root)
        folder = file.resolve().parent / options.get("meshdir", options.get("assetdir", ""))
        meshes, used, shells = dict[str, Element](), dict[str, str](), set[str]()
        for asset in root.iterfind("asset/mesh"):
            if "file" in asset.attrib:
                asset.attrib.setdefault("name", Path(asset.get("file", "")).stem)
                meshes[asset.get("name", "")] = asset
            if asset.attrib.pop("inertia", "") == "shell":
                shells.add(asset.get("name", ""))
        colliding = {geom.get("mesh") for geom in root.iter("geom") if mjcf.collides(geom)}
        for geom, body, moves in mjcf.geoms(root):
            name, mesh, fault = body.get("name", ""), geom.get("mesh", ""), mjcf.fault(geom)
            weighs = moves and number_in(geom.get("mass", "1")) != 0.0
            weighs &= mjcf.weighs_by_geometry(root) or body.find("inertial") is None
            is_seen = self.has_geometry and (self.drawn or mjcf.collides(geom))
            if mesh in meshes and mesh not in used and (weighs or is_seen):
                own = meshes[mesh].get("file", "")
                is_hull = self.has_geometry and mesh in colliding
                used[mesh] = self._mesh(own, folder / own, is_hull, (".obj",))
                meshes[mesh].set("file", used[mesh])
            is_refused = mesh in used and not used[mesh]
            why = "" if fault == mjcf.EMPTY and "mass" not in geom.attrib else fault
            if is_refused or mesh in shells:
                why = (
                    f"is the mesh '{mesh}', which Drake cannot read, or not as a shell (trimesh "
                    "reads more: pip install 'drake_dae[meshes]')"
                )
            if weighs and why:
                text = f"body '{name}' has its mass from geometry that {why}"
                raise ModelError(f"{text}; give the body an <inertial>")
            if is_seen and is_refused:
                self.crossed.add((model, name))
            elif is_seen and fault:
                self._leave_out(fault, f"of '{name}'")
            if is_refused or fault or not (weighs or is_seen):
                body.remove(geom)
        for owner in root.iterfind("asset"):
            for asset in owner.findall("mesh"):
                if "file" in asset.attrib and not used.get(asset.get("name", "")):
                    owner.remove(asset)


def _fault(form: Element, kind: str) -> str:
    """Why Drake takes no such shape of URDF or SDFormat; "" if it does."""
    sizes = _SIZES.get(form.tag.removeprefix("drake:"))
    if sizes is None and not (kind == ".sdf" and form.tag in ("plane", "empty")):
        return mjcf.UNREAD
    for key in ("size", "radius", "length", "radii", "a", "b", "c", "scale"):
        words = (form.get(key) or form.findtext(key) or "").split()
        count = (sizes or {}).get(key, len(words))
        if len(words) != count and (words or kind == ".urdf"):
            return mjcf.UNREAD
        numbers = [number_in(word) or 0.0 for word in words]
        if any(abs(number) <= _FLAT if key == "scale" else number <= 0.0 for number in numbers):
            return mjcf.EMPTY
    return ""


@cache
def _has_hull(mesh: str, changed: int) -> bool:
    """Whether Drake can compute the convex hull that a collision needs, of a file of a time."""
    try:
        Mesh(mesh).GetConvexHull()
    except RuntimeError:
        return False
    return True


def _remove(owner: Element, tag: str) -> int:
    """Removes the children of a tag; returns how many there were."""
    children = [child for child in owner if child.tag == tag]
    for child in children:
        owner.remove(child)
    return len(children)


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


def _mend_inertia(inertial: Element, kind: str, place: str) -> str:
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
    written = [repr(float(entry)) for entry in nearest[_ROWS, _COLUMNS]]
    if (matrix := inertial.find("inertia")) is None:
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
    """Mass in kg, and xx, yy, zz, xy, xz and yz in kg m^2; none if entries are missing."""
    matrix = inertial.find("inertia")
    if kind == ".xml":
        entries = inertial.get("fullinertia", inertial.get("diaginertia", "")).split()
        return [inertial.get("mass", "0"), *entries, *["0"] * 3][: 7 if entries[2:] else 0]
    if matrix is None:
        return []
    if kind == ".urdf":
        mass = inertial.find("mass")
        weight = "0" if mass is None else mass.get("value", "0")
        return [weight, *(matrix.get(key, "0") for key in _ENTRIES)]
    own = zip(_ENTRIES, "111000", strict=True)  # The defaults of SDFormat are a unit matrix.
    return [inertial.findtext("mass", "1"), *(matrix.findtext(key, zero) for key, zero in own)]
