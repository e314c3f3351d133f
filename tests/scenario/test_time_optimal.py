"""The key `time_optimal` of a scenario, and the option of the command."""

import json

import numpy as np
import pytest

from drake_dae import Record, build_scenario, load_scenario, shipped_model
from drake_dae.cli import main
from drake_dae.dae.timing.profile import TimeOptimalReference
from drake_dae.errors import ScenarioError
from drake_dae.pictures.profile import PROFILE, plot_profile
from drake_dae.scenario.build import build_completed
from drake_dae.scenario.feasibility.feasibility import find_feasibility
from drake_dae.scenario.shipped import find_scenario

SCENARIO = find_scenario("two_link_wall")


def loaded(*settings):
    return load_scenario(SCENARIO, ["start.errors={}", *settings])


def profile_of(scenario):
    completed, loop = build_completed(scenario)
    (reference,) = loop.reference.references
    assert isinstance(reference, TimeOptimalReference)
    return completed, reference.profile


def test_the_run_lasts_as_long_as_the_motion_and_is_the_same_when_it_is_run_again():
    completed, profile = profile_of(loaded("time_optimal={efforts: 0.8}"))
    # s starts with the rate 0, and may be slowed.
    assert completed.scenario.duration == profile.duration + 0.5
    assert completed.scenario.time_optimal.until == 10.0
    assert any(note.startswith("time-optimal: ") for note in completed.notes)
    again, same = profile_of(completed.scenario)
    assert again.scenario.duration == completed.scenario.duration
    assert same.duration == profile.duration
    exact = loaded("time_optimal={efforts: 0.8, governor: false}")
    assert profile_of(exact)[0].scenario.duration == profile.duration
    longer = loaded("time_optimal={efforts: 0.8, until: 10}", "duration=12")
    assert profile_of(longer)[0].scenario.duration == 12.0


def test_what_it_needs_is_within_its_share_of_the_limits():
    scenario = loaded("time_optimal={efforts: 0.8}")
    found = find_feasibility(scenario)
    assert not found.problems
    shares = [max(-r.least, r.largest) / r.high for r in found.controls]
    # It is accurate to 5e-4.
    assert max(shares) == pytest.approx(0.8, abs=2e-3)


@pytest.mark.parametrize(
    ("setting", "text"),
    [
        (
            "time_optimal={efforts: 0.2}",
            r"time_optimal: at rest at t = .* joint2_motor is 37.16 N m, ",
        ),
        ("time_optimal={efforts: 2}", "efforts is a share of the robot's own limits"),
        ("time_optimal={forces: {wall: [1, 2]}}", "no signal 'wall'; there are wall.force"),
        ("time_optimal={forces: {wall.force: [16, null]}}", r"wall.force is 15 N, and must be"),
        ("time_optimal={speed: 1}", "time_optimal: has no key 'speed'"),
    ],
)
def test_what_is_refused_is_named_with_its_key(setting, text):
    with pytest.raises(ScenarioError, match=text):
        build_scenario(loaded(setting))


@pytest.mark.parametrize("name", ["two_link_flexible", "wall_polish", "seven_joint_moving_plate"])
def test_robots_without_a_profile_are_refused_in_a_sentence(name):
    scenario = load_scenario(find_scenario(name), ["time_optimal={}"])
    with pytest.raises(ScenarioError, match=r"^time_optimal: ") as error:
        build_scenario(scenario)
    assert len(error.value.problems) == 1


def test_a_drive_without_a_limit_is_told_since_the_control_is_then_not_limited(tmp_path):
    file = tmp_path / "free.urdf"
    text = shipped_model("two_link_arm.urdf").read_text("utf-8")
    file.write_text(text.replace('effort="120"', 'effort="0"'))
    settings = [f"robot.file={file}", "robot.actuators=[joint1, joint2]"]
    completed, loop = build_completed(loaded("time_optimal={}", *settings))
    assert loop.feasible is None
    assert any(note.startswith("joint2 has no effort limit: ") for note in completed.notes)
    assert build_completed(loaded("time_optimal={}"))[1].feasible is not None


@pytest.mark.slow
@pytest.mark.parametrize("rolled", [[], ["--rollout"]])
def test_the_command_leaves_a_picture_of_the_profile(tmp_path, capsys, rolled):
    folder = tmp_path / "run"
    settings = ["--set", "integrator.accuracy=1e-7"]
    settings += ["--set", "write={plots: true, animation: false}"]
    given = [str(SCENARIO), "--time-optimal", "--json", "--out", str(folder), *settings, *rolled]
    assert main(["simulate", *given]) == 0
    found = json.loads(capsys.readouterr().out)
    assert PROFILE in found["files"]
    assert (folder / PROFILE).read_bytes().startswith(b"\x89PNG")
    record = Record.load(folder / "record.npz")
    # The tip goes where the reference of the file goes, from rest to rest.
    desired = record["desired_output"][:, 0]
    # A step is not at the turn itself.
    assert desired.min() == pytest.approx(0.0, abs=2e-3)
    assert desired.max() == pytest.approx(0.6, abs=2e-3)
    assert np.abs(record["reference"][[0, -1], 1]).max() < 1e-9
    # The start error of 5 cm decays as predicted, to the accuracy of the integrator.
    error = record["tracking_error"][:, 0]
    predicted = 0.05 * (1.0 + 4.0 * record.time) * np.exp(-4.0 * record.time)
    np.testing.assert_allclose(error, predicted, atol=2e-5)


def test_the_picture_names_what_limits_the_motion():
    _, profile = profile_of(loaded("time_optimal={efforts: 0.9}"))
    figure = plot_profile(profile)
    (axis,) = figure.axes
    assert axis.get_xlabel().startswith("s")
    assert axis.get_ylabel() == "s' [1/s]"
    (legend,) = figure.legends
    texts = [text.get_text() for text in legend.get_texts()]
    assert texts[0] == "can brake up to here"
    assert texts[1].startswith("largest joint1_motor, ")
    assert len(texts) == 1 + len(profile.shares)
