"""The speed of a diagram on this machine, before a run in real time."""

import time
from copy import deepcopy

from pydrake.systems.analysis import ApplySimulatorConfig, Simulator, SimulatorConfig
from pydrake.systems.framework import Context, System

from drake_dae.errors import DrakeDaeError

TRIAL = 0.3
"""The longest duration of a trial by the clock, in s."""

FIRST, PIECE = 0.02, 1.0 / 32.0
"""The simulated time before the measurement, and that of a piece of the measurement, in s."""


def attainable_rate(
    diagram: System, context: Context, duration: float, config: SimulatorConfig
) -> float | None:
    """Measures the simulated seconds per second on this machine, by a short trial run.

    Args:
        diagram: The system.
        context: Its context with the start state; not changed.
        duration: The duration of the run, in s.
        config: The settings of the run.

    Returns:
        The rate; None if the run is too short, or fails immediately.
    """
    free = deepcopy(config)
    free.target_realtime_rate = 0.0
    trial = Simulator(diagram, context.Clone())
    ApplySimulatorConfig(free, trial)
    start = trial.get_context().get_time()
    end = start + duration
    try:
        trial.Initialize()
        began = time.perf_counter()
        trial.AdvanceTo(min(end, start + FIRST))
        now, counted = start + FIRST, time.perf_counter()
        while now + PIECE <= end and time.perf_counter() - began < TRIAL:
            now += PIECE
            trial.AdvanceTo(now)
    except (DrakeDaeError, RuntimeError):
        return None  # The run itself reports the reason.
    if now <= start + FIRST:
        return None
    return (now - start - FIRST) / (time.perf_counter() - counted)
