"""Copies of a robot's files, mended so that Drake's parser reads them as their authors mean them.

A copy has possible inertias, and geometry that can be read and drawn; it lacks what is not read.
What changed on the way is collected, and so is what is lost, for which `reading` refuses the robot
unless `leave_out` names it.
"""

import logging
from collections import Counter, defaultdict
from collections.abc import Mapping
from functools import cache, lru_cache
from pathlib import Path
from threading import get_native_id
from typing import Any
from xml.etree.ElementTree import Element, SubElement, tostring

import numpy as np
from pydrake.geometry import Mesh, SceneGraph
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import RotationalInertia

from drake_dae.arrays import FloatArray, number_in
from drake_dae.errors import GeometryWarning, ModelError, RobotFileWarning
from drake_dae.scenario.robot_file.read_by_drake import (
    DRIVES,
    READ_BY_DRAKE,
    place_of,
    read_xml,
    take_lost,
    write_xml,
)
from drake_dae.scenario.robot_file.robot import Robot, RobotFiles, drawable

ARMATURE = "joint/armature"
"""Rotor inertia of MJCF. Drake gives it to motors only."""

_OF_MANY_AXES = ("planar", "floating", "universal", "ball", "free")
"""Types of joints that no motor drives, and that follow no other joint."""

_TURNS = {"quat", "axisangle", "euler", "xyaxes", "zaxis"}

_SERVOS = ("position", "velocity", "intvelocity", "general")
"""Actuators whose control is no effort, while their range of forces limits an effort."""

_ACTUATORS = (*_SERVOS, "motor", "damper", "cylinder")
"""What in a class has one default, under any of these names."""

_LAW = ("dyntype", "gaintype", "biastype")

_OF_GENERAL = {*_LAW, "dynprm", "gainprm", "biasprm"}
"""What motors and servos set themselves, whatever is the default."""

_PROBES = {
    ".urdf": '<robot name="r"><link name="a">{}</link></robot>',
    ".sdf": '<sdf version="1.9"><model name="r"><link name="a">{}</link></model></sdf>',
    ".xml": '<mujoco model="r"><asset>{1}</asset><worldbody><body>{0}</body></worldbody></mujoco>',
}
"""Models of a lone shape, and of its mesh."""


