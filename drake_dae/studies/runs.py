"""The runs of a study in one process, and their results."""

import json
import time
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import lru_cache
from threading import Lock
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
from drake_dae.scenario.build import build_completed
from drake_dae.scenario.scenario import Scenario, read_scenario
from drake_dae.scenario.start import start_scenario
from drake_dae.simulation.figures import exceeded, run_figures
from drake_dae.simulation.records.record import Record
from drake_dae.simulation.simulate import simulate
from drake_dae.simulation.summary import Limits
from drake_dae.studies.results import Outcome, RunResult
from drake_dae.studies.structures import TOGETHER, Batch, built_data, study_data
from drake_dae.studies.variations import Variation

if TYPE_CHECKING:  # It loads SciPy's integrators, which a study without rollouts does not need.
    from drake_dae.running.rollout.rollout import Rollout


class Runner:
    """Simulates runs of a study, and reuses the closed loop for equal structures.

    Attributes:
        builds: The number of loops it has built; Drake does not free all of their memory.

    Args:
        base: The plain data of the study's scenario.
        lasting: The total duration of runs of one structure, in s, for rollouts; None for Drake's
            Simulator.
    """

    def __init__(self, base: Mapping[str, Any], lasting: float | None = None) -> None:
        self._base, self._own = base, study_data(base, {}, lasting is not None)
        self._lasting = lasting
        self._key, self._known = "", dict[Any, Any]()
        self._built: ClosedLoop | DrakeDaeError | None = None
        self.builds = 0

    def loop(self, data: Mapping[str, Any]) -> ClosedLoop:
        """The closed loop of a run's data.

        Raises:
            ScenarioError: Something does not fit; the message names its key.
        """
        built = built_data(data, self._own)
        key = json.dumps(built, sort_keys=True)
        if key != self._key:
            self._key, self._built = "", None
            self.builds += 1
            try:
                self._built = build_completed(read_scenario(built))[1]
            except DrakeDaeError as error:
                self._built = error
            self._key = key
        if isinstance(self._built, DrakeDaeError):
            raise self._built
        return cast(ClosedLoop, self._built)

    def why_not(self, variation: Variation) -> ScenarioError | None:
        """The problem with the keys and values of a variation; None if there is none.

        A start out of reach or a violated assumption is an outcome of a run.
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
        """Simulates runs; yields each result, in their order."""
        size = 1 if self._lasting is None else TOGETHER
        for first in range(0, len(batch), size):
            begun = [self._timed(self._begin, *pair) for pair in batch[first : first + size]]
            self._roll_together([each for each in begun if isinstance(each, _Begun)])
            for each in begun:
                yield self._timed(self._end, each) if isinstance(each, _Begun) else each

    def _timed(self, function: Callable[..., Any], *arguments: Any) -> Any:
        """What a part of a run comes to, with the time that its run has taken up to then."""
        began, given = time.perf_counter(), arguments[0]
        number, before = (given.number, given.seconds) if isinstance(given, _Begun) else (given, 0)
        try:
            found = function(*arguments)
        except Exception as error:  # A study of thousands of runs continues.
            text = f"{type(error).__name__}: {brief(str(error))}"
            found = RunResult(number, Outcome.CRASHED, text)
        return replace(found, seconds=before + time.perf_counter() - began)

    def _begin(self, number: int, variation: Variation) -> "_Begun | RunResult":
        try:
            data = study_data(self._base, variation, self._lasting is not None)
            scenario = read_scenario(data, known=self._known)
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # Each worker would report the same.
                loop = self.loop(data)
        except DrakeDaeError as error:
            return RunResult(number, Outcome.REFUSED, str(error))
        try:
            return _Begun(number, scenario, loop, start_scenario(scenario, loop))
        except DrakeDaeError as error:
            return _not_started(number, error)

    def _roll_together(self, begun: Sequence["_Begun"]) -> None:
        """Makes rollouts of one loop at once, where they can be made."""
        if self._lasting is None:
            return
        from drake_dae.scenario.rolled import roll_together

        for loop in dict.fromkeys(each.loop for each in begun):
            own = [each for each in begun if each.loop is loop]
            scenarios, contexts = [each.scenario for each in own], [each.context for each in own]
            began = time.perf_counter()
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                with suppress(Exception):  # Each run says so itself.
                    found = roll_together(scenarios, loop, contexts, self._lasting)
                    for each, rollout in zip(own, found, strict=True):
                        each.rollout = rollout
            share = (time.perf_counter() - began) / len(own)
            for each in own:
                each.seconds += share

    def _end(self, begun: "_Begun") -> RunResult:
        """The result of a run that has a start."""
        number, scenario, loop, context = begun.number, begun.scenario, begun.loop, begun.context
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                if self._lasting is None:
                    record, steps, failure = _stepped(scenario, loop, context)
                else:
                    from drake_dae.scenario.rolled import roll_scenario

                    found = begun.rollout or roll_scenario(scenario, loop, context, self._lasting)
                    record, steps, failure = found.record, found.steps, found.failure
        except DrakeDaeError as error:
            return _not_started(number, error)
        limits = Limits.of(loop.plant.robot("a study"))
        figures, beyond = run_figures(record, limits), tuple(exceeded(record, limits))
        if failure is not None:
            return RunResult(number, Outcome.FAILED, str(failure), figures, beyond)
        return RunResult(number, Outcome.FINISHED, "", {**figures, "steps": float(steps)}, beyond)


@dataclass(eq=False)
class _Begun:
    """A run that has a start.

    Attributes:
        number: Its number in the study.
        scenario, loop, context: What is run.
        rollout: What it came to, if that is known by now.
        seconds: The time that it has taken up to now.
    """

    number: int
    scenario: Scenario
    loop: ClosedLoop
    context: Context
    rollout: "Rollout | None" = None
    seconds: float = 0.0


def _not_started(number: int, error: DrakeDaeError) -> RunResult:
    outcome = Outcome.NO_START if _is_about_states(error) else Outcome.REFUSED
    return RunResult(number, outcome, str(error))


def _is_about_states(error: BaseException | None) -> bool:
    """Whether an error comes from states or assumptions rather than from the file."""
    while error is not None:
        if isinstance(error, (AssumptionError, InconsistentStateError, SimulationError)):
            return True
        error = error.__cause__
    return False


def _stepped(
    scenario: Scenario, loop: ClosedLoop, context: Context
) -> tuple[Record, int, SimulationError | None]:
    """A run by Drake's Simulator: its record, number of steps, and reason of failure."""
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
"""Threads of one process share the built loop."""


def run_batch(base: str, batch: Batch) -> list[dict[str, Any]]:
    """Simulates runs in this process, for a cluster's workers.

    Args:
        base: The arguments of `Runner` as JSON.
        batch: The runs.
    """
    with _ALONE:
        return [result.to_dict() for result in _runner(base).run_all(batch)]


@lru_cache(maxsize=1)
def _runner(base: str) -> Runner:
    return Runner(*json.loads(base))
