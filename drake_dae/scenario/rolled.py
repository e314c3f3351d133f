"""Runs of a scenario by `rollout`, for the command and for studies."""

import time
from collections.abc import Callable, Iterable
from dataclasses import replace
from math import ceil

import numpy as np
from pydrake.systems.framework import Context

from drake_dae.arrays import FloatArray
from drake_dae.diagrams.closed_loop import ClosedLoop
from drake_dae.diagrams.state_feedback import (
    ENCODER_NOISE,
    encoder_seed,
)
from drake_dae.errors import ModelError, SimulationError
from drake_dae.running.rollout.problems import start_values
from drake_dae.running.rollout.rollout import Rollout, diagnosed, run_loop
from drake_dae.scenario.scenario import Scenario
from drake_dae.simulation.divergence import DivergenceWatch
from drake_dae.simulation.records.record import Record, RecordAfter

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
    name, before = type(plant).__name__, type(scenario.plant).__name__
    viscous = [c for c in scenario.constraints if getattr(c, "viscous_friction", None)]
    parameters = {**plant.parameters, **_without_viscous(c.name for c in viscous)}
    plant = replace(plant, parameters=parameters)
    return replace(scenario, plant=plant), (
        f"the rollout runs !{name} in place of !{before}: the same equations of contact, traced. "
        "Drake's solver stops at a relative residual of 1e-6, and joints stop at their limits in "
        "Drake's plant alone"
    )


def _without_viscous(names: Iterable[str]) -> dict[str, float]:
    """The parameters for no viscous friction of contacts, since Drake's contact has none."""
    return {f"{name}.viscous_friction": 0.0 for name in names}


def rollout_times(scenario: Scenario, time_step: float = 0.0) -> FloatArray:
    """The times of the rows of a rollout's record, in s: equidistant, or those of fixed steps.

    Args:
        scenario: The scenario.
        time_step: The step of a plant that Drake steps, in s; 0 for any other plant.

    Raises:
        ModelError: There are too many.
    """
    config, rows = scenario.integrator, ROWS
    if time_step:
        _check_rows(scenario.duration / time_step, "time_step", time_step, scenario.duration)
        end = config.start_time + scenario.duration
        inside = time_step * np.arange(config.start_time // time_step + 1, ceil(end / time_step))
        near = SAME * time_step
        inside = inside[(inside > config.start_time + near) & (inside < end - near)]
        return np.concatenate([[config.start_time], inside, [end]])
    if not config.use_error_control:
        steps = scenario.duration / config.max_step_size
        _check_rows(steps, "max_step_size", config.max_step_size, scenario.duration)
        rows = max(1, ceil(steps - 0.01))
    times: FloatArray = config.start_time + np.linspace(0.0, scenario.duration, rows + 1)
    return times


def _check_rows(count: float, name: str, step: float, duration: float) -> None:
    if count > MOST_ROWS:
        raise ModelError(
            f"{name} {step:g} s makes {count:.2g} rows for {duration:g} s; a rollout keeps at most "
            f"{MOST_ROWS:g}"
        )


def roll_scenario(
    scenario: Scenario,
    loop: ClosedLoop,
    context: Context,
    lasting: float | None = None,
    look: Callable[[RecordAfter], bool] = lambda record: False,
) -> Rollout:
    """Runs a scenario by `rollout`; a diverging run ends, as by `simulate`.

    Args:
        scenario: The scenario.
        loop: Its closed loop.
        context: The start, by `start_scenario`.
        lasting: The expected total duration of runs of this loop, in s, for the decision whether to
            compile it; None for a single run, which uses the cache.
        look: As for `run_loop`.

    Raises:
        ModelError: The loop cannot be rolled out.
        InconsistentStateError: The start is not on N*.
    """
    start, parameters = start_values(loop, context)
    watched = _RolloutWatch(scenario, loop, look)
    (rollout,) = run_loop(
        loop,
        start,
        parameters,
        rollout_times(scenario, loop.plant.time_step),
        config=scenario.integrator,
        seeds=[_seeds(scenario)],
        lasting=lasting,
        look=watched,
    )
    return diagnosed(loop, watched.judged(rollout))


def _seeds(scenario: Scenario) -> dict[str, int]:
    """The seed of each source of noise."""
    seeds = {}
    if scenario.sensors.force is not None:
        seeds["force_noise"] = scenario.sensors.force.seed
    if scenario.sensors.encoders is not None:
        seeds[ENCODER_NOISE] = encoder_seed(scenario.sensors.encoders.seed)
    return seeds


class _RolloutWatch:
    """Ends a rollout that diverges."""

    def __init__(
        self,
        scenario: Scenario,
        loop: ClosedLoop,
        look: Callable[[RecordAfter], bool] = lambda record: False,
    ) -> None:
        self._watch = DivergenceWatch(loop.plant, scenario.duration)
        self._look, self._may_diverge = look, scenario.judgement.may_diverge
        self._time: float | None = None
        self._next = time.perf_counter() + PERIOD
        self._failure: SimulationError | None = None

    def __call__(self, record: RecordAfter) -> bool:
        if time.perf_counter() >= self._next:
            self._see(record(self._time))
            self._next = time.perf_counter() + PERIOD
        return self._failure is not None or self._look(record)

    def _see(self, rows: Record, *, is_last: bool = False) -> None:
        if self._may_diverge or self._failure is not None or not rows.time.size:
            return
        self._time = float(rows.time[-1])
        try:
            self._watch.look(rows, is_last=is_last)
        except SimulationError as error:
            self._failure = error

    def judged(self, rollout: Rollout) -> Rollout:
        """The rollout, or its part up to the time at which it diverges."""
        self._see(rollout.record.after(self._time), is_last=rollout.failure is None)
        return rollout if self._failure is None else rollout.ended(self._failure)
