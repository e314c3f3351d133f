"""`robot.description` names a robot of robot_descriptions; here a package of that name, made up."""

import sys
from pathlib import Path
from types import ModuleType

import pytest
from vendors import write_panda

from drake_dae import load_scenario
from drake_dae.errors import ModelError, ScenarioError
from drake_dae.scenario.model import scenario_model
from drake_dae.scenario.robot_file.files import described_robot
from drake_dae.scenario.scenario import save_scenario

pytestmark = pytest.mark.filterwarnings("ignore::drake_dae.errors.GeometryWarning")

SCENARIO = """
robot: {description: panda_description, base: {weld: panda_link0},
  locked: {panda_finger_joint1: 0.02}, actuators: all}
outputs:
- !JointPositions
  joints: [panda_joint1, panda_joint2, panda_joint3, panda_joint4, panda_joint5, panda_joint6,
    panda_joint7]
references: {panda_joint1: 0.2, panda_joint2: 0.3, panda_joint3: 0.4, panda_joint4: -0.5,
  panda_joint5: 0.6, panda_joint6: 0.7, panda_joint7: 0.8}
"""


@pytest.fixture
def fake(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """A package with the attributes that the real one has, and a clone of one robot."""
    repository = tmp_path / "cache" / "example-robot-data"
    repository.mkdir(parents=True)
    file = write_panda(repository)
    # As in a clone: no package.xml beside the file, and the meshes under the package's name.
    (repository / "panda_description" / "package.xml").unlink()
    package = ModuleType("robot_descriptions")
    package.__path__ = []
    package.DESCRIPTIONS = {"panda_description": None, "xacro_description": None, "far": None}
    robot = ModuleType("robot_descriptions.panda_description")
    robot.REPOSITORY_PATH = str(repository)
    robot.PACKAGE_PATH = str(repository / "panda_description")
    robot.URDF_PATH = str(file)
    xacro = ModuleType("robot_descriptions.xacro_description")
    xacro.XACRO_PATH = "robot.xacro"
    for module in (package, robot, xacro):
        monkeypatch.setitem(sys.modules, module.__name__, module)
    monkeypatch.delenv("ROS_PACKAGE_PATH", raising=False)
    return package


def load(folder: Path, *settings: str):
    (folder / "panda.yaml").write_text(SCENARIO)
    return load_scenario(folder / "panda.yaml", settings)


def test_a_description_is_the_robot_of_its_file(fake, tmp_path):
    """Its packages are found in the clone, and the scenario as run names it as it was."""
    scenario = load(tmp_path)
    model = scenario_model(scenario)
    assert len(model.links.position_signals) == 7
    assert model.dae.name == "panda_description"
    save_scenario(scenario, tmp_path / "again.yaml")
    assert load_scenario(tmp_path / "again.yaml") == scenario


def test_what_is_wrong_with_a_name_is_reported(fake, tmp_path):
    with pytest.raises(ScenarioError) as caught:
        scenario_model(load(tmp_path, "robot.description=panda_descripton"))
    ((key, text),) = caught.value.problems
    assert key == "robot.description"
    assert "'panda_descripton'" in text
    with pytest.raises(ModelError, match="'xacro_description'"):
        described_robot("xacro_description")


def test_without_a_network_it_says_what_to_do(fake, tmp_path, monkeypatch):
    def fail(name, *_):
        if name.endswith(".far"):
            raise RuntimeError("could not resolve host")
        return sys.modules[name]

    monkeypatch.setattr("drake_dae.scenario.robot_file.files.import_module", fail)
    with pytest.raises(ModelError) as caught:
        described_robot("far")
    for words in ("could not resolve host", "ROBOT_DESCRIPTIONS_CACHE", "robot.file"):
        assert words in str(caught.value)


def test_without_the_package_it_says_how_to_install_it(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "robot_descriptions", None)
    with pytest.raises(ScenarioError, match=r"robot\.description: .*drake_dae\[descriptions\]"):
        scenario_model(load(tmp_path))


@pytest.mark.parametrize(
    ("setting", "words"),
    [
        ("robot={}", r"robot: .*'file'.*'description'"),
        ("robot.file=a.urdf", r"robot: .*'file'.*'description'"),
        ("robot.description=3", r"robot\.description: .*3"),
    ],
)
def test_one_of_file_and_description_is_given(setting, words, tmp_path):
    with pytest.raises(ScenarioError, match=words):
        load(tmp_path, setting)
