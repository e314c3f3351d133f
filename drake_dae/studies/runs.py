"""The runs of a sweep in one process, and their results."""

import json
import re
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from functools import lru_cache
from math import isfinite
from threading import Lock
from typing import Any

import numpy as np
from pydrake.systems.framework import Context

from drake_dae.analysis import LimitKind, SignalLimits, SignalRange, robot_limits
from drake_dae.arrays import brief
from drake_dae.dae import Signal
from drake_dae.diagrams.closed_loop import ClosedLoop
from drake_dae.diagrams.record import Record
from drake_dae.errors import (
    AssumptionError,
    DrakeDaeError,
    InconsistentStateError,
    ModelError,
    ScenarioError,
    SimulationError,
)
from drake_dae.running.judgement import late_rms
from drake_dae.running.rollout_program import program_of
from drake_dae.running.simulate import simulate
from drake_dae.scenario.build import build_completed, for_rollout, roll_scenario
from drake_dae.scenario.parts import Matrices
from drake_dae.scenario.scenario import Scenario, read_scenario, varied_data
from drake_dae.scenario.start import start_scenario
from drake_dae.studies.variations import Variation


class Outcome(StrEnum):
    """How a run of a sweep ended."""

    FINISHED = "finished"
    FAILED = "failed"  # Before its end; the figures are those up to the failure.
    NO_START = "no start"  # There is no consistent initial state.
    REFUSED = "refused"  # The scenario contradicts itself, or violates an assumption.
    CRASHED = "crashed"  # The process ended, or raised an unexpected error.
    TIMED_OUT = "timed out"

    @property
    def is_final(self) -> bool:
        """Whether another attempt would have the same outcome."""
        return self not in (Outcome.CRASHED, Outcome.TIMED_OUT)


@dataclass(frozen=True)
class RunResult:
    """How a run of a sweep ended and why, its figures, and the signals beyond their limits."""

    outcome: Outcome
    reason: str = ""
    figures: Mapping[str, float] = field(default_factory=dict)
    exceeded: tuple[str, ...] = ()


# Keys whose values are set in a context, for any scenario.
_OF_A_RUN = (
    r"description|duration|judgement\.may_diverge|(integrator|write)(\..+)?|start\.errors(\..+)?|"
    r"sensors\.(encoders\.seed|force\.(seed|bias|drift))"
)


def structure_of(variation: Variation, base: Scenario) -> Variation:
    """The part of a variation of the sweep's scenario that the closed loop depends on.

    The other values are set in a context, so that runs with the same part share one loop: start,
    duration and integrator, parameters of the plant, gains that couple no outputs, seeds.
    """
    plant = base.plant
    patterns = [_OF_A_RUN, *(rf"start\.positions\.{re.escape(q)}" for q in base.start.positions)]
    if not base.is_advised:
        patterns += [rf"plant\.{re.escape(name)}" for name in plant.in_context]
    elif "friction" in plant.in_context:  # No gains are computed from it.
        patterns.append(r"plant\.friction")
    if not plant.carries:
        patterns.append(r"plant\.parameters(\..+)?")
    if plant.adjusts and not plant.carries:
        patterns.append(r"plant\.(payloads\.\d+\.mass|disturbances\.\d+\.force(\.\d)?)")
    if not (isinstance(base.law.gains, Matrices) or base.is_advised or base.task is not None):
        patterns.append(r"law\.gains\..+")
        if base.sensors.force_noise:
            patterns.append(r"sensors\.force\.noise_deviation")
    in_context = re.compile("|".join(patterns))
    own = {key: value for key, value in variation.items() if not in_context.fullmatch(key)}
    # Another kind of plant may set other values in a context.
    of_kind = re.compile(r"plant(\.(?!parameters|payloads|disturbances)|$)")
    return variation if any(map(of_kind.match, own)) else own


