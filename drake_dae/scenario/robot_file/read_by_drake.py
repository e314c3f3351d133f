"""XML of robot files: its trees, and which elements and attributes are read, a table per format.

A part of a file that is not read and that changes masses, forces, constraints or limits is lost,
and a run without it is one of another robot. So whatever is not in the table is an error, until the
scenario names it under `robot.leave_out`, as "<parent>/<name>": "joint/stiffness", "gazebo/joint".
The tables follow Drake's page "Parsing Models for Multibody Dynamics", without constraints and
bushings that are no part of the library's equations; a test feeds them through Drake.
"""

from collections.abc import Collection, Iterator
from pathlib import Path
from xml.etree.ElementTree import Element, TreeBuilder
from xml.parsers import expat
from xml.sax.saxutils import escape, quoteattr

from drake_dae.arrays import number_in
from drake_dae.errors import ModelError
from drake_dae.files import read_bytes

DEEPEST = 200
"""The largest number of elements inside each other."""


class Node(Element):
    """An element of XML, and where it is: 0 and "" if it is not of the file."""

    line, place = 0, ""  # "arm.urdf:12: link 'hand'": the name of it, or of what it belongs to.


def place_of(element: Element) -> str:
    """Where an element is in its file, and its name."""
    return getattr(element, "place", "")


def read_xml(file: Path) -> Node:
    """The root of an XML file, without entities and comments.

    Like Drake it takes prefixes that are not declared, such as `drake:`, as parts of names.
    """
    try:
        data = read_bytes(file)
    except (OSError, ValueError) as error:
        raise ModelError(f"no file '{file}': {getattr(error, 'strerror', error)}") from None
    text = data.lstrip()  # Drake takes blank lines before the declaration.
    skipped, named = data[: len(data) - len(text)].count(b"\n"), list[str]()
    builder, parser = TreeBuilder(element_factory=Node), expat.ParserCreate()

    def start(tag: str, attributes: dict[str, str]) -> None:
        own = attributes.get("name", "")
        named.append(f"{tag} '{own}'" if own or not named else named[-1])
        if len(named) > DEEPEST:
            raise ModelError(f"'{file.name}' nests more than {DEEPEST} elements")
        node: Node = builder.start(tag, attributes)  # type: ignore[assignment]
        node.line = skipped + parser.CurrentLineNumber
        node.place = f"{file.name}:{node.line}: {named[-1]}"

    def end(tag: str) -> None:
        named.pop()
        builder.end(tag)

    def refuse_entity(name: str, *_: object) -> None:
        raise ModelError(f"'{file.name}' declares the entity '{name}': none are read")

    parser.StartElementHandler, parser.EndElementHandler = start, end
    parser.CharacterDataHandler, parser.EntityDeclHandler = builder.data, refuse_entity
    try:
        parser.Parse(text, True)
    except expat.ExpatError as error:
        line = skipped + error.lineno
        raise ModelError(f"{file}:{line}: no XML: {expat.ErrorString(error.code)}") from None
    root: Node = builder.close()  # type: ignore[assignment]
    return root


def write_xml(root: Element) -> str:
    """The text of a tree, whose elements stand in the lines that they had."""
    pieces: list[str] = []
    line = 1

    def put(node: Element) -> None:
        nonlocal line
        breaks = max(0, getattr(node, "line", 0) - line)
        attributes = "".join(f" {name}={quoteattr(value)}" for name, value in node.items())
        text = escape((node.text or "").strip())
        pieces.append("\n" * breaks + f"<{node.tag}{attributes}>{text}")
        line += breaks + text.count("\n")
        for child in node:
            put(child)
        pieces.append(f"</{node.tag}>")

    put(root)
    return "".join(pieces)


