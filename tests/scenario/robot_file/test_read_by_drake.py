"""The tables of what Drake reads of robot files, fed through Drake part by part."""

import logging
import re
import warnings
from copy import deepcopy
from pathlib import Path
from threading import Event, Thread
from xml.etree.ElementTree import Element

import numpy as np
import pytest
from pydrake.geometry import SceneGraph
from pydrake.multibody.inverse_kinematics import AddMultibodyPlantConstraints
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import DiscreteContactApproximation, MultibodyPlant
from pydrake.multibody.tree import FrameIndex
from pydrake.solvers import MathematicalProgram

from drake_dae.errors import GeometryWarning, ModelError, RobotFileWarning
from drake_dae.scenario.robot_file import mending
from drake_dae.scenario.robot_file.read_by_drake import READ_BY_DRAKE, read_xml, write_xml
from drake_dae.scenario.robot_file.reading import finalize, needs_of, read_robot
from drake_dae.scenario.robot_file.robot import Robot

pytestmark = [
    pytest.mark.filterwarnings("ignore::drake_dae.errors.RobotFileWarning"),
    pytest.mark.filterwarnings("ignore::drake_dae.errors.GeometryWarning"),
]

# Files in which each part that Drake reads has a value that is not its default.
INERTIAL = (
    '<inertial><origin xyz="0.1 0.2 0.3" rpy="0.1 0.2 0.3"/><mass value="2"/><inertia ixx="0.3" '
    'iyy="0.4" izz="0.5" ixy="0.01" ixz="0.02" iyz="0.03"/></inertial>'
)
JOINT = (
    '<joint name="{0}" type="{1}"><origin xyz="0.1 0.2 0.3" rpy="0.3 0.2 0.1"/>'
    '<parent link="{2}"/><child link="{3}"/><axis xyz="0.6 0 0.8"/>{4}'
    '<limit lower="-1" upper="2" velocity="3" effort="4" drake:acceleration="5"/>'
    '<dynamics damping="0.5"/></joint>'
)
URDF = f"""<robot name="r" xmlns:drake="http://drake.mit.edu">
<material name="grey"><color rgba="0.5 0.5 0.5 1"/></material>
<link name="base"/><link name="a">{INERTIAL}</link><link name="b">{INERTIAL}</link>
<link name="c">{INERTIAL}</link><link name="d">{INERTIAL}</link>
<joint name="hold" type="fixed"><parent link="world"/><child link="base"/></joint>
{JOINT.format("j", "revolute", "base", "a", "")}
{JOINT.format("k", "prismatic", "a", "b", '<mimic joint="j" multiplier="2" offset="0.1"/>')}
<joint name="p" type="planar"><parent link="b"/><child link="c"/><axis xyz="0.6 0 0.8"/>
<dynamics damping="0.1 0.2 0.3"/></joint>
{JOINT.format("l", "continuous", "c", "d", "")}
<transmission><type>SimpleTransmission</type><joint name="j"/><actuator name="m">
<drake:rotor_inertia value="0.1"/><drake:gear_ratio value="3"/></actuator></transmission>
<frame name="tip" link="a" xyz="1 0 0"/></robot>"""
BALL = (
    '<drake:ball_constraint><drake:ball_constraint_body_A name="a"/><drake:ball_constraint_body_B '
    'name="c"/><drake:ball_constraint_p_AP value="0 0 1"/><drake:ball_constraint_p_BQ '
    'value="0 0 1"/></drake:ball_constraint>'
)
SDF_INERTIAL = (
    "<inertial><pose>0.1 0.2 0.3 0.1 0.2 0.3</pose><mass>2</mass><inertia><ixx>0.3</ixx>"
    "<iyy>0.4</iyy><izz>0.5</izz><ixy>0.01</ixy><ixz>0.02</ixz><iyz>0.03</iyz></inertia></inertial>"
)
SDF_JOINT = (
    '<joint name="{0}" type="{1}"><parent>{2}</parent><child>{3}</child><pose>0.1 0.2 0.3 0 0 0'
    "</pose><axis><xyz>0.6 0 0.8</xyz><limit><lower>-1</lower><upper>2</upper>"
    "<velocity>3</velocity><effort>4</effort><drake:acceleration>5</drake:acceleration></limit>"
    "<dynamics><damping>0.5</damping><spring_stiffness>6</spring_stiffness>"
    "<spring_reference>0.2</spring_reference></dynamics></axis>{4}</joint>"
)
ROTOR = "<drake:rotor_inertia>0.1</drake:rotor_inertia><drake:gear_ratio>3</drake:gear_ratio>"
FOLLOWS = '<drake:mimic joint="j" multiplier="2" offset="0.1"/>'
SDF = f"""<sdf version="1.9" xmlns:drake="http://drake.mit.edu"><model name="r">
<link name="base">{SDF_INERTIAL}</link><link name="a"><pose>1 0 0 0.1 0.2 0.3</pose>{SDF_INERTIAL}
</link><link name="b"><pose>2 0 0 0 0 0</pose>{SDF_INERTIAL}</link>
<frame name="tip"><pose>1 0 0 0 0 0</pose></frame>
<joint name="hold" type="fixed"><parent>world</parent><child>base</child></joint>
{SDF_JOINT.format("j", "revolute", "base", "a", ROTOR)}
{SDF_JOINT.format("k", "prismatic", "a", "b", FOLLOWS)}</model></sdf>"""
MJCF = """<mujoco model="r"><compiler angle="radian" eulerseq="zyx"/><option gravity="0 1 -3"/>
<worldbody><body name="a" pos="1 0 0" euler="0.1 0.2 0.3"><inertial pos="0.1 0.2 0.3"
quat="0.9 0.1 0.2 0.3" mass="2" diaginertia="0.3 0.4 0.5"/><joint name="j" pos="0.1 0 0"
axis="0.6 0 0.8" range="-1 2" damping="0.5" ref="0.1" armature="0.2"/>
<body name="b" pos="1 0 0" axisangle="0 1 0 0.4"><inertial pos="0 0 0" mass="1"
fullinertia="0.3 0.4 0.5 0.01 0.02 0.03"/><joint name="k" type="slide" axis="0 0 1"/>
<body name="c" xyaxes="0 1 0 -1 0 0"><geom type="box" size="0.1 0.2 0.3" pos="0.1 0 0" mass="3"/>
<geom type="capsule" fromto="0 0 0 1 0 0" size="0.1" density="100"/><joint name="l"/>
<body name="d" zaxis="1 0 1"><freejoint/><geom size="0.1"/></body></body></body></body></worldbody>
<actuator><motor name="m" joint="j" gear="2" ctrlrange="-3 3" forcerange="-4 4"/>
<motor name="n" joint="k" forcerange="-4 4"/></actuator><equality/></mujoco>""".replace(
    '<body name="d" zaxis="1 0 1"><freejoint/>', '<body name="d" zaxis="1 0 1"><joint name="f"/>'
)
WHOLE = {".urdf": URDF, ".sdf": SDF, ".xml": MJCF}

