"""Runs of a scenario by `rollout`, for the command and for studies."""

import time
from collections.abc import Callable
from dataclasses import replace
from math import ceil

import numpy as np
from pydrake.systems.framework import Context

from drake_dae.arrays import FloatArray
from drake_dae.diagrams.closed_loop import ClosedLoop
from drake_dae.diagrams.parts import ENCODER_NOISE, encoder_seed
from drake_dae.diagrams.record import Record, RecordAfter
from drake_dae.errors import ModelError, SimulationError
from drake_dae.running.divergence import DivergenceWatch
from drake_dae.running.rollout import Rollout, diagnosed, run_loop, start_values
from drake_dae.scenario.scenario import Scenario

ROWS = 1000
"""The number of rows of a record of a rollout under error control, after the first."""

PERIOD = 0.2
"""The time by the clock between checks of a running rollout for divergence, in s."""

SAME = 1e-6
"""Two times are equal if they differ by less than this fraction of a step."""

MOST_ROWS = 1e7
"""The largest number of rows of fixed steps; a larger record takes gigabytes."""


def for_rollout(scenario: Scenario) -> tuple[Scenario, str]:
    """A scenario with a plant that rollouts support, and a remark if this changed the plant."""
    plant = scenario.plant.rolled
    if plant is scenario.plant:
        return scenario, ""
    # Drake's contact has no viscous friction.
    viscous = [c.name for c in scenario.constraints if getattr(c, "viscous_friction", None)]
    none = {f"{name}.viscous_friction": 0.0 for name in viscous}
    plant = replace(plant, parameters={**plant.parameters, **none})
    return replace(scenario, plant=plant), (
        f"a !{type(plant).__name__} runs in place of !{type(scenario.plant).__name__}: "
        "the same equations of contact, traced. Drake's solver stops at a relative residual of "
        "1e-6, and joints stop at their limits in Drake's plant alone"
    )


def rollout_times(scenario: Scenario, time_step: float = 0.0) -> FloatArray:
    """The times of the rows of a rollout's record, in s: equidistant, or those of fixed steps."""
    config, duration = scenario.integrator, scenario.duration
    start, end = config.start_time, config.start_time + duration
    fixed = time_step or (0.0 if config.use_error_control else config.max_step_size)
    if fixed and duration / fixed > MOST_ROWS:
        raise ModelError(
            f"steps of {fixed:g} s make {duration / fixed:.2g} rows for {duration:g} s; a rollout "
            f"keeps at most {MOST_ROWS:g}"
        )
    if time_step:
        inside = time_step * np.arange(start // time_step + 1, ceil(end / time_step))
        near = SAME * time_step
        inside = inside[(inside > start + near) & (inside < end - near)]
        return np.concatenate([[start], inside, [end]])
    rows = max(1, ceil(duration / fixed - 0.01)) if fixed else ROWS
    times: FloatArray = start + np.linspace(0.0, duration, rows + 1)
    return times


def roll_scenario(
    scenario: Scenario,
    loop: ClosedLoop,
    context: Context,
    lasting: float | None = None,
    look: Callable[[RecordAfter], bool] = lambda record: False,
) -> Rollout:
    """Runs a scenario by `rollout`; a diverging run ends, as by `simulate`."""
    start, parameters = start_values(loop, context)
    sensors, seeds = scenario.sensors, dict[str, int]()
    if sensors.force is not None:
        seeds["force_noise"] = sensors.force.seed
    if sensors.encoders is not None:
        seeds[ENCODER_NOISE] = encoder_seed(sensors.encoders.seed)
    watch, due = DivergenceWatch(loop.plant, scenario.duration), time.perf_counter() + PERIOD
    seen: float | None = None
    failure: SimulationError | None = None

    def diverges(rows: Record, is_last: bool = False) -> bool:
        nonlocal seen, due, failure
        due = time.perf_counter() + PERIOD
        if not scenario.judgement.may_diverge and failure is None and rows.time.size:
            seen = float(rows.time[-1])
            try:
                watch.look(rows, is_last=is_last)
            except SimulationError as error:
                failure = error
        return failure is not None

    def watched(record: RecordAfter) -> bool:
        return (time.perf_counter() > due and diverges(record(seen))) or look(record)

    (rollout,) = run_loop(
        loop,
        start,
        parameters,
        rollout_times(scenario, loop.plant.time_step),
        config=scenario.integrator,
        seeds=[seeds],
        lasting=lasting,
        look=watched,
    )
    if diverges(rollout.record.after(seen), is_last=rollout.failure is None):
        assert failure is not None
        rollout = rollout.ended(failure)
    return diagnosed(loop, rollout, scenario.integrator)
