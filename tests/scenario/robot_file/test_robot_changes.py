"""Bases, locked joints and actuators of a scenario, against robots whose files say the same."""

import re
from pathlib import Path

import casadi as ca
import numpy as np
import pytest
from pydrake.geometry import SceneGraph
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import MultibodyPlant
from runs import scenario_model
from vendors import joint, link, panda, robot, write_panda

from drake_dae import load_scenario
from drake_dae.errors import ScenarioError
from drake_dae.scenario.robot_file.reading import finalize, read_robot, robot_links
from drake_dae.scenario.robot_file.robot import Robot

# The collision meshes of the panda are left out.
pytestmark = pytest.mark.filterwarnings("ignore::drake_dae.errors.GeometryWarning")

# The hand on a wall, the fingers and the wrist locked, the base on a table that is turned.
PANDA = """
robot:
  file: panda_description/urdf/panda.urdf
  base: {weld: panda_link0, pose: {translation: [0.1, 0.0, 0.2], rpy_deg: [5.0, -3.0, 10.0]}}
  locked: {panda_finger_joint1: 0.03, panda_joint7: 0.4}
  actuators: all
constraints:
- name: wall
  frame: panda_hand
  surface: !Plane {point: [0.8, 0.0, 0.0], normal: [-1.0, 0.0, 0.0]}
outputs:
- !PointCoordinates {frame: panda_hand, axes: yz}
- !JointPositions {joints: [panda_joint3, panda_joint5, panda_joint6]}
law:
  gains: !Poles {all: [-4.0]}
references:
  panda_hand.y: !Sinusoids {offset: 0.3, amplitudes: [0.05], frequencies: [2.0]}
  panda_hand.z: !Sinusoids {offset: 1.3, amplitudes: [0.04], frequencies: [2.0]}
  panda_joint3: 0.2
  panda_joint5: 0.1
  panda_joint6: 1.3
  wall.force: !Sinusoids {offset: 20.0, amplitudes: [5.0], frequencies: [2.0]}
start:
  positions: {panda_joint2: 0.5, panda_joint4: -1.1, panda_joint6: 1.3}
  errors: {panda_hand.z: 0.01}
duration: 1.0
integrator: {accuracy: 1.0e-8}
"""


def files(folder: Path, text: str) -> Path:
    write_panda(folder)
    (folder / "scenario.yaml").write_text(text)
    return folder / "scenario.yaml"


def fixed(text: str, name: str, shift: str, turn: str = "0 0 0") -> str:
    """A URDF in which a joint is a fixed one, at another place: what "locked" should be."""
    old = re.search(rf'<joint name="{name}".*?</joint>', text, re.DOTALL)
    assert old is not None
    parent, child = (re.search(rf'<{one} link="(\w+)"', old[0])[1] for one in ("parent", "child"))
    new = (
        f'<joint name="{name}" type="fixed"><origin xyz="{shift}" rpy="{turn}"/>'
        f'<parent link="{parent}"/><child link="{child}"/></joint>'
    )
    return text.replace(old[0], new)


def standing(text: str, base: str, pose: RigidTransform) -> MultibodyPlant:
    """A robot of Drake's own, without geometry, on its base."""
    plant = MultibodyPlant(0.0)
    Parser(plant).AddModelsFromString(text, "urdf")
    plant.WeldFrames(plant.world_frame(), plant.GetFrameByName(base), pose)
    for index in plant.GetJointIndices():
        if plant.get_joint(index).num_velocities() == 1:
            plant.AddJointActuator(plant.get_joint(index).name(), plant.get_joint(index))
    plant.Finalize()
    return plant


