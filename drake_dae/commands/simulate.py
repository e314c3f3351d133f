"""`drake-dae simulate`: runs a scenario and writes its files into a folder."""

import argparse
import json
import os
import shlex
import sys
import time
from collections.abc import Callable
from contextlib import redirect_stdout, suppress
from dataclasses import dataclass
from datetime import datetime
from itertools import count
from pathlib import Path
from typing import Any, TextIO

from pydrake.systems.framework import Context

import drake_dae
from drake_dae.commands.options import program
from drake_dae.commands.play import show
from drake_dae.commands.run.files import RunFiles
from drake_dae.commands.run.folder import (
    ANIMATION,
    FILES,
    MARK,
    PART,
    SCENARIO,
    new_folder,
    run_folder,
)
from drake_dae.diagrams.closed_loop import ClosedLoop
from drake_dae.errors import DrakeDaeError, ScenarioError
from drake_dae.pictures.plots import PLOTS
from drake_dae.pictures.scene.view import start_meshcat
from drake_dae.scenario.build import build_completed
from drake_dae.scenario.completion import Completed
from drake_dae.scenario.files import load_scenario, save_scenario
from drake_dae.scenario.judging import judge_run
from drake_dae.scenario.scenario import Scenario, scenario_data
from drake_dae.scenario.shipped import find_scenario
from drake_dae.scenario.start import start_scenario
from drake_dae.simulation.judgement import Outcome
from drake_dae.simulation.real_time import attainable_rate
from drake_dae.simulation.records.interruption import Interruption, end_at_once, ending_signals
from drake_dae.simulation.records.record import Record, RecordAfter
from drake_dae.simulation.records.record_writer import RecordWriter
from drake_dae.simulation.simulate import RunStatistics, simulate
from drake_dae.simulation.summary import RunSummary


def run_command(options: argparse.Namespace) -> int:
    """Runs the scenario that the options name; returns the exit code."""
    path = find_scenario(options.scenario)
    scenario = load_scenario(path, options.settings)
    if options.open and not scenario.write.animation:
        raise ScenarioError(
            ("write.animation", ("--open shows the animation, so write.animation must be true"))
        )
    if not options.json:
        return _simulate(options, path.stem, scenario)[0]
    with redirect_stdout(sys.stderr):
        code, results = _simulate(options, path.stem, scenario)
    print(json.dumps(results, indent=2))
    return code


def _simulate(
    options: argparse.Namespace, name: str, scenario: Scenario
) -> tuple[int, dict[str, Any]]:
    """Runs a scenario; returns the exit code, and the results for JSON."""
    if options.meshcat:
        scenario.integrator.target_realtime_rate = scenario.integrator.target_realtime_rate or 1.0
    meshcat = start_meshcat() if options.meshcat else None
    began, remark = time.perf_counter(), ""
    if options.rollout:
        from drake_dae.scenario.rolled import for_rollout

        scenario, remark = for_rollout(scenario)
    completed, loop = build_completed(scenario, meshcat)
    scenario, context = completed.scenario, start_scenario(completed.scenario, loop)
    simulate_by = _roll if options.rollout else _step
    print(f"{name}: built in {time.perf_counter() - began:.2f} s", flush=True)
    for note in (*completed.notes, *filter(None, [remark])):
        print(note, flush=True)
    folder = options.out or _unused(f"{name}-{datetime.now():%Y%m%d-%H%M%S}")
    with ending_signals(end_at_once), run_folder(folder) as moved_to:
        if moved_to is not None:
            print(f"the earlier run in {folder}/ is kept in {moved_to}/", flush=True)
        save_scenario(scenario, folder / SCENARIO, f"{MARK} {drake_dae.__version__}")
        if meshcat is not None:
            print(f"watch at {meshcat.web_url()}", flush=True)
        title = f"{name}: {scenario.description}" if scenario.description else name
        code, results = _run(loop, context, completed, folder, simulate_by, title)
    if options.open:
        show(folder)
    if code == 0 and options.check and results.get("missed"):
        code = 2
    return code, {"scenario": name, "folder": str(folder), **results}


def _unused(name: str) -> Path:
    """A new folder below runs/."""
    runs = Path("runs")
    runs.mkdir(exist_ok=True)
    return new_folder(runs / (name if i == 1 else f"{name}-{i}") for i in count(1))


@dataclass
class _CommandRun:
    """A run of the command: its loop, context and scenario, and what it has recorded."""

    loop: ClosedLoop
    context: Context
    completed: Completed
    writer: RecordWriter
    statistics: RunStatistics | None = None
    record: Record | None = None
    recorded: RecordAfter | None = None

    @property
    def scenario(self) -> Scenario:
        """The completed scenario."""
        return self.completed.scenario


def _step(run: _CommandRun) -> RunStatistics:
    """Runs by Drake's Simulator."""
    _warn_of_rate(run)
    return simulate(
        run.loop.diagram,
        run.context,
        run.scenario.duration,
        run.scenario.integrator,
        progress=True,
        look=run.writer.update if run.scenario.write.record else None,
        may_diverge=run.scenario.judgement.may_diverge,
    )


