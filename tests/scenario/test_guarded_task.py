"""Guards, signals and chosen successors of tasks in scenarios: told, judged, rolled and swept."""

import json
import re

import numpy as np
import pytest
from arms import numbers
from numpy.testing import assert_allclose
from scenario_texts import task_text

from drake_dae import Record, build_scenario, load_scenario
from drake_dae.cli import main
from drake_dae.diagrams.record import phase_spans
from drake_dae.errors import ScenarioError

SHORT = task_text("""
  - !Approach
    name: feel
    speed: 0.05
    over: 0.1
    until: [{of: force, above: 2.0}]
    guards: [{of: travel, above: 0.05}]
    on_failure: away
  - !Press
    force: 10
    over: 0.1
    on_failure: away
    if_lost: hold
    guards: [{of: force, above: 40}, {of: control, above: 200}]
  - !Release {over: 0.1}
  - !Retreat {name: away, distance: 0.03, over: 0.1}
""")
BARE = [
    "--rollout",
    "--force",
    "--json",
    "--check",
    "--set",
    "write={plots: false, animation: false}",
]


TOLERANT = "task.phases.1.tolerance=3"


@pytest.fixture
def file(tmp_path):
    path = tmp_path / "short.yaml"
    path.write_text(SHORT)
    return path


def told(file, tmp_path, capsys, *settings):
    """The exit code, what JSON has, and the summary."""
    words = [word for setting in settings for word in ("--set", setting)]
    code = main(["simulate", str(file), *BARE, *words, "--out", str(tmp_path / "run")])
    found = json.loads(capsys.readouterr().out)
    return code, found, (tmp_path / "run" / "summary.txt").read_text()


@pytest.mark.slow
def test_a_way_that_was_chosen_for_failure_is_a_good_end(file, tmp_path, capsys):
    """The guard has it at 9 N; pressing to 10 N takes 0.1 s. The record is read again."""
    guards = ["task.phases.1.guards.0={of: force, above: 9}", TOLERANT]
    code, found, text = told(file, tmp_path, capsys, *guards)
    assert (code, found["outcome"]) == (0, "good")
    press, away = found["phases"][1:3]
    assert (press["phase"], away["phase"], away["failed"]) == ("Press", "away", True)
    assert re.match("Press .*9 N", away["reason"])
    story = " ".join(text.split("\n\n")[0].split())
    assert story.startswith("GOOD: ")
    assert away["reason"] in story
    assert f"\n{away['time']:.6g} s: away, " in text
    record = Record.load(tmp_path / "run" / "record.npz")
    assert [one.name for one in phase_spans(record)] == ["feel", "Press", "away", "end"]


def test_a_task_that_is_given_up_fails_the_check(file, tmp_path, capsys):
    guards = ["task.phases.1.guards.0.above=9", "task.phases.1.on_failure=leave", TOLERANT]
    code, found, text = told(file, tmp_path, capsys, *guards)
    assert (code, found["outcome"]) == (2, "bad")
    assert [one["phase"] for one in found["phases"]] == ["feel", "Press", "leave", "held"]
    story = " ".join(text.split("\n\n")[0].split())
    assert re.match("BAD: .*: Press .*9 N", story)
    assert found["phases"][-1]["force"] <= 0.5


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ("task.phases.0.on_failure=park", r"task: .*feel: on_failure: .*'park'"),
        (
            "task.phases.3=!Dwell {name: away, until: [{of: signal, name: go, above: 0.5}]}",
            r"task\.signals\.go",
        ),
        ("task.signals={go: 1}", "'go'"),
        ("plant=!IdealConstraints {}", r"task.*CompliantContact"),
    ],
)
def test_what_does_not_fit_is_refused_by_its_key(file, change, message):
    with pytest.raises(ScenarioError, match=message):
        build_scenario(load_scenario(file, [change]))


@pytest.mark.slow
def test_the_shipped_task_tells_its_story(tmp_path, capsys):
    """15 mm do not reach the wall, and it tries again; the touch stays below what was told."""
    code, found, text = told("wall_guarded", tmp_path, capsys, "duration=4.5")
    assert (code, found["outcome"]) == (0, "good")
    names = [one["phase"] for one in found["phases"]]
    assert names == ["feel", "feel", "Press", "Dwell", "slide", "Release", "Retreat", "done"]
    assert re.match(r"feel .*0\.015 m", found["phases"][1]["reason"])
    # The speed is constant after a ramp, which costs half of its time; samples of 1 ms.
    assert_allclose(found["phases"][1]["time"], 0.015 / 0.03 + 0.1, atol=1.1e-3)
    assert_allclose(found["phases"][2]["time"], 0.028 / 0.03 + 0.1, atol=3e-3)
    record = Record.load(tmp_path / "run" / "record.npz")
    near = record.time < 1.1
    peak = np.max(record["constraint_force"][near, 0])
    q, v = np.split(record["state"][np.argmax(~near)], 2)
    arm = numbers("two_link", q, v)
    jacobian = arm.constraint_jacobian[0]
    mass = 1.0 / (jacobian @ np.linalg.solve(arm.mass, jacobian))
    alone = 0.03 * np.sqrt(1e5 * mass)
    expected = 2.0 + alone + 1e5 * 0.03 * 0.002
    assert 0.5 * alone < peak < expected
    limit = float(text.split("A touch at 0.03 m/s is expected to stay below ")[1].split(" N")[0])
    # The expectation is made where the law has the wall, 8 mm before.
    assert_allclose(limit, expected, rtol=0.02)
