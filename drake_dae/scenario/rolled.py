"""The run of a scenario by `rollout`, as the command and studies make it."""

from collections.abc import Callable
from math import ceil

import numpy as np
from pydrake.systems.framework import Context

from drake_dae.arrays import FloatArray
from drake_dae.diagrams.closed_loop import ClosedLoop
from drake_dae.diagrams.state_feedback import encoder_seed
from drake_dae.errors import ModelError
from drake_dae.running.rollout.problems import start_values
from drake_dae.running.rollout.rollout import Rollout, run_loop
from drake_dae.scenario.scenario import Scenario

ROWS = 1000
"""So many rows has the record of a rollout under error control, after the first."""

MOST_ROWS = 1e7
"""Of more rows, each a fixed step, the record takes gigabytes."""


def rollout_times(scenario: Scenario) -> FloatArray:
    """When the record of a scenario's rollout has rows, in s: even ones, or the fixed steps."""
    config, rows = scenario.integrator, ROWS
    if not config.use_error_control:
        steps = scenario.duration / config.max_step_size
        if steps > MOST_ROWS:
            raise ModelError(
                f"max_step_size {config.max_step_size:g} s makes {steps:.2g} rows for "
                f"{scenario.duration:g} s; a rollout keeps at most {MOST_ROWS:g}"
            )
        rows = max(1, ceil(steps - 0.01))
    times: FloatArray = config.start_time + np.linspace(0.0, scenario.duration, rows + 1)
    return times


def roll_scenario(
    scenario: Scenario,
    loop: ClosedLoop,
    context: Context,
    lasting: float | None = None,
    stop: Callable[[], bool] = lambda: False,
) -> Rollout:
    """Runs a scenario by `rollout`.

    Args:
        scenario: The scenario.
        loop: Its closed loop.
        context: The start, by `start_scenario`.
        lasting: How long this loop will be run altogether, in s, which decides on machine code
            alone; None if this run is all, and what is in the cache is welcome.
        stop: Whether to stop where the run is, looked at now and then.

    Raises:
        ModelError: The loop has what no rollout has.
        InconsistentStateError: The start is not on N*.
    """
    start, parameters = start_values(loop, context)
    seeds = (
        {"force_noise": scenario.force_feedback.seed} if scenario.force_feedback.is_measured else {}
    )
    if scenario.encoders is not None:
        seeds["encoder_noise"] = encoder_seed(scenario.encoders.seed)
    (found,) = run_loop(
        loop,
        start,
        parameters,
        rollout_times(scenario),
        config=scenario.integrator,
        seeds=[seeds],
        lasting=lasting,
        stop=stop,
    )
    return found
