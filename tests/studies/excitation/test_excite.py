"""Motions that determine parameters best: against closed forms, random choices, measured runs."""

import json
import os
import signal
from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2

from drake_dae import build_scenario, excite, identify, load_scenario
from drake_dae.cli import main
from drake_dae.errors import ModelError, ScenarioError
from drake_dae.scenario.files import varied_data
from drake_dae.scenario.rolled import for_rollout, roll_scenario
from drake_dae.scenario.scenario import read_scenario, scenario_data
from drake_dae.scenario.shipped import find_scenario
from drake_dae.simulation.records.record import Recorded
from drake_dae.studies.excitation.promised import ScenarioRuns

MASS, SIGMA, FASTEST, DURATION, STEP = 2.5, 1e-4, 1.0, 2.0, 0.01

SLIDER = f"""<robot name="slider">
  <link name="world"/>
  <link name="mass">
    <inertial><mass value="{MASS}"/>
      <inertia ixx="0.01" ixy="0" ixz="0" iyy="0.01" iyz="0" izz="0.01"/></inertial>
  </link>
  <joint name="guide" type="prismatic">
    <parent link="world"/><child link="mass"/><axis xyz="1 0 0"/>
    <limit lower="-1" upper="1" velocity="{FASTEST}" effort="100"/>
  </joint>
  <transmission name="transmission">
    <type>transmission_interface/SimpleTransmission</type>
    <joint name="guide"><hardwareInterface>PositionJointInterface</hardwareInterface></joint>
    <actuator name="motor"/>
  </transmission>
</robot>
"""

SCENARIO = f"""
robot: {{file: slider.urdf}}
outputs:
- !JointPositions
  joints: [guide]
gains: !Poles
  all: [-4.0]
references:
  guide: !Sinusoids
    offset: 0.0
    amplitudes: [0.1]
    frequencies: [2.0]
    phases: [1.5707963267948966]  # from rest
duration: {DURATION}
integrator: {{integration_scheme: runge_kutta3, use_error_control: false, max_step_size: {STEP}}}
"""

AMPLITUDE, FREQUENCY = "references.guide.amplitudes.0", "references.guide.frequencies.0"
RANGES = {AMPLITUDE: (0.05, 0.6), FREQUENCY: (1.0, 6.0)}
NOISE = {"position": SIGMA}


@pytest.fixture
def slider(tmp_path):
    """The file of a scenario: a mass on a guide."""
    (tmp_path / "slider.urdf").write_text(SLIDER)
    path = tmp_path / "slider.yaml"
    path.write_text(SCENARIO)
    return path


def closed_form(amplitude, frequency):
    """The deviation of the mass from q = a cos(w t), its start and its speed there unknown.

    With m q'' = u and a known u it is dq/dm = -(q - q0 - v0 t)/m, less what q0 and v0 explain.
    """
    t = np.linspace(0.0, DURATION, round(DURATION / STEP) + 1)
    lines, q = np.column_stack([np.ones_like(t), t]), amplitude * np.cos(frequency * t)
    rest = q - lines @ np.linalg.lstsq(lines, q, rcond=None)[0]
    return MASS * SIGMA / np.linalg.norm(rest)


def kept(amplitude, frequency):
    t = np.linspace(0.0, DURATION, round(DURATION / STEP) + 1)
    return np.abs(amplitude * frequency * np.sin(frequency * t)).max() <= FASTEST


def within(values, truth, deviation):
    """Whether values are as far from the truth as their deviation says, but once in a thousand."""
    total = np.square((values - truth) / deviation).sum(axis=0)
    low, high = chi2.ppf([5e-4, 1.0 - 5e-4], len(values))
    return (total > low).all() and (total < high).all()


@pytest.mark.slow
def test_promised_deviations_are_those_of_the_closed_form(slider):
    found = excite(load_scenario(slider), RANGES, ["mass.mass"], noise=NOISE, runs=40)
    # Controls between the rows are a spline.
    assert found.before.deviations[0] == pytest.approx(closed_form(0.1, 2.0), rel=1e-4)
    after = closed_form(*found.choice.values())
    assert found.after.deviations[0] == pytest.approx(after, rel=1e-4)
    assert found.after.halves[0] == pytest.approx(1.96 * after, rel=1e-4)
    assert found.after.d_size == pytest.approx(after / MASS, rel=1e-4)
    assert found.after.a_size == pytest.approx(after / MASS, rel=1e-4)
    # Better than random choices, and about the best that the speed allows.
    draws = np.random.default_rng(0).random((200, 2)) * [0.55, 5.0] + [0.05, 1.0]
    assert after < min(closed_form(*each) for each in draws if kept(*each))
    grid = [(a, w) for a in np.linspace(0.05, 0.6, 23) for w in np.linspace(1.0, 6.0, 21)]
    assert after < 1.02 * min(closed_form(*each) for each in grid if kept(*each))
    assert kept(*found.choice.values())
    assert found.refused["exceeds a limit"] > 0
    assert "+- 0.0" in found.text()


