"""Runs a diagram: progress, clean interruption, and statistics."""

import os
import sys
import time
from collections.abc import Callable
from contextlib import closing, suppress
from math import isfinite

import numpy as np
from pydrake.systems.analysis import (
    ApplySimulatorConfig,
    GetIntegrationSchemes,
    Simulator,
    SimulatorConfig,
)
from pydrake.systems.framework import Context, Diagram, EventStatus, System
from pydrake.systems.primitives import Integrator, VectorLogSink
from tqdm import tqdm

from drake_dae.arguments import checked
from drake_dae.arrays import unknown_name
from drake_dae.blocks.traced_system import check_context
from drake_dae.errors import DrakeDaeError, InconsistentStateError, ModelError
from drake_dae.running.diagnosis import RunWatch
from drake_dae.running.interruption import Interruption, ending_signals
from drake_dae.running.judgement import RunStatistics
from drake_dae.running.merged_run import NO_EVENTS, MergedRun

BAR_PERIOD = 0.1  # The time between updates of the progress bar, in s.


@checked(ModelError, lasts=True)
def simulate(
    diagram: System,
    context: Context,
    duration: float,
    config: SimulatorConfig | None = None,
    progress: bool = False,
    may_diverge: bool = False,
    look: Callable[[Context], None] | None = None,
) -> RunStatistics:
    """Runs a diagram from a context; afterwards the context has the final state, on the manifold.

    If states or errors of a `Plant` diverge, an exception ends the run: see `DivergenceWatch`.

    In runs of many steps all traced blocks are composed to one, so that Drake calls Python once for
    each derivative and sample; see `compile_diagram`. A live view or a real-time rate need each
    step; then the blocks run one by one.

    A run whose start_time is the end of an earlier run appends to its logs. A run that starts
    earlier clears them.

    Ctrl-C, SIGTERM and SIGHUP end the run after the current step; a second signal ends it
    immediately with a KeyboardInterrupt. Logs are kept, also if an exception ends the run.

    Args:
        diagram: The system.
        context: Its context with the start state; changed in place.
        duration: The duration to simulate, in s.
        config: Drake's integrator settings; its defaults if None. The run starts at its start_time.
        progress: Shows simulated time and speed on stderr, if it is a terminal.
        may_diverge: Whether a diverging run continues.
        look: A function that is called with the context after at most 32 steps, again and again.

    Raises:
        ModelError: The duration or the settings are not valid.
        InconsistentStateError: The start state is not on the manifold.
        SimulationError: The run cannot continue, or diverges; the exception has time and state.
    """
    config = config or SimulatorConfig()
    check_context(diagram, context)
    check_config(config)
    if not (isfinite(duration) and duration > 0.0):
        raise ModelError(f"a duration must be positive, got {duration} s")
    start = config.start_time
    if not np.isfinite(start) or np.spacing(abs(start)) > 1e-9 * duration:
        raise ModelError(
            f"start_time must be a time from which {duration:g} s can be counted, got {start:g} s"
        )
    simulator = Simulator(diagram, context)
    ApplySimulatorConfig(config, simulator)
    _clear_later(diagram, context, start)
    # Under error control, witness functions take their accuracy from the context.
    context.SetAccuracy(config.accuracy)
    start, steps, composed = context.get_time(), 0, None
    watch = RunWatch(diagram, context, may_diverge)

    def seen(current: Context, steps: int) -> bool:
        bar.show(current.get_time() - start)
        if look is not None:
            look(current)
        watch.look(current, steps)
        return ending.signal is None

    def monitor(current: Context) -> EventStatus:
        if seen(current, 1):
            return EventStatus.DidNothing()
        return EventStatus.ReachedTermination(diagram, "interrupted")

    bar, ending = _Progress(duration, progress), Interruption()
    with closing(bar), ending_signals(ending):
        try:
            simulator.Initialize()
            began = time.perf_counter()
            watch.look(context, is_last=True)
            simulator.set_monitor(monitor)
            if not config.target_realtime_rate:
                composed = MergedRun.of(diagram, context, config, duration)
            if composed is None or not composed.run(start + duration, seen):
                if composed is not None:  # To the failure, whose message the blocks know.
                    simulator.Initialize(NO_EVENTS)
                simulator.AdvanceTo(start + duration)
                steps = simulator.get_num_steps_taken()
                simulator.AdvancePendingEvents()
            steps += 0 if composed is None else composed.steps
            elapsed = time.perf_counter() - began
            watch.look(context, is_last=True)
        except InconsistentStateError:
            raise  # The start state: its message says what to do.
        except (DrakeDaeError, RuntimeError) as error:
            told = watch.explain(error, context)
            if told is error:
                raise
            raise told from error
        bar.show(context.get_time() - start, is_last=True)
        return RunStatistics(context.get_time() - start, elapsed, steps, ending.signal)


