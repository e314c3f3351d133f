"""What noise does to a scenario, as `analyze` tells it."""

import json

import numpy as np
import pytest

from drake_dae import load_scenario
from drake_dae.cli import main
from drake_dae.scenario.shipped import find_scenario
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
def test_a_resolution_counts_as_its_noise():
    """h / sqrt(12) = 1e-5 rad."""
    rounded = outlook(*ON_CONTACT, FORCE, f"encoders={{resolution: {1e-5 * 12.0**0.5!r}}}")
    noisy = outlook(*ON_CONTACT, FORCE, "encoders={position_noise: 1.0e-5}")
    assert set(noisy.outputs) == {"tool.z", "wall.force"}
    for name, (unit, deviation) in noisy.outputs.items():
        assert rounded.outputs[name] == (unit, pytest.approx(deviation, rel=1e-6))


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