def test_the_same_seed_makes_the_same_choice(slider):
    made, noise = load_scenario(slider), {"position": SIGMA}
    choices = [
        excite(made, RANGES, ["mass.mass"], noise=noise, runs=5, seed=seed).choice
        for seed in (1, 1, 2)
    ]
    assert choices[0] == choices[1] != choices[2]


@pytest.mark.slow
def test_measured_values_spread_as_promised(slider):
    found = excite(load_scenario(slider), RANGES, ["mass.mass"], noise=NOISE, runs=10)
    loop, context = build_scenario(found.scenario)
    record = roll_scenario(found.scenario, loop, context).record
    state, results = record.signals["state"], []
    for seed in range(25):
        noise = SIGMA * np.random.default_rng(seed).normal(size=state.values.shape)
        signals = {**record.signals, "state": Recorded(state.values + noise, state.signals)}
        results.append(identify(loop, context, [replace(record, signals=signals)], ["mass.mass"]))
    values = np.array([each["mass.mass"] for each in results])
    (promised,) = found.after.deviations
    assert within(values, MASS, promised)
    # Each knows its noise from 201 rows, to 5 %.
    deviations = np.array([each.deviations[0] for each in results])
    np.testing.assert_allclose(deviations, promised, rtol=0.2)
    assert deviations.mean() == pytest.approx(promised, rel=0.04)


@pytest.mark.parametrize(
    ("changes", "kind"),
    [
        ({}, None),
        ({AMPLITUDE: 0.6, FREQUENCY: 6.0}, "exceeds a limit"),
        ({"start.errors.guide": 5.0}, "does not start"),
    ],
)
def test_runs_beyond_limits_are_refused(slider, changes, kind):
    trial = ScenarioRuns(load_scenario(slider), ["mass.mass"], NOISE).run(changes)
    assert list(trial.problems) == ([] if kind is None else [kind])
    assert (trial.promised is None) == (kind is not None)


WALL = ("duration=0.5", "integrator={integration_scheme: runge_kutta3, max_step_size: 0.002}")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("settings", "kind"),
    [
        ((), "exceeds a limit"),
        (
            (
                "sampling={period: 0.002, delay: 0.002}",
                "plant=!CompliantContact {time_step: 0.002}",
            ),
            "opens a contact",
        ),
    ],
)
def test_a_contact_that_would_pull_or_opens_is_refused(settings, kind):
    made = load_scenario(find_scenario("two_link_wall"), [*WALL, *settings])
    noise = {"position": 1e-4, "force": 0.1}
    run = ScenarioRuns(made, ["link2.mass"], noise).run
    assert not run({}).problems
    large = {
        "references.wall.force.amplitudes.0": 60.0,
        "references.wall.force.frequencies.0": 15.0,
    }
    assert kind in run(large).problems


def test_ctrl_c_gives_the_best_so_far(slider, monkeypatch):
    made, run = [], ScenarioRuns.run

    def interrupted(self, changes, judge_all=False):
        made.append(changes)
        if len(made) == 4:
            os.kill(os.getpid(), signal.SIGINT)
        return run(self, changes, judge_all)

    monkeypatch.setattr(ScenarioRuns, "run", interrupted)
    found = excite(load_scenario(slider), RANGES, ["mass.mass"], noise=NOISE, runs=40)
    assert (found.runs, found.interrupted) == (3, signal.SIGINT)
    assert found.after.d_size <= found.before.d_size
    assert "interrupted" in found.text()


WRONG = {
    "no range": ({}, NOISE, ModelError, "ranges must have at least one key"),
    "empty range": ({AMPLITUDE: (0.3, 0.1)}, NOISE, ModelError, "a lower and a larger number"),
    "no key": ({"references.guide.height": (0, 1)}, NOISE, ScenarioError, "has no key 'height'"),
    "no noise": (RANGES, {}, ModelError, "states no noise of 'state.guide'"),
    "noise of nothing": (RANGES, {"speed": 1.0}, ModelError, "'speed'.*position, force"),
    "no positive noise": (RANGES, {"position": 0.0}, ModelError, "must be positive"),
}


@pytest.mark.parametrize("kind", WRONG)
def test_what_cannot_be_excited_is_refused(slider, kind):
    ranges, noise, error, message = WRONG[kind]
    with pytest.raises(error, match=message):
        excite(load_scenario(slider), ranges, ["mass.mass"], noise=noise, runs=2)


