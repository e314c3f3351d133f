"""The command `drake-dae`."""

import argparse
import json
import logging
import os
import signal
import sys
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from datetime import datetime
from io import TextIOWrapper
from math import ceil
from pathlib import Path
from typing import TextIO

import numpy as np
from pydrake.systems.framework import Context

import drake_dae
from drake_dae.diagrams.build import build_scenario
from drake_dae.diagrams.closed_loop import ClosedLoop
from drake_dae.diagrams.export.export import export_code
from drake_dae.diagrams.feasibility import find_feasibility
from drake_dae.diagrams.rollout.rollout import rollout, start_values
from drake_dae.diagrams.scenario import (
    DEFAULT_SCENARIO,
    Scenario,
    find_scenario,
    load_scenario,
    save_scenario,
    shipped_scenarios,
)
from drake_dae.errors import (
    DrakeDaeError,
    MachineCodeError,
    ModelError,
    NonMinimumPhaseWarning,
    ScenarioError,
)
from drake_dae.simulation.animation import make_animation
from drake_dae.simulation.interruption import Ending, end_at_once, ending_signals
from drake_dae.simulation.plots import PLOTS, save_plots
from drake_dae.simulation.record import Record
from drake_dae.simulation.record_writer import RecordWriter
from drake_dae.simulation.run_folder import FILES, MARK, PART, SCENARIO, run_folder, stage
from drake_dae.simulation.simulate import RunStatistics, simulate
from drake_dae.simulation.summary import Limits, summary
from drake_dae.simulation.view import start_meshcat
from drake_dae.systems.robot_plant import RobotPlant
from drake_dae.trace.cache import cache_folder, clear, contents
from drake_dae.trace.compiled import find_compiler

ROWS = 1000
"""So many rows has the record of a rollout under error control, after the first."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs the command line; returns the exit code.

    0, or 1 for an error, 2 for a problem that `analyze` found (as for wrong usage), 128 + signal
    after Ctrl-C (130), SIGTERM (143) or SIGHUP (129).
    """
    parser = argparse.ArgumentParser(
        prog="drake-dae",
        description="Robots in contact: position and force tracking on Drake's systems framework.",
    )
    parser.add_argument("--version", action="version", version=drake_dae.__version__)
    commands = parser.add_subparsers(dest="command", required=True)
    commands.add_parser("list", help="show the shipped scenarios")
    named = argparse.ArgumentParser(add_help=False)
    named.add_argument(
        "scenario",
        nargs="?",
        default=DEFAULT_SCENARIO,
        help=f"a shipped scenario or a YAML file (default: {DEFAULT_SCENARIO})",
    )
    named.add_argument(
        "--set",
        dest="settings",
        action="append",
        default=[],
        metavar="KEY=VALUE",
        help='change the scenario, for example "integrator.accuracy=1e-8"; may be repeated',
    )
    named.add_argument(
        "--compiled",
        choices=["true", "false", "auto"],
        help="whether functions become machine code, as the scenario's key `compiled`",
    )
    run = commands.add_parser("simulate", parents=[named], help="run a scenario")
    run.add_argument(
        "--out", type=Path, help="folder for the results (default: runs/<scenario>-<time>)"
    )
    run.add_argument(
        "--meshcat", action="store_true", help="show the robot while it runs, in a browser"
    )
    run.add_argument(
        "--rollout",
        action="store_true",
        help="run without Drake's Simulator, the whole loop as one function: some fifty times as "
        "fast where it is machine code, twice as fast where not; the record has every fixed "
        f"step, or {ROWS} rows under error control",
    )
    examine = commands.add_parser(
        "analyze",
        parents=[named],
        help="examine a scenario without running it",
        description="Examines the robot of a scenario (relative degrees, index, Assumptions "
        "(1)-(5), zero dynamics) and what its reference takes: the nearest singularity, control "
        "and joint forces against their limits, contact forces, joint limits, and when the "
        "reference leaves what the robot can reach.",
        epilog="exit code: 0 if no problem was found, 2 if one was (the lines PROBLEM), 1 for an "
        "error",
    )
    examine.add_argument(
        "--json", action="store_true", help='print JSON; for an error, its text under "error"'
    )
    written = commands.add_parser(
        "export",
        parents=[named],
        help="write law, plant and projection as C99",
        description="Writes the law, the plant and the projection of a scenario as plain C99 "
        "without dependencies, with sizes, names and units, and a test program: `make` in the "
        "folder compiles it and compares it with Python.",
    )
    written.add_argument("--out", type=Path, help="folder for the files (default: <scenario>_c99)")
    kept = commands.add_parser("cache", help="show the machine code that is kept, or remove it")
    kept.add_argument("--clear", action="store_true", help="remove it all")
    options = parser.parse_args(arguments)
    if options.command == "simulate" and options.rollout and options.meshcat:
        parser.error("--rollout shows nothing while it runs; leave out --meshcat")
    if isinstance(sys.stdout, TextIOWrapper):
        # Names may have letters that the terminal does not.
        sys.stdout.reconfigure(errors="backslashreplace")
    # Drake tells where each Meshcat listens, also the one that only records.
    logging.getLogger("drake").setLevel(logging.WARNING)
    try:
        if options.command == "list":
            return _list()
        if options.command == "cache":
            return _cache(options)
        if options.command == "analyze":
            with _warnings(NonMinimumPhaseWarning):  # The report tells it.
                return _analyze(options)
        with _warnings():
            return _export(options) if options.command == "export" else _simulate(options)
    except DrakeDaeError as error:
        # A scenario has a line for each problem; other texts, as of Drake, are made one.
        text = str(error) if isinstance(error, ScenarioError) else " ".join(str(error).split())
        print(*(f"error: {line}" for line in text.splitlines()), sep="\n", file=sys.stderr)
        if options.command == "analyze" and options.json:
            print(json.dumps({"error": text}))
        return 1
    except BrokenPipeError:
        # The reader of our output, such as head, has enough; Python would complain on exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    except OSError as error:
        print(f"error: {_of(error)}", file=sys.stderr)
        return 1
    except KeyboardInterrupt as interrupt:
        print("interrupted", file=sys.stderr)
        return 128 + (interrupt.args[0] if interrupt.args else signal.SIGINT)


