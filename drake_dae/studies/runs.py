"""The runs of a study in one process, and their results."""

import json
import time
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import lru_cache
from threading import Lock, local
from typing import TYPE_CHECKING, Any, cast

from pydrake.systems.framework import Context

from drake_dae.arrays import brief
from drake_dae.diagrams.closed_loop import ClosedLoop
from drake_dae.errors import (
    AssumptionError,
    DrakeDaeError,
    InconsistentStateError,
    ModelError,
    ScenarioError,
    SimulationError,
)
from drake_dae.scenario.build import build_completed, check_error_bound
from drake_dae.scenario.scenario import Scenario, read_scenario
from drake_dae.scenario.start import start_scenario
from drake_dae.simulation.figures import exceeded, margins, run_figures
from drake_dae.simulation.records.record import Record
from drake_dae.simulation.simulate import simulate
from drake_dae.simulation.summary import Limits
from drake_dae.studies.results import Outcome, RunResult
from drake_dae.studies.structures import (
    TOGETHER,
    Batch,
    built_data,
    data_text,
    structure_key,
    study_data,
)
from drake_dae.studies.variations import Variation

if TYPE_CHECKING:  # It loads SciPy's integrators, which a study without rollouts does not need.
    from drake_dae.running.rollout.rollout import Rollout