def _clear_later(system: System, context: Context, start: float) -> None:
    """Clears the logs that have samples after a time in s."""
    if isinstance(system, Diagram):
        for part in system.GetSystems():
            _clear_later(part, context, start)
    elif isinstance(system, VectorLogSink):
        log = system.FindMutableLog(context)
        if log.num_samples() and log.sample_times()[-1] > start:
            log.Clear()


def check_config(config: SimulatorConfig) -> None:
    """Checks for settings that Drake accepts but that hang, fail late, or are ignored."""
    scheme = config.integration_scheme
    schemes = [name for name in GetIntegrationSchemes() if name != "cenic"]  # Of MultibodyPlants.
    if scheme not in schemes:
        text = unknown_name("scheme", scheme, schemes)
        raise ModelError(f"integration_scheme: {text}")
    for name in ("accuracy", "max_step_size"):
        value = getattr(config, name)
        if not (isfinite(value) and value > 0.0):
            raise ModelError(f"{name} must be positive, got {value}")
    if not config.target_realtime_rate >= 0.0:
        raise ModelError(
            f"target_realtime_rate must not be negative, got {config.target_realtime_rate}; 0 is "
            "as fast as possible"
        )
    trial = Simulator(Integrator(1))
    ApplySimulatorConfig(config, trial)
    if config.use_error_control and trial.get_integrator().get_fixed_step_mode():
        raise ModelError(
            f"use_error_control: {scheme} has none; set it to false and max_step_size to the "
            "step, or choose runge_kutta5"
        )


class _Progress:
    """A bar with simulated time and speed on stderr, if it is a terminal."""

    def __init__(self, duration: float, is_shown: bool) -> None:
        form = "{desc}{percentage:3.0f}%|{bar}| {n:.2f}/{total:.2f} s{postfix}"
        self._bar = tqdm(
            total=duration,
            disable=None if is_shown else True,  # None: without a terminal.
            file=sys.stderr,
            bar_format=form,
            **default_size(),
        )
        self._began = self._last = time.perf_counter()

    def show(self, simulated: float, *, is_last: bool = False) -> None:
        """Shows the simulated time in s if it is due."""
        now = time.perf_counter()
        if self._bar.disable or not (is_last or now - self._last >= BAR_PERIOD):
            return
        self._last, speed = now, simulated / (now - self._began)
        with suppress(OSError):  # A closed terminal must not end the run.
            self._bar.set_postfix_str(f"{speed:.1f} x real time", refresh=False)
            self._bar.n = min(simulated, self._bar.total)
            self._bar.refresh()

    def close(self) -> None:
        with suppress(OSError):
            self._bar.close()


def default_size() -> dict[str, int]:
    """The size for tqdm if the terminal reports no columns, as in some containers."""
    try:
        if os.get_terminal_size(sys.stderr.fileno()).columns > 0:
            return {}
    except (OSError, ValueError, AttributeError):  # Of what is no terminal, nor a file.
        pass
    return {"ncols": 79, "nrows": 24}
