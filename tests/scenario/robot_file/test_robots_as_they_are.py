"""Robots whose files Drake refuses or reads otherwise than their authors mean them."""

import warnings
from pathlib import Path

import numpy as np
import pytest
from pydrake.geometry import SceneGraph
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import RotationalInertia
from scipy.optimize import minimize
from vendors import joint, link, robot

from drake_dae.errors import ModelError, RobotFileWarning, ScenarioError
from drake_dae.scenario.robot_file.mending import nearest_inertia
from drake_dae.scenario.robot_file.reading import finalize, read_robot, robot_links
from drake_dae.scenario.robot_file.robot import Pose, Robot, RobotPlacement


def plant_of(file: Path, scene_graph: SceneGraph | None = None, **more) -> MultibodyPlant:
    """The finalized plant of a robot's file, as a scenario reads it."""
    own = Robot(str(file), **more)
    plant, _ = read_robot(own, scene_graph=scene_graph)
    finalize(plant)
    return plant


def written(folder: Path, text: str, name: str = "robot.urdf") -> Path:
    (folder / name).write_text(text)
    return folder / name


def mass_matrix(plant: MultibodyPlant, seed: int = 0) -> np.ndarray:
    context = plant.CreateDefaultContext()
    plant.SetPositions(context, np.random.default_rng(seed).normal(size=plant.num_positions()))
    return plant.CalcMassMatrix(context)


# Bodies without mass.

MJCF = """<mujoco model="arm"><compiler angle="radian"/><worldbody>
<body name="base">{base}<geom type="box" size="0.1 0.1 0.1"/>
<body name="upper" pos="0 0 0.3"><inertial pos="0.1 0 0" mass="2" diaginertia="0.02 0.03 0.04"/>
<joint name="j1" axis="0 1 0"/>
<body name="mark" pos="0.2 0 0">{mark}<geom type="sphere" size="0.05"/>
<body name="lower" pos="0.2 0 0"><inertial pos="0.1 0 0" mass="1" diaginertia="0.02 0.01 0.01"/>
<joint name="j2" axis="0 1 0"/></body></body></body></body></worldbody></mujoco>"""

LIGHT = '<inertial pos="0 0 0" mass="1e-12" diaginertia="0 0 0"/>'
NOTHING = '<inertial pos="0 0 0" mass="0" diaginertia="0 0 0"/>'

CARRIED = '<inertial pos="1 0 0" mass="0.0" diaginertia="0 0 0" quat="1 0 0 0"/>'


@pytest.mark.parametrize(("base", "mark"), [(NOTHING, LIGHT), ("", CARRIED), (NOTHING, NOTHING)])
def test_an_mjcf_body_of_mass_0_weighs_nothing_and_neither_does_its_geometry(base, mark, tmp_path):
    """A body of 1e-12 kg is the other route; it is below round-off of 1 kg."""
    plant = plant_of(written(tmp_path, MJCF.format(base=base, mark=mark), "arm.xml"))
    other = MultibodyPlant(0.0)
    Parser(other).AddModelsFromString(MJCF.format(base=LIGHT, mark=LIGHT), ".xml")
    other.Finalize()
    np.testing.assert_allclose(mass_matrix(plant), mass_matrix(other), rtol=1e-10, atol=1e-12)


# Limits.

NONE = (-np.inf, np.inf)


@pytest.mark.parametrize(
    ("kind", "low", "high", "leave_out", "wanted"),
    [
        ("continuous", -1, 1, [], NONE),
        ("revolute", -1, 1, [], (-1.0, 1.0)),
        ("revolute", 0, 0, [], (0.0, 0.0)),
        ("revolute", 1, -1, ["empty_limits"], NONE),
        ("prismatic", -2, -2, ["empty_limits"], NONE),
    ],
)
def test_limits_without_room_go_where_a_joint_or_the_scenario_says_so(
    kind, low, high, leave_out, wanted, tmp_path
):
    """A speed limit of 0 is none."""
    one = joint("j", "base", "arm", "0 1 0", kind=kind).replace('velocity="2"', 'velocity="0"')
    one = one.replace('lower="-2.9" upper="2.9"', f'lower="{low}" upper="{high}"')
    file = written(tmp_path, robot("one", link("base", 1), link("arm", 1), one))
    found = plant_of(file, leave_out=leave_out).GetJointByName("j")
    assert (found.position_lower_limits()[0], found.position_upper_limits()[0]) == wanted
    assert found.velocity_upper_limits()[0] == np.inf
    if low > high:
        with pytest.raises(ModelError, match=r"'j'.*1 .*-1.*empty_limits"):
            plant_of(file)


