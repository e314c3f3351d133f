"""Packages are found where ROS finds them, and a message says where to name the others."""

from pathlib import Path

import pytest
from pydrake.geometry import Role, SceneGraph
from runs import scenario_model
from vendors import write_panda

from drake_dae import load_scenario
from drake_dae.errors import GeometryWarning, RobotFileWarning, ScenarioError
from drake_dae.scenario.robot_file.reading import needs_of, read_robot
from drake_dae.scenario.robot_file.robot import Robot

SCENARIO = """
robot: {file: FILE, base: {weld: panda_link0}, locked: {panda_finger_joint1: 0.02}, actuators: all}
outputs:
- !JointPositions
  joints: [panda_joint1, panda_joint2, panda_joint3, panda_joint4, panda_joint5, panda_joint6,
    panda_joint7]
references: {panda_joint1: 0.2, panda_joint2: 0.3, panda_joint3: 0.4, panda_joint4: -0.5,
  panda_joint5: 0.6, panda_joint6: 0.7, panda_joint7: 0.8}
"""

pytestmark = [
    # Its collision meshes are left out.
    pytest.mark.filterwarnings("ignore::drake_dae.errors.GeometryWarning"),
    pytest.mark.usefixtures("no_ros"),
]


@pytest.fixture
def no_ros(monkeypatch):
    monkeypatch.delenv("ROS_PACKAGE_PATH", raising=False)


def joints(folder: Path, file: str = "panda_description/urdf/panda.urdf", *settings: str) -> int:
    (folder / "panda.yaml").write_text(SCENARIO.replace("FILE", file))
    return len(
        scenario_model(load_scenario(folder / "panda.yaml", settings)).links.position_signals
    )


def drawn(folder: Path, file: str, **packages: str) -> int:
    """The number of visual geometries."""
    scene_graph = SceneGraph()
    read_robot(Robot(str(folder / file), packages=packages), scene_graph=scene_graph)
    return len(scene_graph.model_inspector().GetAllGeometryIds(Role.kIllustration))


def away(folder: Path) -> str:
    """Puts the file far from its package, whose folder has another name."""
    file = write_panda(folder)
    (folder / "robots").mkdir()
    file.rename(folder / "robots" / "panda.urdf")
    (folder / "workspace").mkdir()
    (folder / "panda_description").rename(folder / "workspace" / "panda")
    return "robots/panda.urdf"


def test_a_package_beside_that_of_the_file_is_found(tmp_path: Path):
    file = write_panda(tmp_path)
    (tmp_path / "my_cell" / "robots").mkdir(parents=True)
    file.rename(tmp_path / "my_cell" / "robots" / "panda.urdf")
    assert joints(tmp_path, "my_cell/robots/panda.urdf") == 7


def test_a_package_in_ros_package_path_is_found(tmp_path: Path, monkeypatch):
    file = away(tmp_path)
    monkeypatch.setenv("ROS_PACKAGE_PATH", f"{tmp_path}/none:{tmp_path}/workspace")
    with pytest.warns(RobotFileWarning, match=f"{tmp_path}/none"):  # It is no folder.
        assert joints(tmp_path, file) == 7


def test_geometry_of_an_unknown_package_is_left_out_with_the_key(tmp_path: Path):
    file = away(tmp_path)
    with pytest.warns(GeometryWarning, match=r"robot\.packages.*'package://panda_description/"):
        assert drawn(tmp_path, file) == 0
    assert drawn(tmp_path, file, panda_description=str(tmp_path / "workspace/panda")) == 11


URDF = """<robot name="a"><link name="b"><visual><geometry>{}</geometry><material name="m">
<texture filename="package://colours/a.png"/></material></visual></link>
<gazebo><plugin filename="f"><uri>model://worlds/a</uri></plugin></gazebo></robot>"""
SDF = """<sdf version="1.9"><model name="a"><link name="b"><visual name="v"><geometry>{}</geometry>
</visual></link><plugin name="p" filename="f"><uri>model://worlds/a</uri></plugin></model></sdf>"""


@pytest.mark.parametrize(
    ("name", "text", "shape", "missing"),
    [
        ("a.urdf", URDF, '<sphere radius="1"/>', []),
        ("a.urdf", URDF, '<mesh filename="package://shapes/a.obj"/>', ["shapes"]),
        ("a.sdf", SDF, "<sphere><radius>1</radius></sphere>", []),
        ("a.sdf", SDF, "<mesh><uri> package://shapes/a.obj </uri></mesh>", ["shapes"]),
    ],
)
def test_only_packages_of_what_is_read_are_needed(name, text, shape, missing, tmp_path: Path):
    (tmp_path / name).write_text(text.format(shape))
    assert needs_of(Robot(str(tmp_path / name))) == (missing, [])


@pytest.mark.parametrize(
    ("file", "settings", "words"),
    [
        ("package://non/a.urdf", (), ["robot.file: ", "'non'", "robot.packages"]),
        ("a.urdf", ("robot.packages.x=none",), ["robot.packages.x: ", "/none'"]),
        ("a.urdf", ("robot.packages.drake=.",), ["robot.packages.drake: ", "drake"]),
        ("a.urdf", ("robot.packages=[x]",), ["robot.packages: "]),
    ],
)
def test_packages_that_are_none(file: str, settings: tuple[str, ...], words, tmp_path: Path):
    (tmp_path / "a.urdf").write_text("<robot name='a'><link name='b'/></robot>")
    with pytest.raises(ScenarioError) as caught:
        joints(tmp_path, file, *settings)
    assert [word for word in words if word not in str(caught.value)] == [], str(caught.value)
