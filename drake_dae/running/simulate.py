"""Runs a diagram: progress, clean interruption, and statistics."""

import os
import signal
import sys
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from difflib import get_close_matches
from functools import cache
from math import isfinite
from typing import Self

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
from drake_dae.blocks.traced_system import check_context
from drake_dae.errors import DrakeDaeError, InconsistentStateError, ModelError, SimulationError
from drake_dae.running.compiled_run import NO_EVENTS, CompiledRun
from drake_dae.running.diagnosis import RunDiagnosis
from drake_dae.running.divergence import DiagramWatch
from drake_dae.running.interruption import Interruption, ending_signals

BAR_PERIOD, LINE_PERIOD = 0.1, 10.0
"""The time between updates of the progress bar, or between lines without a terminal, in s."""

PATIENCE = 1.0
"""The time in s after a signal at which a step is ended in its middle."""


@dataclass(frozen=True)
class RunStatistics:
    """The statistics of a run.

    Attributes:
        simulated_time: The simulated time, in s.
        wall_time: The elapsed time, in s.
        steps: The number of steps of the integrator.
        interrupted: The signal that ended it early, SIGINT for Ctrl-C; None otherwise.
    """

    simulated_time: float
    wall_time: float
    steps: int
    interrupted: signal.Signals | None

    @property
    def times_real_time(self) -> float:
        """Simulated seconds per second."""
        return self.simulated_time / max(self.wall_time, 1e-9)


@checked(ModelError)
def simulate(
    diagram: System,
    context: Context,
    duration: float,
    config: SimulatorConfig | None = None,
    progress: bool = False,
    after_step: Callable[[Context], None] | None = None,
    may_diverge: bool = False,
    look: Callable[[Context], None] | None = None,
) -> RunStatistics:
    """Runs a diagram from a context; afterwards the context has the final state, on the manifold.

    If the states or errors of a `Plant` diverge, an exception ends the run: see `DiagramWatch`.

    In runs of many steps all traced blocks are composed to one, so that Drake calls Python once for
    each derivative and sample; see `compile_diagram`. `after_step`, a live view or a real-time rate
    need each step; then the blocks run one by one.

    A run whose start_time is the end of an earlier run appends to its logs. A run that starts
    earlier clears them.

    Ctrl-C, SIGTERM and SIGHUP end the run after the current step, or within it after a second; a
    second signal ends it immediately with a KeyboardInterrupt. Logs are kept, also if an exception
    ends the run.

    Args:
        diagram: The system.
        context: Its context with the start state; changed in place.
        duration: The duration to simulate, in s.
        config: Drake's integrator settings; its defaults if None. The run starts at its start_time.
        progress: Shows simulated time and speed on stderr.
        after_step: A function that is called with the context after each step.
        may_diverge: Whether a diverging run continues.
        look: A function that is called with the context after some steps, at least after every
            32nd, such as `RecordWriter.update`.

    Raises:
        ModelError: The duration or the settings are not valid.
        InconsistentStateError: The start state is not on the manifold.
        SimulationError: The run cannot continue, or diverges; the exception has time and state.
    """
    config = config or SimulatorConfig()
    check_context(diagram, context)
    check_duration(duration)
    check_config(config)
    _check_times(config.start_time, duration)
    simulator = Simulator(diagram, context)
    ApplySimulatorConfig(config, simulator)
    _clear_later(diagram, context, config.start_time)
    # Under error control, witness functions take their accuracy from the context.
    context.SetAccuracy(config.accuracy)
    start, going_on = context.get_time(), EventStatus.DidNothing()
    followers = [function for function in (after_step, look) if function is not None]
    ending = Interruption()
    began: float | None = None
    watch: DiagramWatch | None = None
    steps, composed = 0, None
    diagnosis = RunDiagnosis(diagram, context, config, duration)
    accepted = start, context.get_continuous_state_vector().CopyToVector()

    def stop(number: signal.Signals) -> None:
        ending(number)
        if began is not None:
            simulator.set_monitor(monitor)
            # In the middle of a long step, a second one ends it between two evaluations.
            impatience.number = number
            impatience.start()

    with (
        _Impatience() as impatience,
        ending_signals(stop),
        _StepMonitor(duration, progress) as shown,
    ):

        def seen(current: Context, steps: int) -> bool:
            nonlocal accepted
            state = current.get_continuous_state_vector().CopyToVector()
            accepted = current.get_time(), state
            if progress:
                shown.update(current.get_time() - start)
            for function in followers:
                function(current)
            if watch is not None:
                watch.look(current, steps)
            diagnosis.look(current, steps)
            return ending.signal is None

        def monitor(current: Context) -> EventStatus:
            if seen(current, 1):
                return going_on
            return EventStatus.ReachedTermination(diagram, "interrupted")

        try:
            simulator.Initialize()
            began = time.perf_counter()
            if not may_diverge:
                watch = DiagramWatch(diagram, context, duration)
            # A monitor in Python takes 10 % of a short step, so it is set only if needed.
            is_needed = progress or followers or (watch is not None and watch.sees)
            if is_needed or ending.signal is not None:
                simulator.set_monitor(monitor)
            if after_step is None and not config.target_realtime_rate:
                composed = CompiledRun.of(diagram, context, config, duration)
            if composed is None or not composed.run(start + duration, seen):
                if composed is not None:  # To the failure, whose message the blocks know.
                    simulator.Initialize(NO_EVENTS)
                simulator.AdvanceTo(start + duration)
                steps = simulator.get_num_steps_taken()
                simulator.AdvancePendingEvents()
            steps += 0 if composed is None else composed.steps
            elapsed = time.perf_counter() - began
            if watch is not None:
                watch.look(context, is_last=True)
        except KeyboardInterrupt:
            if began is None or not impatience.is_over:
                raise
            context.SetTimeAndContinuousState(*accepted)
            steps = simulator.get_num_steps_taken() + (0 if composed is None else composed.steps)
            elapsed = time.perf_counter() - began
        except (DrakeDaeError, RuntimeError) as error:
            if began is None and isinstance(error, InconsistentStateError):
                raise  # The start state: its message says what to do.
            grown: DrakeDaeError | RuntimeError = error
            if watch is not None:
                try:
                    watch.look(context, states_only=True)  # They may diverge within a few steps.
                except SimulationError as diverged:
                    grown = diverged
            told = diagnosis.explain(grown, context)
            if told is error:
                raise
            raise told from error
        shown.finish(context.get_time() - start)
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


