"""Tasks in scenario files: touches, moving walls, sensors that err, a misplaced part."""

import json
import re

import numpy as np
import pytest
from arms import numbers, parse
from numpy.testing import assert_allclose
from runs import some
from scenario_texts import OBSERVED, written

from drake_dae import Record, build_scenario, load_scenario
from drake_dae.cli import main
from drake_dae.diagrams.record import phase_spans
from drake_dae.errors import ScenarioError
from drake_dae.scenario.build import build_completed, roll_scenario
from drake_dae.scenario.judging import find_feasibility
from drake_dae.scenario.start import start_scenario


@pytest.fixture
def file(tmp_path):
    return written("task", tmp_path)


@pytest.fixture
def told(tmp_path, capsys):
    """A function: scenario and settings -> exit code of a rollout, JSON, summary, record."""

    def run(file, *settings):
        every = ["write={plots: false, animation: false}", *settings]
        words = [word for setting in every for word in ("--set", setting)]
        words += ["--rollout", "--force", "--json", "--check", "--out", str(tmp_path / "run")]
        code, folder = main(["simulate", str(file), *words]), tmp_path / "run"
        assert code in (0, 2)
        found = json.loads(capsys.readouterr().out)
        return code, found, (folder / "summary.txt").read_text(), Record.load(folder / "record.npz")

    return run


@pytest.mark.slow
def test_command_runs_a_task_in_drakes_own_contact(file, tmp_path, capsys):
    """Its animation tells the phases."""
    words = ["--set", "plant=!MultibodyPlant {radius: 1.0e-5}", "--set", "duration=0.3"]
    assert main(["simulate", str(file), *words, "--out", str(tmp_path / "run")]) == 0
    told = capsys.readouterr().out
    assert "wall.distance" in told
    assert "\n0 s: Approach, " in told
    assert ": Press, " in told
    page = (tmp_path / "run" / "animation.html").read_text()
    assert '"phases": [[0.0, "Approach"], [0.' in page


def test_analysis_of_a_task_knows_its_robot(file):
    """Not its motion."""
    found = find_feasibility(load_scenario(file))
    assert found.problems == ()
    assert found.analysis.structure is not None


@pytest.mark.slow
@pytest.mark.parametrize("mass", some([None, 5.0]))
def test_a_touch_lasts_up_to_the_computed_speed(file, mass):
    """The speed, without a bounce, is a quarter of that at which the contact opens again, or more.

    A touch that falls between samples is felt with a force of up to k v T, which helps to keep the
    contact; so the computed speed may be below the largest one, and is not above it.
    """
    settings = ["law.constraint_damping=null", "law.gains=null"]
    settings += ["task.gains=null", "task.phases.0.speed=null", "duration=1.5"]
    settings.append("constraints.0.surface.point=[1.183, 0, 0]")  # 3 mm before it
    if mass:
        settings.append(f"robot.payloads=[{{frame: tool, mass: {mass}}}]")
    computed = build_completed(load_scenario(file, settings))[0].scenario.task.phases[0].speed
    assert 1e-3 < computed < 0.049  # Less than the default.

    def least_force(speed):
        completed, loop = build_completed(
            load_scenario(file, [*settings, f"task.phases.0.speed={speed}", "task.retries=0"])
        )
        context = start_scenario(completed.scenario, loop)
        rolled = roll_scenario(completed.scenario, loop, context)
        changes = loop.changes(rolled.record)
        touched = changes[1].time
        near = (rolled.record.time >= touched) & (rolled.record.time < touched + 0.4)
        return rolled.record["constraint_force"][near, 0].min()

    assert least_force(computed) > 0.0
    assert least_force(4.0 * computed) == 0.0