class Runner:
    """Makes runs of a sweep, and keeps the closed loop as long as the structure is the same.

    `lasting` is the simulated time of all runs with one loop, in s, for rollouts; None for Drake's
    Simulator. `builds` counts the loops that were built.
    """

    def __init__(self, base: Mapping[str, Any], lasting: float | None = None) -> None:
        self._base, self._lasting, self.builds = base, lasting, 0
        self._scenario = self._read({})
        self._structure: Variation | None = None
        self._loop: ClosedLoop | DrakeDaeError | None = None

    def run(self, variation: Variation) -> RunResult:
        """The result of a run, whatever happens in it."""
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # Each run would report the same.
                scenario, loop = self._built(variation)
                try:
                    context = start_scenario(scenario, loop)
                    record, steps, failure = self._simulated(scenario, loop, context)
                except DrakeDaeError as error:
                    outcome = Outcome.NO_START if _is_about_states(error) else Outcome.REFUSED
                    return RunResult(outcome, str(error))
        except DrakeDaeError as error:
            return RunResult(Outcome.REFUSED, str(error))
        except Exception as error:  # A sweep of thousands of runs goes on.
            return RunResult(Outcome.CRASHED, f"{type(error).__name__}: {brief(str(error))}")
        limits = _limits(loop)
        ranges = limits.ranges(record.time, limits.of_record(record))
        figures = figures_of(record, ranges)
        exceeded = tuple(r.signal.name for r in ranges if r.excess)
        if failure is not None:
            return RunResult(Outcome.FAILED, str(failure), figures, exceeded)
        return RunResult(Outcome.FINISHED, "", {**figures, "steps": float(steps)}, exceeded)

    def check(self, variation: Variation) -> None:
        """Checks keys and values of a variation; that it starts is no question here."""
        try:
            scenario, loop = self._built(variation)
            if self._lasting is not None:
                program_of(loop)
            start_scenario(scenario, loop)
        except ModelError as error:
            raise ScenarioError(("", str(error))) from error
        except DrakeDaeError as error:
            if isinstance(error, ScenarioError) and not _is_about_states(error):
                raise

    def _read(self, variation: Variation) -> Scenario:
        scenario = read_scenario(varied_data(self._base, variation))
        return scenario if self._lasting is None else for_rollout(scenario)[0]

    def _built(self, variation: Variation) -> tuple[Scenario, ClosedLoop]:
        """The scenario of a run and its closed loop, which is built if the structure changed."""
        scenario, structure = self._read(variation), structure_of(variation, self._scenario)
        if structure != self._structure or self._loop is None:
            self._structure, self._loop = structure, None
            self.builds += 1
            try:
                self._loop = build_completed(self._read(structure))[1]
            except DrakeDaeError as error:
                self._loop = error
        if isinstance(self._loop, DrakeDaeError):
            raise self._loop
        return scenario, self._loop

    def _simulated(
        self, scenario: Scenario, loop: ClosedLoop, context: Context
    ) -> tuple[Record, int, SimulationError | None]:
        """The record, the number of steps, and the failure if any."""
        if self._lasting is not None:
            rollout = roll_scenario(scenario, loop, context, self._lasting)
            return rollout.record, rollout.steps, rollout.failure
        steps, failure, may = 0, None, scenario.judgement.may_diverge
        given = scenario.duration, scenario.integrator
        try:
            run = simulate(loop.diagram, context, *given, may_diverge=may)
            steps = run.steps
            if run.interrupted:
                raise KeyboardInterrupt(run.interrupted)
        except SimulationError as error:
            failure = error
        return loop.record(context), steps, failure


def figures_of(record: Record, ranges: Sequence[SignalRange]) -> dict[str, float]:
    """The figures of a run: name with unit, such as "largest error of tool.z [m]" -> number.

    For each output: the largest |z - r|, the last z - r, and the "late" error, the root mean square
    of z - r over the second half of the time. For each constraint force: its least and largest
    value. For each control: the largest |u|. Then the "margin" of each limited signal, its least
    distance from its limits, which is negative beyond them; the largest constraint residual before
    a projection, and the time at which the record ends. An empty record has none.
    """
    figures = dict[str, float]()

    def add(what: str, signal: Signal, value: float) -> None:
        figures[f"{what} {signal.name}" + (f" [{signal.unit}]" if signal.unit else "")] = value

    if not record.time.size:
        return figures
    errors = record.signals["tracking_error"]
    late = late_rms(record.time, errors.values) if errors.signals else ()
    for signal, column, rms in zip(errors.signals, errors.values.T, late, strict=True):
        add("largest error of", signal, float(np.max(np.abs(column))))
        add("final error of", signal, float(column[-1]))
        add("late error of", signal, float(rms))
    forces, controls = (record.signals[name] for name in ("constraint_force", "control"))
    for signal, column in zip(forces.signals, forces.values.T, strict=True):
        add("least", signal, float(np.min(column)))
        add("largest", signal, float(np.max(column)))
    for signal, column in zip(controls.signals, controls.values.T, strict=True):
        add("largest", signal, float(np.max(np.abs(column))))
    for r in ranges:
        # The margin of a force that may not pull is its least value.
        if isfinite(r.room) and r.kind is not LimitKind.FORCE:
            add("margin of", r.signal, r.room)
    figures["largest residual"] = float(np.abs(record["constraint_residual"]).max(initial=0.0))
    figures["end [s]"] = float(record.time[-1])
    return figures


@lru_cache(maxsize=1)
def _limits(loop: ClosedLoop) -> SignalLimits:
    return robot_limits(loop.plant.robot("a sweep"))


def _is_about_states(error: BaseException | None) -> bool:
    """Whether an error is about states or assumptions, and not about keys of the scenario."""
    while error is not None:
        if isinstance(error, (AssumptionError, InconsistentStateError, SimulationError)):
            return True
        error = error.__cause__
    return False


_ALONE = Lock()


def run_one(settings: str, variation: Variation) -> RunResult:
    """Makes one run, in whatever process or thread; the settings are those of `Runner` as JSON."""
    with _ALONE:  # The threads of a process share its loop.
        return _runner(settings).run(variation)


@lru_cache(maxsize=1)
def _runner(settings: str) -> Runner:
    return Runner(*json.loads(settings))
