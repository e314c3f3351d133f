"""The parts of an MJCF file that Drake reads otherwise than MuJoCo does."""

from collections.abc import Collection, Iterator, Mapping
from pathlib import Path
from xml.etree.ElementTree import Element, SubElement

from drake_dae.arrays import number_in
from drake_dae.errors import ModelError

ARMATURE = "joint/armature"
"""Rotor inertia. Drake gives it to motors only."""

_TURNS = {"quat", "axisangle", "euler", "xyaxes", "zaxis"}

_ONE_DEFAULT = {
    "actuator": ["general", "motor", "position", "velocity", "intvelocity", "damper", "cylinder"],
    "equality": ["equality"],
}
"""Parents whose elements have one and the same default -> the names under which it is written."""

_OF_GENERAL = {"dyntype", "gaintype", "biastype", "dynprm", "gainprm", "biasprm"}
"""What motors and servos set themselves, whatever is the default."""


def prepare(root: Element, file: Path) -> None:
    """Writes an MJCF file so that each element says all that it means, where it means it.

    Defaults of classes go into the elements. Inactive equalities go. Limits of motors become those
    of the efforts at joints, the gear times those of motors; servos become motors, since controls
    are efforts here. Bodies of mass 0, which MuJoCo takes if they do not move or move with others,
    lose their inertia, and their geometry its mass.
    """
    root.attrib.setdefault("model", file.stem)
    _apply_defaults(root)
    compiler = _compiler(root)
    if compiler.get("coordinate") == "global":
        raise ModelError(
            f"'{file.name}' has global coordinates; MuJoCo up to 2.3.2 reads it, and saves it with "
            "local ones"
        )
    for equality in root.iterfind("equality"):
        for constraint in equality.findall("*[@active='false']"):
            equality.remove(constraint)
        for constraint in equality:
            constraint.attrib.pop("active", None)
    for joint in root.iter("joint"):  # MuJoCo takes an empty range for none.
        if "limited" not in joint.attrib and not any(
            map(number_in, joint.get("range", "").split())
        ):
            joint.attrib.pop("range", None)
    for motor in [*root.iterfind("actuator/motor"), *root.iterfind("actuator/position")]:
        if motor.tag == "position":  # Its control is a position, and has no limit of efforts.
            motor.tag = "motor"
            motor.attrib.pop("ctrlrange", None)
            motor.attrib.pop("ctrllimited", None)
        gear = abs(number_in([*motor.get("gear", "").split(), "1"][0]) or 1.0)
        for key in ("ctrlrange", "forcerange"):
            bounds = [number_in(word) for word in motor.get(key, "").split()]
            if gear != 1.0 and bounds and None not in bounds:
                motor.set(key, " ".join(repr(gear * (bound or 0.0)) for bound in bounds))
    for body in root.iter("body"):
        inertial = body.find("inertial")
        if inertial is None or compiler.get("inertiafromgeom") == "true":
            continue
        if number_in(inertial.get("mass", "")) == 0.0:
            body.remove(inertial)
            for geom in body.iterfind("geom"):
                geom.set("mass", "0")
    for geom in root.iter("geom"):
        if _collides(geom):
            geom.attrib.pop("contype", None)
            geom.attrib.pop("conaffinity", None)
        if "friction" in geom.attrib:  # Drake has none that resists turning.
            geom.set("friction", "".join(geom.get("friction", "").split()[:1]))


def _compiler(root: Element) -> dict[str, str]:
    return {key: value for one in root.iterfind("compiler") for key, value in one.items()}


def _collides(geom: Element) -> bool:
    return {geom.get("contype", "1"), geom.get("conaffinity", "1")} != {"0"}


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
            if node.tag in ("motor", "position"):
                values = {key: value for key, value in values.items() if key not in _OF_GENERAL}
            if _TURNS & node.attrib.keys():
                values = {key: value for key, value in values.items() if key not in _TURNS}
            node.attrib.update({**values, **node.attrib})
            apply(node, node.get("childclass", inherited))

    for default in root.findall("default"):
        collect(default, classes.get("main", {}), "main")
        root.remove(default)
    apply(root, "main")


