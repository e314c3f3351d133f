"""Sweeps: a scenario run many times with other values of some of its keys."""

import json
import os
import re
import sqlite3
import sys
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, CancelledError, Executor, Future
from concurrent.futures import wait as wait_for
from contextlib import AbstractContextManager, closing, contextmanager, nullcontext, suppress
from dataclasses import asdict
from functools import lru_cache
from importlib.metadata import version
from multiprocessing.context import SpawnContext, SpawnProcess
from pathlib import Path
from threading import Lock, RLock
from types import ModuleType
from typing import Any

from pebble import ProcessExpired, ProcessFuture, ProcessPool
from pydrake.systems.framework import Context
from tqdm import tqdm

from drake_dae.analysis import SignalLimits, robot_limits
from drake_dae.arguments import checked
from drake_dae.arrays import brief, check_whole_number, positive
from drake_dae.blocks.machine import num_cores
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
from drake_dae.running.interruption import end_at_once, ending_signals
from drake_dae.running.rollout_program import program_of
from drake_dae.running.simulate import default_size, simulate
from drake_dae.scenario.build import build_completed, for_rollout, roll_scenario
from drake_dae.scenario.model import complete_scenario
from drake_dae.scenario.parts import Matrices
from drake_dae.scenario.scenario import Scenario, read_scenario, scenario_data, varied_data
from drake_dae.scenario.start import start_scenario
from drake_dae.studies.study import Outcome, RunResult, Study, figures_of
from drake_dae.studies.variations import Variation, plain

# The largest number of variations whose keys and values are checked before the first run.
CHECKED = 20
# The number of runs after which a process is replaced if each has a loop of its own, since Drake
# does not free all memory.
BUILDS = 200
AHEAD = 1000  # The largest number of runs that an executor has at a time.

Submit = Callable[[str, Variation], "Future[RunResult]"]


