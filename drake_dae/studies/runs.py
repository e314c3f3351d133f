"""The runs of a study in one process, and their results."""

import time
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any, cast

from pydrake.systems.framework import Context

from drake_dae.arrays import brief
from drake_dae.diagrams.closed_loop import ClosedLoop
from drake_dae.errors import (
    DrakeDaeError,
    ModelError,
    ScenarioError,
    SimulationError,
)
from drake_dae.scenario.build import build_completed
from drake_dae.scenario.scenario import Scenario, read_scenario
from drake_dae.scenario.start import begin, prepare, start_scenario
from drake_dae.simulation.figures import figures_of, margins
from drake_dae.simulation.records.record import Record
from drake_dae.simulation.records.together import RunsTogether, indexed_record
from drake_dae.simulation.simulate import simulate
from drake_dae.simulation.summary import Limits
from drake_dae.studies.results import Outcome, RunResult, is_about_states, not_started
from drake_dae.studies.structures import (
    TOGETHER,
    Batch,
    built_data,
    only_starts_differ,
    structure_key,
    study_data,
)
from drake_dae.studies.variations import Variation


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
        self._prepared: tuple[Mapping[str, Any], Context] | None = None
        self.builds = 0

    def loop(self, data: Mapping[str, Any]) -> ClosedLoop:
        """Returns the closed loop for the data of a run; builds it if the structure changed.

        Raises:
            ScenarioError: The loop cannot be built; the message names the key.
        """
        if self._starts_elsewhere(data, with_positions=False):
            return cast(ClosedLoop, self._built)
        key = structure_key(data, self._completed)
        if key != self._key:
            self._key, self._built, self._contexts, self._prepared = "", None, [], None
            self.builds += 1
            built = built_data(data, self._completed)
            try:
                self._built = build_completed(read_scenario(built))[1]
            except DrakeDaeError as error:
                self._built = error
            self._key = key
        if isinstance(self._built, DrakeDaeError):
            raise self._built
        return cast(ClosedLoop, self._built)

    @property
    def is_rollout(self) -> bool:
        """Whether the runs are rollouts."""
        return self._lasting is not None

    def why_not(self, variation: Variation) -> ScenarioError | None:
        """Returns the error in the keys and values of a variation; None if there is none.

        An unreachable start or a violated assumption is no such error: it is the outcome of a run.
        """
        try:
            data = study_data(self._base, variation, self.is_rollout)
            loop = self.loop(data)
            start_scenario(read_scenario(data), loop)
        except ScenarioError as error:
            return None if is_about_states(error) else error
        except DrakeDaeError:
            return None
        if self.is_rollout:
            from drake_dae.running.rollout.program import program_of

            try:
                program_of(loop)
            except ModelError as error:
                return ScenarioError(("", str(error)))
        return None

    def run_all(self, batch: Batch) -> Iterator[RunResult]:
        """Simulates runs; yields their results in the same order."""
        for run in self._started(batch):
            if isinstance(run, RunResult):
                yield run
            else:
                yield run.result or self._timed(run.number, run.seconds, self._finish, run)

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
            data = study_data(self._base, variation, self.is_rollout, self._read)
            scenario = read_scenario(data, known=self._read)
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # Each worker would report the same.
                loop = self.loop(data)
        except DrakeDaeError as error:
            return RunResult(number, Outcome.REFUSED, str(error))
        try:
            if self._lasting is None:
                context = start_scenario(scenario, loop)
            else:
                context = self._context(data, scenario, loop)
                begin(scenario, loop, context)
        except DrakeDaeError as error:
            return not_started(number, error)
        return _StartedRun(number, scenario, loop, context)

    def _context(self, data: Mapping[str, Any], scenario: Scenario, loop: ClosedLoop) -> Context:
        """A context that is prepared for a rollout: one of an earlier rollout, or a new one."""
        new = loop.diagram.CreateDefaultContext
        if not self._contexts:
            self._contexts = [new()]
        context = self._contexts.pop() if len(self._contexts) > 1 else new()
        if self._prepared is not None and self._starts_elsewhere(data):
            context.SetTimeStateAndParametersFrom(self._prepared[1])
            return context
        context.SetTimeStateAndParametersFrom(self._contexts[0])
        prepare(scenario, loop, context)
        prepared = new() if self._prepared is None else self._prepared[1]
        prepared.SetTimeStateAndParametersFrom(context)
        self._prepared = data, prepared
        return context

    def _starts_elsewhere(self, data: Mapping[str, Any], with_positions: bool = True) -> bool:
        """Whether the data of a run differ only in their start from those of the prepared one."""
        if self._prepared is None:
            return False
        last = self._prepared[0]
        keys = [each["start"].get("positions") for each in (data, last)]
        return (with_positions or keys[0] == keys[1]) and only_starts_differ(data, last)

    def _roll_together(self, started: Sequence["_StartedRun"]) -> None:
        """Computes rollouts and results of runs with the same loop together; others stay None."""
        if self._lasting is None:
            return
        from drake_dae.scenario.rolled import roll_together

        for loop in dict.fromkeys(run.loop for run in started):
            runs, began = [run for run in started if run.loop is loop], time.perf_counter()
            scenarios, contexts = [run.scenario for run in runs], [run.context for run in runs]
            # `_finish` repeats what fails, and reports it.
            with suppress(Exception), warnings.catch_warnings():
                warnings.simplefilter("ignore")
                for together in roll_together(scenarios, loop, contexts, self._lasting):
                    some = [runs[place] for place in together.places]
                    for index, run in enumerate(some):
                        run.rolled = together, index
                    for run, result in zip(some, _results(together, some), strict=True):
                        run.result = result
            seconds = (time.perf_counter() - began) / len(runs)
            for run in runs:
                run.seconds += seconds
                run.result = run.result and replace(run.result, seconds=run.seconds)

    def _alone(self, run: "_StartedRun") -> tuple[Record, int, SimulationError | None]:
        """Simulates a run; returns record, steps, and failure if any."""
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            if self._lasting is None:
                return _stepped(run.scenario, run.loop, run.context)
            from drake_dae.scenario.rolled import roll_scenario

            rollout = roll_scenario(run.scenario, run.loop, run.context, self._lasting)
            return rollout.record, rollout.steps, rollout.failure

    def _finish(self, run: "_StartedRun") -> RunResult:
        """Simulates a run, unless its rollout exists, and returns its result."""
        try:
            if run.rolled is None:
                record, steps, failure = self._alone(run)
                alone = RunsTogether([0], indexed_record(record, None), [steps], failure)
                run.rolled = alone, 0
            (result,) = _results(run.rolled[0], [run])
        except DrakeDaeError as error:
            return not_started(run.number, error)
        return result