# "owner: parts that are read | parts that change no equation | limits that are not read". Of "a=0"
# that holds with this value only, of "a=never" with none; "*" is all others. Owners without a line
# hold geometry. "limit@ball,screw" has what is different in joints of these types.
_URDF = """
robot: name material link joint drake:joint transmission frame gazebo drake:linear_spring_damper
robot: drake:distance_constraint drake:collision_filter_group mujoco
robot: | version sensor ros2_control disable_collisions link_group group verbose plugin
mujoco: compiler option | *
compiler: | * boundmass=0 boundinertia=0 settotalmass=-1 inertiafromgeom=0
option: | * gravity=0,0,-9.81/0,0,-9.8 density=0 viscosity=0 wind=0
gazebo: | * reference joint=never constraint=never gravity=1 turnGravityOff=0 springStiffness=0
gazebo: velocity_decay | dampingFactor=0 kinematic=0 static=0 link=never model=never axis=never
gazebo: | inertial=never
velocity_decay: | linear=0 angular=0
link: name inertial visual collision contact drake:surface_velocity_axis | gravity=1 kinematic=0
link: | type origin self_filter collision_checking surface self_collide sensor
contact: | * inertia_scaling=1
inertial: origin mass inertia | name
mass: value
inertia: ixx iyy izz ixy ixz iyz
joint drake:joint: name type origin parent child axis limit dynamics mimic
drake:joint: drake:screw_thread_pitch drake:curves drake:initial_tangent drake:plane_normal
drake:joint: drake:is_periodic
joint: | calibration safety_controller dont_collapse hardwareInterface role mechanicalReduction
joint: | mechanical_reduction offset sensor disable_collision
origin: xyz rpy
axis: xyz | rpy
limit: lower upper velocity effort drake:acceleration
limit@floating,planar,ball,universal,screw: || lower upper velocity drake:acceleration
limit@screw: || effort
dynamics: damping | coulomb_window friction=0
dynamics@floating: | damping=0
mimic: joint multiplier offset
visual: *
material: name color | *
transmission: type=simple joint actuator | name mechanicalReduction plugin param
transmission: | use_simulated_gripper_joint
actuator: name drake:rotor_inertia drake:gear_ratio drake:controller_gains
actuator: | hardwareInterface mechanicalReduction mechanical_reduction role
"""

_SDF = """
sdf: version model world | light actor
world: name model frame include joint | light scene physics gui plugin atmosphere wind
world: | gravity=0,0,-9.81/0,0,-9.8 magnetic_field spherical_coordinates audio state population
world: | road actor
include: uri name pose placement_frame static merge | plugin experimental:params=never
model: name canonical_link placement_frame pose static link joint frame include model
model: drake:joint drake:linear_spring_damper drake:distance_constraint drake:collision_filter_group
model: | enable_wind=0 self_collide allow_auto_disable plugin gripper
link: name pose inertial visual collision drake:visual drake:surface_velocity_axis velocity_decay
link: | gravity=1 kinematic=0 enable_wind=0 self_collide must_be_base_link sensor light
link: | audio_source audio_sink battery projector particle_emitter
velocity_decay: | linear=0 angular=0
inertial: pose mass inertia | auto=0 density auto_inertia_params
inertia: ixx iyy izz ixy ixz iyz
joint: name type parent child pose axis axis2 screw_thread_pitch drake:rotor_inertia
joint: drake:gear_ratio drake:controller_gains drake:mimic
joint: | sensor plugin physics gearbox_ratio gearbox_reference_body
joint@revolute,prismatic,continuous,ball,fixed,screw: | axis2
joint@revolute,prismatic,continuous,ball,fixed,universal: | thread_pitch
axis axis2: xyz limit dynamics use_parent_model_frame | initial_position
axis2: | dynamics=never
visual drake:visual: *
material: ambient diffuse specular emissive | *
limit: lower upper effort velocity drake:acceleration | stiffness dissipation
limit@ball,universal,screw: || lower upper velocity drake:acceleration
limit@ball,universal: || effort
dynamics: damping spring_reference spring_stiffness | friction=0
dynamics@ball,universal,screw: | spring_reference spring_stiffness=0
"""

_MJCF = """
mujoco: model compiler option asset worldbody body actuator contact
mujoco: equality | size statistic sensor keyframe visual custom extension
compiler: coordinate angle assetdir meshdir eulerseq inertiafromgeom autolimits
compiler: | boundmass=0 boundinertia=0 settotalmass=-1 balanceinertia=0 inertiagrouprange=0,5
compiler: | strippath=0 usethread texturedir discardvisual fusestatic fitaabb saveinertial
compiler: | alignfree convexhull exactmeshinertia conflictcheck lengthrange
option: gravity flag | * density=0 viscosity=0 wind=0
flag: | * constraint=enable equality=enable frictionloss=enable limit=enable passive=enable
flag: | spring=enable damper=enable gravity=enable clampctrl=enable actuation=enable
worldbody body: name pos quat axisangle euler xyaxes zaxis body geom joint freejoint inertial
worldbody body: | mocap=0 gravcomp=0 user site light camera childclass sleep class
inertial: pos quat axisangle euler xyaxes zaxis mass diaginertia fullinertia
joint: name type pos axis range limited damping ref armature
joint: | stiffness=0 springdamper=0 frictionloss=0 actuatorfrclimited=0 class group user margin
joint: | solreflimit solimplimit solreffriction solimpfriction springref actuatorgravcomp
joint@free: | damping=0 range
joint@ball: || range
freejoint: name | group align class user
geom: name type pos quat axisangle euler xyaxes zaxis size fromto mesh mass density contype
geom: conaffinity group material rgba friction | shellinertia=0 fluidshape=none class condim
geom: | priority solmix solref solimp margin gap fitscale user hfield fluidcoef
actuator: motor
motor: name joint gear ctrlrange=+- ctrllimited forcerange=+- forcelimited
motor: | group lengthrange user kp kv dampratio timeconst inheritrange cranklength actearly actdim
motor: | actlimited actrange nsample interp delay
equality: | *=never
asset: mesh material | texture hfield skin
mesh: name file scale inertia | *
"""

