"""How fast a diagram runs here, before a run that shall keep up with the clock."""

import time
from copy import deepcopy

from pydrake.systems.analysis import ApplySimulatorConfig, Simulator, SimulatorConfig
from pydrake.systems.framework import Context, System

from drake_dae.errors import DrakeDaeError

TRIAL = 0.3
"""How long a trial takes at most, in s."""

FIRST, PIECE = 0.02, 1.0 / 32.0
"""What is simulated before the clock counts, and then at a time, in s."""


def attainable_rate(
    diagram: System, context: Context, duration: float, config: SimulatorConfig
) -> float | None:
    """How many seconds are simulated in one second here, at the start of a run.

    Args:
        diagram: The system.
        context: Its context with the start state; not changed.
        duration: How long the run lasts, in s.
        config: Its settings; it begins at their start_time.

    Returns:
        The rate; None where the run is too short, or fails at once.
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
        return None  # The run itself says why.
    if now <= start + FIRST:
        return None
    return (now - start - FIRST) / (time.perf_counter() - counted)
