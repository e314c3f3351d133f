"""The pace of phases, and `within_limits`: the slower task keeps the robot's limits."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from drake_dae import (
    Approach,
    Dwell,
    Move,
    Search,
    SinusoidReference,
    build_scenario,
    load_scenario,
)
from drake_dae.errors import ScenarioError
from drake_dae.scenario.build import build_completed
from drake_dae.scenario.rolled import roll_scenario
from drake_dae.scenario.start import start_scenario

FAST = """
robot: {file: package://drake_dae_models/two_link_arm.urdf}
constraints:
- {name: wall, frame: tool, surface: {point: [1.2, 0, 0], normal: [-1, 0, 0]}}
outputs:
- {frame: tool, axes: z}
gains: {all: [-25]}
task:
  phases:
  - !Press {force: 10, over: 0.1}
  - !Move
    references: {tool.z: !Sinusoids {offset: 0.3, amplitudes: [0.2], frequencies: [8]}}
    duration: 1.0
    over: 0.2
  - !Dwell {duration: 0.5, over: 0.4}
start: {positions: {joint1: 1.3694, joint2: -1.3694}}
duration: 2.0
"""


@pytest.fixture
def file(tmp_path):
    path = tmp_path / "fast.yaml"
    path.write_text(FAST)
    return path


def shares(path, *settings):
    """The completed scenario, and the largest shares of the effort and velocity limits."""
    completed, loop = build_completed(load_scenario(path, settings))
    context = start_scenario(completed.scenario, loop)
    record = roll_scenario(completed.scenario, loop, context).record
    efforts = np.abs(record["control"]) / loop.plant.model.control_limits
    speeds = np.abs(record["state"][:, 2:]) / loop.plant.model.links.velocity_limits[1]
    return completed, efforts.max(), speeds.max()


@pytest.mark.slow
def test_phases_are_slowed_down_until_the_limits_hold_and_no_further(file):
    """The pace is an estimate times 0.98, so the limit is used to 0.98^2 and the grid of a run."""
    _, efforts, speeds = shares(file)
    assert max(efforts, speeds) > 1.3
    completed, efforts, speeds = shares(file, "task.within_limits={efforts: 0.9}")
    assert efforts < 0.9 * 1.005
    assert speeds < 0.95 * 1.005
    assert max(efforts / 0.9, speeds / 0.95) > 0.93
    task = completed.scenario.task
    assert task.within_limits is None
    assert set(task.pace) <= {"Move", "Dwell"}
    assert completed.scenario.duration > 2.0
    notes = "\n".join(completed.notes)
    assert f"task.pace: Move at {task.pace['Move']:.3g} of its speed, so that limits hold" in notes
    # Slow as it is, the motion is within all limits, and stays as it is.
    same, *_ = shares(file, "task.within_limits={}", "task.pace={Move: 0.1, Dwell: 0.1}")
    assert same.scenario.task.pace == {"Move": 0.1, "Dwell": 0.1}
    assert same.scenario.duration == 2.0


def test_what_needs_too_much_at_rest_is_refused(file):
    text = r"Press needs \d+% of the effort limit of joint\d_motor, however slowly it moves"
    settings = ["task.within_limits={efforts: 0.01}"]
    with pytest.raises(ScenarioError, match=text):
        build_scenario(load_scenario(file, settings))


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        ("task.pace={Slide: 0.5}", "pace: no phase 'Slide'; there are Press, Move, Dwell"),
        ("task.pace={Move: 0}", "pace: Move must be positive, got 0"),
        ("task.within_limits={efforts: 1.5}", "efforts is a fraction of the robot's own limits"),
    ],
)
def test_a_wrong_pace_is_refused(file, setting, message):
    with pytest.raises(ScenarioError, match=message):
        build_scenario(load_scenario(file, [setting]))


def test_a_phase_at_another_pace_passes_through_the_same_values():
    wave = SinusoidReference(0.3, 0.2, 8.0)
    move = Move({"tool.z": wave, "wall.force": 5.0}, 1.0, over=0.2).at_pace(0.5)
    assert (move.duration, move.over, move.references["wall.force"]) == (2.0, 0.4, 5.0)
    times = np.array([0.0, 0.3, 0.7])
    value = move.references["tool.z"].derivatives([2])
    there = [[0.3 + 0.2 * np.sin(4 * t), 0.8 * np.cos(4 * t), -3.2 * np.sin(4 * t)] for t in times]
    assert_allclose([value(t) for t in times], there, rtol=1e-14, atol=1e-14)
    approach = Approach(0.05, over=0.2).at_pace(0.5)
    assert (approach.speed, approach.over, approach.within) == (0.025, 0.4, 60.0)
    search = Search("tool.yz", 0.01, speed=0.02, acceleration=0.4).at_pace(0.5)
    assert (search.speed, search.acceleration) == (0.01, 0.1)
    assert_allclose(
        search.duration, 2 * Search("tool.yz", 0.01, speed=0.02, acceleration=0.4).duration
    )
    assert Dwell(1.0).at_pace(0.5) == Dwell(1.0, over=1.0)