@dataclass(eq=False)
class _StartedRun:
    """A run with a consistent initial state, in `context`.

    Attributes:
        number: The number of the run in the study.
        rolled: The runs that it was computed together with, and its index among them.
        seconds: The time that the run has taken so far, in s.
        result: Its result, if it was computed together with others.
    """

    number: int
    scenario: Scenario
    loop: ClosedLoop
    context: Context
    rolled: tuple[RunsTogether, int] | None = None
    seconds: float = 0.0
    result: RunResult | None = None


def _results(together: RunsTogether, runs: Sequence[_StartedRun]) -> list[RunResult]:
    """The results of some runs that were computed together."""
    record, failure = together.record, together.failure
    rooms, results = margins(record, _limits(runs[0].loop)), []
    figures, exceeded = figures_of(record, rooms), rooms.exceeded()
    for run in runs:
        assert run.rolled is not None
        index = run.rolled[1]
        own = figures[index]
        outcome, reason = Outcome.FAILED, str(failure)
        if failure is None:
            outcome, reason = Outcome.FINISHED, ""
            own["steps"] = float(together.steps[index])
        results.append(RunResult(run.number, outcome, reason, own, exceeded[index]))
    return results


def _limits(loop: ClosedLoop) -> Limits:
    """The limits of the robot of a loop."""
    if "limits" not in loop.memory:
        loop.memory["limits"] = Limits.of(loop.plant.robot("a study"))
    return cast(Limits, loop.memory["limits"])


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
