"""Studies: a scenario run many times with other values of some of its keys."""

import os
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, closing, contextmanager, suppress
from functools import cache
from importlib.metadata import version
from math import isfinite
from pathlib import Path
from typing import Any

from tqdm import tqdm

from drake_dae.arguments import checked
from drake_dae.arrays import check_whole_number, positive
from drake_dae.errors import ScenarioError
from drake_dae.scenario.files import varied_data
from drake_dae.scenario.model import complete_scenario
from drake_dae.scenario.scenario import Scenario, read_scenario, scenario_data
from drake_dae.simulation.records.interruption import end_at_once, ending_signals
from drake_dae.simulation.simulate import default_size
from drake_dae.studies.cluster import Cluster
from drake_dae.studies.journal import Journal, open_journal, study_head
from drake_dae.studies.processes import cores, run_in_processes
from drake_dae.studies.results import Outcome, RunResult
from drake_dae.studies.runs import Runner
from drake_dae.studies.structures import batches, lasting, structures_of
from drake_dae.studies.study import Study
from drake_dae.studies.variations import MOST_RUNS, Variation, plain

MOST_PROBLEMS = 10
"""The largest number of invalid values that are reported together."""


@checked(lambda text: ScenarioError(("", text)))
def sweep(
    scenario: Scenario,
    variations: Sequence[Mapping[str, Any]],
    file: str | Path,
    *,
    workers: int | None = None,
    cluster: str | None = None,
    progress: bool = False,
    rollout: bool = False,
    time_limit: float = 3600.0,
) -> Study:
    """Runs a scenario once for each variation, and stores each result in a file at once.

    A study that was interrupted continues when the same call is made again: it skips runs with a
    result in the file, and its table is the same as without the interruption. A failed run is an
    outcome with a reason. The next call repeats runs whose process died or exceeded the time limit.
    Before the first run, all keys and values are checked (of numbers, the least and the largest),
    and up to three variations are built until one starts.

    Runs that differ only in start, plant_parameters, seed of the sensor, gains that couple no
    outputs, or integrator share one closed loop in each process.

    Args:
        scenario: A scenario from `load_scenario`.
        variations: For each run, dotted key of the scenario -> value; for example from
            `grid_variations`, `random_variations` or `listed_variations`.
        file: The file, in JSON Lines: a line for the study, then a line for each run.
        workers: The number of processes of this machine; None for the number of its cores.
        cluster: The address of a Dask scheduler, whose workers simulate the runs instead. Their
            machines need drake_dae and the files of the robot.
        progress: Shows a bar with the remaining time, if stderr is a terminal.
        rollout: Simulates by `rollout` instead of Drake's Simulator, which is many times as fast.
            Machine code is compiled if this saves time in the whole study. Figures are computed
            from 1,000 equally spaced rows of each run, or from all steps if steps are fixed.
        time_limit: The longest elapsed time of a run on this machine, in s, including the time to
            build its loop. A process that exceeds it is killed.

    Raises:
        ScenarioError: A key or a value is not valid, or none of the variations that were tried
            starts, or a rollout does not support the loop.
        ModelError: The file belongs to another study or cannot be written, or processes or cluster
            cannot be used.
    """
    with suppress(ScenarioError):  # Each run reports it; a run may have other values.
        scenario = complete_scenario(scenario).scenario
    base = scenario_data(scenario)
    chosen = [{key: plain(key, value) for key, value in changes.items()} for changes in variations]
    _check(base, chosen)
    if workers is not None:
        check_whole_number("workers", workers, 1)
    positive("time_limit", time_limit)
    path, head = Path(file), study_head(version("drake_dae"), base, chosen, rollout)
    structures = cache(lambda: structures_of(base, chosen, rollout))
    settings = base, lasting(structures()) if rollout else None
    with ending_signals(end_at_once):
        if not os.path.lexists(path):
            _try(Runner(*settings), chosen)
        with open_journal(path, head) as journal:
            _run(settings, chosen, structures, journal, workers, cluster, progress, time_limit)
    found = tuple(journal.results[run] for run in range(len(chosen)))
    return Study(tuple(chosen), found, scenario, rollout)