class Mender:
    """Makes mended copies of files. A "model" is the name of a model instance, "" for a lone robot.

    `folder` is an empty one for the copies; with `has_geometry` geometry is read, and with `drawn`
    converted to be drawn.
    """

    def __init__(
        self, files: RobotFiles, robot: Robot, folder: Path, has_geometry: bool, drawn: bool
    ) -> None:
        self.files, self.leave_out, self.folder = files, robot.leave_out, folder
        self.drives = robot.actuators is None  # Else the file's motors do not count.
        self.has_geometry, self.drawn = has_geometry, drawn
        # Links that the scenario places, so that no joint fixes them to the world.
        self.placed = {*robot.free, *([robot.base.weld] if robot.base is not None else [])}
        # Category of a warning and its text -> what it concerns; part that is lost -> where.
        self.told: dict[tuple[type[Warning], str], list[str]] = defaultdict(list)
        self.lost: dict[str, list[str]] = defaultdict(list)
        self.copies = 0
        # (model, joint) -> "effort" limit, "armature", and "follows" (leader, ratio, offset).
        self.joints: dict[tuple[str, str], dict[str, Any]] = defaultdict(dict)
        # Joints that the copies lack: model, name, child, and the frame that is their origin.
        self.floating: list[tuple[str, str, str, str]] = []

    def copy(self, file: Path, model: str = "") -> Path:
        """A mended copy of a file; one that is neither URDF, SDFormat nor MJCF stays."""
        kind = file.suffix
        if kind not in READ_BY_DRAKE:
            return file
        with self.files.within(file):
            root = read_xml(file)
            if kind == ".xml":
                self._expand(root, file)
            for node in root.iter():
                for value in map(str.strip, (*node.attrib.values(), node.text or "")):
                    if "$(" in value or "${" in value:
                        way = "is a template: xacro FILE -o robot.urdf writes the URDF"
                        raise ModelError(f"{place_of(node)}: '{value}' {way}")
                    if "," in value and number_in(value.replace(",", ".", 1)) is not None:
                        text = f"'{value}': numbers have a point, no comma"
                        raise ModelError(f"{place_of(node)}: {text}")
            for mesh in root.iterfind(".//link/*/geometry/mesh"):
                self.files.find(_uri_of(mesh), file)  # What is missing is collected.
            # Only the armature of joints without motor is lost.
            for part, place in take_lost(root, kind, {*self.leave_out} - {ARMATURE}):
                self.lose(part, place)
            for inertial in root.iter("inertial"):
                if text := _mend_inertia(inertial, kind):
                    self.lose("inertia", text)
                    self.tell("moments of inertia of no body become possible ones", text)
            for joint in root.iter("joint"):
                self._mend_limits(joint)
            mends = {".urdf": self._mend_urdf, ".sdf": self._mend_sdf, ".xml": self._mend_mjcf}
            mends[kind](root, file, model)
        copy = self.folder / str(self.copies) / file.name
        self.copies += 1
        copy.parent.mkdir()
        copy.write_text(write_xml(root), "utf-8")
        return copy

    def tell(self, kind: str, item: str, category: type[Warning] = RobotFileWarning) -> None:
        self.told[category, kind].append(item)

    def lose(self, part: str, item: str) -> None:
        if part not in self.leave_out and (self.drives or not part.startswith(DRIVES)):
            self.lost[part].append(item)

    def _mend_limits(self, joint: Element) -> None:
        """Removes limits that Drake refuses, those of joints that have none, and speeds of 0."""
        is_continuous = joint.get("type") == "continuous"
        for owner in (joint, *joint.iterfind("limit"), *joint.iterfind("*/limit")):
            keys = ("lower", "upper", "velocity")
            sides = [owner.get(key) or owner.findtext(key) or "" for key in keys]
            bounds = [number_in(word) for word in owner.get("range", "").split() or sides[:2]]
            low, high = bounds if len(bounds) == 2 else (None, None)
            is_reversed = low is not None and high is not None and low > high
            if is_reversed and not is_continuous:
                self.lose("empty_limits", f"{place_of(joint)}: limits from {low:g} to {high:g}")
            is_empty = low is not None and low == high and "empty_limits" in self.leave_out
            gone = ["range", *keys[:2]] if is_continuous or is_reversed or is_empty else []
            # Many authors write 0 for an unknown speed.
            for key in (*gone, *keys[2:] * (number_in(sides[2]) == 0.0)):
                owner.attrib.pop(key, None)
                _remove(owner, key)

    # Geometry.

    def _leave_out(self, why: str, item: str) -> None:
        text = f"geometry that {why} is left out; no equation needs it"
        self.tell(text, item, GeometryWarning)

    def _mesh(self, name: str, path: Path | None, collides: bool, kinds: tuple[str, ...]) -> str:
        """The file of a mesh as Drake reads it, of some kinds if any; "" if it is left out."""
        drawn, why, way = path, "", "(robot.packages can name its folder)"
        if path is None:
            why = f"is in a package neither near nor in ROS_PACKAGE_PATH or AMENT_PREFIX_PATH {way}"
        elif not path.is_file():
            why = "is not there"
        elif not self.files.holds(path):
            why = f"is outside of the model's folder or package {way}"
        elif kinds and (drawn := drawable(path, kinds)) is None:
            why = "cannot be converted (pip install 'drake_dae[meshes]' converts more)"
        elif collides and drawn and not _has_hull(str(drawn), drawn.stat().st_mtime_ns):
            why = "cannot be read by Drake"
        if why:
            self._leave_out(why, f"'{name if path is None else Path(name).name}'")
        return "" if why else str(drawn)

    def _mend_shapes(self, link: Element, file: Path) -> None:
        """Leaves out what of a link's geometry Drake cannot take, in URDF and SDFormat."""
        kinds = (".obj", ".gltf") if self.drawn else ()
        for shape in [*link.iterfind("visual"), *link.iterfind("collision")]:
            is_visual, is_kept = shape.tag == "visual", True
            for mesh in shape.iterfind("geometry/mesh"):
                uri, text = mesh.find("uri"), _uri_of(mesh)
                found = self.files.find(text, file)
                path = self._mesh(text, found, not is_visual, kinds if is_visual else ())
                if uri is None:
                    mesh.set("filename", f"file://{path}")
                else:
                    uri.text = f"file://{path}"
                is_kept = is_kept and bool(path)
            if not is_kept:
                link.remove(shape)
                continue
            forms = "".join(tostring(form, "unicode") for form in shape.iterfind("geometry"))
            text = f'<{shape.tag} name="s">{forms}</{shape.tag}>'
            if not _is_read(file.suffix, _PROBES[file.suffix].format(text)):
                self._leave_out("Drake does not read", f"of '{link.get('name', '')}'")
                link.remove(shape)

    # URDF and SDFormat.

    def _mend_joint(self, joint: Element, owner: Element, model: str) -> None:
        name, kind = joint.get("name", ""), joint.get("type")
        ends = joint.find("parent"), joint.find("child")
        words = ("" if end is None else end.get("link") or end.text or "" for end in ends)
        parent, child = map(str.strip, words)
        of_file, is_placed = self.joints[model, name], parent == "world" and child in self.placed
        of_file["parent"] = parent
        if kind == "floating" or (kind == "fixed" and is_placed):
            owner.remove(joint)
        if kind == "floating" and not is_placed:
            origin = joint.find("origin")
            own = {"name": f"{name}_origin", "link": parent, "xyz": "0 0 0", "rpy": "0 0 0"}
            SubElement(owner, "frame", own | ({} if origin is None else origin.attrib))
            self.floating.append((model, name, child, own["name"]))
        for limit in joint.iterfind("limit[@effort]"):
            of_file["effort"] = number_in(limit.get("effort", "")) or 0.0
        # What is wrong with a mimic is reported by Drake.
        for mimic in (*joint.findall("mimic"), *joint.findall("drake:mimic")):
            ratio = number_in(mimic.get("multiplier", "1"))
            offset = number_in(mimic.get("offset", "0"))
            if kind in _OF_MANY_AXES:
                self.lose(f"joint/{mimic.tag}", f"joint '{name}'")
            elif kind == "fixed":
                joint.remove(mimic)
            elif ratio is not None and offset is not None and "joint" in mimic.attrib:
                joint.remove(mimic)
                of_file["follows"] = (mimic.get("joint"), ratio, offset)

    def _mend_urdf(self, root: Element, file: Path, model: str) -> None:
        root.attrib.setdefault("name", file.stem)
        for link in root.iterfind("link") if self.has_geometry else ():
            self._mend_shapes(link, file)
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
        joints = [*root.findall("joint"), *root.findall("drake:joint")]
        for joint in joints:
            self._mend_joint(joint, root, model)
        # Many authors write 0 for an unknown limit, with which Drake makes no actuator.
        kinds = {joint.get("name", ""): joint.get("type") for joint in joints}
        still = {name for name in kinds if self.joints[model, name].get("effort") == 0.0}
        still |= {name for name, kind in kinds.items() if kind in _OF_MANY_AXES}
        moving = {name for name, kind in kinds.items() if kind != "fixed"}
        count = Counter[str]()
        for transmission in root.findall("transmission"):
            driven = {joint.get("name", "") for joint in transmission.iterfind("joint")}
            has_type = "type" in transmission.attrib or transmission.find("type") is not None
            for name in driven & still:
                text = f"joint '{name}': its effort is 0, or it has more than one axis"
                self.lose("transmission/joint", text)
            if not has_type or not driven & moving or driven & still:
                root.remove(transmission)
                continue
            for actuator in transmission.iterfind("actuator"):  # Their names may be equal.
                name = actuator.get("name", "")
                count[name] += 1
                actuator.set("name", f"{name}_{count[name]}" if count[name] > 1 else name)

    def _mend_sdf(self, root: Element, file: Path, model: str) -> None:
        for uri in root.iterfind(".//include/uri"):
            path = self.files.find((uri.text or "").strip(), file)
            if path is not None and path.is_dir():
                path = next(iter(sorted(path.glob("*.sdf"))), None)
            if path is not None and path.is_file():
                uri.text = self.copy(path, model).resolve().as_uri()
        for number, body in enumerate(root.iter("model")):
            body.attrib.setdefault("name", file.stem + f"_{number}" * bool(number))
            for link in body.iterfind("link") if self.has_geometry else ():
                self._mend_shapes(link, file)
            for joint in body.findall("joint"):
                self._mend_joint(joint, body, model)

    # MJCF: each element of the copy says all that it means, where it means it.

    def _expand(self, root: Element, file: Path) -> None:
        """Puts included files and defaults of classes into their places, and mends what is there.

        Inactive equalities go. Servos become motors, since controls are efforts here, and the
        limits of motors those of the efforts at joints, the gear times those of motors. Bodies of
        mass 0, which MuJoCo takes if they do not move or move with others, lose their inertia, and
        their geometry its mass.
        """
        self._include(root, file)
        root.attrib.setdefault("model", file.stem)
        _apply_defaults(root)
        if _compiler(root).get("coordinate") == "global":
            way = "MuJoCo up to 2.3.2 reads it, and saves it with local ones"
            raise ModelError(f"'{file.name}' has global coordinates; {way}")
        for equality in root.iterfind("equality"):
            for constraint in list(equality):
                if constraint.attrib.pop("active", "true") == "false":
                    equality.remove(constraint)
        for joint in root.iter("joint"):  # MuJoCo takes an empty range for none.
            is_empty = not any(map(number_in, joint.get("range", "").split()))
            if joint.get("limited", "auto") in ("false", *["auto"] * is_empty):
                joint.attrib.pop("range", None)
        kinds = {one.get("name", ""): one.get("type", "hinge") for one in root.iter("joint")}
        kinds |= {one.get("name", ""): "free" for one in root.iter("freejoint")}
        for owner, motor in [(one, motor) for one in root.iterfind("actuator") for motor in one]:
            law = motor.attrib.keys() & _OF_GENERAL if motor.tag in _SERVOS else set()
            own, gain = {key: motor.attrib.pop(key) for key in law}, 1.0
            if motor.tag == "general" and {own.get(k, "") for k in _LAW} <= {"", "none", "fixed"}:
                motor.tag = "motor"  # Of a control in another unit.
                gain = abs(_first(own.get("gainprm", "")))
            elif motor.tag in _SERVOS:  # Its control is no effort, and neither are its limits.
                motor.tag = "motor"
                text = "servos become motors without their gains: controls are efforts"
                self.tell(text, f"'{motor.get('name', motor.get('joint', ''))}'")
                for key in ("ctrlrange", "ctrllimited"):
                    motor.attrib.pop(key, None)
            gear = abs(_first(motor.get("gear", "")))
            for key, scale in (("ctrlrange", gain * gear), ("forcerange", gear)):
                bounds = [number_in(word) for word in motor.get(key, "").split()]
                if scale != 1.0 and bounds and None not in bounds:
                    motor.set(key, " ".join(repr(scale * (bound or 0.0)) for bound in bounds))
            kind = kinds.get(motor.get("joint", ""))
            if motor.tag == "motor" and kind in _OF_MANY_AXES:
                owner.remove(motor)
                self.lose(f"{kind}/motor", place_of(motor))
        for body in root.iter("body") if _compiler(root).get("inertiafromgeom") != "true" else ():
            inertial = body.find("inertial")
            if inertial is not None and number_in(inertial.get("mass", "")) == 0.0:
                body.remove(inertial)
                for geom in body.iterfind("geom"):
                    geom.set("mass", "0")

    def _include(self, owner: Element, main: Path) -> None:
        for index, node in reversed(list(enumerate(owner))):
            if node.tag != "include":
                self._include(node, main)
                continue
            file = main.parent / node.get("file", "")
            with self.files.within(file):
                included = read_xml(file)
                self._include(included, main)
            for part in included.iter():
                part.line = 0  # type: ignore[attr-defined]
            owner[index : index + 1] = list(included)

    def _mend_mjcf(self, root: Element, file: Path, model: str) -> None:
        self._mend_geoms(root, file)
        if not self.has_geometry:
            _remove(root, "contact")
        for joint in root.iter("joint"):
            name, armature = joint.get("name", ""), number_in(joint.get("armature", ""))
            if armature and name and joint.get("type", "hinge") in ("hinge", "slide"):
                self.joints[model, name]["armature"] = armature
            elif armature:
                self.lose(ARMATURE, f"{place_of(joint)}, which no motor can drive")
        for body in root.iterfind("worldbody/body"):
            name = body.get("name", "")
            free = [*body.iterfind("freejoint"), *body.iterfind("joint[@type='free']")]
            if free and name not in self.placed:
                self.floating.append((model, free[0].get("name", name), name, "world"))
            elif name in self.placed and not free and body.find("joint") is None:
                SubElement(body, "freejoint")  # Else Drake welds it.

    def _mend_geoms(self, root: Element, file: Path) -> None:
        """Leaves out what of the geometry Drake cannot take, unless a body has its mass from it."""
        options, meshes, paths = _compiler(root), dict[str, Element](), dict[str, str]()
        folder = file.resolve().parent / options.get("meshdir", options.get("assetdir", ""))
        for mesh in root.iterfind("asset/mesh[@file]"):  # Drake reads no others.
            mesh.attrib.setdefault("name", Path(mesh.get("file", "")).stem)
            meshes[mesh.get("name", "")] = mesh
        shells = {
            name for name, mesh in meshes.items() if mesh.attrib.pop("inertia", "") == "shell"
        }
        hulls = {geom.get("mesh") for geom in root.iter("geom") if _collides(geom)}
        joints = "joint", "freejoint"
        moved = [body for body in root.iter("body") if any(one.tag in joints for one in body)]
        moving = {geom for body in moved for geom in body.iter("geom")}
        bodies = [*root.iterfind("worldbody"), *root.iter("body")]
        for body, geom in [(owner, geom) for owner in bodies for geom in owner.findall("geom")]:
            weighs = geom in moving and number_in(geom.get("mass", "1")) != 0.0
            weighs &= options.get("inertiafromgeom") == "true" or body.find("inertial") is None
            if not weighs and not (self.has_geometry and (self.drawn or _collides(geom))):
                body.remove(geom)
                continue
            name, asset = geom.get("mesh", ""), ""
            if name in meshes:
                if name not in paths:
                    file_name = meshes[name].get("file", "")
                    is_hull = self.has_geometry and name in hulls
                    paths[name] = self._mesh(file_name, folder / file_name, is_hull, (".obj",))
                    meshes[name].set("file", paths[name])
                asset = tostring(meshes[name], "unicode")
            own = {key: value for key, value in geom.items() if key not in ("name", "material")}
            probe = _PROBES[".xml"].format(tostring(Element("geom", own), "unicode"), asset)
            is_told, is_shell = paths.get(name) == "", weighs and name in shells
            if not is_told and not is_shell and _is_read(".xml", probe):
                continue
            where = f"of '{body.get('name', '')}'"
            if weighs:
                text = f"the mass {where} is that of geometry which Drake does not read"
                raise ModelError(f"{place_of(geom)}: {text}; give the body an <inertial>")
            if not is_told:
                self._leave_out("Drake does not read", where)
            body.remove(geom)
        for owner in root.iterfind("asset"):
            for mesh in owner.findall("mesh"):
                if not paths.get(mesh.get("name", "")):
                    owner.remove(mesh)