def test_no_run_within_limits_is_an_error(slider):
    fast = load_scenario(slider, [f"{AMPLITUDE}=0.6", f"{FREQUENCY}=6.0"])
    ranges = {AMPLITUDE: (0.5, 0.6), FREQUENCY: (5.0, 6.0)}
    with pytest.raises(ModelError, match=r"no run of 3 keeps all limits.*exceeds a limit"):
        excite(fast, ranges, ["mass.mass"], noise=NOISE, runs=3)


@pytest.mark.slow
def test_rows_between_samples_are_refused():
    """Rows of a run under error control are 2 ms apart, where the sensor samples each 1 ms."""
    settings = [
        "duration=2",
        "sampling={period: 0.001}",
        "force_feedback=!MeasuredForce {sample_period: 0.001, noise_deviation: 0.3}",
    ]
    arm = load_scenario("two_link_wall", settings)
    ranges = {"references.wall.force.offset": (10.0, 20.0)}
    with pytest.raises(ModelError, match=r"no row at which 'measured_force' was sampled.*0.002 s"):
        excite(arm, ranges, ["link2.mass"], noise={"position": 1e-5}, runs=2)


def test_the_command(slider, tmp_path, capsys):
    out = tmp_path / "best.yaml"
    asked = ["excite", str(slider), "--free", "mass.mass", "--runs", "3", "--criterion", "A"]
    asked += ["--vary", f"{AMPLITUDE}=0.2..0.4", "--noise", "position=1e-4"]
    assert main([*asked, "--json", "--out", str(out)]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["after"]["A"] < found["before"]["A"]
    (written,) = load_scenario(out).references["guide"].amplitudes
    assert written == found["choice"][AMPLITUDE]
    assert main([*asked, "--noise", "force=much"]) == 1
    assert "--noise takes" in capsys.readouterr().err
    assert main([*asked, "--vary", f"{FREQUENCY}=[1, 2]"]) == 1
    assert "expected LOW..HIGH" in capsys.readouterr().err
    assert main(asked) == 0
    assert "95 % after" in capsys.readouterr().out


@pytest.mark.thorough
@pytest.mark.parametrize("criterion", ["D", "A"])
def test_the_best_is_better_than_random_choices(criterion):
    made = load_scenario(find_scenario("two_link_wall"), ["duration=2"])
    keys = {"tool.z.amplitudes.0": (0.05, 0.4), "tool.z.frequencies.0": (0.5, 5.0)}
    keys |= {"wall.force.amplitudes.0": (0.0, 18.0), "wall.force.frequencies.0": (0.5, 12.0)}
    ranges = {f"references.{key}": ends for key, ends in keys.items()}
    noise, free = {"position": 1e-4, "force": 0.1}, ["link1.mass", "link2.mass"]
    found = excite(made, ranges, free, noise=noise, criterion=criterion, runs=80)
    trials, random = ScenarioRuns(made, free, noise), np.random.default_rng(1)
    for _ in range(200):
        values = {key: random.uniform(*ends) for key, ends in ranges.items()}
        trial = trials.run(values)
        if not trial.problems:
            assert found.after.size(criterion) < trial.promised.size(criterion)


@pytest.mark.thorough
def test_a_robot_with_sensors_measures_what_is_promised():
    """Seven joints in compliant contact, its sensors with other seeds in each run."""
    made = load_scenario(
        find_scenario("wall_point_contact"),
        [
            "duration=1",
            "encoders={position_noise: 1e-5, seed: 1}",
            "force_feedback=!MeasuredForce {sample_period: 0.001, noise_deviation: 0.3}",
        ],
    )
    free = ["tool.mass", "link3.mass", "plant.friction"]
    ranges = {"references.wall.force.amplitudes.0": (5.0, 15.0)}
    ranges["references.tool.z.frequencies.0"] = (1.0, 3.0)
    found = excite(made, ranges, free, runs=6)
    results, base = [], scenario_data(for_rollout(found.scenario)[0])
    for seed in range(12):
        changes = {"encoders.seed": seed, "force_feedback.seed": 100 + seed}
        again = read_scenario(varied_data(base, changes))
        loop, context = build_scenario(again)
        record = roll_scenario(again, loop, context).record
        results.append(identify(loop, context, [record], free))
    values = np.array([each.values for each in results])
    assert within(values, found.after.values, found.after.deviations)
    deviations = np.array([each.deviations for each in results])
    np.testing.assert_allclose(deviations, np.tile(found.after.deviations, (12, 1)), rtol=0.15)
