"""Scenarios of one's own, robots' files unedited: constraints hold by Drake's kinematics."""

from pathlib import Path

import numpy as np
import pytest
from runs import run_scenario, scenario_model, scenario_validator, untagged

from drake_dae import load_scenario
from drake_dae.errors import GeometryWarning, ScenarioError
from drake_dae.scenario.form import load_yaml

ROBOTS = Path(__file__).parent / "robots"

SINE = "{offset: %s, amplitudes: [%s], frequencies: [2]}"
REST = """
law:
  gains: {all: [-4]}
duration: 0.3
integrator: {max_step_size: 0.01, use_error_control: false}
"""
ARM = f"""
robot: {{file: {ROBOTS}/leaning_arm.xml}}
constraints:
- {{name: table, frame: palm, surface: {{point: [0, 0, 0.35], normal: [0, 0, 1]}}}}
- name: wall
  frame: finger
  point: [0.12, 0, 0]
  surface: {{point: [0.7, 0, 0], normal: [-1, 0, 0]}}
outputs:
- {{frame: palm, axes: x}}
- {{frame: finger, point: [0.12, 0, 0], axes: z, name: tip}}
references:
  palm.x: 0.537
  tip.z: !Sinusoids {SINE % (0.55, 0.03)}
  table.force: 40
  wall.force: !Sinusoids {SINE % (15, 5)}
start:
  positions: {{shoulder: -0.2, elbow: 1.355, wrist: -1.575, knuckle: -1.315}}
  errors: {{tip.z: 0.02}}
{REST}"""
FIVE_BAR = f"""
robot: {{file: {ROBOTS}/five_bar.sdf}}
constraints:
- name: wall
  frame: right_rod
  point: [0.3, 0, 0]
  surface: {{point: [0.02, 0, 0], normal: [-1, 0, 0]}}
outputs:
- {{frame: right_rod, point: [0.3, 0, 0], axes: z, name: tip}}
forces: [wall.force]
references:
  tip.z: !Sinusoids {SINE % (0.36, 0.03)}
  wall.force: !Sinusoids {SINE % (15, 5)}
start: {{errors: {{tip.z: 0.02}}}}
{REST}"""


def held(folder, text):
    """The loop and the record of a scenario, whose errors are predicted to what steps leave."""
    (folder / "mine.yaml").write_text(text)
    scenario_validator().validate(untagged(load_yaml(text, "own")))
    loop, _, record = run_scenario(load_scenario(folder / "mine.yaml"))
    predicted, positions = loop.predicted_error(record), len(loop.plant.model.position_signals)
    off = np.abs(record["tracking_error"] - predicted)
    assert np.max(off[:, :positions]) < 1e-7  # RK5 at 10 ms.
    assert np.max(off[:, positions:], initial=0.0) < 1e-9  # Forces are met at once.
    assert np.max(np.abs(predicted)) > 0.009
    assert np.max(np.abs(record["constraint_residual"])) < 1e-7
    return loop, record


@pytest.mark.slow
def test_an_arm_of_mjcf_on_a_table_and_a_wall(tmp_path, caplog):
    """Classes, an .obj and an .stl, sites and sensors; what no equation has is no noise."""
    _, record = held(tmp_path, ARM)
    forces = record["constraint_force"]
    np.testing.assert_allclose(forces[:, 0], 40.0, atol=1e-9)
    np.testing.assert_allclose(forces[:, 1], 15.0 + 5.0 * np.sin(2.0 * record.time), atol=1e-9)
    assert not [one for one in caplog.messages if "leaning_arm.xml" in one]


@pytest.mark.slow
def test_a_closed_chain_of_sdformat_on_a_wall(tmp_path):
    """Its fifth joint closes the loop, and is a constraint of its name in the loop's plane."""
    with pytest.warns(GeometryWarning, match=r"'hand\.stl'"):
        loop, record = held(tmp_path, FIVE_BAR)
    names = [one.name for one in record.signals["constraint_force"].signals]
    assert names == ["wall.force", "pin.fx", "pin.fy"]
    plant = loop.plant.model.links.plant
    context = plant.CreateDefaultContext()
    for state in record["state"][::10]:
        plant.SetPositionsAndVelocities(context, state)
        ends = [
            plant.EvalBodyPoseInWorld(context, plant.GetBodyByName(f"{side}_rod")) @ [0.3, 0.0, 0.0]
            for side in ("left", "right")
        ]
        np.testing.assert_allclose(*ends, atol=1e-8)


PRESS = """
robot: {file: press.sdf}
outputs: [!JointPositions {joints: [motor]}]
forces: []
references: {motor: -0.3}
"""


def test_a_loop_that_cannot_be_cut_says_what_to_do(tmp_path):
    joint = '<joint name="%s" type="fixed"><parent>%s</parent><child>%s</child></joint>'
    links = "".join(
        f'<link name="{name}"><inertial><mass>1</mass></inertial></link>' for name in "ab"
    )
    ends = ("one", "world", "a"), ("two", "a", "b"), ("three", "world", "b")
    joints = "".join(joint % end for end in ends)
    model = f'<sdf version="1.8"><model name="m">{links}{joints}</model></sdf>'
    (tmp_path / "press.sdf").write_text(model)
    (tmp_path / "mine.yaml").write_text(PRESS)
    with pytest.raises(ScenarioError, match="'three'"):
        scenario_model(load_scenario(tmp_path / "mine.yaml"))
