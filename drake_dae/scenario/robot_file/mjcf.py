"""MJCF as Drake reads it: each element says all that it means, where it means it."""

from collections.abc import Collection, Iterator, Mapping
from itertools import count
from pathlib import Path
from xml.etree.ElementTree import Element, SubElement

from drake_dae.arrays import number_in
from drake_dae.errors import ModelError
from drake_dae.scenario.robot_file.xml_tree import check_included, read_xml

ARMATURE = "joint/armature"
"""Rotor inertia. Drake gives it to motors only."""

_MOST_INCLUDED = 1000
"""The largest number of files that an MJCF file includes: each may include another one twice."""

EMPTY, UNREAD = "has size 0", "has a shape that Drake does not read"

_SIZES = {"sphere": 1, "capsule": 2, "cylinder": 2, "ellipsoid": 3, "box": 3}
"""Type of a geom -> how many sizes it has."""

_TURNS = {"quat", "axisangle", "euler", "xyaxes", "zaxis"}

_ONE_DEFAULT = {
    "actuator": ["general", "motor", "position", "velocity", "intvelocity", "damper", "cylinder"],
    "equality": ["equality"],
}
"""Parents whose elements have one and the same default -> the names under which it is written."""

_SERVOS = ("position", "velocity", "intvelocity", "general")
"""Actuators whose control is no effort, while their range of forces limits an effort."""

_LAW = ("dyntype", "gaintype", "biastype")

_OF_GENERAL = {"dyntype", "gaintype", "biastype", "dynprm", "gainprm", "biasprm"}
"""What motors and servos set themselves, whatever is the default."""


def expand(root: Element, file: Path) -> list[str]:
    """Writes an MJCF file so that each element says all that it means, where it means it.

    Included files and defaults of classes go into their places. Inactive equalities go. Limits of
    motors become those of the efforts at joints, the gear times those of motors. Servos become
    motors, since controls are efforts here; their names are returned. Bodies of mass 0, which
    MuJoCo takes if they do not move or move with others, lose their inertia, and their geometry its
    mass.
    """
    _include(root, file, (file.resolve(),), count(1))
    root.attrib.setdefault("model", file.stem)
    _apply_defaults(root)
    if compiler(root).get("coordinate") == "global":
        way = "MuJoCo up to 2.3.2 reads it, and saves it with local ones"
        raise ModelError(f"'{file.name}' has global coordinates; {way}")
    for equality in root.iterfind("equality"):
        for constraint in list(equality):
            if constraint.attrib.pop("active", "true") == "false":
                equality.remove(constraint)
    for joint in root.iter("joint"):  # MuJoCo takes an empty range for none.
        words = joint.get("range", "").split()
        if joint.get("limited", "auto" if any(map(number_in, words)) else "false") == "false":
            joint.attrib.pop("range", None)
    servos = []
    for motor in root.iterfind("actuator/*"):
        general = {key: motor.attrib.pop(key, "") for key in _OF_GENERAL if motor.tag == "general"}
        gain = 1.0
        if motor.tag == "general" and {general[key] for key in _LAW} <= {"", "none", "fixed"}:
            motor.tag = "motor"  # Of a control in another unit.
            gain = abs(number_in([*general["gainprm"].split(), "1"][0]) or 1.0)
        elif motor.tag in _SERVOS:  # Its control is no effort, and neither are its limits.
            motor.tag = "motor"
            servos.append(motor.get("name", motor.get("joint", "")))
            motor.attrib.pop("ctrlrange", None)
            motor.attrib.pop("ctrllimited", None)
        gear = abs(number_in([*motor.get("gear", "").split(), "1"][0]) or 1.0)
        for key, scale in (("ctrlrange", gain * gear), ("forcerange", gear)):
            bounds = [number_in(word) for word in motor.get(key, "").split()]
            if scale != 1.0 and bounds and None not in bounds:
                motor.set(key, " ".join(repr(scale * (bound or 0.0)) for bound in bounds))
    for body in root.iter("body"):
        inertial = body.find("inertial")
        if inertial is None or weighs_by_geometry(root):
            continue
        if number_in(inertial.get("mass", "")) == 0.0:
            body.remove(inertial)
            for geom in body.iterfind("geom"):
                geom.set("mass", "0")
    for geom in root.iter("geom"):
        if collides(geom):
            geom.attrib.pop("contype", None)
            geom.attrib.pop("conaffinity", None)
        if "friction" in geom.attrib:  # Drake has none that resists turning.
            geom.set("friction", "".join(geom.get("friction", "").split()[:1]))
    return servos