DRAWN = {"robot/material", "material/name", "material/color", "color/rgba", "sdf/version"}
DRAWN |= {"motor/gear"}  # The inertia of a rotor at its joint is the armature, whatever the gear.
"""Parts of these files that no equation of Drake's has."""


def facts(text: str, kind: str) -> tuple:
    """What Drake makes of a file: accelerations, limits, names and numbers of things."""
    free, held = MultibodyPlant(0.0), MultibodyPlant(0.001)
    held.set_discrete_contact_approximation(DiscreteContactApproximation.kSap)
    for plant in (free, held):
        Parser(plant).AddModelsFromString(text, kind)
        for key in plant.GetConstraintIds() if plant is free else ():
            plant.RemoveConstraint(key)  # Continuous plants have none.
        plant.Finalize()
    context = free.CreateDefaultContext()
    found = [free.GetPositions(context), free.GetEffortUpperLimits()]
    found += [free.GetPositionLowerLimits(), free.GetPositionUpperLimits()]
    found += [free.GetVelocityUpperLimits(), free.GetAccelerationUpperLimits()]
    random = np.random.default_rng(0)
    q = random.normal(size=free.num_positions())
    free.SetPositions(context, q)
    free.SetVelocities(context, random.normal(size=free.num_velocities()))
    free.get_actuation_input_port().FixValue(context, random.normal(size=free.num_actuators()))
    found.append(free.EvalTimeDerivatives(context).CopyToVector())
    program = MathematicalProgram()
    variables = program.NewContinuousVariables(q.size)
    kept = held.CreateDefaultContext()  # The constraints point to it.
    AddMultibodyPlantConstraints(held, variables, program, kept)
    for binding in program.GetAllConstraints():
        own = binding.evaluator()
        values = q[[program.FindDecisionVariableIndex(one) for one in binding.variables()]]
        found.append(own.Eval(values) - own.lower_bound())
    names = [free.get_joint(index).name() for index in free.GetJointIndices()]
    names += [free.get_joint_actuator(i).name() for i in free.GetJointActuatorIndices()]
    names += [free.get_frame(FrameIndex(i)).name() for i in range(free.num_frames())]
    return tuple(np.round(np.clip(np.concatenate(found), -1e6, 1e6), 9).tolist()), *names