def test_accelerations_are_those_of_a_robot_whose_file_says_the_same(tmp_path):
    """Fixed joints at other places, and a weld, by hand; what is left is round-off."""
    links = scenario_model(load_scenario(files(tmp_path, PANDA))).links
    text = fixed(panda(), "panda_finger_joint1", "0 0.03 0.06")
    text = fixed(text, "panda_finger_joint2", "0 -0.03 0.06")
    text = fixed(text, "panda_joint7", "0 0 0.25", "0 0 0.4")
    pose = RigidTransform(RollPitchYaw(np.deg2rad([5, -3, 10])), [0.1, 0, 0.2])
    plant = standing(text, "panda_link0", pose)
    assert [signal.name for signal in links.position_signals] == list(
        plant.GetPositionNames(add_model_instance_prefix=False, always_add_suffix=False)
    )
    masses = ca.vertcat(*[parameter.symbol for parameter in links.parameters])
    u = ca.SX.sym("u", plant.num_actuators())
    force = links.actuation_matrix @ u - links.bias
    acceleration = ca.Function(
        "acceleration", [links.q, links.v, u, masses], [ca.solve(links.mass_matrix, force)]
    )
    context = plant.CreateDefaultContext()
    rng = np.random.default_rng(5)
    values = [parameter.value.item() for parameter in links.parameters]
    for _ in range(5):
        q, v, torque = (rng.normal(size=n) for n in (links.q.numel(),) * 3)
        plant.SetPositions(context, q)
        plant.SetVelocities(context, v)
        plant.get_actuation_input_port().FixValue(context, torque)
        wanted = plant.EvalTimeDerivatives(context).CopyToVector()[links.q.numel() :]
        found = np.array(acceleration(q, v, torque, values)).ravel()
        np.testing.assert_allclose(found, wanted, rtol=1e-9, atol=1e-9 * np.abs(wanted).max())


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        (["robot.base=null"], ["'panda_link0'", "{weld: panda_link0}"]),
        (["robot.base.weld=panda_lnk0"], ["robot.base.weld: ", "'panda_link0'"]),
        (["robot.base.weld=panda_hand"], ["robot.base.weld: ", "'panda_hand_joint'"]),
        (["robot.base.weld=world"], ["robot.base.weld: "]),
        (["robot.free=[panda_link0]"], ["robot.free: ", "'world_welds_to_panda_link0'"]),
        (["robot.locked={panda_joint8: 0}"], ["robot.locked: ", "panda_joint"]),
        (["robot.locked={panda_hand_joint: 0}"], ["robot.locked: ", "'panda_hand_joint'", "there"]),
        (["robot.locked={panda_joint1: 3}"], ["robot.locked: ", "3", "-2.9", "2.9"]),
        (["robot.locked.panda_finger_joint2=0"], ["robot.locked: "]),
        (["robot.locked.panda_joint6=0"], ["outputs.1: ", "'panda_joint6'"]),
        (["robot.actuators=null"], ["robot.actuators: ", "'panda.urdf'", "all"]),
        (["robot.actuators=[panda_joint0]"], ["robot.actuators: ", "panda_joint"]),
        (["robot.actuators=[panda_finger_joint1]"], ["robot.actuators: ", "'panda_finger_joint1'"]),
        (["robot.actuators={panda_joint1: 0}"], ["robot.actuators: ", "panda_joint1", "positive"]),
    ],
)
def test_what_does_not_fit_is_refused_with_its_key(settings, words, tmp_path):
    with pytest.raises(ScenarioError) as caught:
        scenario_model(load_scenario(files(tmp_path, PANDA), settings), SceneGraph())
    message = str(caught.value)
    assert "\n" not in message
    assert [word for word in words if word not in message] == [], message
    assert not re.search(r"plant\.\w+\(|Finalize", message)


@pytest.mark.parametrize("name", ["panda_finger_joint1", "panda_finger_joint2"])
def test_either_of_two_coupled_joints_locks_the_other(name, tmp_path):
    """A file and Drake may name either one as the one that follows."""
    file = write_panda(tmp_path)
    plant, _ = read_robot(Robot(str(file), locked={name: 0.03}))
    finalize(plant)
    for finger in ("panda_finger_joint1", "panda_finger_joint2"):
        weld = plant.GetJointByName(finger).X_FM()
        np.testing.assert_allclose(np.linalg.norm(weld.translation()), 0.03, rtol=1e-12)
    assert plant.num_constraints() == 0


@pytest.mark.parametrize(
    ("effort", "actuators", "wanted"),
    [
        ("0", "all", np.inf),
        ("87.0", ["j"], 87.0),
        ("87.0", {"j": None}, 87.0),
        ("0", {"j": 6}, 6.0),
    ],
)
def test_effort_limits_are_those_of_the_scenario_or_of_the_file(
    effort, actuators, wanted, tmp_path
):
    """One of 0 is unknown."""
    text = robot("one", link("a", 1), link("b", 1), joint("j", "a", "b", "0 0 1"))
    (tmp_path / "robot.urdf").write_text(text.replace("87.0", effort))
    plant, _ = read_robot(Robot(str(tmp_path / "robot.urdf"), actuators=actuators))
    finalize(plant)
    assert plant.GetEffortUpperLimits() == [wanted]


MASS = "<inertial><mass>1</mass></inertial>"
TURNS = (
    '<joint name="{}" type="revolute"><parent>{}</parent><child>{}</child>{}<axis><xyz>0 1 0</xyz>'
)
TURNS += "</axis></joint>"
OPEN = f"""<sdf version="1.9"><model name="m"><link name="a">{MASS}</link>
<link name="b"><pose>0 0 1 0 0 0</pose>{MASS}</link><link name="c"><pose>1 0 0 0 0 0</pose>{MASS}
</link><frame name="tip" attached_to="a"><pose>1.28 0 0 0 0 0</pose></frame>
<joint name="hold" type="fixed"><parent>world</parent><child>a</child></joint>
{TURNS.format("one", "a", "b", "")}{TURNS.format("two", "b", "c", "")}
{TURNS.format("three", "tip", "c", "POSE")}</model></sdf>"""


def test_a_loop_whose_named_parent_frame_is_elsewhere_is_told(tmp_path):
    """SDFormat puts a joint at its child, and takes only the body of a frame that is its parent."""
    file = tmp_path / "loop.sdf"
    file.write_text(OPEN.replace("POSE", ""))
    with pytest.raises(ScenarioError, match=r"'three'.* 0\.28 m .*'tip'"):
        robot_links(Robot(str(file)), SceneGraph())
    file.write_text(OPEN.replace("POSE", "<pose relative_to='tip'/>"))
    _, (loop,) = robot_links(Robot(str(file)), SceneGraph())
    assert loop.name == "three"
