"""Sweeps: a scenario run many times with other values of some of its keys."""

import json
import multiprocessing.context
import os
import re
import sqlite3
import sys
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import (
    FIRST_COMPLETED,
    BrokenExecutor,
    CancelledError,
    Executor,
    Future,
    wait,
)
from contextlib import AbstractContextManager, closing, contextmanager, nullcontext, suppress
from functools import lru_cache
from importlib.metadata import version
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
    twenty variations are checked before the first run, and up to three are built until one is
    valid.

    Runs that differ only in start, duration, integrator, plant.parameters, seeds, or gains that
    couple no outputs, share one closed loop in each process.

    Args:
        scenario: A scenario from `load_scenario`.
        variations: For each run, dotted key of the scenario -> value; for example from
            `drake_dae.studies.make_variations`.
        file: The file, an SQLite database: a row for each run that has ended. Several processes
            may continue one sweep in it at the same time.
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
    with suppress(ScenarioError):  # Each run reports it; a run may have other values.
        scenario = complete_scenario(scenario).scenario
    base = scenario_data(scenario)
    chosen = [{key: plain(key, value) for key, value in changes.items()} for changes in variations]
    _check(base, chosen)
    simulated = for_rollout(scenario)[0] if rollout else scenario
    structures = [json.dumps(structure_of(each, simulated), sort_keys=True) for each in chosen]
    num_structures, lasting = len(set(structures)), None
    if rollout:
        durations = (each.get("duration", scenario.duration) for each in chosen)
        lasting = sum(d for d in durations if isinstance(d, (int, float))) / num_structures
    head = {"drake_dae": version("drake_dae"), "rollout": json.dumps(rollout)}
    head |= {key: json.dumps(part) for key, part in base.items()}
    head["variations"] = json.dumps(chosen)
    path, settings = Path(file), json.dumps([base, lasting])
    with ending_signals(end_at_once):
        if not os.path.lexists(path):
            runner, errors = Runner(base, lasting), list[ScenarioError]()
            # The first, the middle or the last run can be built.
            for index in dict.fromkeys((0, len(chosen) // 2, len(chosen) - 1)):
                try:
                    runner.check(chosen[index])
                    break
                except ScenarioError as error:
                    errors.append(error)
            else:
                raise errors[0]
        with open_journal(path, head) as journal:
            # Runs of one structure follow each other, so that a process keeps its loop.
            order = sorted(range(len(chosen)), key=structures.__getitem__)
            todo = [run for run in order if not journal.is_done(run)]
            if todo:
                count = min(workers or num_cores(), len(todo))
                opened: AbstractContextManager[Submit] = (
                    _processes(count, time_limit, BUILDS if num_structures > BUILDS else 0)
                    if executor is None
                    else nullcontext(lambda *args: executor.submit(run_one, *args))
                )
                ahead = 4 * count if executor is None else AHEAD
                size = {"total": len(chosen), "initial": len(chosen) - len(todo), "unit": "run"}
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
    waiting, running = list(todo)[::-1], dict[Future[RunResult], int]()
    try:
        while waiting or running:
            while waiting and len(running) < ahead:
                run = waiting.pop()
                if journal.is_done(run):  # By another process meanwhile.
                    bar.update()
                else:
                    running[submit(run)] = run
            ended = wait(running, return_when=FIRST_COMPLETED).done
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
        for process in filter(_Process.is_alive, list(context.started)):
            process.kill()
        pool.join()


def _begin() -> None:
    """Makes bars lock threads alone: a process that is killed would leave a semaphore behind."""
    tqdm.set_lock(RLock())


class _Process(multiprocessing.context.SpawnProcess):
    """A new interpreter that does not import the caller's script, which so needs no guard."""

    def start(self) -> None:
        main = sys.modules["__main__"]
        sys.modules["__main__"] = ModuleType("__main__")
        try:
            super().start()
        finally:
            sys.modules["__main__"] = main


class _WithoutMain(multiprocessing.context.SpawnContext):
    def __init__(self) -> None:
        self.started: list[_Process] = []

    def Process(self, **settings: Any) -> _Process:  # type: ignore[override]
        """A process as the pool wants it; it is started next."""
        self.started = [process for process in self.started if process.is_alive()]
        self.started.append(_Process(**settings))
        return self.started[-1]


def _check(base: Mapping[str, Any], variations: Sequence[Variation]) -> None:
    """Checks keys and values, of some variations if there are many."""
    if not variations:
        raise ScenarioError(("", "a sweep needs at least one variation"))
    problems: dict[tuple[str, str], None] = {}
    for changes in variations[:: -(-len(variations) // CHECKED)]:
        try:
            read_scenario(varied_data(base, changes))
        except ScenarioError as error:
            problems.update(dict.fromkeys(error.problems))
    if problems:
        raise ScenarioError(*problems)


_TABLES = """
CREATE TABLE IF NOT EXISTS sweep (key TEXT PRIMARY KEY, value TEXT NOT NULL);
CREATE TABLE IF NOT EXISTS runs (
    run INTEGER PRIMARY KEY, outcome TEXT NOT NULL, reason TEXT NOT NULL,
    figures TEXT NOT NULL, exceeded TEXT NOT NULL
);
"""

# The outcomes of runs that are tried again, in SQL.
_AGAIN = f"({', '.join(repr(str(each)) for each in Outcome if not each.is_final)})"


class Journal:
    """An open file of a sweep. Several processes may have it open; none loses a row of another."""

    def __init__(self, database: sqlite3.Connection) -> None:
        self._database = database

    def add(self, results: Mapping[int, RunResult]) -> None:
        """Writes results; a result that is already there stays, unless it is not final."""
        rows = [
            (run, r.outcome, r.reason, json.dumps(dict(r.figures)), json.dumps(r.exceeded))
            for run, r in results.items()
        ]
        self._database.executemany(
            "INSERT INTO runs VALUES (?, ?, ?, ?, ?) ON CONFLICT (run) DO UPDATE SET "
            "outcome = excluded.outcome, reason = excluded.reason, figures = excluded.figures, "
            f"exceeded = excluded.exceeded WHERE outcome IN {_AGAIN}",
            rows,
        )
        self._database.commit()

    def is_done(self, run: int) -> bool:
        """Whether the run has a final result."""
        query = f"SELECT 1 FROM runs WHERE run = ? AND outcome NOT IN {_AGAIN}"
        return self._database.execute(query, [run]).fetchone() is not None

    def results(self) -> dict[int, RunResult]:
        """Number of a run -> its result."""
        return {
            run: RunResult(Outcome(outcome), reason, json.loads(figures), tuple(json.loads(left)))
            for run, outcome, reason, figures, left in self._database.execute("SELECT * FROM runs")
        }


@contextmanager
def open_journal(path: Path, head: Mapping[str, str]) -> Iterator[Journal]:
    """Creates the file of a sweep with missing folders, or opens that with an equal `head`."""
    unusable = f"cannot use {brief(str(path))} as the file of a sweep: "
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        database = sqlite3.connect(path, timeout=60.0)
    except (sqlite3.Error, OSError, ValueError) as error:  # ValueError: a null byte in the path.
        raise ModelError(f"{unusable}{error}") from None
    with closing(database):
        try:
            database.executescript(f"BEGIN IMMEDIATE; {_TABLES}")
            there = dict(database.execute("SELECT key, value FROM sweep"))
            if not there:
                database.executemany("INSERT INTO sweep VALUES (?, ?)", list(head.items()))
            database.commit()
            differing = [
                f"{key} = {brief(there.get(key))} there, {brief(head.get(key))} here"
                for key in {**there, **head}
                if there and there.get(key) != head.get(key)
            ]
            if differing:
                raise ModelError(
                    f"'{path}' belongs to another sweep: {'; '.join(differing[:6])}. Choose "
                    "another folder, or remove it"
                )
            yield Journal(database)
        except sqlite3.Error as error:
            raise ModelError(f"{unusable}{error}") from None


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

    `lasting`: the simulated time of all runs with one loop, in s, for rollouts.
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


_runner = lru_cache(maxsize=1)(lambda settings: Runner(*json.loads(settings)))
_ALONE = Lock()


def run_one(settings: str, variation: Variation) -> RunResult:
    """Makes one run, in whatever process or thread; the settings are those of `Runner` as JSON."""
    with _ALONE:  # The threads of a process share its loop.
        return _runner(settings).run(variation)