class Runner:
    """Simulates runs of a study, and reuses the closed loop for equal structures.

    Attributes:
        builds: The number of loops that were built. Drake does not free all of their memory.

    Args:
        base: The plain data of the study's scenario.
        lasting: The simulated time of all runs with one loop, in s, for rollouts; None for Drake's
            Simulator.
    """

    def __init__(self, base: Mapping[str, Any], lasting: float | None = None) -> None:
        self._base, self._completed = base, study_data(base, {}, lasting is not None)
        self._lasting = lasting
        self._key, self._read = "", dict[Any, Any]()
        self._built: ClosedLoop | DrakeDaeError | None = None
        self._contexts: list[Context] = []
        self.builds = 0

    def loop(self, data: Mapping[str, Any]) -> ClosedLoop:
        """Returns the closed loop for the data of a run; builds it if the structure changed.

        Raises:
            ScenarioError: The loop cannot be built; the message names the key.
        """
        key = structure_key(data, self._completed)
        if key != self._key:
            self._key, self._built, self._contexts = "", None, []
            self.builds += 1
            built = built_data(data, self._completed)
            try:
                self._built = _loop_of(built)
            except DrakeDaeError as error:
                self._built = error
            self._key = key
        if isinstance(self._built, DrakeDaeError):
            raise self._built
        return cast(ClosedLoop, self._built)

    @property
    def limits(self) -> Limits:
        """The limits of the robot whose loop was built last."""
        assert isinstance(self._built, ClosedLoop)
        return _limits(self._built)

    def why_not(self, variation: Variation) -> ScenarioError | None:
        """Returns the error in the keys and values of a variation; None if there is none.

        An unreachable start or a violated assumption is no such error: it is the outcome of a run.
        """
        try:
            data = study_data(self._base, variation, self._lasting is not None)
            loop = self.loop(data)
            start_scenario(read_scenario(data), loop)
        except ScenarioError as error:
            return None if _is_about_states(error) else error
        except DrakeDaeError:
            return None
        if self._lasting is not None:
            from drake_dae.running.rollout.program import program_of

            try:
                program_of(loop)
            except ModelError as error:
                return ScenarioError(("", str(error)))
        return None

    def run_all(self, batch: Batch) -> Iterator[RunResult]:
        """Simulates runs; yields their results in the same order."""
        for run in self._started(batch):
            if isinstance(run, _StartedRun):
                yield self._timed(run.number, run.seconds, self._finish, run)
            else:
                yield run

    def records(self, batch: Batch) -> Iterator[tuple[Record | None, str]]:
        """Simulates runs; yields the record of each, and the reason if it ended early.

        The record is None if a run has no start.
        """
        for run in self._started(batch):
            if not isinstance(run, _StartedRun):
                yield None, run.reason
                continue
            try:
                record, _, failure = self._recorded(run)
            except DrakeDaeError as error:
                yield None, str(error)
            else:
                yield record, "" if failure is None else str(failure)

    def _started(self, batch: Batch) -> Iterator["_StartedRun | RunResult"]:
        """Starts runs, with their rollouts where these can be computed together."""
        size = 1 if self._lasting is None else TOGETHER
        for first in range(0, len(batch), size):
            started = [
                self._timed(number, 0.0, self._start, number, variation)
                for number, variation in batch[first : first + size]
            ]
            rolled = [run for run in started if isinstance(run, _StartedRun)]
            self._roll_together(rolled)
            yield from started
            if self._lasting is not None:
                self._contexts += [run.context for run in rolled if run.loop is self._built]

    def _timed(
        self, number: int, before: float, function: Callable[..., Any], *arguments: Any
    ) -> Any:
        """Calls a part of a run, and adds its time to the time `before`, in s."""
        began = time.perf_counter()
        try:
            result = function(*arguments)
        except Exception as error:  # A study of thousands of runs continues.
            text = f"{type(error).__name__}: {brief(str(error))}"
            result = RunResult(number, Outcome.CRASHED, text)
        return replace(result, seconds=before + time.perf_counter() - began)

    def _start(self, number: int, variation: Variation) -> "_StartedRun | RunResult":
        """Reads the scenario of a run, builds its loop, and finds its initial state."""
        try:
            data = study_data(self._base, variation, self._lasting is not None)
            scenario = read_scenario(data, known=self._read)
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # Each worker would report the same.
                loop = self.loop(data)
        except DrakeDaeError as error:
            return RunResult(number, Outcome.REFUSED, str(error))
        try:
            context = start_scenario(scenario, loop, self._unused(loop))
        except DrakeDaeError as error:
            return _not_started(number, error)
        return _StartedRun(number, scenario, loop, context)

    def _unused(self, loop: ClosedLoop) -> Context:
        """A context of a loop with its defaults: one of an earlier rollout, or a new one."""
        if not self._contexts:
            self._contexts = [loop.diagram.CreateDefaultContext()]
        default = self._contexts[0]
        if len(self._contexts) == 1:
            return loop.diagram.CreateDefaultContext()
        unused = self._contexts.pop()
        unused.SetTimeStateAndParametersFrom(default)
        return unused

    def _roll_together(self, started: Sequence["_StartedRun"]) -> None:
        """Computes the rollouts of runs with the same loop together; failed ones stay None."""
        if self._lasting is None:
            return
        from drake_dae.scenario.rolled import roll_together

        for loop in dict.fromkeys(run.loop for run in started):
            runs = [run for run in started if run.loop is loop]
            scenarios, contexts = [run.scenario for run in runs], [run.context for run in runs]
            began = time.perf_counter()
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                with suppress(Exception):  # `_finish` repeats the rollout, and reports the error.
                    rollouts = roll_together(scenarios, loop, contexts, self._lasting)
                    for run, rollout in zip(runs, rollouts, strict=True):
                        run.rollout = rollout
            seconds = (time.perf_counter() - began) / len(runs)
            for run in runs:
                run.seconds += seconds

    def _recorded(self, run: "_StartedRun") -> tuple[Record, int, SimulationError | None]:
        """Simulates a run, unless its rollout exists; returns record, steps, and failure if any."""
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            if self._lasting is None:
                return _stepped(run.scenario, run.loop, run.context)
            from drake_dae.scenario.rolled import roll_scenario

            rollout = run.rollout or roll_scenario(
                run.scenario, run.loop, run.context, self._lasting
            )
            return rollout.record, rollout.steps, rollout.failure

    def _finish(self, run: "_StartedRun") -> RunResult:
        """Simulates a run, unless its rollout exists, and returns its result."""
        number, bound = run.number, run.scenario.error_bound
        try:
            record, steps, failure = self._recorded(run)
            rooms = margins(record, _limits(run.loop))
            figures, beyond = run_figures(record, rooms), exceeded(rooms)
            if bound is not None and record.time.size:
                figures |= bound.figures(record)
        except DrakeDaeError as error:
            return _not_started(number, error)
        if failure is not None:
            return RunResult(number, Outcome.FAILED, str(failure), figures, beyond)
        return RunResult(number, Outcome.FINISHED, "", {**figures, "steps": float(steps)}, beyond)