# Words and motors.

ONE = (
    '<transmission type="SimpleTransmission"><joint name="{}"/><actuator name="m"/></transmission>'
)
PARTS = '<actuator name="m"/>', "<actuator name='m'>{}</actuator>".format
GEAR = "<drake:gear_ratio xmlns:drake='d' value='0'/>"
FAULTS = [
    ("r.urdf", 'mass value="1"', 'mass value="${m}"', r"r\.urdf:\d+: link 'a'.*\{m\}"),
    ("r.urdf", 'mass value="1"', 'mass value="1,5"', r"r\.urdf:\d+: link 'a'.*1,5"),
    ("r.urdf", 'mass value="1"', 'mass value="0"', "'a'"),
    ("r.urdf", 'mass value="1"', 'mass value="-4.0"', r"r\.urdf:3: link 'a'"),
    ("r.urdf", 'parent link="a"', 'parent link="none"', r"r\.urdf"),
    ("r.urdf", 'xyz="0 0 1"', 'xyz="0 -1"', "3 values .* 0 -1"),
    ("r.urdf", 'xyz="0.01 -0.02 0.12"', 'xyz="nan 0 0"', "3 values .* nan"),
    ("r.urdf", '"revolute"', '"planar"', "'j'"),
    ("r.urdf", PARTS[0], PARTS[1](GEAR), "'m'.*0"),
    ("r.urdf", "</robot>", "", r"r\.urdf"),
    ("r.xml", 'angle="radian"', 'coordinate="global"', r"r\.xml.*global"),
]


@pytest.mark.parametrize(("name", "old", "new", "message"), FAULTS)
def test_faults_that_drake_would_change_or_pass_over_are_refused(name, old, new, message, tmp_path):
    parts = link("a", 1), link("b", 1), joint("j", "a", "b", "0 0 1"), ONE.format("j")
    text = robot("r", *parts) if name == "r.urdf" else MJCF.format(base="", mark="")
    assert old in text
    file = written(tmp_path, text.replace(old, new, 1), name)
    with pytest.raises((ModelError, ScenarioError), match=message):
        robot_links(Robot(str(file), base=RobotPlacement("a")), SceneGraph())


def test_motors_of_one_name_are_two_and_one_without_effort_is_lost(tmp_path):
    """Many authors write 0 for an unknown effort, with which Drake makes no motor."""
    joints = [joint("j", "a", "b", "0 1 0"), joint("k", "b", "c", "0 1 0")]
    text = robot("r", *(link(name, 1) for name in "abc"), *joints, ONE.format("j"), ONE.format("k"))
    plant = plant_of(written(tmp_path, text))
    motors = [plant.get_joint_actuator(index) for index in plant.GetJointActuatorIndices()]
    assert [(motor.name(), motor.joint().name()) for motor in motors] == [("m", "j"), ("m_2", "k")]
    file = written(tmp_path, text.replace('effort="87.0"', 'effort="0"', 1))
    with pytest.raises(ModelError, match=r"transmission/joint .*'j'"):
        plant_of(file)
    assert [*plant_of(file, actuators="all").GetEffortUpperLimits()] == [87.0, np.inf]


# Inertias.

MOMENTS = [
    ((2.0, 1.0, 0.1, 0, 0, 0), False),  # No triangle.
    ((1.0, 0.0, 0.0, 0, 0, 0), False),  # Written in part.
    ((0.1, -0.02, 0.1, 0, 0, 0), False),
    ((0.1, 0.1, 0.1, 0.2, 0.0, 0.05), False),  # Swapped: what is beside the diagonal is larger.
    ((0.3, 0.2, 0.1, 0.0, 0.0, 0.0), True),  # A sheet.
    ((0.0, 0.0, 0.0, 0.0, 0.0, 0.0), True),  # A point.
]