def remove_geometry(root: Element, collides: bool) -> None:
    """Removes geometry from which no mass is computed: what is only drawn, or also collisions."""
    always = _compiler(root).get("inertiafromgeom") == "true"
    for body in [*root.iter("body"), *root.iter("worldbody")]:
        if body.tag == "worldbody" or (body.find("inertial") is not None and not always):
            for geom in body.findall("geom"):
                if collides or not _collides(geom):
                    body.remove(geom)
    for contact in root.findall("contact") if collides else ():
        root.remove(contact)
    named = {geom.get("mesh", "") for geom in root.iter("geom")}
    for asset in root.iterfind("asset"):
        for mesh in asset.findall("mesh"):
            if mesh.get("name", Path(mesh.get("file", "")).stem) not in named:
                asset.remove(mesh)


def mesh_files(root: Element, file: Path) -> Iterator[tuple[Element, Path]]:
    """The meshes of a file with their names, and their files."""
    compiler = _compiler(root)
    folder = file.resolve().parent / compiler.get("meshdir", compiler.get("assetdir", ""))
    for mesh in root.iterfind("asset/mesh"):
        if name := mesh.get("file", ""):
            mesh.set("name", mesh.get("name", Path(name).stem))
            yield mesh, folder / name


def colliding_meshes(root: Element) -> set[str]:
    """The names of the meshes that are collisions."""
    return {geom.get("mesh", "") for geom in root.iter("geom") if _collides(geom)}


def remove_shapes(root: Element, refused: Mapping[str, str]) -> tuple[list[str], list[str]]:
    """Removes meshes that cannot be read, and shapes that have one or are of size 0."""
    shells = set()
    for asset in root.iterfind("asset"):
        for mesh in asset.findall("mesh"):
            shells |= {mesh.get("name", "")} if mesh.attrib.pop("inertia", "") == "shell" else set()
            if mesh.get("name", "") in refused:
                asset.remove(mesh)
    always = _compiler(root).get("inertiafromgeom") == "true"
    movable = {body for world in root.iter("worldbody") for body in _movable(world)}
    bodies, empty = list[str](), list[str]()
    for body in [*root.iter("body"), *root.iter("worldbody")]:
        has_mass = body in movable and (always or body.find("inertial") is None)
        for geom in body.findall("geom"):
            name, form = body.get("name", ""), geom.get("mesh", "")
            weighs = has_mass and number_in(geom.get("mass", "1")) != 0.0
            if weighs and (form in refused or form in shells):
                raise ModelError(
                    f"body '{name}' has its mass from the mesh '{refused.get(form, form)}', which "
                    "Drake cannot read, or not as a shell; give the body an <inertial>, or the "
                    "mesh as .obj, or let trimesh read it, by pip install 'drake_dae[meshes]'"
                )
            is_empty = "mesh" not in geom.attrib and geom.get("type", "sphere") != "plane"
            size = number_in((geom.get("size", "").split() or ["1"])[0])
            if form in refused or (is_empty and size == 0.0):
                (bodies if form in refused else empty).append(name)
                body.remove(geom)
    return bodies, empty


def _movable(body: Element, moves: bool = False) -> Iterator[Element]:
    """The bodies in an element that joints can move."""
    for child in body.iterfind("body"):
        has_joint = child.find("joint") is not None or child.find("freejoint") is not None
        if moves or has_joint:
            yield child
        yield from _movable(child, moves or has_joint)


def armatures(root: Element) -> Iterator[tuple[str, float]]:
    """Joint -> its rotor inertia, kg m^2 or kg; "" for joints that no motor can drive."""
    for joint in root.iter("joint"):
        if armature := number_in(joint.get("armature", "")):
            can_be_driven = joint.get("type", "hinge") in ("hinge", "slide")
            yield joint.get("name", "") if can_be_driven else "", armature


def floating_bodies(root: Element, placed: Collection[str]) -> Iterator[tuple[str, str]]:
    """The bodies that float, and their joints. Those that are placed elsewhere become free."""
    for body in root.iterfind("worldbody/body"):
        name = body.get("name", "")
        free = [*body.iterfind("freejoint"), *body.iterfind("joint[@type='free']")]
        if free and name not in placed:
            yield name, free[0].get("name", name)
        elif name in placed and not free and body.find("joint") is None:
            SubElement(body, "freejoint")
