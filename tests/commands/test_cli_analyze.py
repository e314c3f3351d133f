"""`drake-dae analyze`: its numbers against simulations and closed forms, and how it ends."""

import json
import re

import numpy as np
import pytest
from runs import TASKS, each_scenario, scenario, some

from drake_dae.cli import main
from drake_dae.scenario import judging as module
from drake_dae.scenario.judging import find_feasibility


def analyze(capsys, *arguments):
    """Exit code, and what is printed."""
    code = main(["analyze", *arguments])
    captured = capsys.readouterr()
    assert captured.err == ""
    return code, captured.out


@pytest.mark.slow
def test_a_torque_limit_that_is_exceeded(capsys):
    """At rest, u = g(q) - J' F with rods of 12 and 6 kg, 1 m long, and 400 N against the wall."""
    code, text = analyze(
        capsys,
        "two_link_wall",
        *("--set", "references.tool.z=0.3"),
        *("--set", "references.wall.force=400"),
    )
    x, z, force, gravity = 1.2, 0.3, 400.0, 9.81
    elbow = -np.arccos((x**2 + z**2 - 2.0) / 2.0)
    second = np.arctan2(z, x) + elbow / 2.0  # Of the isosceles triangle.
    first = second - elbow
    torque1 = gravity * (12.0 * np.cos(first) + 3.0 * np.cos(second)) - force * z
    torque2 = 3.0 * gravity * np.cos(second) - force * np.sin(second)
    assert abs(torque1) < 300.0
    assert torque2 > 120.0
    assert code == 2
    line, most = [line for line in text.splitlines() if line.startswith("PROBLEM")]
    assert f"joint2_motor has {torque2:.4g} N m" in most
    assert f"joint2_motor has {torque2:.4g} N m" in line
    (row,) = [line.split() for line in text.splitlines() if line.startswith("joint1_motor")]
    assert row[1:4] == ["N", "m", f"{torque1:.4g}"]
    assert row[-1] == "300"


@pytest.mark.slow
def test_a_contact_that_would_have_to_pull(capsys):
    """2 + 5 sin 2t is negative from t = (pi + asin 0.4) / 2 on; samples are 10 ms apart."""
    code, text = analyze(capsys, "two_link_wall", "--set", "references.wall.force.offset=2")
    assert code == 2
    line, most = [line for line in text.splitlines() if line.startswith("PROBLEM")]
    assert "wall.force would pull with 3 N" in most
    assert "wall.force would pull with 3 N" in line
    found = re.search(r"^wall\.force +N +-3 .* left at (\S+) s$", text, re.M)
    first = (np.pi + np.arcsin(0.4)) / 2.0
    assert first <= float(found[1]) <= first + 0.01


@pytest.mark.slow
@pytest.mark.parametrize("periods", [10, 1000])
def test_times_follow_a_reference_that_even_times_would_not_see(periods):
    """1001 even times over 1000 periods see sin(2 pi t) as 0, and half as many as a beat."""
    wanted = lambda t: np.array([4.0 + 5.0 * np.sin(2 * np.pi * t), 0.3])  # noqa: E731
    times, is_resolved = module.sample_times(wanted, 0.0, float(periods))
    assert is_resolved
    assert (times[0], times[-1]) == (0.0, periods)
    assert module.SAMPLES <= times.size <= module.MOST_SAMPLES
    assert np.all(np.diff(times) > 0.0)
    values = np.array([wanted(t)[0] for t in times])
    # A chord is off by 1 % of the range, 0.1, at a random place of it: 0.16 at the worst.
    assert values.min() == pytest.approx(-1.0, abs=0.16)
    assert values.max() == pytest.approx(9.0, abs=0.16)
    # Long ones are about turning points of the curvature, or passed by chance.
    assert np.quantile(np.diff(times), 0.9) < 0.15


# How it ends.


def test_a_violated_assumption_is_a_finding(capsys):
    """The wall fixes x, so x is no output; what the constraint alone tells is still known."""
    code, text = analyze(capsys, "two_link_wall", "--set", "outputs.0.axes=x")
    assert code == 2
    assert re.search(r"^wall\.distance +2$", text, re.M)
    assert re.search(r"^\(5\) .* violated$", text, re.M)
    assert "'tool.x'" in text


@pytest.mark.slow
def test_json(capsys):
    code, text = analyze(capsys, "two_link_motors", "--json", "--set", "duration=1")
    assert code == 0
    found = json.loads(text)
    assert found.pop("scenario") == "two_link_motors"
    assert found == find_feasibility(scenario("two_link_motors", "duration=1")).to_dict()
    assert found["analysis"]["index"] == 3
    # Voltages have no limit, which JSON has no number for.
    assert [c["high"] for c in found["controls"]] == [None, None]
    assert [c["high"] for c in found["joint_forces"]] == [300.0, 120.0]
    assert set(found["analysis"]["reference"]["margins"]) == {"A(x)", "B(x)"}


def test_an_error_as_json(capsys):
    assert main(["analyze", "two_link_wall", "--json", "--set", "start.positions.joint2=9"]) == 1
    captured = capsys.readouterr()
    text = "start.positions: joint2 = 9 rad"
    assert json.loads(captured.out)["error"].startswith(text)
    assert captured.err.startswith(f"error: {text}")


@pytest.mark.slow
@pytest.mark.parametrize(
    "name",
    some(
        each_scenario(),
        dear=(
            "wall_flexible_contact",
            "wall_hydroelastic",
            "wall_guarded",
            "wall_point_contact",
            "polish_unknown_part",
        ),
    ),
)
def test_shipped_scenarios_have_no_problems(name):
    told = find_feasibility(scenario(name))
    assert told.problems == ()
    motion = told.analysis.motion
    assert motion.times[-1] == told.duration if motion else name in TASKS
    assert str(told).endswith("no problem found")