MOVING = """
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
def moving(file):
    file.write_text(MOVING)
    return file


@pytest.mark.slow
def test_a_task_follows_a_wall_that_moves(moving):
    """The places of tool and wall by MultibodyPlant and by the sine.

    20 N press it 0.2 mm into the wall, of 1e5 N/m; its steps of 1 ms leave some 10 um.
    """
    chosen = load_scenario(moving)
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
    gap = 1.2 + 0.02 * np.sin(3.0 * record.time) - np.array(places)
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


def test_a_task_does_not_begin_at_rest_on_a_wall_that_moves(moving):
    chosen = load_scenario(moving, ["task.phases=[!Press {force: 15}]"])
    with pytest.raises(ScenarioError, match="task"):
        build_scenario(chosen)


@pytest.mark.slow
def test_a_task_that_is_given_up_fails_the_check(told):
    code, found, text, record = told("wall_guarded", "task.phases.1.guards.0.above=9", "duration=3")
    assert (code, found["outcome"]) == (2, "bad")
    names = ["feel", "feel", "Press", "leave", "held"]
    assert [one["phase"] for one in found["phases"]] == names
    story = " ".join(text.split("\n\n")[0].split())
    assert re.match("BAD: .*: Press .*9 N", story)
    assert found["phases"][-1]["force"] <= 0.5
    # The record is read again; one span has both times that it felt for the wall.
    assert [one.name for one in phase_spans(record)] == ["feel", "Press", "leave", "end"]


@pytest.mark.slow
def test_the_shipped_task_tells_its_story(told):
    """15 mm do not reach the wall, and it tries again; the touch is as hard as its momentum."""
    code, found, _, record = told("wall_guarded", "duration=4.5")
    assert (code, found["outcome"]) == (0, "good")
    names = [one["phase"] for one in found["phases"]]
    assert names == ["feel", "feel", "Press", "Dwell", "slide", "Release", "Retreat", "done"]
    assert re.match(r"feel .*0\.015 m", found["phases"][1]["reason"])
    # The speed is constant after a ramp, which costs half of its time; samples of 1 ms.
    assert_allclose(found["phases"][1]["time"], 0.015 / 0.03 + 0.1, atol=1.1e-3)
    assert_allclose(found["phases"][2]["time"], 0.028 / 0.03 + 0.1, atol=3e-3)
    near = record.time < 1.1
    peak = np.max(record["constraint_force"][near, 0])
    q, v = np.split(record["state"][np.argmax(~near)], 2)
    arm = numbers("two_link", q, v)
    jacobian = arm.constraint_jacobian[0]
    mass = 1.0 / (jacobian @ np.linalg.solve(arm.mass, jacobian))
    alone = 0.03 * np.sqrt(1e5 * mass)
    # The felt force, the mass at its speed, and what it goes until the law reacts.
    assert 0.5 * alone < peak < 2.0 + alone + 1e5 * 0.03 * 0.002


BIASED = "sensors.force={sample_period: 0.001, noise_deviation: 0.3, bias: 1.0}"


@pytest.fixture
def observed(tmp_path):
    return written("observed_task", tmp_path)


def late(record, after=1.0):
    """The errors of position in m and force in N after the transient."""
    return np.abs(record["tracking_error"][record.time > after, :2])


def touched(record):
    """When the second phase began, and the distance by the model there, in s and m."""
    row = int(np.argmax(record["phase"][:, 1] > 0.5))
    return record.time[row], record["distance"][row, 0]


@pytest.mark.slow
def test_an_observer_makes_a_task_robust_to_friction(observed, told):
    """As of the loop of a law: 0.1 mm and, with noise of 0.3 N, 0.2 N rms; without it far more.

    Noise is no touch: it is at the wall, within what 0.1 m/s goes in seven samples of the low-pass.
    """
    found = told(observed)[-1]
    assert abs(touched(found)[1]) < 1e-3
    errors = np.sqrt(np.mean(late(found) ** 2, axis=0))
    assert np.all(errors < [1e-4, 0.2])
    assert_allclose(found["friction"][-1], 0.3, rtol=0.1)
    without = np.sqrt(np.mean(late(told(observed, "estimator=null")[-1]) ** 2, axis=0))
    assert np.all(without > 5.0 * errors)


@pytest.mark.slow
def test_a_bias_is_found_before_the_touch(observed, told):
    """1 N of bias touches the air; tared, force and wall are found. 0.15 N: three deviations of the
    mean of 100 samples, and what is left of the transient."""
    time, distance = touched(told(observed, BIASED, "duration=0.4")[-1])
    assert time < 0.05
    assert distance > 0.019
    found = told(observed, BIASED, "task.tare_time=0.1")[-1]
    assert abs(touched(found)[1]) < 1e-3
    errors = found["tracking_error"][found.time > 1.0, 1]
    assert abs(np.mean(errors)) < 0.15


@pytest.mark.slow
def test_gains_of_a_task_are_advised(observed, told):
    """With friction of 0.3 in Drake's contact: 0.02 mm and 0.05 N were asked, 3.6 mm and 3.2 N
    were."""
    text = OBSERVED.replace(
        "law:\n  gains: {all: [-25]}\n  constraint_damping: {all: [-250]}\n", ""
    )
    text = text.replace('  gains: {outputs: {wall.distance: [-8], "*": [-25]}}\n', "")
    text = text.replace("estimator: {rate: 60, parameters: [wall.friction]}\n", "")
    observed.write_text(text.replace(", noise_deviation: 0.3", ""))
    found = told(observed, "duration=2.5", "task.phases.0.speed=0.03")[-1]
    errors = late(found, after=2.0)
    assert np.all(np.sqrt(np.mean(errors**2, axis=0)) < [2e-5, 0.05])