def parts(root: Element) -> list[tuple[Element, str]]:
    """The owners and names of all attributes and elements of a file."""
    found = [(node, name) for node in root.iter() for name in node.attrib if ":" not in name]
    return found + [(node, child.tag) for node in root.iter() for child in node]


@pytest.mark.parametrize("kind", WHOLE)
def test_each_part_that_the_table_has_is_one_that_drake_reads(kind: str, tmp_path: Path):
    """Without it Drake makes another robot of the file, or none: wherever it is, or somewhere."""
    (tmp_path / "whole").write_text(WHOLE[kind])
    whole = read_xml(tmp_path / "whole")
    before, table = facts(write_xml(whole), kind), READ_BY_DRAKE[kind]
    found: dict[str, bool] = {}
    for number, (owner, name) in enumerate(parts(whole)):
        if not table.get(owner.tag, {}).get(name, (False, ""))[0] or owner.tag == "mujoco":
            continue
        root = deepcopy(whole)
        node = parts(root)[number][0]
        if name in node.attrib:
            del node.attrib[name]
        else:
            node.remove(next(child for child in node if child.tag == name))
        try:
            changes = facts(write_xml(root), kind) != before
        except (RuntimeError, ValueError, SystemExit):
            changes = True
        part = f"{owner.tag}/{name}"
        found[part] = found.get(part, False) or changes
    assert {part for part, changes in found.items() if not changes} <= DRAWN
    assert len(found) > 25


def with_texts(kind: str, *pairs: str) -> str:
    """A whole file with texts, each before a marker that ends an element, or after another one."""
    text = WHOLE[kind]
    for marker, new in zip(pairs[::2], pairs[1::2], strict=True):
        assert marker in text
        both = new + marker if marker.startswith("</") else marker + new
        text = text.replace(marker, both, 1)
    return text


def rows(text: str) -> list[list[str]]:
    """The cells of the rows of a table."""
    return [line.split(" | ") for line in text.strip().splitlines()]