def _apply_defaults(root: Element) -> None:
    """Writes the defaults of its classes into each element of an MJCF file."""
    classes: dict[str, dict[str, dict[str, str]]] = {}

    def collect(default: Element, inherited: Mapping[str, dict[str, str]], name: str) -> None:
        own = dict(inherited)
        for node in default:
            tag = "general" if node.tag in _ACTUATORS else node.tag
            own[tag] = own.get(tag, {}) | node.attrib
        classes[default.get("class", name)] = own
        for child in default.iterfind("default"):
            collect(child, own, "")

    def apply(owner: Element, inherited: str) -> None:
        for node in owner:
            tag = "general" if owner.tag == "actuator" else node.tag
            of_class = classes.get(node.attrib.pop("class", inherited), {})
            values = of_class.get(tag, {}) if owner is not root else {}
            gone = _TURNS if _TURNS & node.attrib.keys() else set()
            gone = _OF_GENERAL if tag != node.tag else gone
            known = {key: value for key, value in values.items() if key not in gone}
            node.attrib.update(known | node.attrib)
            apply(node, node.get("childclass", inherited))

    for default in root.findall("default"):
        collect(default, classes.get("main", {}), "main")
        root.remove(default)
    apply(root, "main")


def _compiler(root: Element) -> dict[str, str]:
    """The options of MuJoCo's compiler."""
    return {key: value for one in root.iterfind("compiler") for key, value in one.items()}


