"""Gains of a contact from the loop's own block: margins, and what forbids them."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from runs import scenario

from drake_dae import Sampling, build_scenario, contact_gains, rollout
from drake_dae.diagrams import LoopSettings
from drake_dae.errors import GainError, ModelError
from drake_dae.references import references_by_name
from drake_dae.running import start_values
from drake_dae.scenario.build import build_completed
from drake_dae.scenario.model import scenario_model, scenario_structure
from drake_dae.systems import Encoders, ForceSensor, PointMaterial

PLANT = "plant=!CompliantContact {time_step: 1.0e-3, stiffness: 1.0e5, friction: 0.3}"
LATE = "sampling={period: 1.0e-3, delay: 1.0e-3}"
SWINGS = "!Sinusoids {offset: 0.3, amplitudes: [0.1], frequencies: [2]}"
MOVES = f"references={{tool.z: {SWINGS}, wall.force: 20}}"


@cache
def two_link():
    found = scenario(
        "two_link_wall", PLANT, LATE, MOVES, "law.gains=", "constraints.0.friction=0.0"
    )
    found.start.errors.clear()
    model = scenario_model(found)
    return found, model, scenario_structure(model)


def gains(encoders=None, **more):
    found, model, structure = two_link()
    names = [signal.name for signal in model.dae.output_signals]
    settings = LoopSettings(
        sensor=ForceSensor(1, sample_period=1e-3),
        encoders=encoders,
        sampling=Sampling(1e-3, 1e-3),
    )
    return contact_gains(
        model,
        PointMaterial(1e-3, 1e5),
        references_by_name(found.references, names, (2, 2)),
        settings,
        times=(0.0, 3.0),
        structure=structure,
        identify=["wall.friction"],
        integral=names,
        **more,
    )


@pytest.mark.slow
def test_gains_keep_their_margins_and_get_slower_with_noise():
    quiet = gains()
    assert quiet.margin >= 1.0
    noisy = gains(encoders=Encoders(position_noise=1e-4), roughness=0.9)
    assert 0.0 < noisy.roughness <= 0.9
    assert noisy.position_rate < quiet.position_rate
    assert noisy.position_error > quiet.position_error


@pytest.mark.slow
@pytest.mark.parametrize("stiffness", [0.5, 2.0])
def test_a_loop_with_these_gains_bears_another_stiffness_and_friction(stiffness):
    """By rollouts, which know nothing of linear models: the errors in the second half are small."""
    chosen = build_completed(two_link()[0])[0].scenario
    plant = replace(chosen.plant, stiffness=1e5 * stiffness, friction=0.8)
    loop, context = build_scenario(replace(chosen, plant=plant))
    times = 1e-3 * np.arange(3001)
    (run,) = rollout(loop, *start_values(loop, context), times, compiled=False)
    assert run.failure is None
    error = run.record["tracking_error"][1500:]
    assert np.sqrt(np.mean(error[:, 0] ** 2)) < 1e-4
    assert np.sqrt(np.mean(error[:, 1] ** 2)) < 1.0


@pytest.mark.slow
def test_what_forbids_gains_is_named():
    with pytest.raises(GainError, match="1e-06"):
        gains(encoders=Encoders(position_noise=1e-3), roughness=1e-6)
    with pytest.raises(ModelError, match="roughness"):
        gains(roughness=0.0)