# Format, what is lost, and texts with their markers.
LOST = rows(f"""
.urdf | dynamics/friction | damping="0.5" |  friction="0.3"
.urdf | robot/loop_joint | </robot> | <loop_joint name="x"/>
.urdf | robot/drake:ball_constraint | </robot> | {BALL}
.urdf | gazebo/turnGravityOff | </robot> | <gazebo><turnGravityOff>1</turnGravityOff></gazebo>
.urdf | link/gravity | </link> | <gravity>0</gravity>
.urdf | transmission/type | Simple | X
.urdf | limit/current | <limit |  current="2"
.urdf | compiler/settotalmass | </robot> | <mujoco><compiler settotalmass='3'/></mujoco>
.urdf | inertia | ixx=" | 3
.urdf | empty_limits | upper=" | -
.sdf | dynamics/friction | </dynamics> | <friction>0.3</friction>
.sdf | link/gravity | </link> | <gravity>false</gravity>
.sdf | axis/mimic | </axis> | <mimic joint="k"><multiplier>2</multiplier></mimic>
.sdf | world/gravity | edu"> | <world name='w'><gravity>0 0 -2</gravity> | </sdf> | </world>
.sdf | inertia | <ixx> | 3
.xml | joint/stiffness | <joint name="l" |  stiffness="3" springref="1"
.xml | joint/frictionloss | </mujoco> | <default><joint frictionloss="1"/></default>
.xml | joint/armature | <joint name="l" |  type="ball" armature="0.1"
.xml | body/gravcomp | <body name="b" |  gravcomp="1"
.xml | body/frame | </body> | <frame><body/></frame>
.xml | mujoco/tendon | </mujoco> | <tendon><fixed name="t"/></tendon>
.xml | equality/joint | <equality/> | <equality><joint joint1="j" joint2="k"/></equality>
.xml | equality/connect | <equality/> | <equality><connect body1="a" anchor="0 0 1"/></equality>
.xml | flag/gravity | </mujoco> | <option><flag gravity="disable"/></option>
.xml | ball/motor | <joint name="l" |  type="ball" | </actuator> | <motor joint="l"/>
.xml | motor/forcerange | </actuator> | <motor joint="l" forcerange="-4 9"/>
.xml | compiler/settotalmass | <compiler |  settotalmass="3"
.xml | inertia | diaginertia=" | 3
""")
READ_IN_PART = "motor/forcerange", "joint/armature", "ball/motor"
READ_IN_PART += "equality/connect", "robot/drake:ball_constraint"  # No equation of ours has them.


@pytest.mark.parametrize(("kind", "part", "pairs"), [(*one[:2], one[2:]) for one in LOST])
def test_what_is_lost_is_an_error_with_its_name_until_it_is_left_out(kind, part, pairs, tmp_path):
    text, file = with_texts(kind, *pairs), tmp_path / f"robot{kind}"
    file.write_text(text)
    assert needs_of(Robot(str(file)))[1] == [part]
    with pytest.raises(ModelError, match=rf"leave_out: \[{part}\]"):
        read_robot(Robot(str(file)))
    finalize(read_robot(Robot(str(file), leave_out=[part]))[0])
    if "/" not in part or part in READ_IN_PART:
        return  # Drake refuses it, or reads it in part.
    try:
        assert facts(text, kind) == facts(WHOLE[kind], kind) or part.startswith("transmission")
    except (RuntimeError, ValueError):
        assert part == "robot/loop_joint"


HARMLESS = rows("""
.urdf | damping="0.5" |  friction="0.0"
.urdf | </link> | <gravity>1</gravity><self_filter/><contact><stiffness value='3'/></contact>
.urdf | </robot> | <gazebo><sensor/><gravity>true</gravity><mu1>0.3</mu1></gazebo>
.urdf | </joint> | <safety_controller k_velocity="1"/><calibration rising="0"/>
.urdf | </robot> | <mujoco><compiler meshdir="../m" balanceinertia="true"/></mujoco>
.sdf | </dynamics> | <friction>0</friction>
.sdf | </link> | <gravity>1</gravity><sensor name='s' type='imu'/>
.xml | <option |  timestep="0.01" density="0" integrator="RK4"
.xml | <joint name="l" |  stiffness="0" solreflimit="0.1 1" margin="1"
.xml | </mujoco> | <default><joint stiffness="0"/></default><sensor/><worldbody><light/></worldbody>
.xml | <equality/> | <equality><joint joint1="j" joint2="k" active="false"/></equality>
.xml | <joint name="l" |  range="0 0"
.xml | </mujoco> | <asset><mesh vertex="0 0 0 1 0 0 0 1 0 0 0 1"/></asset>
""")