def check_duration(duration: float) -> None:
    """Checks that a duration is positive."""
    if not (isfinite(duration) and duration > 0.0):
        raise ModelError(f"a duration must be positive, got {duration} s")


def _check_times(start: float, duration: float) -> None:
    """Checks that floating-point numbers can resolve the times of a run."""
    if not np.isfinite(start) or np.spacing(abs(start)) > 1e-9 * duration:
        raise ModelError(
            f"start_time must be a time from which {duration:g} s can be counted, got {start:g} s"
        )


@cache
def _schemes() -> tuple[str, ...]:
    """All integration schemes of Drake except CENIC, which simulates only a MultibodyPlant."""
    return tuple(name for name in GetIntegrationSchemes() if name != "cenic")


@cache
def _has_error_control(scheme: str) -> bool:
    trial = Simulator(Integrator(1))
    ApplySimulatorConfig(SimulatorConfig(integration_scheme=scheme, use_error_control=True), trial)
    return not trial.get_integrator().get_fixed_step_mode()


def check_config(config: SimulatorConfig) -> None:
    """Checks for settings that Drake accepts but that hang, fail late, or are ignored."""
    scheme = config.integration_scheme
    schemes = _schemes()
    if scheme not in schemes:
        near = get_close_matches(scheme, schemes, n=1)
        hint = f"did you mean '{near[0]}'? " if near else ""
        raise ModelError(
            f"integration_scheme: no scheme '{scheme}' for these systems; {hint}there are "
            f"{', '.join(schemes)}"
        )
    for name in ("accuracy", "max_step_size"):
        value = getattr(config, name)
        if not (isfinite(value) and value > 0.0):
            raise ModelError(f"{name} must be positive, got {value}")
    if not config.target_realtime_rate >= 0.0:
        raise ModelError(
            f"target_realtime_rate must not be negative, got {config.target_realtime_rate}; 0 is "
            "as fast as possible"
        )
    if config.use_error_control and not _has_error_control(scheme):
        raise ModelError(
            f"use_error_control: {scheme} has none; set it to false and max_step_size to the "
            "step, or choose runge_kutta5"
        )


class _Impatience:
    """Sends a signal once more if what it should end lasts, as long as the block is open."""

    def __init__(self) -> None:
        self.number, self.is_over = signal.SIGINT, False
        self._timer = threading.Timer(PATIENCE, self._send)
        self._timer.daemon = True

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self._timer.cancel()

    def start(self) -> None:
        """Starts to wait."""
        self._timer.start()

    def _send(self) -> None:
        self.is_over = True
        os.kill(os.getpid(), self.number)


class _StepMonitor:
    """Shows simulated time and speed on stderr: a bar on a terminal, otherwise periodic lines."""

    def __init__(self, duration: float, enabled: bool) -> None:
        self._duration = duration
        self._enabled = enabled
        self._terminal = sys.stderr.isatty()
        self._period = BAR_PERIOD if self._terminal else LINE_PERIOD
        self._bar = tqdm(
            total=duration,
            disable=not (enabled and self._terminal),
            file=sys.stderr,
            **default_size(),
            bar_format="{desc}{percentage:3.0f}%|{bar}| {n:.2f}/{total:.2f} s{postfix}",
        )
        self._began = self._shown = time.perf_counter()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        with suppress(OSError):
            self._bar.close()

    def update(self, simulated: float) -> None:
        """Shows the simulated time in s, if an update is due."""
        if self._enabled and time.perf_counter() - self._shown >= self._period:
            self._show(simulated)

    def finish(self, simulated: float) -> None:
        """Shows the end of the run; as a line only for long runs."""
        if self._terminal or self._shown > self._began:
            self._show(simulated)

    def _show(self, simulated: float) -> None:
        self._shown = time.perf_counter()
        speed = f"{simulated / (self._shown - self._began):.1f} x real time"
        # A closed terminal or pipe must not end the run.
        with suppress(OSError):
            if self._terminal:
                self._bar.set_postfix_str(speed, refresh=False)
                self._bar.n = min(simulated, self._duration)
                self._bar.refresh()
            elif self._enabled:
                text = f"{simulated:.2f}/{self._duration:.2f} s, {speed}"
                print(text, file=sys.stderr, flush=True)


def default_size() -> dict[str, int]:
    """The size for tqdm if the terminal reports no columns, as in some containers."""
    try:
        if os.get_terminal_size(sys.stderr.fileno()).columns > 0:
            return {}
    except OSError:
        pass
    return {"ncols": 79, "nrows": 24}