def matrix(entries) -> np.ndarray:
    xx, yy, zz, xy, xz, yz = entries
    return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]], dtype=float)


@pytest.mark.parametrize("entries", [one for one, is_possible in MOMENTS if not is_possible])
def test_the_nearest_inertia_is_nearest_of_all_that_bodies_have(entries):
    """Those of bodies are tr(S) 1 - S with S = L L^T: SciPy searches L from several starts.

    Its searches end some 1e-6 above the least distance.
    """
    wanted = matrix(entries)
    found = nearest_inertia(wanted)
    entries = [found[place] for place in ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))]
    assert RotationalInertia(*entries).CouldBePhysicallyValid()

    def distance(factor: np.ndarray) -> float:
        second = factor.reshape(3, 3) @ factor.reshape(3, 3).T
        return float(np.sum((np.trace(second) * np.eye(3) - second - wanted) ** 2))

    random = np.random.default_rng(0)
    least = min(minimize(distance, random.normal(size=9)).fun for _ in range(6))
    assert np.sum((found - wanted) ** 2) <= least + 1e-5


URDF_INERTIA = '<inertia ixx="{0}" iyy="{1}" izz="{2}" ixy="{3}" ixz="{4}" iyz="{5}"/>'
SDF_INERTIA = (
    "<inertia><ixx>{0}</ixx><iyy>{1}</iyy><izz>{2}</izz>"
    "<ixy>{3}</ixy><ixz>{4}</ixz><iyz>{5}</iyz></inertia>"
)
BODIES = {
    "robot.urdf": '<robot name="r"><link name="arm">\n<inertial><origin xyz="0.1 0 0"/>'
    f'<mass value="2"/>{URDF_INERTIA}</inertial></link></robot>',
    "robot.sdf": '<sdf version="1.9"><model name="r"><link name="arm">\n<inertial><pose>0.1 0 0 '
    f"0 0 0</pose><mass>2</mass>{SDF_INERTIA}</inertial></link></model></sdf>",
    "robot.xml": '<mujoco model="r"><worldbody><body name="arm"><freejoint/>\n<inertial '
    'pos="0.1 0 0" mass="2" fullinertia="{0} {1} {2} {3} {4} {5}"/></body></worldbody></mujoco>',
}


@pytest.mark.parametrize("name", BODIES)
@pytest.mark.parametrize(("entries", "is_possible"), MOMENTS)
def test_an_impossible_inertia_is_named_and_the_nearest_taken(name, entries, is_possible, tmp_path):
    """Its mass and centre of mass stay; the rotation of the free body feels the nearest inertia."""
    file = written(tmp_path, BODIES[name].format(*entries), name)
    own = {"free": ["arm"]}
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always", RobotFileWarning)
        plant = plant_of(file, leave_out=["inertia"], **own)
    body = plant.GetBodyByName("arm")
    assert body.default_mass() == 2.0
    np.testing.assert_allclose(body.default_com(), [0.1, 0, 0], atol=1e-12)
    wanted = matrix(entries) if is_possible else nearest_inertia(matrix(entries))
    inertia = body.default_spatial_inertia().Shift([0.1, 0, 0]).CalcRotationalInertia()
    np.testing.assert_allclose(inertia.CopyToFullMatrix3(), wanted, atol=1e-8)
    assert len(told) == int(not is_possible)
    if is_possible:
        return
    change = np.linalg.norm(wanted - matrix(entries)) / np.linalg.norm(matrix(entries))
    assert "'arm'" in str(told[0].message)
    assert f"{100 * change:.2g} %" in str(told[0].message)
    with pytest.raises(ModelError, match=rf"{name}:2: .*'arm'.*\[inertia\]"):
        plant_of(file, **own)


# Where robots stand.