def _first(words: str) -> float:
    """The first number, and 1 if there is none, or 0."""
    return number_in([*words.split(), "1"][0]) or 1.0


def _uri_of(mesh: Element) -> str:
    """The file that a mesh of URDF or SDFormat names."""
    return mesh.get("filename", mesh.findtext("uri", "")).strip()


def _collides(geom: Element) -> bool:
    """Whether a geometry of MJCF collides, and is not only drawn."""
    return {geom.get("contype", "1"), geom.get("conaffinity", "1")} != {"0"}


@lru_cache(10000)
def _is_read(kind: str, text: str) -> bool:
    """Whether Drake makes geometry of a model with a lone shape."""
    plant, scene_graph, logger = MultibodyPlant(0.0), SceneGraph(), logging.getLogger("drake")
    plant.RegisterAsSourceForSceneGraph(scene_graph)
    here = get_native_id()

    def is_elsewhere(record: logging.LogRecord) -> bool:
        return record.thread != here

    logger.filters.insert(0, is_elsewhere)  # Before those that tell what Drake logs.
    try:
        Parser(plant).AddModelsFromString(text, kind)
    except (RuntimeError, ValueError, SystemExit):  # The last: a failed assertion of Drake.
        return False
    finally:
        logger.removeFilter(is_elsewhere)
    return scene_graph.model_inspector().num_geometries() > 0


