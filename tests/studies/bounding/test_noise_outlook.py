"""What noise does to a scenario, as `analyze` tells it."""

import json

import numpy as np
import pytest

from drake_dae import load_scenario, rollout, start_values
from drake_dae.cli import main
from drake_dae.scenario.build import build_completed
from drake_dae.scenario.shipped import find_scenario
from drake_dae.scenario.start import start_scenario
from drake_dae.studies.bounding.noise import noise_outlook

ON_CONTACT = (
    "plant=!CompliantContact {stiffness: 1.0e5, radius: 1.0e-5}",
    "sampling={period: 0.001, delay: 0.001}",
    "gains=",
    "duration=1",
)
FORCE = "force_feedback=!MeasuredForce {sample_period: 0.001, noise_deviation: 0.3}"


def outlook(*settings, name="two_link_wall"):
    return noise_outlook(load_scenario(find_scenario(name), settings))


def test_without_noise_nothing_is_predicted_and_for_tasks_it_says_why():
    assert outlook() is None
    assert outlook(name="wall_polish") is None
    told = outlook("encoders={position_noise: 1.0e-5}", name="wall_polish")
    assert "a task changes its law" in str(told)
    assert "several seeds" in told.to_dict()["reason"]


@pytest.mark.slow
def test_rounding_at_rest_is_predicted_within_a_factor_of_two():
    """Beside runs at three heights, at which the joints rest between other steps of the encoders.

    White noise of the same deviation would be a quarter of what the runs have for the height.
    """
    settings = (*ON_CONTACT, FORCE, "encoders={resolution: 1.0e-4}", "start.errors={}")
    rested = outlook(*settings, "references={tool.z: 0.3, wall.force: 20}")
    squares = []
    for height in (0.29, 0.3, 0.31):
        asked = (*settings, f"references={{tool.z: {height}, wall.force: 20}}")
        completed, loop = build_completed(load_scenario(find_scenario("two_link_wall"), asked))
        context = start_scenario(completed.scenario, loop)
        (run,) = rollout(loop, *start_values(loop, context), np.linspace(0.0, 1.0, 1001))
        error = run.record["controlled_output"] - run.record["desired_output"]
        squares.append(np.mean(np.square(error[500:]), axis=0))
    measured = np.sqrt(np.mean(squares, axis=0))
    predicted = np.array([deviation for _, deviation in rested.outputs.values()])
    np.testing.assert_array_less(np.abs(np.log2(predicted / measured)), 1.0)


@pytest.mark.slow
def test_noise_too_large_for_a_first_order_is_told_by_runs():
    """Beside 32 runs with other seeds and zeros.

    The angles come from a start that friction holds, so that a run gives one independent value of
    each deviation: 64 know it to 9 per cent, and 32 to 13. A factor of 1.6 is three times as much.
    """
    differences = "encoders={resolution: 1.0e-4, velocity_bandwidth: 200}"
    told = outlook(*ON_CONTACT, FORCE, differences)
    assert told.off > 0.2
    assert "too large for a prediction to first order" in str(told)
    assert told.to_dict()["shifts"].keys() == told.outputs.keys()
    asked = load_scenario(find_scenario("two_link_wall"), (*ON_CONTACT, FORCE, differences))
    completed, loop = build_completed(asked)
    context, rng, cases = start_scenario(completed.scenario, loop), np.random.default_rng(7), []
    own = loop.encoders.sensor.GetMyMutableContextFromRoot(context)
    for _ in range(32):
        loop.encoders.sensor.set_zeros(own, rng.uniform(-5e-5, 5e-5, 2))
        cases.append(start_values(loop, context))
    starts, parameters = (np.array(each) for each in zip(*cases, strict=True))
    times = np.linspace(0.0, 1.0, 1001)
    runs = rollout(loop, starts, parameters, times, seeds=list(range(100, 132)))
    late = [run.record["controlled_output"][500:] for run in runs]
    measured = np.sqrt(np.mean(np.var(late, axis=0, ddof=1), axis=0))
    predicted = np.array([deviation for _, deviation in told.outputs.values()])
    np.testing.assert_array_less(np.abs(np.log(predicted / measured)), np.log(1.6))
    steady = outlook(*ON_CONTACT, FORCE, "encoders={position_noise: 1.0e-5}")
    assert steady.off < 0.2
    assert not steady.shifts


@pytest.mark.slow
def test_the_command_tells_it_or_why_not(capsys):
    """The step of Drake's hydroelastic contact has no expression."""
    noise = "encoders={position_noise: 1.0e-5}"
    settings = [word for each in (*ON_CONTACT, FORCE, noise) for word in ("--set", each)]
    assert main(["analyze", "two_link_wall", *settings]) == 0
    assert "wall.force" in capsys.readouterr().out.partition("noise of the sensors spreads")[2]
    main(["analyze", "two_link_wall", "--json", *settings])
    found = json.loads(capsys.readouterr().out)["noise"]
    assert found["roughness"] > 0.0
    assert np.all(np.array(list(found["deviations"].values())) > 0.0)
    told = outlook("encoders={position_noise: 1.0e-5}", "gains=", name="wall_hydroelastic")
    assert "no prediction of what noise does" in str(told)
    assert "Drake steps it" in told.to_dict()["reason"]
