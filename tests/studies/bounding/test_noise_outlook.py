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


def test_without_noise_and_for_tasks_nothing_is_predicted():
    assert outlook() is None
    assert outlook("encoders={position_noise: 1.0e-5}", name="wall_polish") is None


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