@cache
def _has_hull(mesh: str, changed: int) -> bool:
    """Whether Drake can compute the convex hull that a collision needs, of a file of a time."""
    try:
        Mesh(mesh).GetConvexHull()
    except RuntimeError:
        return False
    return True


def _remove(owner: Element, tag: str) -> None:
    """Removes the children of a tag."""
    for child in owner.findall(tag):
        owner.remove(child)


_ENTRIES = ("ixx", "iyy", "izz", "ixy", "ixz", "iyz")
_ROWS, _COLUMNS = [0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]  # Their places in the matrix.


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


def _mend_inertia(inertial: Element, kind: str) -> str:
    """Replaces an impossible inertia by the nearest possible one; says what it replaced, or ""."""
    place, matrix = place_of(inertial), inertial.find("inertia")
    # A fullinertia cannot be combined with a quat, so a diagonal one remains diagonal.
    key = "fullinertia" if "fullinertia" in inertial.attrib else "diaginertia"
    if kind == ".xml":
        mass, words = inertial.get("mass", "0"), inertial.get(key, "").split()
        words += ["0", "0", "0"] * (key == "diaginertia")
    elif kind == ".urdf":
        weight = inertial.find("mass")
        mass = "0" if weight is None else weight.get("value", "0")
        words = [] if matrix is None else [matrix.get(entry, "0") for entry in _ENTRIES]
    else:  # The defaults of SDFormat are a unit matrix.
        mass, own = inertial.findtext("mass", "1"), zip(_ENTRIES, "111000", strict=True)
        words = [] if matrix is None else [matrix.findtext(entry, one) for entry, one in own]
    if len(words) != 6:
        return ""  # Drake reports it.
    numbers = [number_in(word) for word in (mass, *words)]
    if None in numbers:
        raise ModelError(f"{place}: mass and inertia are numbers, got {mass}, {', '.join(words)}")
    kilograms, *entries = np.array(numbers, float).tolist()
    if kilograms < 0.0:
        raise ModelError(f"{place}: a mass is positive, got {kilograms:g} kg")
    try:
        is_possible = RotationalInertia(*entries).CouldBePhysicallyValid()
    except RuntimeError:
        is_possible = False
    if not any(entries) if kilograms == 0.0 else is_possible:
        return ""
    inertia = np.zeros((3, 3))
    inertia[_ROWS, _COLUMNS] = inertia[_COLUMNS, _ROWS] = entries
    nearest = nearest_inertia(inertia) if kilograms > 0.0 else np.zeros((3, 3))
    written = [repr(entry) for entry in nearest[_ROWS, _COLUMNS].tolist()]
    if matrix is None:
        inertial.set(key, " ".join(written[: 6 if key == "fullinertia" else 3]))
    else:
        matrix.clear()
        for entry, value in zip(_ENTRIES, written, strict=True):
            if kind == ".urdf":
                matrix.set(entry, value)
            else:
                SubElement(matrix, entry).text = value
    moments = (np.linalg.eigvalsh(one) for one in (inertia, nearest))
    was, now = (", ".join(f"{d:.3g}" for d in each) for each in moments)
    change = 100.0 * np.linalg.norm(nearest - inertia) / np.linalg.norm(inertia)
    return f"{place}: ({was}) kg m^2, nearest possible ({now}), changed by {change:.2g} %"