@pytest.mark.parametrize(("kind", "marker", "new"), HARMLESS)
def test_what_changes_no_equation_passes_without_a_word(kind, marker, new, tmp_path):
    told = []
    for text in (WHOLE[kind], with_texts(kind, marker, new)):
        (tmp_path / f"robot{kind}").write_text(text)
        with warnings.catch_warnings(record=True) as found:
            warnings.simplefilter("always")
            finalize(read_robot(Robot(str(tmp_path / f"robot{kind}")))[0])
        told.append([re.sub(r":\d+:", "", str(one.message)) for one in found])
    assert told[0] == told[1]


MASSES = {
    ".urdf": '<inertial><mass value="2"/><inertia ixx="1" iyy="1" izz="1"/></inertial>',
    ".sdf": "<inertial><mass>2</mass></inertial>",
    ".xml": '<inertial pos="0 0 0" mass="2" diaginertia="1 1 1"/>',
}
OF_DRAKE = {"ball": "", "universal": "", "screw": '<drake:screw_thread_pitch value="0.1"/>'}


def one_joint(kind: str, form: str, limit: str = "", dynamics: str = "", rest: str = "") -> str:
    """A robot with one joint 'j' of a type."""
    if kind == ".urdf":
        tag = "drake:joint" if form in OF_DRAKE else "joint"
        return f"""<robot name="r" xmlns:drake="d"><link name="a">{MASSES[kind]}</link>
<{tag} name="j" type="{form}"><parent link="world"/><child link="a"/><limit {limit}/>
<dynamics {dynamics}/>{OF_DRAKE.get(form, "")}</{tag}>{rest}</robot>"""
    if kind == ".xml":
        return f"""<mujoco model="r"><compiler angle="radian"/><worldbody><body name="a">
{MASSES[kind]}<joint name="j" type="{form}" {limit} {dynamics}/>{rest}</body></worldbody>
</mujoco>"""
    limit += "" if "effort" in limit else "<effort>0</effort>"
    second = "<axis2><xyz>0 1 0</xyz></axis2>"
    return f"""<sdf version="1.9" xmlns:drake="d"><model name="r"><link name="a">{MASSES[kind]}
</link><joint name="j" type="{form}"><parent>world</parent><child>a</child><axis><xyz>0 0 1</xyz>
<limit>{limit}</limit><dynamics>{dynamics}</dynamics></axis>{second * (form == "universal")}{rest}
</joint></model></sdf>"""


FORMS = {
    ".urdf": "revolute prismatic planar floating ball universal screw",
    ".sdf": "revolute prismatic ball universal screw",
    ".xml": "hinge slide ball free",
}
KEYS = {
    ".urdf": "upper lower velocity drake:acceleration damping",
    ".sdf": "upper lower velocity drake:acceleration effort damping spring_stiffness",
    ".xml": "range damping ref",
}
MEANT_OF_NONE = {("ball", "ref"), ("free", "ref"), ("free", "range")}
"""What MuJoCo does not read either."""


@pytest.mark.parametrize(
    ("kind", "form", "key"),
    [
        (kind, form, key)
        for kind in FORMS
        for form in FORMS[kind].split()
        for key in KEYS[kind].split()
        if (form, key) not in MEANT_OF_NONE
    ],
)
def test_what_drake_does_not_read_of_a_type_of_joint_is_refused(kind, form, key, tmp_path):
    value = {"lower": "-1.5", "range": "-1.5 1.5"}.get(key, "1.5")
    value = "1.5 1.5 1.5" if (form, key) == ("planar", "damping") else value
    part = f"<{key}>{value}</{key}>" if kind == ".sdf" else f'{key}="{value}"'
    text = one_joint(
        kind, form, *(("", part) if key in ("damping", "spring_stiffness") else (part,))
    )
    file = tmp_path / f"r{kind}"
    file.write_text(text)
    if facts(text, kind) == facts(one_joint(kind, form), kind):
        with pytest.raises(ModelError, match=rf"{form}/{key} .*'j' {value}"):
            read_robot(Robot(str(file)))
        finalize(read_robot(Robot(str(file), leave_out=[f"{form}/{key}"]))[0])
    else:
        finalize(read_robot(Robot(str(file)))[0])