HELD = {
    "arm.urdf": robot(
        "arm",
        '<link name="world"/>',
        link("base", 2),
        link("tip", 1),
        '<joint name="hold" type="fixed"><parent link="world"/><child link="base"/></joint>',
        joint("a", "base", "tip", "0 1 0"),
        # What mimics is a constraint, with which Drake removes no joint.
        link("other", 1),
        joint("b", "base", "other", "0 1 0", rest='<mimic joint="a"/>'),
    ),
    "arm.sdf": """<sdf version="1.9"><model name="arm"><link name="base"/><link name="tip">
<pose>0 0 0.25 0 0 0</pose></link>
<joint name="hold" type="fixed"><parent>world</parent><child>base</child></joint>
<joint name="a" type="revolute"><parent>base</parent><child>tip</child><axis><xyz>0 1 0</xyz>
</axis></joint></model></sdf>""",
    "arm.xml": """<mujoco model="arm"><worldbody><body name="base">
<geom type="sphere" size="0.1"/><body name="tip" pos="0 0 0.25"><geom type="sphere" size="0.1"/>
<joint name="a" axis="0 1 0"/></body></body></worldbody></mujoco>""",
}
TWO = """directives:
- add_model: {{name: left, file: "file://{0}"}}
- add_model: {{name: right, file: "file://{0}"}}
"""
MOVED = "- add_weld: {parent: world, child: 'right::base', X_PC: {translation: [1, 2, 3]}}\n"


def place(plant: MultibodyPlant, frame: str, model: str) -> np.ndarray:
    context = plant.CreateDefaultContext()
    body = plant.GetBodyByName(frame, plant.GetModelInstanceByName(model))
    return plant.EvalBodyPoseInWorld(context, body).translation()


@pytest.mark.parametrize("name", HELD)
def test_a_robot_that_its_file_holds_stands_where_the_user_says(name, tmp_path):
    file = written(tmp_path, HELD[name], name)
    two = written(tmp_path, TWO.format(file) + MOVED, "two.dmd.yaml")
    plant = plant_of(two)
    np.testing.assert_allclose(place(plant, "tip", "left"), [0, 0, 0.25], atol=1e-12)
    np.testing.assert_allclose(place(plant, "tip", "right"), [1, 2, 3.25], atol=1e-12)
    moved = RobotPlacement("base", Pose((0.5, 0.0, 0.0), (0.0, 90.0, 0.0)))
    np.testing.assert_allclose(
        place(plant_of(file, base=moved), "tip", "arm"), [0.75, 0, 0], atol=1e-12
    )
    assert plant_of(file, free=["base"]).num_velocities() == plant_of(file).num_velocities() + 6


# Joints that float.

HULL = '<link name="{}"><inertial><mass value="{}"/>' + URDF_INERTIA.format(
    *(0.1, 0.2, 0.25, 0.01, 0, 0)
)
FLOATING = {
    "craft.urdf": robot(
        "craft",
        '<link name="world"/>',
        HULL.format("hull", 2) + "</inertial></link>",
        HULL.format("arm", 1) + "</inertial></link>",
        '<joint name="root" type="floating"><parent link="world"/><child link="hull"/></joint>',
        joint("a", "hull", "arm", "0 1 0"),
    ),
    "craft.xml": """<mujoco model="craft"><worldbody><body name="hull" pos="0 0 2">
<freejoint name="root"/><inertial pos="0 0 0" mass="2" fullinertia="0.1 0.2 0.25 0.01 0 0"/>
<body name="arm" pos="0 0 0.25"><joint name="a" axis="0 1 0"/>
<inertial pos="0 0 0" mass="1" fullinertia="0.1 0.2 0.25 0.01 0 0"/></body></body></worldbody>
</mujoco>""",
}


FLOATING["free.xml"] = FLOATING["craft.xml"].replace("freejoint", 'joint type="free"')