def _list() -> int:
    paths = shipped_scenarios()
    width = max(map(len, paths), default=0)
    for name, path in paths.items():
        print(f"{name.ljust(width)}  {load_scenario(path).description}")
    return 0


def _cache(options: argparse.Namespace) -> int:
    files = contents()
    size = sum(path.stat().st_size for path in files if path.is_file())
    what = f"{len(files)} files, {size / 1e6:.1f} MB"
    if options.clear:
        clear()
        print(f"removed from {cache_folder()}: {what}")
        return 0
    print(f"cache     {cache_folder()}: {what}")
    try:
        print(f"compiler  {' '.join(find_compiler().command)}")
    except MachineCodeError as error:
        print(f"compiler  none: {error}")
    return 0


def _settings(options: argparse.Namespace) -> list[str]:
    """The changes of the scenario, those by options of their own the last."""
    own = [] if options.compiled is None else [f"compiled={options.compiled}"]
    return [*options.settings, *own]


@contextmanager
def _warnings(*ignored: type[Warning]) -> Iterator[None]:
    """Prints warnings as errors are printed, without the line of code; some are ignored."""
    with warnings.catch_warnings():
        for category in ignored:
            warnings.simplefilter("ignore", category)
        warnings.showwarning = lambda message, *_: print(f"warning: {message}", file=sys.stderr)
        yield


def _analyze(options: argparse.Namespace) -> int:
    path = find_scenario(options.scenario)
    found = find_feasibility(load_scenario(path, _settings(options)))
    if options.json:
        print(json.dumps({"scenario": path.stem, **found.to_dict()}, indent=2))
    else:
        print(f"{path.stem}\n\n{found}")
    return 2 if found.problems else 0


def _export(options: argparse.Namespace) -> int:
    path = find_scenario(options.scenario)
    loop, context = build_scenario(load_scenario(path, _settings(options)))
    folder = options.out or Path(f"{path.stem}_c99")
    files = export_code(loop, context, path.stem, folder)
    print(f"written to {folder}/: {', '.join(file.name for file in files)}")
    return 0


def _simulate(options: argparse.Namespace) -> int:
    path = find_scenario(options.scenario)
    scenario = load_scenario(path, _settings(options))
    if options.meshcat:
        scenario.integrator.target_realtime_rate = scenario.integrator.target_realtime_rate or 1.0
    meshcat = start_meshcat() if options.meshcat else None
    began = time.perf_counter()
    loop, context = build_scenario(scenario, meshcat)
    simulate_by = _roll if options.rollout else _step
    print(f"{path.stem}: built in {time.perf_counter() - began:.2f} s", flush=True)
    folder = options.out or _unused(f"{path.stem}-{datetime.now():%Y%m%d-%H%M%S}")
    with ending_signals(end_at_once), run_folder(folder):
        save_scenario(scenario, folder / SCENARIO, f"{MARK} {drake_dae.__version__}")
        if meshcat is not None:
            print(f"watch at {meshcat.web_url()}", flush=True)
        return _run(loop, context, scenario, folder, simulate_by)


def _unused(name: str) -> Path:
    """A folder below runs/ that was not there before."""
    runs, number = Path("runs"), 1
    runs.mkdir(exist_ok=True)
    while True:
        folder = runs / (name if number == 1 else f"{name}-{number}")
        try:
            folder.mkdir()
            return folder
        except FileExistsError:
            number += 1


