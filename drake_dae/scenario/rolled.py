"""The run of a scenario by `rollout`, for the command and for studies."""

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
"""The number of rows of a record of a rollout under error control, after the first."""

MOST_ROWS = 1e7
"""The largest number of rows of fixed steps; a larger record takes gigabytes."""


def rollout_times(scenario: Scenario) -> FloatArray:
    """The times of the rows of a rollout's record, in s: equidistant, or the fixed steps."""
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
        lasting: The expected total duration of runs of this loop, in s, for the decision on machine
            code; None for a single run, which uses the cache.
        stop: A function that is called regularly and says whether to stop.

    Raises:
        ModelError: The loop cannot be rolled out.
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