class _LastLoop(local):
    """The loop that was built last in this thread, and a text of the data that it was built from.

    `bound_errors` and a study of the same scenario thus share a loop, and its machine code.
    """

    text, loop = "", cast(ClosedLoop | None, None)


_last = _LastLoop()


def _loop_of(built: Mapping[str, Any]) -> ClosedLoop:
    """Builds the loop of complete data, unless it was the last one that was built.

    Raises:
        DrakeDaeError: It cannot be built.
    """
    text, scenario = data_text({**built, "error_bound": None}), read_scenario(built)
    if _last.loop is None or text != _last.text:
        _last.loop = None  # It takes memory while the other one is built.
        _last.loop = build_completed(replace(scenario, error_bound=None))[1]
        _last.text = text
    check_error_bound(scenario, _last.loop.plant.dae.output_signals)
    return _last.loop


@dataclass(eq=False)
class _StartedRun:
    """A run with a consistent initial state, in `context`.

    Attributes:
        number: The number of the run in the study.
        rollout: The rollout, if it was computed together with others.
        seconds: The time that the run has taken so far, in s.
    """

    number: int
    scenario: Scenario
    loop: ClosedLoop
    context: Context
    rollout: "Rollout | None" = None
    seconds: float = 0.0


def _limits(loop: ClosedLoop) -> Limits:
    """The limits of the robot of a loop."""
    if "limits" not in loop.memory:
        loop.memory["limits"] = Limits.of(loop.plant.robot("a study"))
    return cast(Limits, loop.memory["limits"])


def _not_started(number: int, error: DrakeDaeError) -> RunResult:
    outcome = Outcome.NO_START if _is_about_states(error) else Outcome.REFUSED
    return RunResult(number, outcome, str(error))


def _is_about_states(error: BaseException | None) -> bool:
    """Whether an error is about states or assumptions, and not about keys of the scenario."""
    while error is not None:
        if isinstance(error, (AssumptionError, InconsistentStateError, SimulationError)):
            return True
        error = error.__cause__
    return False


def _stepped(
    scenario: Scenario, loop: ClosedLoop, context: Context
) -> tuple[Record, int, SimulationError | None]:
    """Runs Drake's Simulator; returns the record, the number of steps, and the failure if any."""
    steps, failure = 0, None
    try:
        run = simulate(
            loop.diagram,
            context,
            scenario.duration,
            scenario.integrator,
            may_diverge=scenario.may_diverge,
        )
        steps = run.steps
        if run.interrupted:
            raise KeyboardInterrupt(run.interrupted)
    except SimulationError as error:
        failure = error
    return loop.record(context), steps, failure


_ALONE = Lock()
"""Threads of a worker share one loop, so that only one of them simulates at a time."""


def run_batch(base: str, batch: Batch) -> list[dict[str, Any]]:
    """Simulates runs in a worker of a cluster, and returns their results as plain data.

    Args:
        base: The arguments of `Runner` as JSON.
        batch: The runs.
    """
    with _ALONE:
        return [result.to_dict() for result in _runner(base).run_all(batch)]


@lru_cache(maxsize=1)
def _runner(base: str) -> Runner:
    return Runner(*json.loads(base))