def _warn_of_rate(run: _CommandRun) -> None:
    """Warns if this machine is too slow for a run in real time."""
    scenario, config = run.scenario, run.scenario.integrator
    target = config.target_realtime_rate
    if not target:
        return
    rate = attainable_rate(run.loop.diagram, run.context, scenario.duration, config)
    if rate is not None and rate < target:
        print(
            f"runs at about {rate:.2g} times real time here, not at {target:g}: the view is slow "
            "motion. Machine code (--compiled true, with a C compiler) and larger steps are faster",
            flush=True,
        )


def _roll(run: _CommandRun) -> RunStatistics:
    """Runs by `rollout`.

    Raises:
        SimulationError: The run cannot continue.
    """
    from drake_dae.scenario.rolled import roll_scenario

    began = time.perf_counter()

    def look(record: RecordAfter) -> bool:
        run.recorded = record
        if run.scenario.write.record:
            run.writer.update(run.context)
        return ending.signal is not None

    with ending_signals(ending := Interruption()):
        rollout = roll_scenario(run.scenario, run.loop, run.context, look=look)
    run.record, run.recorded = rollout.record, rollout.record.after
    run.context = rollout.context or run.context
    if rollout.failure is not None:
        raise rollout.failure
    times, wall = run.record.time, time.perf_counter() - began
    simulated = float(times[-1] - times[0]) if times.size else 0.0
    return RunStatistics(simulated, wall, rollout.steps, ending.signal)


def _run(
    loop: ClosedLoop,
    context: Context,
    completed: Completed,
    folder: Path,
    simulate_by: Callable[[_CommandRun], RunStatistics],
    title: str,
) -> tuple[int, dict[str, Any]]:
    """Runs, and writes the files, also if the run fails or is interrupted."""
    about = {"scenario": scenario_data(completed.scenario)}

    def recorded(context: Context, after: float | None) -> Record:
        return loop.record(context, after) if run.recorded is None else run.recorded(after)

    files, failure = RunFiles(folder), ""
    with RecordWriter(folder / PART, recorded, about) as writer:
        run = _CommandRun(loop, context, completed, writer)
        try:
            run.statistics = simulate_by(run)
        except DrakeDaeError as error:
            failure = str(error)
            raise
        except KeyboardInterrupt:
            failure, title = "interrupted in the middle of a step", ""
            raise
        finally:
            results = _write(run, files, failure, title)
    if run.statistics.interrupted:
        return 128 + run.statistics.interrupted, results
    return 1 if files.problems else 0, results


def _write(run: _CommandRun, files: RunFiles, failure: str, title: str) -> dict[str, Any]:
    """Writes the files, prints the summary, and returns the results.

    Args:
        run: The run, which has ended.
        files: Its files.
        failure: The reason of its failure; empty if it did not fail.
        title: The title of the animation; empty for a run without pictures.
    """
    scenario, wanted = run.scenario, run.scenario.write
    # A signal from here on takes effect after the record is written and before the pictures.
    with ending_signals(ending := Interruption()):
        record = run.record or run.loop.record(run.context)
        if record.time.size == 0:
            return {}
        report = judge_run(scenario, run.loop, run.context, record, run.statistics, failure)
        if wanted.record:
            files.write_record(record, run.loop, run.writer, run.context)
        files.write_summary(report, *run.completed.notes)
    try:
        if ending.signal is not None:
            end_at_once(ending.signal)
        if title:
            files.write_pictures(report, run.loop, run.context, wanted, title)
    finally:
        written = _print_report(report, files)
    return {**report.data, "files": written}


def _print_report(report: RunSummary, files: RunFiles) -> list[str]:
    """Prints the verdict, the summary and the problems; returns the names of the files."""
    folder = files.folder
    written = [name for name in (*FILES, PART) if (folder / name).exists()]
    with files.collected():
        where = f"written to {folder}/: {', '.join(written)}"
        _print(f"{_colored(report)}\n{where}", sys.stdout)
        if ANIMATION in written:
            named = shlex.quote(str(folder))
            drawn = "" if PLOTS[0] in written else f"; plots: {program()} plot {named} --all"
            _print(f"watch it: {program()} play {named}{drawn}", sys.stdout)
    with suppress(OSError):
        _print("".join(f"error: {line}\n" for line in files.problems), sys.stderr)
    return written


def _colored(report: RunSummary) -> str:
    """A summary for the screen: its first word green, red or yellow on a terminal."""
    text, outcome = report.text, report.judgement.outcome
    if not sys.stdout.isatty() or os.environ.get("NO_COLOR"):
        return text
    color, word = {Outcome.GOOD: 32, Outcome.BAD: 31, Outcome.UNDECIDED: 33}[outcome], outcome.name
    return f"\x1b[1;{color}m{word}\x1b[0m{text.removeprefix(word)}"


def _print(text: str, file: TextIO) -> None:
    """Prints and flushes; a closed output, as after SIGHUP, is not tried again on exit."""
    try:
        print(text, end="\n" if text and text[-1] != "\n" else "", file=file, flush=True)
    except OSError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), file.fileno())
        raise