DRIVES = ("transmission/", "actuator/", "motor/", "ball/motor", "free/motor")
"""Parts that only drive joints: nothing of them is lost if the scenario names the driven joints."""


def _words(text: str) -> list[str | float]:
    """The words of a value, with numbers for those that are or mean numbers."""
    words = [{"true": "1", "false": "0", "auto": "0"}.get(w, w) for w in text.lower().split()]
    return [word if (number := number_in(word)) is None else number for word in words]


def _is_meant(value: str, meant: str) -> bool:
    """Whether a value in a file means the same as one in the tables."""
    words, numbers = _words(value), [number_in(word) for word in value.split()]
    match meant:
        case "":
            return True
        case "0" | "1":
            return {*words} <= {float(meant)}
        case "+-":  # A range of both directions.
            low, high = [*numbers, None, None][:2]
            return low is None or high is None or low == -high
        case "unlimited":
            return not any(0.0 < abs(number or 0.0) < 1e16 for number in numbers)
        case "simple":
            return "SimpleTransmission" in value
    return words in [_words(way.replace(",", " ")) for way in meant.split("/")]


def _table(text: str) -> dict[str, dict[str, tuple[bool, str]]]:
    """Owner -> part -> whether it is read, and the values with which it changes no equation."""
    table: dict[str, dict[str, tuple[bool, str]]] = {}
    for line in text.strip().splitlines():
        owners, _, parts = line.partition(": ")
        for owner in owners.split():
            tag, _, types = owner.partition("@")
            for k, names in enumerate(parts.split("|")):
                for part in names.split():
                    name, _, value = part.partition("=")
                    own = k == 0, value or ("unlimited" if k == 2 else "")
                    for joint in types.split(","):
                        table.setdefault(f"{tag}@{joint}".rstrip("@"), {})[name] = own
    return table


READ_BY_DRAKE = {".urdf": _table(_URDF), ".sdf": _table(_SDF), ".xml": _table(_MJCF)}


def take_lost(
    element: Element, kind: str, leave_out: Collection[str], joint: str = ""
) -> Iterator[tuple[str, str]]:
    """Removes what is not read of an element, and yields what is lost, and where.

    That is "<parent>/<name>", or "<type>/<name>" of what is lost of joints of one type. `joint` is
    the type of the joint to which the element belongs.
    """
    tables = READ_BY_DRAKE[kind]
    if element.tag not in tables:
        return
    if element.tag in ("joint", "drake:joint"):
        joint = element.get("type", "")
    of_type = tables.get(f"{element.tag.removeprefix('drake:')}@{joint}", {})
    table = tables[element.tag] | of_type
    parts: list[tuple[str, str, Element | None]]
    parts = [(name, value, None) for name, value in element.items()]
    for child in element:
        parts.append((child.tag, (child.text or "").strip() or child.get("value", ""), child))
    for name, value, node in parts:
        is_foreign = ":" in name and name not in table and not name.startswith("drake:")
        other = (name.startswith("xmlns"), "") if is_foreign else table.get("*", (False, "never"))
        is_read, meant = table.get(name, other)
        part = f"{joint if name in of_type else element.tag}/{name}"
        is_meant = _is_meant(value, meant)
        if not is_meant and part not in leave_out:
            yield part, f"{place_of(element)}{f' {value}' * bool(value)}"
        if is_read and is_meant and part not in leave_out:
            if node is not None:
                yield from take_lost(node, kind, leave_out, joint)
                own = tables.get(name, {})
                if own and not any(is_read for is_read, _ in own.values()):
                    element.remove(node)
        elif node is not None:
            element.remove(node)
        else:
            del element.attrib[name]
