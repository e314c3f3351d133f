"""The runs of a study in one process, and their results."""

import json
import time
import warnings
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from enum import StrEnum
from functools import lru_cache
from math import isfinite
from threading import Lock
from typing import Any, Self, cast

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
from drake_dae.scenario.files import varied_data
from drake_dae.scenario.forms.typed_yaml import TAG
from drake_dae.scenario.plants import plant_kind
from drake_dae.scenario.scenario import Scenario, read_scenario
from drake_dae.scenario.start import start_scenario
from drake_dae.simulation.figures import exceeded, run_figures
from drake_dae.simulation.records.record import Record
from drake_dae.simulation.simulate import simulate
from drake_dae.simulation.summary import Limits
from drake_dae.studies.variations import Variation


class Outcome(StrEnum):
    """How a run of a study ended."""

    FINISHED = "finished"
    FAILED = "failed"
    """During the run; figures are up to the failure."""
    NO_START = "no start"
    """No consistent state satisfies the start."""
    REFUSED = "refused"
    """The scenario is inconsistent, or violates an assumption."""
    CRASHED = "crashed"
    """The process ended, or failed unexpectedly."""
    TIMED_OUT = "timed out"
    """The process was ended, since the run exceeded its time limit."""

    @property
    def is_final(self) -> bool:
        """Whether it is a property of the run itself; otherwise it may be tried again."""
        return self not in (Outcome.CRASHED, Outcome.TIMED_OUT)


@dataclass(frozen=True)
class RunResult:
    """The result of a run of a study.

    Attributes:
        run: Its number in the study.
        outcome: How it ended.
        reason: The reason, if it did not finish.
        figures: Name with unit -> value, as `run_figures` has them.
        exceeded: Names of the signals beyond their limits.
        seconds: The elapsed time, including the build.
    """

    run: int
    outcome: Outcome
    reason: str = ""
    figures: Mapping[str, float] = field(default_factory=dict)
    exceeded: tuple[str, ...] = ()
    seconds: float = 0.0

    def to_dict(self) -> dict[str, Any]:
        """The result as plain data."""
        return asdict(self)

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> Self:
        """The result of plain data.

        Raises:
            KeyError, TypeError, ValueError: The data are those of something else.
        """
        values = dict(data)
        values["outcome"] = Outcome(values["outcome"])
        values["exceeded"] = tuple(values["exceeded"])
        found = cls(**values)
        numbers = [*found.figures.values(), found.seconds]
        if not (
            type(found.run) is int
            and found.run >= 0
            and all(type(number) in (int, float) and isfinite(number) for number in numbers)
            and all(isinstance(text, str) for text in (found.reason, *found.exceeded))
            and isinstance(found.figures, dict)
            and found.seconds >= 0.0
        ):
            raise ValueError("no result of a run")
        return found


Batch = Sequence[tuple[int, Variation]]
"""Runs of one structure, with their numbers."""


def structure_key(data: Mapping[str, Any], base: Mapping[str, Any]) -> str:
    """Text that is equal for scenarios that the same closed loop can simulate.

    They may differ in the data of a context: start, parameters of the plant, uncoupled gains, seed;
    or in the settings of the run.
    """
    return json.dumps(_built(data, base), sort_keys=True)


