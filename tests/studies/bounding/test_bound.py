"""Bounds of errors for ranges of unknown numbers: closed forms, other plants, and failures."""

import numpy as np
import pytest
from runs import some

from drake_dae import bound_errors, load_scenario, random_variations, sweep
from drake_dae.errors import ModelError, ScenarioError
from drake_dae.scenario.files import save_scenario
from drake_dae.simulation.error_bound import USED

TWO_LINK = ("duration=1.0", "compiled=false", "integrator.accuracy=1e-8", "start.errors={}")
AT_REST = (
    *TWO_LINK,
    "references={tool.z: 0.3, wall.force: 20.0}",
    "integrator={integration_scheme: runge_kutta3, use_error_control: false, max_step_size: 0.005}",
)
START = "start.errors.tool.z"

COMPLIANT = (
    *TWO_LINK,
    "gains=",
    "constraints.0.friction=0.0",
    "plant=!CompliantContact {time_step: 0.001, stiffness: 1.0e5, friction: 0.2}",
    "sampling={period: 0.001, delay: 0.001}",
    "force_feedback=!MeasuredForce {sample_period: 0.001, noise_deviation: 0.1}",
    "duration=0.8",
)
SENSED = (
    "gains=",
    "sampling={period: 0.001, delay: 0.001}",
    "force_feedback=!MeasuredForce {sample_period: 0.001}",
)
UNKNOWN = {
    "plant.friction": (0.1, 0.5),
    "plant.stiffness": (3e4, 1e5),
    "plant_parameters.link2.mass": (5.5, 6.5),
    "force_feedback.bias": (-0.2, 0.2),
}


@pytest.mark.slow
@pytest.mark.parametrize("rollout", [True, False])
def test_the_error_of_a_double_pole_is_bounded_as_its_closed_form_says(rollout):
    scenario = load_scenario("two_link_wall", AT_REST)
    ranges = {START: (-0.05, 0.02)}
    found = bound_errors(scenario, ranges, after=0.5, corners=8, rollout=rollout)
    place = [signal.name for signal in found.signals].index("tool.z")
    # Poles at -4: e = e_0 (1 + 4 t) exp(-4 t), which decreases, so that it is largest at 0.5 s. The
    # middle starts at -0.015 m, and an end is 0.035 m from it. Steps of 5 ms of third order leave
    # 1e-6 of an error.
    decay = 3.0 * np.exp(-2.0)
    assert found.middle[place] == pytest.approx(0.015 * decay, rel=1e-5)
    assert found.shares[START][place] == pytest.approx(0.035 * decay, rel=1e-5)
    assert found.worst[place] == pytest.approx(0.05 * decay, rel=1e-5)
    assert found.bound.outputs["tool.z"] == found.worst[place]
    assert not found.failed


@pytest.mark.slow
def test_plants_within_the_ranges_keep_the_bound_and_others_do_not(tmp_path):
    scenario = load_scenario("two_link_wall", COMPLIANT)
    found = bound_errors(scenario, UNKNOWN, after=0.4, corners=16)
    assert set(found.shares) == {*UNKNOWN, "noise, jitter"}
    # Contact of one point in a plane: A_nn is left by 1 - 0.5 / mu_crit, whatever way it slides.
    margin = found.friction_margin
    assert margin.reserve == pytest.approx(1.0 - 0.5 / margin.critical_friction["wall.friction"])
    assert "the Painleve paradox is at wall.friction" in str(found)
    bounded = found.bounded_scenario
    # The law is written down: another stiffness of the plant does not change it.
    assert bounded.gains is not None
    runs = random_variations(UNKNOWN, 12, seed=5)
    runs = [{**run, "force_feedback.seed": 100 + i} for i, run in enumerate(runs)]
    runs.append({"plant_parameters.link2.mass": 12.0})
    study = sweep(bounded, runs, tmp_path / "runs.jsonl", rollout=True, workers=1)
    here = found.study(runs)
    assert here.rollout
    assert here.scenario == bounded
    assert here.table() == study.table()
    used = study.values(USED)
    assert used[:12].max() <= 1.0
    assert used[12] > 1.0
    assert "the error bound held in 12 of 13 runs" in str(study)
    again = tmp_path / "bounded.yaml"
    save_scenario(bounded, again)
    assert load_scenario(again).error_bound == bounded.error_bound


@pytest.mark.slow
@pytest.mark.parametrize(
    ("settings", "friction"),
    some(
        [
            ((), 0.3),  # Of the constraint.
            (("plant_parameters={wall.friction: 0.1}",), 0.1),
            (("plant=!CompliantContact {time_step: 0.001}", *SENSED), 0.3),
            (("plant=!CompliantContact {time_step: 0.001, friction: 0.2}", *SENSED), 0.2),
        ],
        first=1,
    ),
)
def test_the_margin_of_friction_is_that_of_the_plant(settings, friction):
    settings = (*TWO_LINK, "constraints.0.friction=0.3", "duration=0.1", *settings)
    ranges = {"plant_parameters.link2.mass": (5.9, 6.1)}
    margin = bound_errors(load_scenario("two_link_wall", settings), ranges, corners=8)
    found = margin.friction_margin
    assert found.reserve == pytest.approx(1.0 - friction / found.critical_friction["wall.friction"])


def test_a_run_that_fails_leaves_no_bound_and_its_cause_is_named():
    scenario = load_scenario("two_link_wall", AT_REST)
    # The wall is 1.2 m before links of 1 m each: the tool reaches z = 1.6 m.
    ranges = {START: (0.0, 3.0), "plant_parameters.link1.mass": (9.5, 10.5)}
    with pytest.raises(ModelError, match="in the middle of all ranges the run fails"):
        bound_errors(scenario, ranges, corners=8)
    ranges[START] = (0.0, 2.0)  # The tool reaches the middle, and not the end.
    found = bound_errors(scenario, ranges, corners=8)
    assert found.friction_margin is None
    assert len(found.failed) == 1 + 4  # This end alone, and half of the corners.
    with pytest.raises(ModelError, match=f"no bound: 5 runs .* {START} at its high end"):
        _ = found.bound
    assert "PROBLEM" in str(found)
    assert found.to_dict()["bound"] is None


@pytest.mark.parametrize(
    ("ranges", "settings", "error", "text"),
    [
        ({START: [0.1]}, {}, ModelError, "no number varies"),
        ({START: (0.0, 0.1)}, {"after": 1.0}, ModelError, "less than the duration of 1 s, got 1 s"),
        ({START: (0.0, 0.1)}, {"corners": 4}, ModelError, "corners"),
        ({"start.errors.tool.q": (0.0, 0.1)}, {}, ScenarioError, r"no output 'tool\.q'"),
        ({START: (0.1, 0.0)}, {}, ScenarioError, "empty"),
    ],
)
def test_what_makes_no_sense_is_refused(ranges, settings, error, text):
    scenario = load_scenario("two_link_wall", TWO_LINK)
    with pytest.raises(error, match=text):
        bound_errors(scenario, ranges, **settings)
