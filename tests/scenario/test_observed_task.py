"""Tasks with observers, sensors that err, drives with limits, and robots that carry something."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from drake_dae import Record, build_scenario, load_scenario
from drake_dae.cli import main
from drake_dae.errors import ScenarioError

# At rest 20 mm before the wall, whose friction the law takes for zero.
OBSERVED = """
robot: {file: package://drake_dae_models/two_link_arm.urdf}
constraints:
- name: wall
  frame: tool
  surface: {point: [1.2, 0, 0], normal: [-1, 0, 0]}
  friction: 0.0
outputs:
- {frame: tool, axes: z}
law:
  gains: {all: [-25]}
  constraint_damping: {all: [-250]}
sampling: {period: 0.001, delay: 0.001}
sensors:
  force: {sample_period: 0.001, noise_deviation: 0.3}
plant: !CompliantContact {radius: 1.0e-5, friction: 0.3}
estimator: {rate: 60, parameters: [wall.friction]}
task:
  gains: {outputs: {wall.distance: [-8], "*": [-25]}}
  phases:
  - !Approach {speed: 0.1, over: 0.1}
  - !Press {force: 10, over: 0.1}
  - !Move
    references:
      tool.z: !Sinusoids {offset: 0.31, amplitudes: [0.05], frequencies: [2.0]}
      wall.force: 12
    duration: 2.5
    over: 0.5
start: {positions: {joint1: 1.1653, joint2: -1.8326}}
duration: 2.0
"""
BIASED = "sensors.force={sample_period: 0.001, noise_deviation: 0.3, bias: 1.0}"
NO_PICTURES = ["--set", "write={plots: false, animation: false}"]


@pytest.fixture
def file(tmp_path):
    path = tmp_path / "observed.yaml"
    path.write_text(OBSERVED)
    return path


def rolled(file, tmp_path, *settings):
    """The record of a rollout, and what it printed is left to capsys."""
    words = [word for setting in settings for word in ("--set", setting)]
    out = tmp_path / "run"
    assert (
        main(
            ["simulate", str(file), "--rollout", "--force", *NO_PICTURES, *words, "--out", str(out)]
        )
        == 0
    )
    return Record.load(out / "record.npz")


def late(record, after=1.0):
    """The errors of position in m and force in N after the transient."""
    return np.abs(record["tracking_error"][record.time > after, :2])


def touched(record):
    """When the second phase began, and the distance by the model there, in s and m."""
    row = int(np.argmax(record["phase"][:, 1] > 0.5))
    return record.time[row], record["distance"][row, 0]


@pytest.mark.slow
def test_an_observer_makes_a_task_robust_to_friction(file, tmp_path):
    """As of the loop of a law: 0.1 mm and, with noise of 0.3 N, 0.2 N rms; without it far more."""
    found = rolled(file, tmp_path)
    errors = np.sqrt(np.mean(late(found) ** 2, axis=0))
    assert np.all(errors < [1e-4, 0.2])
    assert_allclose(found["friction"][-1], 0.3, rtol=0.1)
    without = np.sqrt(np.mean(late(rolled(file, tmp_path, "estimator=null")) ** 2, axis=0))
    assert np.all(without > 5.0 * errors)


@pytest.mark.slow
def test_noise_is_no_touch(file, tmp_path):
    """It touches at the wall, within what 0.1 m/s goes in the seven samples of the low-pass."""
    _, distance = touched(rolled(file, tmp_path, "duration=0.4"))
    assert abs(distance) < 1e-3


@pytest.mark.slow
def test_a_bias_is_found_before_the_touch(file, tmp_path):
    """1 N of bias touches the air; tared, force and wall are found. 0.15 N: three deviations of the
    mean of 100 samples, and what is left of the transient."""
    time, distance = touched(rolled(file, tmp_path, BIASED, "duration=0.4"))
    assert time < 0.05
    assert distance > 0.019
    found = rolled(file, tmp_path, BIASED, "task.tare_time=0.1")
    assert abs(touched(found)[1]) < 1e-3
    errors = found["tracking_error"][found.time > 1.0, 1]
    assert abs(np.mean(errors)) < 0.15


@pytest.mark.slow
def test_a_contact_that_is_lost_after_the_last_phase(file, tmp_path, capsys):
    """A push pulls with 40 N where the arm rests with 10 N; the law in contact would go on."""
    push = "plant.disturbances=[{frame: tool, force: [-40, 0, 0], start_time: 0.8, end_time: 3}]"
    only = "task.phases=[!Approach {speed: 0.1, over: 0.1}, !Press {force: 10, over: 0.1}]"
    settings = [push, only, "estimator=null", "task.patience=0.02", "duration=1.6"]
    found = rolled(file, tmp_path, *settings, "plant.friction=0")
    assert "held, the contact is lost at rest" in " ".join(capsys.readouterr().out.split("; "))
    assert found["constraint_force"][found.time < 0.8][-1] > 5.0
    assert found["phase"][found.time < 0.8][-1, 2] == 1.0  # It is done.
    assert np.all(found["constraint_force"][found.time > 1.0] == 0.0)
    assert np.max(np.abs(found["state"][-1, 2:])) < 0.05


@pytest.mark.slow
def test_gains_of_a_task_are_advised(file, tmp_path, capsys):
    """With friction of 0.3 in Drake's contact: 0.02 mm and 0.05 N were asked, 3.6 mm and 3.2 N
    were; the peak of the touch stays below what was told."""
    text = OBSERVED.replace(
        "law:\n  gains: {all: [-25]}\n  constraint_damping: {all: [-250]}\n", ""
    )
    text = text.replace('  gains: {outputs: {wall.distance: [-8], "*": [-25]}}\n', "")
    text = text.replace("estimator: {rate: 60, parameters: [wall.friction]}\n", "")
    file.write_text(text.replace(", noise_deviation: 0.3", ""))
    found = rolled(file, tmp_path, "duration=2.5", "task.phases.0.speed=0.03")
    errors = late(found, after=2.0)
    assert np.all(np.sqrt(np.mean(errors**2, axis=0)) < [2e-5, 0.05])
    told = capsys.readouterr().out
    peak = float(told.split("A touch at 0.03 m/s is expected to stay below ")[1].split(" N")[0])
    assert 0.3 * peak < np.max(found["constraint_force"][found.time < 1.0]) < peak


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ("sensors.force=null", "observer"),
        ("task.contact_force=0.1", r"contact_force: .*0\.3.*0\.1"),
        ("task.tare_time=0.01", r"task: tare_time: .*0\.01"),
        ("task.phases.0.behind=0", r"task\.phases\.0: .*behind"),
    ],
)
def test_what_does_not_fit_is_said(file, change, message):
    settings = [change]
    if "force=null" in change:
        settings += [
            "sensors.encoders={position_noise: 1.0e-5}",
            "estimator={rate: 60, state_rate: 200}",
        ]
    with pytest.raises(ScenarioError, match=message):
        build_scenario(load_scenario(file, settings))
