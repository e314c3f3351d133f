"""The key `time_optimal` of a scenario, and the option of the command."""

import json
import re

import numpy as np
import pytest
from runs import some

from drake_dae import Record, build_scenario, load_scenario, shipped_model, simulate
from drake_dae.cli import main
from drake_dae.dae.timing.profile import TimeOptimalReference
from drake_dae.errors import ScenarioError
from drake_dae.pictures.profile import PROFILE, plot_profile
from drake_dae.scenario.build import build_completed
from drake_dae.scenario.feasibility.feasibility import find_feasibility
from drake_dae.scenario.rolled import roll_scenario
from drake_dae.scenario.shipped import FOLDER, find_scenario
from drake_dae.scenario.start import start_scenario
from drake_dae.simulation.remarks import departure_remarks

SCENARIO = find_scenario("two_link_wall")


def loaded(*settings):
    return load_scenario(SCENARIO, ["start.errors={}", *settings])


def profile_of(scenario):
    completed, loop = build_completed(scenario)
    (reference,) = loop.reference.references
    assert isinstance(reference, TimeOptimalReference)
    return completed, reference.profile


@pytest.mark.slow
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


@pytest.mark.slow
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
@pytest.mark.parametrize("rolled", some([[], ["--rollout"]], first=1))
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


def observed(tmp_path, *settings):
    """The arm with slow joints, 8 cm off its path, beside a contact that gives way and friction."""
    text = (FOLDER / "models" / "two_link_arm.urdf").read_text()
    slow = tmp_path / "slow_arm.urdf"
    slow.write_text(re.sub(r'velocity="[^"]*"', 'velocity="1.0"', text))
    limits = "limits: {speed: 2.0, acceleration: 8.0, jerk: 200.0}"
    path = f"!Polyline {{points: [[0.46], [0.1], [0.4]], corner: 0.02, {limits}}}"
    changed = [
        f"robot.file={slow}",
        "constraints.0.friction=0.0",
        "plant=!CompliantContact {stiffness: 1.0e5, friction: 0.3, radius: 1.0e-3}",
        "sampling={period: 0.001, delay: 0.001}",
        f"references={{tool.z: {path}, wall.force: 30.0}}",
        "start={errors: {tool.z: 0.08}}",
        "duration=1.5",
        "compiled=false",
    ]
    # Without gains they are recommended, with an observer.
    plain = tmp_path / "plain.yaml"
    plain.write_text(re.sub(r"gains:.*?\n(?=\S)", "", SCENARIO.read_text(), flags=re.DOTALL))
    return build_completed(load_scenario(plain, [*changed, *settings]))


ENCODERS = "encoders={position_noise: 1.0e-5}"


@pytest.mark.slow
@pytest.mark.parametrize("sensing", [(), (ENCODERS,)], ids=["states", "encoders"])
def test_beside_an_observer_the_limits_hold_on_a_contact_that_gives_way(sensing, tmp_path):
    """By its estimates, one sample late, of the state, too, where there are only encoders.

    Speeds are 1.1 % beyond their limit at most: where a drive is at its limit they give way first.
    Without governor the same start needs 1.4 of the efforts and 1.6 of the speeds, and with
    encoders 3.3 and 2.2.
    """
    shares = {}
    for governor in ("true", "false"):
        setting = f"time_optimal={{joint_speeds: 0.9, governor: {governor}}}"
        completed, loop = observed(tmp_path, setting, *sensing)
        found = roll_scenario(completed.scenario, loop, start_scenario(completed.scenario, loop))
        assert found.failure is None
        model, record = loop.plant.robot("a test"), found.record
        efforts = np.abs(record["control"]) / model.control_limits
        speeds = np.abs(record["state"][:, 2:]) / model.links.velocity_limits[1]
        shares[governor] = efforts.max(), speeds.max()
        if governor == "true":
            (remark,) = departure_remarks(record, loop.feasible)
            assert re.search(r"within the limits \(.*joint1_motor.*\): .*tool.z by up to", remark)
            assert record["path"][-1, 1] == pytest.approx(1.0, abs=1e-4)
            assert np.abs(record["tracking_error"][-200:, 0]).max() < 2e-3
    assert max(shares["true"]) < 1.02
    assert min(shares["false"]) > 1.3


@pytest.mark.slow
@pytest.mark.parametrize(
    "sensing", [(), ("encoders={resolution: 1.0e-5}",)], ids=["exact", "steps"]
)
def test_a_governed_rollout_beside_an_observer_is_that_of_drakes_simulator(sensing, tmp_path):
    """Of one sequence of samples and steps, so that only round-off differs."""
    settings = "time_optimal={joint_speeds: 0.9}", "duration=0.2", "time_optimal.until=1.5"
    completed, loop = observed(tmp_path, *settings, *sensing)
    scenario = completed.scenario
    rolled = roll_scenario(scenario, loop, start_scenario(scenario, loop)).record
    context = start_scenario(scenario, loop)
    simulate(loop.diagram, context, scenario.duration, scenario.integrator)
    record = loop.record(context)
    assert record["departure"].any()
    assert record["compensated"].any()
    for name in ("state", "control", "path", "reference", "departure", "compensated"):
        at = [np.argmin(np.abs(record.time - time)) for time in rolled.time[:-1]]
        scale = max(1.0, np.abs(record[name]).max())
        np.testing.assert_allclose(
            rolled[name][:-1], record[name][at], rtol=0.0, atol=1e-9 * scale, err_msg=name
        )
