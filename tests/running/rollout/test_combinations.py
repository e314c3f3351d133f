"""All combinations of parts of a scenario: a rollout is Drake's run, or one sentence refuses."""

import re

import numpy as np
import pytest
from combinations import combined, one_in
from runs import close_records

from drake_dae import build_scenario, load_scenario, rollout, simulate
from drake_dae.diagrams.parts import encoder_seed
from drake_dae.errors import ModelError, ScenarioError, WiringError
from drake_dae.running import start_values


@pytest.mark.slow
@pytest.mark.parametrize("names", one_in(47), ids=", ".join)
def test_a_rollout_is_drakes_run_or_says_why_not(names, tmp_path):
    """To 1e-9 of the largest value, away from what happens at a moment that both find."""
    path = combined(names, tmp_path)
    try:
        loop, context = build_scenario(load_scenario(path))
    except (ScenarioError, WiringError):
        return  # No scenario at all.
    chosen = load_scenario(path)
    refused = ""
    try:
        start, parameters = start_values(loop, context)
    except ModelError as error:
        refused = str(error)
    if refused:
        assert names[3] == "Drake's contact", refused
        assert re.fullmatch(r"[^.]+(\. [^.]+)?", refused), refused
        return
    seeds = {"force_noise": chosen.sensors.force.seed} if chosen.sensors.force else {}
    if chosen.sensors.encoders is not None:
        seeds["encoder_noise"] = encoder_seed(chosen.sensors.encoders.seed)
    simulate(loop.diagram, context, chosen.duration, chosen.integrator, may_diverge=True)
    wanted = loop.record(context)
    arguments = (loop, start, parameters, wanted.time)
    (found,) = rollout(*arguments, config=chosen.integrator, compiled=False, seeds=[seeds])
    assert found.failure is None
    away = np.ones(wanted.time.size, dtype=bool)
    away[-2] = False  # Drake adds its steps up, and so may take one of 1e-13 s more.
    close_records(found.record, wanted, 1e-9, away)