def _include(owner: Element, main: Path, within: tuple[Path, ...], number: Iterator[int]) -> None:
    for index, node in reversed(list(enumerate(owner))):
        if node.tag != "include":
            _include(node, main, within, number)
            continue
        if next(number) > _MOST_INCLUDED:
            raise ModelError(f"'{main.name}' includes more than {_MOST_INCLUDED} files")
        file = main.parent / node.get("file", "")
        check_included(file, within)
        included = read_xml(file)
        _include(included, main, (*within, file.resolve()), number)
        for part in included.iter():
            part.line = 0  # type: ignore[attr-defined]
        owner[index : index + 1] = list(included)


def _apply_defaults(root: Element) -> None:
    classes: dict[str, dict[str, dict[str, str]]] = {}

    def collect(default: Element, inherited: Mapping[str, dict[str, str]], name: str) -> None:
        own = dict(inherited)
        for node in default:
            tags = (tag for tag, names in _ONE_DEFAULT.items() if node.tag in names)
            tag = next(tags, node.tag)
            own[tag] = own.get(tag, {}) | node.attrib
        classes[default.get("class", name)] = own
        for child in default.iterfind("default"):
            collect(child, own, "")

    def apply(owner: Element, inherited: str) -> None:
        for node in owner:
            tag = owner.tag if owner.tag in _ONE_DEFAULT else node.tag
            known = classes.get(node.attrib.pop("class", inherited), {})
            values = {} if node.tag in _ONE_DEFAULT else known.get(tag, {})
            if owner.tag == "actuator" and node.tag != "general":
                values = {key: value for key, value in values.items() if key not in _OF_GENERAL}
            if _TURNS & node.attrib.keys():
                values = {key: value for key, value in values.items() if key not in _TURNS}
            node.attrib.update({**values, **node.attrib})
            apply(node, node.get("childclass", inherited))

    for default in root.findall("default"):
        collect(default, classes.get("main", {}), "main")
        root.remove(default)
    apply(root, "main")


def compiler(root: Element) -> dict[str, str]:
    """The options of the compiler."""
    return {key: value for one in root.iterfind("compiler") for key, value in one.items()}


def weighs_by_geometry(root: Element) -> bool:
    """Whether masses are those of the geometry, also where a body has an <inertial>."""
    return compiler(root).get("inertiafromgeom") == "true"


def collides(geom: Element) -> bool:
    """Whether a geometry collides, and is not only drawn."""
    return {geom.get("contype", "1"), geom.get("conaffinity", "1")} != {"0"}


def fault(geom: Element) -> str:
    """Why Drake takes no such shape; "" if it does, or if it is a mesh."""
    kind = "mesh" if "mesh" in geom.attrib else geom.get("type", "sphere")
    if kind in ("mesh", "plane"):
        return ""
    if kind not in _SIZES:
        return UNREAD
    sizes = [number_in(word) or 0.0 for word in geom.get("size", "").split()]
    ends = geom.get("fromto", "").split()
    count = 1 if ends else _SIZES[kind]
    is_empty = len(sizes) < count or min(sizes[:count]) <= 0.0
    return EMPTY if is_empty or (ends and ends[:3] == ends[3:]) else ""


def geoms(root: Element) -> Iterator[tuple[Element, Element, bool]]:
    """Geometries, their bodies, and whether joints can move these."""

    def below(body: Element, moves: bool) -> Iterator[tuple[Element, Element, bool]]:
        for geom in body.findall("geom"):
            yield geom, body, moves
        for inner in body.iterfind("body"):
            has_joint = any(part.tag in ("joint", "freejoint") for part in inner)
            yield from below(inner, moves or has_joint)

    for world in root.iterfind("worldbody"):
        yield from below(world, False)


def floating_bodies(root: Element, placed: Collection[str]) -> Iterator[tuple[str, str]]:
    """The bodies that float, and their joints. Those that are placed elsewhere become free."""
    for body in root.iterfind("worldbody/body"):
        name = body.get("name", "")
        free = [*body.iterfind("freejoint"), *body.iterfind("joint[@type='free']")]
        if free and name not in placed:
            yield name, free[0].get("name", name)
        elif name in placed and not free and body.find("joint") is None:
            SubElement(body, "freejoint")