@checked(lambda text: ScenarioError(("", text)), lasts=True)
def sweep(
    scenario: Scenario,
    variations: Sequence[Mapping[str, Any]],
    file: str | Path,
    *,
    workers: int | None = None,
    executor: Executor | None = None,
    progress: bool = False,
    rollout: bool = False,
    time_limit: float = 3600.0,
) -> Study:
    """Runs a scenario once for each variation, and stores each result in a file at once.

    A sweep that was interrupted continues when the same call is made again: it skips runs with a
    result in the file. A failed run is an outcome with a reason. A run whose process dies, or that
    exceeds the time limit, is lost alone, and the next call repeats it. Keys and values of up to
    twenty variations are checked before the first run, which has to be a valid one.

    Runs that differ only in start (positions where gains are given), duration, integrator,
    plant.parameters, seeds, or gains that couple no outputs, share one closed loop in each process.

    Args:
        scenario: A scenario from `load_scenario`.
        variations: For each run, dotted key of the scenario -> value; for example from
            `drake_dae.studies.make_variations`.
        file: The file, an SQLite database: a row for each run that has ended.
        workers: The number of processes of this machine; None for the number of its cores.
        executor: Where to run instead, such as `dask.distributed.Client(...).get_executor()`. Its
            machines need drake_dae and the files of the robot. Time limits are then those of the
            executor.
        progress: Shows a bar with the remaining time, if stderr is a terminal.
        rollout: Simulates by `rollout` instead of Drake's Simulator, which is many times as fast.
            Machine code is compiled if this saves time in the whole sweep. Figures are computed
            from 1,000 equally spaced rows of each run, or from all steps if steps are fixed.
        time_limit: The longest elapsed time of a run on this machine, in s, including the time to
            build its loop. A process that exceeds it is killed.

    Raises:
        ScenarioError: A key or a value is not valid, or a rollout does not support the loop.
        ModelError: The file belongs to another sweep or cannot be written, or no process starts.
    """
    if workers is not None:
        check_whole_number("workers", workers, 1)
    positive("time_limit", time_limit)

    # The scenario, and the loops that its runs need.
    with suppress(ScenarioError):  # Each run reports it; a run may have other values.
        scenario = complete_scenario(scenario).scenario
    base = scenario_data(scenario)
    chosen = [{key: plain(key, value) for key, value in changes.items()} for changes in variations]
    if not chosen:
        raise ScenarioError(("", "a sweep needs at least one variation"))
    for changes in chosen[:: -(-len(chosen) // CHECKED)]:
        read_scenario(varied_data(base, changes))
    simulated = for_rollout(scenario)[0] if rollout else scenario
    structures = [json.dumps(structure_of(each, simulated), sort_keys=True) for each in chosen]
    num_structures, lasting = len({*structures}), None
    if rollout:
        durations = (each.get("duration", scenario.duration) for each in chosen)
        lasting = sum(d for d in durations if isinstance(d, (int, float))) / num_structures
    path, settings = Path(file), json.dumps([base, lasting])

    # The runs that the file has not, those of one structure together: a process keeps its loop.
    head = {"drake_dae": version("drake_dae"), "rollout": rollout, **base, "variations": chosen}
    with ending_signals(end_at_once):
        if not os.path.lexists(path):
            Runner(base, lasting).check(chosen[0])
        with open_journal(path, head) as journal:
            done = {run for run, result in journal.results().items() if result.outcome.is_final}
            order = sorted(range(len(chosen)), key=structures.__getitem__)
            todo = [run for run in order if run not in done]
            if todo:
                count, ahead = min(workers or num_cores(), len(todo)), AHEAD
                opened: AbstractContextManager[Submit]
                if executor is None:
                    most = BUILDS if num_structures > BUILDS else 0
                    ahead, opened = 4 * count, _processes(count, time_limit, most)
                else:
                    opened = nullcontext(lambda *args: executor.submit(run_one, *args))
                size = {"total": len(chosen), "initial": len(done), "unit": "run"}
                is_hidden = None if progress else True  # None: without a terminal.
                with opened as submit, tqdm(**size, disable=is_hidden, **default_size()) as bar:
                    _run(todo, lambda run: submit(settings, chosen[run]), ahead, journal, bar)
            results = journal.results()
    return Study(tuple(chosen), tuple(results[run] for run in range(len(chosen))))


def _run(
    todo: Sequence[int],
    submit: Callable[[int], "Future[RunResult]"],
    ahead: int,
    journal: "Journal",
    bar: Any,
) -> None:
    """Makes runs, at most so many at a time, and writes their results when they end."""
    waiting, running = [*todo][::-1], dict[Future[RunResult], int]()
    try:
        while waiting or running:
            while waiting and len(running) < ahead:
                run = waiting.pop()
                running[submit(run)] = run
            ended = wait_for(running, return_when=FIRST_COMPLETED).done
            journal.add({running.pop(future): _result(future) for future in ended})
            bar.update(len(ended))
    finally:
        for future in running:
            if not isinstance(future, ProcessFuture):  # Those end with their processes.
                future.cancel()


def _result(future: "Future[RunResult]") -> RunResult:
    """The result of a run that has ended, or been lost."""
    try:
        return future.result()
    except TimeoutError:
        return RunResult(Outcome.TIMED_OUT, "no end within its time limit")
    except BrokenExecutor as error:
        raise ModelError(f"the processes of the sweep have ended: {error}") from error
    except ProcessExpired as error:
        return RunResult(Outcome.CRASHED, f"its process ended with exit code {error.exitcode}")
    except (Exception, CancelledError) as error:
        return _crash(error)


def _crash(error: BaseException) -> RunResult:
    return RunResult(Outcome.CRASHED, f"{type(error).__name__}: {brief(str(error))}")


@contextmanager
def _processes(count: int, time_limit: float, most: int) -> Iterator[Submit]:
    """Processes of this machine, each for so many runs. One that dies, or is slow, is replaced."""
    context = _WithoutMain()
    pool = ProcessPool(count, max_tasks=most, context=context, initializer=_begin)
    try:
        yield lambda *args: pool.schedule(run_one, args, timeout=time_limit)
    finally:
        pool.stop()  # type: ignore[no-untyped-call]
        # The pool closes its channels first, which a process that is just starting would report.
        for process in filter(_Process.is_alive, context.started):
            process.kill()
        pool.join()


def _begin() -> None:
    """Makes bars lock threads alone: a process that is killed would leave a semaphore behind."""
    tqdm.set_lock(RLock())


class _Process(SpawnProcess):
    """A new interpreter that does not import the caller's script, which so needs no guard."""

    def start(self) -> None:
        main = sys.modules["__main__"]
        sys.modules["__main__"] = ModuleType("__main__")
        try:
            super().start()
        finally:
            sys.modules["__main__"] = main


class _WithoutMain(SpawnContext):
    def __init__(self) -> None:
        self.started: list[_Process] = []

    def Process(self, **settings: Any) -> _Process:  # type: ignore[override]
        """A process as the pool wants it; it is started next."""
        self.started.append(_Process(**settings))
        return self.started[-1]


class Journal:
    """An open file of a sweep, with a row for each run that has ended."""

    def __init__(self, database: sqlite3.Connection) -> None:
        self._database = database

    def add(self, results: Mapping[int, RunResult]) -> None:
        """Writes results, in the place of those that the runs have."""
        rows = [(run, json.dumps(asdict(result))) for run, result in results.items()]
        self._database.executemany("INSERT OR REPLACE INTO runs VALUES (?, ?)", rows)
        self._database.commit()

    def results(self) -> dict[int, RunResult]:
        """Number of a run -> its result."""
        results = dict[int, RunResult]()
        for run, text in self._database.execute("SELECT run, result FROM runs"):
            found = json.loads(text)
            results[run] = RunResult(**{**found, "outcome": Outcome(found["outcome"])})
        return results


@contextmanager
def open_journal(path: Path, head: Mapping[str, Any]) -> Iterator[Journal]:
    """Creates the file of a sweep with missing folders, or opens that with an equal `head`."""
    unusable = f"cannot use {brief(str(path))} as the file of a sweep: "
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        database = sqlite3.connect(path, timeout=60.0)
    except (sqlite3.Error, OSError, ValueError) as error:  # ValueError: a null byte in the path.
        raise ModelError(f"{unusable}{error}") from None
    with closing(database):
        try:
            for name in ("sweep (key TEXT PRIMARY KEY, value)", "runs (run PRIMARY KEY, result)"):
                database.execute(f"CREATE TABLE IF NOT EXISTS {name}")
            here = {key: json.dumps(value) for key, value in head.items()}
            there = dict(database.execute("SELECT key, value FROM sweep")) or here
            database.executemany("INSERT OR REPLACE INTO sweep VALUES (?, ?)", [*there.items()])
            database.commit()
            if differing := [
                f"{key} = {brief(there.get(key))} there, {brief(here.get(key))} here"
                for key in {**there, **here}
                if there.get(key) != here.get(key)
            ]:
                raise ModelError(
                    f"'{path}' belongs to another sweep: {'; '.join(differing[:6])}. Choose "
                    "another folder, or remove it"
                )
            yield Journal(database)
        except sqlite3.Error as error:
            raise ModelError(f"{unusable}{error}") from None


# Keys whose values are set in a context, for any scenario.
_OF_A_RUN = (
    r"description|duration|judgement\.may_diverge|(integrator|write)(\..+)?|start\.errors(\..+)?",
    r"sensors\.(encoders\.seed|force\.(seed|bias|drift))",
)


def structure_of(variation: Variation, base: Scenario) -> Variation:
    """The part of a variation of the sweep's scenario that the closed loop depends on.

    The other values are set in a context, so that runs with the same part share one loop: start,
    duration and integrator, parameters of the plant, gains that couple no outputs, seeds.
    """
    plant, is_advised = base.plant, base.is_advised  # Such gains are computed from plant and start.
    places = base.start.positions if not is_advised else ()
    patterns = [*_OF_A_RUN, *(rf"start\.positions\.{re.escape(q)}" for q in places)]
    numbers = [name for name in plant.in_context if not is_advised or name == "friction"]
    patterns += [rf"plant\.{re.escape(name)}" for name in numbers]
    if not plant.carries:
        patterns.append(r"plant\.parameters(\..+)?")
    if plant.adjusts and not plant.carries:
        patterns.append(r"plant\.(payloads\.\d+\.mass|disturbances\.\d+\.force(\.\d)?)")
    if not (isinstance(base.law.gains, Matrices) or is_advised or base.task is not None):
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

    `lasting`: the simulated time of all runs with one loop, in s, for rollouts.
    """

    def __init__(self, base: Mapping[str, Any], lasting: float | None = None) -> None:
        self._base, self._lasting, self.builds = base, lasting, 0
        self._scenario = self._read({})
        self._structure: Variation | None = None
        self._loop: tuple[ClosedLoop, SignalLimits] | DrakeDaeError | None = None

    def run(self, variation: Variation) -> RunResult:
        """The result of a run, whatever happens in it."""
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # Each run would report the same.
                scenario, loop, limits = self._built(variation)
                context = start_scenario(scenario, loop)
                record, steps, failure = self._simulated(scenario, loop, context)
        except DrakeDaeError as error:
            return RunResult(Outcome.REFUSED, str(error))
        except Exception as error:  # A sweep of thousands of runs goes on.
            return _crash(error)
        ranges = limits.ranges(record.time, limits.of_record(record))
        figures = figures_of(record, ranges)
        if failure is not None:
            return RunResult(Outcome.FAILED, str(failure), figures)
        return RunResult(Outcome.FINISHED, "", {**figures, "steps": float(steps)})

    def check(self, variation: Variation) -> None:
        """Checks keys and values of a variation; that it starts is no question here."""
        try:
            scenario, loop, _ = self._built(variation)
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

    def _built(self, variation: Variation) -> tuple[Scenario, ClosedLoop, SignalLimits]:
        """The scenario of a run, and its closed loop, which is built if the structure changed."""
        scenario, structure = self._read(variation), structure_of(variation, self._scenario)
        if structure != self._structure or self._loop is None:
            self._structure, self._loop = structure, None
            self.builds += 1
            try:
                loop = build_completed(self._read(structure))[1]
                self._loop = loop, robot_limits(loop.plant.robot("a sweep"))
            except DrakeDaeError as error:
                self._loop = error
        if isinstance(self._loop, DrakeDaeError):
            raise self._loop
        return scenario, *self._loop

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


def _is_about_states(error: BaseException | None) -> bool:
    """Whether an error is about states or assumptions, and not about keys of the scenario."""
    while error is not None:
        if isinstance(error, (AssumptionError, InconsistentStateError, SimulationError)):
            return True
        error = error.__cause__
    return False


_runner = lru_cache(maxsize=1)(lambda settings: Runner(*json.loads(settings)))
_ALONE = Lock()


def run_one(settings: str, variation: Variation) -> RunResult:
    """Makes one run, in whatever process or thread; the settings are those of `Runner` as JSON."""
    with _ALONE:  # The threads of a process share its loop.
        return _runner(settings).run(variation)