@pytest.mark.parametrize(
    ("form", "end", "new", "part"),
    [
        ("screw", "</joint>", "<thread_pitch>3</thread_pitch>", "joint/thread_pitch"),
        ("universal", "</axis2>", "<dynamics><damping>2</damping></dynamics>", "axis2/dynamics"),
    ],
)
def test_what_drake_misreads_is_refused(form, end, new, part, tmp_path: Path):
    """It takes a pitch in rad/m for one in m, and one of two dampings."""
    file = tmp_path / "robot.sdf"
    file.write_text(one_joint(".sdf", form).replace(end, new + end))
    with pytest.raises(ModelError, match=rf"{part} .*'j'"):
        read_robot(Robot(str(file)))
    read_robot(Robot(str(file), leave_out=[part]))


def test_what_drake_remarks_is_one_warning_with_the_users_file(tmp_path: Path):
    geoms = "".join(f'<geom name="g{k}" size="1" material="none"/>' for k in range(20))
    (tmp_path / "robot.xml").write_text(one_joint(".xml", "hinge", rest=geoms))
    with pytest.warns(RobotFileWarning) as told:
        read_robot(Robot(str(tmp_path / "robot.xml")), scene_graph=SceneGraph())
    (line,) = {str(one.message) for one in told}
    assert "robot.xml:" in line
    assert "g0" in line
    assert "12 more" in line
    assert "/" not in line


@pytest.mark.parametrize(
    ("words", "limit"),
    [
        ('range="0 0"', np.inf),
        ('range="0 0" limited="auto"', np.inf),
        ('range="-1 1" limited="false"', np.inf),
        ('range="0 0" limited="true"', 0.0),
        ('range="-1 1"', 1.0),
    ],
)
def test_an_empty_range_of_mjcf_is_none(words, limit, tmp_path):
    text = one_joint(".xml", "hinge", words)
    (tmp_path / "robot.xml").write_text(
        text.replace("<worldbody>", "<compiler angle='radian'/><worldbody>")
    )
    joint = read_robot(Robot(str(tmp_path / "robot.xml")))[0].GetJointByName("j")
    np.testing.assert_allclose(joint.position_upper_limits(), limit)


@pytest.mark.parametrize(
    ("tag", "limit"),
    [
        ("position", 8.0),
        ("velocity", 8.0),
        ("intvelocity", 8.0),
        ('general gainprm="3 0 0" biastype="affine"', 8.0),
        ('general gainprm="3 0 0" dyntype="integrator"', 8.0),
        ('general gainprm="3 0 0" gaintype="affine"', 8.0),
        ('general gainprm="3 0 0"', 6.0),
        ('general gainprm="3 0 0" dyntype="none" gaintype="fixed" biastype="none"', 6.0),
    ],
)
def test_servos_become_motors_with_their_limits_of_efforts(tag, limit, tmp_path):
    """Without a law, gain and control limit the effort of a general actuator, and none is told."""
    text = MJCF.replace('<motor name="n"', f'<{tag} name="n" ctrlrange="-1 1" gear="2"')
    (tmp_path / "robot.xml").write_text(text)
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        plant = read_robot(Robot(str(tmp_path / "robot.xml")))[0]
    assert ["'n'" in str(one.message) for one in told] == [True] * (limit == 8.0)
    assert plant.GetJointActuatorByName("n").effort_limit() == limit


@pytest.mark.parametrize("tag", ["motor", "general", "position"])
def test_all_kinds_of_actuators_have_one_default(tag: str, tmp_path: Path):
    """MuJoCo keeps one actuator per class: limits in it are of motors and of servos."""
    default = f'<default><{tag} forcerange="-7 7" gear="3"/></default>'
    text = with_texts(".xml", "</mujoco>", default).replace(' forcerange="-4 4"', "", 2)
    text = text.replace('<motor name="n"', '<position name="n" kp="9"')
    (tmp_path / "robot.xml").write_text(text)
    plant = read_robot(Robot(str(tmp_path / "robot.xml")))[0]
    limits = [plant.GetJointActuatorByName(name).effort_limit() for name in "mn"]
    assert limits == [2.0 * 3.0, 3.0 * 7.0]  # Of m the own gear and control, within 2 times 7.


