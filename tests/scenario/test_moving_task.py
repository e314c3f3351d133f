"""Tasks on surfaces that move, which the law knows."""

import numpy as np
import pytest
from arms import parse

from drake_dae import build_scenario, load_scenario
from drake_dae.errors import ScenarioError
from drake_dae.scenario.rolled import roll_scenario

TEXT = """
robot: {file: package://drake_dae_models/two_link_arm.urdf}
constraints:
- {name: wall, frame: tool, surface: !Plane {point: [1.2, 0, 0], normal: [-1, 0, 0]}}
outputs: [{frame: tool, axes: z}]
law:
  gains: !Poles {all: [-20]}
  constraint_damping: !Poles {all: [-250]}
exogenous:
  wall.position: [!Sinusoids {offset: 1.2, amplitudes: [0.02], frequencies: [3.0]}, 0, 0]
plant: !CompliantContact {radius: 1.0e-5}
task:
  phases:
  - !Approach {speed: 0.03}
  - !Press {force: 15.0}
  - !Move {references: {tool.z: 0.4, wall.force: 20}, duration: 1.0, over: 0.5}
  - !Release {}
  - !Retreat {distance: 0.03}
start: {positions: {joint1: 1.1653, joint2: -1.8326}}
duration: 4.5
"""


@pytest.fixture
def file(tmp_path):
    path = tmp_path / "moving.yaml"
    path.write_text(TEXT)
    return path


def wall(times):
    return 1.2 + 0.02 * np.sin(3.0 * times)


@pytest.mark.slow
def test_a_task_follows_a_wall_that_moves(file):
    """The places of tool and wall by MultibodyPlant and by the sine.

    20 N press it 0.2 mm into the wall, of 1e5 N/m; its steps of 1 ms leave some 10 um.
    """
    chosen = load_scenario(file)
    loop, context = build_scenario(chosen)
    done = roll_scenario(chosen, loop, context)
    record, changes = done.record, loop.changes(done.record)
    names = ["Approach", "Press", "Move", "Release", "Retreat", "done"]
    assert [change.phase for change in changes] == names
    plant = parse("two_link_arm")
    own, frame = plant.CreateDefaultContext(), plant.GetFrameByName("tool")
    places = []
    for state in record["state"]:
        plant.SetPositions(own, state[: plant.num_positions()])
        places.append(frame.CalcPoseInWorld(own).translation()[0])
    gap = wall(record.time) - np.array(places)
    touch, leave, end = changes[1].time, changes[4].time, changes[5].time
    touches = (record.time > touch) & (record.time < leave)
    pressed = record["constraint_force"][touches, 0] / 1e5
    np.testing.assert_allclose(gap[touches], -pressed, atol=1e-5)
    moves = (record.time > changes[2].time + 0.7) & (record.time < changes[3].time)
    np.testing.assert_allclose(record["tracking_error"][moves, 1], 0.0, atol=0.5)
    np.testing.assert_allclose(gap[record.time > end], 0.03, atol=5e-5)
    np.testing.assert_allclose(record["distance"][:, 0], gap, atol=1e-9)
    # The speed of the touch is that towards the wall as it moves.
    approach = (record.time > 0.8) & (record.time < touch)
    np.testing.assert_allclose(
        np.diff(gap[approach]) / np.diff(record.time[approach]), -0.03, atol=5e-3
    )


def test_a_task_does_not_begin_at_rest_on_a_wall_that_moves(file):
    chosen = load_scenario(file, ["task.phases=[!Press {force: 15}]"])
    with pytest.raises(ScenarioError, match="task"):
        build_scenario(chosen)