@pytest.mark.parametrize("name", FLOATING)
def test_a_floating_joint_moves_as_drakes_quaternion_does(name, tmp_path):
    """The accelerations of both plants in one pose; twists and torques are the same numbers."""
    file = written(tmp_path, FLOATING[name], name)
    with pytest.warns(RobotFileWarning, match="'root'"):
        ours = plant_of(file)
    theirs = MultibodyPlant(0.0)
    Parser(theirs).AddModels(str(file))
    theirs.Finalize()
    assert ours.num_positions() == theirs.num_positions() - 1 == 7
    starts = [
        plant.EvalBodyPoseInWorld(plant.CreateDefaultContext(), plant.GetBodyByName("arm"))
        for plant in (ours, theirs)
    ]
    assert starts[0].IsNearlyEqualTo(starts[1], 1e-12)
    random = np.random.default_rng(1)
    pose = RigidTransform(RollPitchYaw(random.uniform(-1, 1, 3)), random.normal(size=3))
    velocities, found = random.normal(size=7), []
    for plant in (ours, theirs):
        context = plant.CreateDefaultContext()
        hull, first = plant.GetBodyByName("hull"), plant.GetJointByName("a").velocity_start()
        if plant is theirs:
            plant.SetFloatingBaseBodyPoseInWorldFrame(context, hull, pose)
        else:
            plant.GetJointByName("root").SetPose(context, pose)
        plant.GetJointByName("a").set_angle(context, 0.3)
        # Of the hull, and of the joint on it.
        own = [*(k for k in range(7) if k != first), first]
        speeds = np.zeros(7)
        speeds[own] = velocities
        plant.SetVelocities(context, speeds)
        found.append(plant.EvalTimeDerivatives(context).CopyToVector()[-7:][own])
    np.testing.assert_allclose(*found, atol=1e-9)


# MJCF with defaults.

CLASSES = """<mujoco><compiler angle="degree" autolimits="true"/>
<default><joint damping="0.3" armature="0.2"/><geom density="500"/>
<default class="wrist"><joint axis="1 0 0" armature="0.05" range="-30 60"/>
<geom type="capsule" size="0.03 0.1"/></default></default>
<worldbody><body name="a" euler="10 20 30"><joint name="j1" axis="0 1 0"/>
<geom type="box" size="0.1 0.2 0.3"/>
<body name="b" childclass="wrist" pos="0 0 0.4"><joint name="j2"/><geom/>
<body name="c" pos="0 0.1 0.3"><joint name="j3" class="main" axis="0 0 1"/><geom size="0.05 0.2"/>
</body></body></body></worldbody></mujoco>"""


def test_defaults_and_rotors_of_mjcf_are_those_of_mujoco(tmp_path):
    """MuJoCo has M(q) and limits of the same file; its masses of capsules and boxes are exact."""
    mujoco = pytest.importorskip("mujoco")
    model = mujoco.MjModel.from_xml_string(CLASSES)
    data = mujoco.MjData(model)
    plant = plant_of(written(tmp_path, CLASSES, "arm.xml"), actuators="all")
    context = plant.CreateDefaultContext()
    random = np.random.default_rng(0)
    for _ in range(3):
        q, wanted = random.normal(size=3), np.zeros((3, 3))
        data.qpos[:] = q
        mujoco.mj_forward(model, data)
        mujoco.mj_fullM(model, data, wanted)
        plant.SetPositions(context, q)
        np.testing.assert_allclose(plant.CalcMassMatrix(context), wanted, atol=1e-12)
    low = plant.GetPositionLowerLimits()
    np.testing.assert_allclose(low, [-np.inf, -np.pi / 6, -np.inf])
    assert [plant.GetJointByName(f"j{k}").default_damping() for k in (1, 2, 3)] == [0.3] * 3


def test_a_rotor_of_a_joint_that_is_locked_is_no_loss(tmp_path):
    """What it added to the joint's own row of M(q) goes with the row."""
    file = written(tmp_path, CLASSES, "arm.xml")
    plant = plant_of(file, actuators="all", locked={"j2": 0.1})
    rotors = {
        one.joint().name(): one.default_rotor_inertia()
        for one in map(plant.get_joint_actuator, plant.GetJointActuatorIndices())
    }
    assert rotors == {"j1": 0.2, "j3": 0.2}
    with pytest.raises(ModelError, match=r"'j3'.* 0\.2 .*\[joint/armature\]"):
        plant_of(file, actuators=["j1"], locked={"j2": 0.1})
