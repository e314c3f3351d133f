"""The elements and attributes of robot files that Drake's parser reads, one table per format.

A part of a file that Drake does not read and that changes masses, forces, constraints or limits is
lost, and a run without it is one of another robot. So whatever is not in the table is an error,
until the scenario names it under `robot.leave_out`, as "<parent>/<name>": "joint/stiffness",
"gazebo/joint". The tables follow Drake's page "Parsing Models for Multibody Dynamics", and those of
the formats; a test feeds them through Drake.
"""

from collections.abc import Callable, Collection, Iterator
from typing import NamedTuple
from xml.etree.ElementTree import Element

from drake_dae.arrays import number_in

# "owner: parts that Drake reads | parts that change no equation | parts that are reported".
# Of "a=0" that holds with this value only, of "a=never" with none; "*" is all others. Owners
# without a line hold geometry. "limit@ball" has what is different in joints of this type.
_URDF = """
robot: name material link joint drake:joint transmission frame gazebo drake:linear_bushing_rpy
robot: drake:linear_spring_damper drake:ball_constraint drake:distance_constraint
robot: drake:tendon_constraint drake:collision_filter_group
robot: | version sensor ros2_control disable_collisions link_group group verbose plugin
robot: mujoco
mujoco: compiler option | *
compiler: | * | boundmass=0 boundinertia=0 settotalmass=-1 inertiafromgeom=auto
option: | * | gravity=earth density=0 viscosity=0 wind=0
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
limit@floating limit@planar limit@ball limit@universal limit@screw limit@curvilinear: || lower
limit@floating limit@planar limit@ball limit@universal limit@screw limit@curvilinear: || upper
limit@floating limit@planar limit@ball limit@universal limit@screw limit@curvilinear: || velocity
limit@floating limit@planar limit@ball limit@universal: || drake:acceleration
limit@screw limit@curvilinear: || drake:acceleration effort
dynamics: damping | coulomb_window friction=0
dynamics@floating: | damping=0
mimic: joint multiplier offset
transmission: type=simple joint actuator | name mechanicalReduction plugin param
transmission: | use_simulated_gripper_joint
actuator: name drake:rotor_inertia drake:gear_ratio drake:controller_gains
actuator: | hardwareInterface mechanicalReduction mechanical_reduction role
"""

_SDF = """
sdf: version model world | light actor
world: name model frame include joint | light scene physics gui plugin atmosphere wind
world: | gravity=earth magnetic_field spherical_coordinates audio state population road actor
include: uri name pose placement_frame static merge | plugin experimental:params=never
model: name canonical_link placement_frame pose static link joint frame include model
model: drake:joint drake:linear_bushing_rpy drake:linear_spring_damper drake:ball_constraint
model: drake:distance_constraint drake:tendon_constraint drake:collision_filter_group
model: | enable_wind=0 self_collide allow_auto_disable plugin gripper
link: name pose inertial visual collision drake:visual drake:surface_velocity_axis velocity_decay
link: | gravity=1 kinematic=0 enable_wind=0 self_collide must_be_base_link sensor light
link: | audio_source audio_sink battery projector particle_emitter
velocity_decay: | linear=0 angular=0
inertial: pose mass inertia | auto=0 density auto_inertia_params
inertia: ixx iyy izz ixy ixz iyz
joint: name type parent child pose axis axis2 screw_thread_pitch thread_pitch drake:rotor_inertia
joint: drake:gear_ratio drake:controller_gains drake:mimic
joint: | sensor plugin physics gearbox_ratio gearbox_reference_body
joint@revolute joint@prismatic joint@continuous joint@ball joint@fixed: | axis2 thread_pitch
joint@screw: | axis2
joint@universal: | thread_pitch
axis axis2: xyz limit dynamics use_parent_model_frame | initial_position
limit: lower upper effort velocity drake:acceleration | stiffness dissipation
limit@ball limit@universal limit@screw: || lower upper velocity drake:acceleration
limit@ball limit@universal: || effort
dynamics: damping spring_reference spring_stiffness | friction=0
dynamics@ball dynamics@universal dynamics@screw: | spring_reference spring_stiffness=0
"""

