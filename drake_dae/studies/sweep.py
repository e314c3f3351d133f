"""Studies: a scenario run many times with other values of some of its keys."""

import os
import sys
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager, suppress
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
from drake_dae.studies.structures import batches, lasting
from drake_dae.studies.study import Study
from drake_dae.studies.variations import MOST_RUNS, Variation, plain

MOST_PROBLEMS = 10
"""The largest number of wrong values that are reported together."""


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
    """Runs a scenario once for each variation; what runs come to is in a file from then on.

    A study that ended early, by whatever, continues when the same call is made again: runs that the
    file has are not run again, and the table is the same as without the interruption. Runs that
    fail are outcomes with a reason; those whose process died or was too slow are run again by the
    next call. Before the first run, keys and values are checked, of numbers
    the least and the largest, and the first, the middle or the last variation is built.

    Runs that differ in start, plant_parameters, seed of the sensor, gains that couple no outputs,
    or in the integrator share one closed loop in each process.

    Args:
        scenario: What `load_scenario` returns.
        variations: For each run, dotted key of the scenario -> value; for example those of
            `grid_variations`, `random_variations` or `listed_variations`.
        file: The file in JSON Lines: a line for the study, then one for each finished run.
        workers: How many processes of this machine; all its cores if None.
        cluster: The address of a Dask scheduler, whose workers run it instead; its machines need
            drake_dae and the robot's files.
        progress: Shows a bar with the time left, if stderr is a terminal.
        rollout: Runs by `rollout` in place of Drake's Simulator, many times as fast; machine code
            is made where that pays for the whole study. Figures are those of 1,000 even rows of
            each run, of all steps where these are fixed.
        time_limit: How long a run may take on this machine by the clock, in s, building included: a
            process that takes longer, as one that was stopped does, is ended.

    Raises:
        ScenarioError: A key or a value cannot be used, or no variation that was tried starts, or a
            loop has what no rollout has.
        ModelError: The file belongs to another study, or cannot be written; processes or cluster
            cannot be used.
    """
    with suppress(ScenarioError):  # It is reported by each run, which may have other values.
        scenario = complete_scenario(scenario).scenario
    base = scenario_data(scenario)
    chosen = [{key: plain(key, value) for key, value in changes.items()} for changes in variations]
    _check(base, chosen)
    if workers is not None:
        check_whole_number("workers", workers, 1)
    positive("time_limit", time_limit)
    path, head = Path(file), study_head(version("drake_dae"), base, chosen, rollout)
    settings = base, lasting(base, chosen) if rollout else None
    with ending_signals(end_at_once):
        if not os.path.lexists(path):
            _try(Runner(*settings), chosen)
        with open_journal(path, head) as journal:
            _run(settings, chosen, journal, workers, cluster, progress, time_limit)
    found = tuple(journal.results[run] for run in range(len(chosen)))
    return Study(tuple(chosen), found, scenario, rollout)


def _run(
    settings: Sequence[Any],
    variations: Sequence[Variation],
    journal: Journal,
    workers: int | None,
    cluster: str | None,
    progress: bool,
    time_limit: float,
) -> None:
    """Runs what is missing, and puts it into the journal as it comes."""
    final = {run for run, result in journal.results.items() if result.outcome.is_final}
    missing = [pair for pair in enumerate(variations) if pair[0] not in final]
    if not missing:
        return
    base, total = settings[0], len(variations)
    with _bar(total, total - len(missing), progress) as show:
        if cluster is None:
            count = workers or cores()
            portions = batches(base, missing, count, settings[1] is not None)
            _collect(run_in_processes(settings, portions, count, time_limit), journal, show)
            return
        with Cluster(cluster) as connected:
            portions = batches(base, missing, connected.workers, settings[1] is not None)
            _collect(connected.run(settings, portions), journal, show)


def _collect(
    found: Generator[list[RunResult], None, None],
    journal: Journal,
    show: Callable[[list[RunResult]], None],
) -> None:
    with closing(found):
        for results in found:
            journal.append(results)
            show(results)


@contextmanager
def _bar(total: int, done: int, is_wanted: bool) -> Iterator[Callable[[list[RunResult]], None]]:
    """A bar with the time left on a terminal; gives what is to be called with new results."""
    form = "{percentage:3.0f}%|{bar}| {n}/{total} runs, {remaining} left{postfix}"
    bar = tqdm(
        total=total,
        initial=done,
        disable=not (is_wanted and sys.stderr.isatty()),
        file=sys.stderr,
        bar_format=form,
        smoothing=0.05,
        **default_size(),
    )
    other = 0

    def show(results: list[RunResult]) -> None:
        nonlocal other
        other += sum(result.outcome is not Outcome.FINISHED for result in results)
        with suppress(OSError):  # A terminal that is closed ends no study.
            if other:
                bar.set_postfix_str(f"{other} not finished", refresh=False)
            bar.update(len(results))

    try:
        yield show
    finally:
        with suppress(OSError):
            bar.close()


def _check(base: Mapping[str, Any], variations: Sequence[Variation]) -> None:
    """Refuses keys and values that a scenario cannot have."""
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
    """Variations that together have each value of each key, of its numbers the extreme ones."""
    for alike in _same_keys(variations):
        first = alike[0]
        yield first
        for key in first:
            for value in _extremes([changes[key] for changes in alike]):
                yield {**first, key: value}


def _same_keys(variations: Sequence[Variation]) -> list[list[Variation]]:
    """The variations, those that change the same keys together."""
    groups: dict[tuple[str, ...], list[Variation]] = {}
    for changes in variations:
        groups.setdefault(tuple(changes), []).append(changes)
    return list(groups.values())


def _extremes(values: Sequence[Any]) -> list[Any]:
    """Different values; of finite numbers the least and the largest of each type."""
    numbers: dict[type, list[float]] = {int: [], float: []}
    others = {}
    for value in values:
        if type(value) is int or (type(value) is float and isfinite(value)):
            numbers[type(value)].append(value)
        else:
            others[repr(value)] = value
    ends = [end for found in numbers.values() if found for end in (min(found), max(found))]
    return [*others.values(), *ends]


def _try(runner: Runner, variations: Sequence[Variation]) -> None:
    """Refuses a study of which nothing starts, as where a parameter has another name.

    Raises:
        ScenarioError: Neither the first, nor the middle, nor the last run can be built and started,
            of those that change the same keys, and not by what the robot can reach; why the first
            cannot.
    """
    for alike in _same_keys(variations):
        reasons = []
        for place in dict.fromkeys((0, len(alike) // 2, len(alike) - 1)):
            reason = runner.why_not(alike[place])
            if reason is None:
                break
            reasons.append(reason)
        else:
            raise reasons[0]