def test_changes_of_an_included_model_are_not_lost(tmp_path: Path):
    (tmp_path / "arm.sdf").write_text(SDF)
    text = """<sdf version="1.9" xmlns:experimental="e"><model name="m"><include {}><uri>arm.sdf
</uri>{}</include></model></sdf>"""
    removal = '<link element_id="a" action="remove"/>'
    changed = text.format("", f"<experimental:params>{removal}</experimental:params>")
    (tmp_path / "robot.sdf").write_text(changed)
    with pytest.raises(ModelError, match="include/experimental:params"):
        read_robot(Robot(str(tmp_path / "robot.sdf")))
    (tmp_path / "robot.sdf").write_text(text.format('merge="true"', ""))
    assert read_robot(Robot(str(tmp_path / "robot.sdf")))[0].HasJointNamed("j")


FAULTY = rows("""
.urdf | <box/>
.urdf | <cylinder radius="1" length="0"/>
.urdf | <sphere radius="nan"/>
.sdf | <box><size>1 1</size></box>
.sdf | <sphere><radius>a</radius></sphere>
.sdf | <heightmap/>
""")


@pytest.mark.parametrize("tag", ["visual", "collision"])
@pytest.mark.parametrize(("kind", "shape"), FAULTY)
def test_no_shape_stops_a_robot(kind: str, shape: str, tag: str, tmp_path: Path):
    text = one_joint(kind, "revolute").replace(
        "</link>", f"<{tag} name='v'><geometry>{shape}</geometry></{tag}></link>"
    )
    (tmp_path / f"robot{kind}").write_text(text)
    with pytest.warns(GeometryWarning, match="of 'a'") as told:
        read_robot(Robot(str(tmp_path / f"robot{kind}")), scene_graph=(scene := SceneGraph()))
    assert len(told) == 1  # None of what Drake logs of the trial.
    assert scene.model_inspector().num_geometries() == 0


@pytest.mark.parametrize(
    "geom",
    [
        'type="cylinder" size="1"',
        'type="capsule" fromto="0 1 0 0 1 0" size="1"',
        'type="box" size="1 -1 1"',
        'type="hfield" hfield="h"',
    ],
)
def test_no_geom_of_mjcf_stops_a_robot_and_none_with_a_mass_is_lost(geom: str, tmp_path: Path):
    file = tmp_path / "robot.xml"
    file.write_text(with_texts(".xml", "<worldbody>", f"<geom {geom}/>"))
    with pytest.warns(GeometryWarning, match="of ''"):
        read_robot(Robot(str(file)), scene_graph=SceneGraph())
    file.write_text(with_texts(".xml", "</body>", f'<geom {geom} mass="2"/>'))
    with pytest.raises(ModelError, match=r"'d'.* mass"):
        read_robot(Robot(str(file)), scene_graph=SceneGraph())


def test_trials_of_shapes_in_two_threads_leave_drakes_log_as_it_was(monkeypatch):
    """The first ends within the second."""
    logger, inside, ended = logging.getLogger("drake"), Event(), Event()
    before = logger.disabled, [*logger.filters]

    class Trial(Parser):
        def AddModelsFromString(self, text: str, kind: str) -> None:
            if text == "first":
                second.start()
                assert inside.wait(10.0)
            else:
                inside.set()
                assert ended.wait(10.0)

    monkeypatch.setattr(mending, "Parser", Trial)
    mending._is_read.cache_clear()
    second = Thread(target=mending._is_read, args=(".urdf", "second"))
    mending._is_read(".urdf", "first")
    ended.set()
    second.join()
    mending._is_read.cache_clear()
    assert (logger.disabled, logger.filters) == before