_MJCF = """
mujoco: model compiler option asset worldbody body actuator contact equality
mujoco: | size statistic sensor keyframe visual custom extension
compiler: coordinate angle assetdir meshdir eulerseq inertiafromgeom autolimits
compiler: | boundmass=0 boundinertia=0 settotalmass=-1 balanceinertia=0 inertiagrouprange=0_5
compiler: | strippath=0
compiler: | usethread texturedir discardvisual fusestatic fitaabb saveinertial alignfree convexhull
compiler: | exactmeshinertia conflictcheck lengthrange
option: gravity flag | density=0 viscosity=0 wind=0
option: | timestep apirate impratio magnetic o_margin o_solref o_solimp o_friction integrator cone
option: | jacobian solver iterations tolerance ls_iterations ls_tolerance noslip_iterations
option: | noslip_tolerance ccd_iterations ccd_tolerance mpr_iterations mpr_tolerance sdf_iterations
option: | sdf_tolerance sdf_initpoints actuatorgroupdisable collision sleep_tolerance
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
geom: conaffinity group material rgba friction | shellinertia=0 fluidshape=ellipsoidal class condim
geom: | priority solmix solref solimp margin gap fitscale user hfield fluidcoef
actuator: motor
motor: name joint gear ctrlrange=+- ctrllimited forcerange=+- forcelimited
motor: | group lengthrange user kp kv dampratio timeconst inheritrange cranklength actearly actdim
motor: | actlimited actrange nsample interp delay
equality: connect
connect: name body1 body2 anchor | class solref solimp
asset: mesh material | texture hfield skin
mesh: name file scale inertia | *
"""

DRIVES = ("transmission/", "actuator/", "motor/", "ball/motor", "free/motor")
"""Parts that only drive joints: nothing of them is lost if the scenario names the driven joints."""


def _is_symmetric(value: str) -> bool:
    low, high = [*(number_in(word) for word in value.split()), None, None][:2]
    return low is None or high is None or low == -high


_RULES: dict[str, Callable[[str], bool]] = {
    "": lambda _: True,
    "never": lambda _: False,
    "0": lambda value: (
        value.lower() in ("false", "auto") or all(number_in(word) == 0.0 for word in value.split())
    ),
    "1": lambda value: value.lower() in ("", "true") or number_in(value) == 1.0,
    "+-": _is_symmetric,
    "-1": lambda value: (number_in(value) or 0.0) <= 0.0,
    "0_5": lambda value: value.split() == ["0", "5"],
    "simple": lambda value: "SimpleTransmission" in value,
    "earth": lambda value: value.split() in (["0", "0", "-9.8"], ["0", "0", "-9.81"]),
    "enable": lambda value: value == "enable",
    "ellipsoidal": lambda value: value == "none",
    "auto": lambda value: value in ("false", "auto"),
    "unlimited": lambda value: (
        not any(0.0 < abs(number_in(word) or 0.0) < 1e16 for word in value.split())
    ),
}
"""A value in the tables -> whether one in a file means the same."""


class _Part(NamedTuple):
    """How Drake takes a part: it reads it, a value of it is without effect, or it is reported."""

    is_read: bool = False
    meant: str = "never"
    is_told: bool = False


def _table(text: str) -> dict[str, dict[str, _Part]]:
    """Owner -> its parts."""
    table: dict[str, dict[str, _Part]] = {}
    for line in text.strip().splitlines():
        owners, _, parts = line.partition(": ")
        for owner in owners.split():
            for k, names in enumerate(parts.split("|")):
                for part in names.split():
                    name, _, value = part.partition("=")
                    meant = value or ("unlimited" if k == 2 else "")
                    table.setdefault(owner, {})[name] = _Part(k == 0, meant, k == 2)
    return table


READ_BY_DRAKE = {".urdf": _table(_URDF), ".sdf": _table(_SDF), ".xml": _table(_MJCF)}


class Lost(NamedTuple):
    """What Drake does not read: "<parent>/<name>", its value, and the element to which it belongs.

    What Drake does not read of joints of one type is "<type>/<name>". It is reported, or refused.
    """

    part: str
    value: str
    owner: Element
    is_told: bool


def take_lost(
    element: Element, kind: str, leave_out: Collection[str], joint: str = ""
) -> Iterator[Lost]:
    """Removes what Drake does not read of an element, and yields what is lost.

    `joint` is the type of the joint to which the element belongs.
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
        other = _Part(name.startswith("xmlns"), "") if is_foreign else table.get("*", _Part(True))
        known = table.get(name, other)
        part = f"{joint if name in of_type else element.tag}/{name}"
        is_meant = _RULES[known.meant](value)
        if not is_meant and part not in leave_out:
            yield Lost(part, value, element, known.is_told)
        if known.is_read and is_meant and part not in leave_out:
            if node is not None:
                yield from take_lost(node, kind, leave_out, joint)
                own = tables.get(name, {})
                if own and not any(part.is_read for part in own.values()):
                    element.remove(node)
        elif node is not None:
            element.remove(node)
        else:
            del element.attrib[name]