def _run(
    settings: Sequence[Any],
    variations: Sequence[Variation],
    structures: Callable[[], Sequence[tuple[str, float]]],
    journal: Journal,
    workers: int | None,
    cluster: str | None,
    progress: bool,
    time_limit: float,
) -> None:
    """Simulates the runs that have no final result in the journal, and appends their results."""
    final = {run for run, result in journal.results.items() if result.outcome.is_final}
    missing = [pair for pair in enumerate(variations) if pair[0] not in final]
    if not missing:
        return
    total = len(variations)
    with _bar(total, total - len(missing), progress) as show, ExitStack() as stack:
        connected = None if cluster is None else stack.enter_context(Cluster(cluster))
        count = connected.workers if connected else workers or cores()
        groups = batches(structures(), missing, count, settings[1] is not None)
        results = (
            connected.run(settings, groups)
            if connected
            else run_in_processes(settings, groups, count, time_limit)
        )
        for some in stack.enter_context(closing(results)):
            journal.append(some)
            show(some)


@contextmanager
def _bar(total: int, done: int, progress: bool) -> Iterator[Callable[[list[RunResult]], None]]:
    """Shows a progress bar on a terminal; yields a function that counts new results."""
    form = "{percentage:3.0f}%|{bar}| {n}/{total} runs, {remaining} left{postfix}"
    bar = tqdm(
        total=total,
        initial=done,
        disable=not (progress and sys.stderr.isatty()),
        file=sys.stderr,
        bar_format=form,
        smoothing=0.05,
        **default_size(),
    )
    unfinished = 0

    def show(results: list[RunResult]) -> None:
        nonlocal unfinished
        unfinished += sum(result.outcome is not Outcome.FINISHED for result in results)
        with suppress(OSError):  # The study continues after its terminal was closed.
            if unfinished:
                bar.set_postfix_str(f"{unfinished} not finished", refresh=False)
            bar.update(len(results))

    try:
        yield show
    finally:
        with suppress(OSError):
            bar.close()


def _check(base: Mapping[str, Any], variations: Sequence[Variation]) -> None:
    """Checks that a scenario accepts all keys and values."""
    if not variations:
        raise ScenarioError(("", "a study needs at least one variation"))
    if len(variations) > MOST_RUNS:
        raise ScenarioError(("", f"a study has at most {MOST_RUNS} runs, got {len(variations)}"))
    problems: dict[tuple[str, str], None] = {}
    for changes in _representatives(variations):
        try:
            robot = read_scenario(varied_data(base, changes)).robot
            for path in (robot.file, *robot.packages.values()):
                if path and not path.startswith("package://") and not Path(path).is_absolute():
                    text = f"a path that varies is absolute or begins with package://, got '{path}'"
                    raise ScenarioError(("robot", text))
        except ScenarioError as error:
            problems.update(dict.fromkeys(error.problems))
            if len(problems) >= MOST_PROBLEMS:
                break
    if problems:
        raise ScenarioError(*problems)


def _representatives(variations: Sequence[Variation]) -> Iterator[Variation]:
    """Variations with each value of each key; of a key's numbers, the least and the largest."""
    for group in _same_keys(variations):
        first = group[0]
        yield first
        for key in first:
            for value in _extremes([changes[key] for changes in group]):
                yield {**first, key: value}


def _same_keys(variations: Sequence[Variation]) -> list[list[Variation]]:
    """Groups of variations that change the same keys."""
    groups: dict[tuple[str, ...], list[Variation]] = {}
    for changes in variations:
        groups.setdefault(tuple(changes), []).append(changes)
    return list(groups.values())


def _extremes(values: Sequence[Any]) -> list[Any]:
    """The different values; of finite numbers, the least and the largest of each type."""
    numbers: dict[type, list[float]] = {int: [], float: []}
    others = {}
    for value in values:
        if type(value) is int or (type(value) is float and isfinite(value)):
            numbers[type(value)].append(value)
        else:
            others[repr(value)] = value
    ends = [end for same in numbers.values() if same for end in (min(same), max(same))]
    return [*others.values(), *ends]


def _try(runner: Runner, variations: Sequence[Variation]) -> None:
    """Checks that runs can be built, for example that the names of parameters exist.

    Raises:
        ScenarioError: The first, the middle and the last run of a group with the same keys all have
            an error in keys or values; it is the error of the first run.
    """
    for group in _same_keys(variations):
        errors = []
        for index in dict.fromkeys((0, len(group) // 2, len(group) - 1)):
            error = runner.why_not(group[index])
            if error is None:
                break
            errors.append(error)
        else:
            raise errors[0]