@dataclass
class _Run:
    """A run: what it is of, where it is written, and how it ended."""

    loop: ClosedLoop
    context: Context
    scenario: Scenario
    folder: Path
    writer: RecordWriter
    statistics: RunStatistics | None = None
    failure: str = ""
    pictures: bool = True
    record: Record | None = None


def _step(run: _Run) -> RunStatistics:
    """Runs by Drake's Simulator."""
    return simulate(
        run.loop.diagram,
        run.context,
        run.scenario.duration,
        run.scenario.integrator,
        progress=True,
        after_step=run.writer.update if run.scenario.write.record else None,
    )


def _roll(run: _Run) -> RunStatistics:
    """Runs by `rollout`.

    Raises:
        SimulationError: The run cannot go on.
    """
    scenario, config = run.scenario, run.scenario.integrator
    rows = ROWS
    if not config.use_error_control:
        rows = max(1, ceil(scenario.duration / config.max_step_size - 0.01))
    times = config.start_time + np.linspace(0.0, scenario.duration, rows + 1)
    seeds = [scenario.force.seed] if scenario.force.is_measured else None
    start, parameters = start_values(run.loop, run.context)
    began = time.perf_counter()
    (found,) = rollout(run.loop, start, parameters, times, config=config, seeds=seeds)
    run.record = found.record
    if found.failure is not None:
        raise found.failure
    return RunStatistics(scenario.duration, time.perf_counter() - began, found.steps, None)


def _run(
    loop: ClosedLoop,
    context: Context,
    scenario: Scenario,
    folder: Path,
    simulate_by: Callable[[_Run], RunStatistics],
) -> int:
    """Runs and writes; what was recorded is kept also when the run fails or is interrupted."""
    with RecordWriter(folder / PART, loop.record) as writer:
        run = _Run(loop, context, scenario, folder, writer)
        try:
            run.statistics = simulate_by(run)
        except DrakeDaeError as error:
            run.failure = str(error)
            raise
        except KeyboardInterrupt:
            run.failure, run.pictures = "interrupted in the middle of a step", False
            raise
        finally:
            complete = _write(run)
    if run.statistics.interrupted:
        return 128 + run.statistics.interrupted
    return 0 if complete else 1


def _write(run: _Run) -> bool:
    """Writes the files, prints the summary, and says whether all files are complete."""
    loop, folder, write = run.loop, run.folder, run.scenario.write
    problems: list[str] = []
    # A signal that comes now does not stop before the record is written, but before the pictures.
    with ending_signals(ending := Ending()):
        record = run.record or loop.record(run.context)
        if record.time.size == 0:
            return True
        predicted = loop.predicted_error(record)
        limits = Limits.of(loop.plant.model) if isinstance(loop.plant, RobotPlant) else Limits()
        text = summary(record, predicted, limits, run.statistics, run.failure)
        if write.record:
            with _collected(problems):
                _write_record(record, run)
        with _collected(problems), stage(folder, "summary.txt") as place:
            (place / "summary.txt").write_text(text + "\n", encoding="utf-8")
    try:
        if ending.signal is not None:
            end_at_once(ending.signal)
        if write.plots and run.pictures:
            with _collected(problems), stage(folder, *PLOTS) as place:
                save_plots(record, predicted, limits.control, place)
        if write.animation and run.pictures:
            with _collected(problems), stage(folder, "animation.html") as place:
                page = make_animation(loop, record, run.context)
                (place / "animation.html").write_text(page, encoding="utf-8")
    finally:
        files = [name for name in (*FILES, PART) if (folder / name).exists()]
        with _collected(problems):
            _print(f"{text}\nwritten to {folder}/: {', '.join(files)}", sys.stdout)
        with suppress(OSError):
            _print("".join(f"error: {line}\n" for line in problems), sys.stderr)
    return not problems


def _write_record(record: Record, run: _Run) -> None:
    writer = run.writer
    try:
        with stage(run.folder, "record.npz") as place:
            record.save(place / "record.npz")
    except OSError as error:
        with suppress(OSError):
            writer.finish(run.context)  # Rows that fit are kept.
        with suppress(OSError, ModelError, IndexError):
            kept = Record.load(writer.path).time[-1]
            error.strerror = f"{error.strerror or error}; {PART} has the record up to {kept:.6g} s"
        raise
    writer.path.unlink(missing_ok=True)


def _print(text: str, file: TextIO) -> None:
    """Prints now; what is closed, as a terminal after SIGHUP, gets no second try on exit."""
    try:
        print(text, end="\n" if text and text[-1] != "\n" else "", file=file, flush=True)
    except OSError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), file.fileno())
        raise


@contextmanager
def _collected(problems: list[str]) -> Iterator[None]:
    """Keeps what is wrong with a file for later: the other files are written, and the summary."""
    try:
        yield
    except OSError as error:
        problems.append(_of(error))


def _of(error: OSError) -> str:
    return f"{error.filename or 'output'}: {error.strerror or error}"