def _built(data: Mapping[str, Any], base: Mapping[str, Any]) -> dict[str, Any]:
    """A scenario's data with the data of a context taken from the base of the study.

    So the loop does not depend on which run comes first.
    """
    own = dict(data)
    for key in ("description", "plant_parameters", "duration", "integrator", "write"):
        own[key] = base[key]
    kind, plant = plant_kind(own["plant"]), base["plant"]
    if kind is plant_kind(plant):
        same = {
            key: plant[key]
            for key in kind.in_context
            if (plant[key] is None) is (own["plant"][key] is None)
        }
        own["plant"] = {**own["plant"], **same}
    if kind.carries:  # It is built with its own parameters.
        own["plant_parameters"] = data["plant_parameters"]
    first, positions = base["start"], own["start"].get("positions", {})
    if positions.keys() == first["positions"].keys():
        positions = first["positions"]
    own["start"] = {**first, "positions": positions}
    # Default gains depend on the built loop; and a task is built with its numbers.
    if own["gains"] and base["gains"] and not own["task"]:
        tag = own["gains"].get(TAG, "!Poles")
        if tag == base["gains"][TAG] != "!Matrices":
            own["gains"] = base["gains"]
    if "seed" in own["force_feedback"]:
        own["force_feedback"] = {**own["force_feedback"], "seed": 0}
    if own["encoders"]:
        own["encoders"] = {**own["encoders"], "seed": 0}
    return own


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
        self._base = base
        self._lasting = lasting
        self._key = ""
        self._built: ClosedLoop | DrakeDaeError | None = None
        self.builds = 0

    def loop(self, data: Mapping[str, Any]) -> ClosedLoop:
        """The closed loop of a scenario's data.

        Raises:
            ScenarioError: Something does not fit; the message names its key.
        """
        built = _built(data, self._base)
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
            data = varied_data(self._base, variation)
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
        """Simulates runs; yields each result."""
        for number, variation in batch:
            began = time.perf_counter()
            try:
                result = self._run(number, variation)
            except Exception as error:  # A study of thousands of runs continues.
                text = f"{type(error).__name__}: {brief(str(error))}"
                result = RunResult(number, Outcome.CRASHED, text)
            yield RunResult(**{**vars(result), "seconds": time.perf_counter() - began})

    def _run(self, number: int, variation: Variation) -> RunResult:
        try:
            data = varied_data(self._base, variation)
            scenario = read_scenario(data)
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # Each worker would report the same.
                loop = self.loop(data)
        except DrakeDaeError as error:
            return RunResult(number, Outcome.REFUSED, str(error))
        return _simulated(number, scenario, loop, self._lasting)


def _is_about_states(error: BaseException | None) -> bool:
    """Whether an error comes from states or assumptions rather than from the file."""
    while error is not None:
        if isinstance(error, (AssumptionError, InconsistentStateError, SimulationError)):
            return True
        error = error.__cause__
    return False


def _simulated(
    number: int, scenario: Scenario, loop: ClosedLoop, lasting: float | None
) -> RunResult:
    """The result of a run, from a new context of the loop."""
    try:
        context = start_scenario(scenario, loop)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            if lasting is None:
                record, steps, failure = _stepped(scenario, loop, context)
            else:
                from drake_dae.scenario.rolled import roll_scenario

                found = roll_scenario(scenario, loop, context, lasting)
                record, steps, failure = found.record, found.steps, found.failure
    except DrakeDaeError as error:
        outcome = Outcome.NO_START if _is_about_states(error) else Outcome.REFUSED
        return RunResult(number, outcome, str(error))
    limits = Limits.of(loop.plant.robot("a study"))
    figures, beyond = run_figures(record, limits), tuple(exceeded(record, limits))
    if failure is not None:
        return RunResult(number, Outcome.FAILED, str(failure), figures, beyond)
    return RunResult(number, Outcome.FINISHED, "", {**figures, "steps": float(steps)}, beyond)


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


def lasting(base: Mapping[str, Any], variations: Iterable[Variation]) -> float:
    """The mean total duration of the runs of one structure, in s of simulated time.

    Args:
        base: The plain data of the study's scenario.
        variations: All runs of the study.
    """
    total, keys = 0.0, set()
    for variation in variations:
        data = varied_data(base, variation)
        total += data["duration"]
        keys.add(structure_key(data, base))
    return total / len(keys)


def batches(
    base: Mapping[str, Any], runs: Iterable[tuple[int, Variation]], workers: int
) -> list[Batch]:
    """The runs by structure, in portions: a worker builds at most one loop per portion.

    Args:
        base: The plain data of the study's scenario.
        runs: The runs.
        workers: The number of workers.
    """
    groups: dict[str, list[tuple[int, Variation]]] = {}
    for number, variation in runs:
        key = structure_key(varied_data(base, variation), base)
        groups.setdefault(key, []).append((number, variation))
    total = sum(map(len, groups.values()))
    size = max(1, min(32, total // (32 * workers)))
    return [
        group[first : first + size]
        for group in groups.values()
        for first in range(0, len(group), size)
    ]
