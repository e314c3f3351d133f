"""`drake-dae simulate`: runs a scenario and writes what it leaves into a folder."""

import argparse
import gc
import os
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from datetime import datetime
from math import ceil
from pathlib import Path
from typing import TextIO

import numpy as np
from pydrake.systems.framework import Context

import drake_dae
from drake_dae.diagrams.build import build_scenario
from drake_dae.diagrams.closed_loop import ClosedLoop
from drake_dae.diagrams.scenario import Scenario, load_scenario, save_scenario
from drake_dae.diagrams.shipped import find_scenario
from drake_dae.errors import DrakeDaeError, ModelError, describe_os_error
from drake_dae.simulation.animation import make_animation
from drake_dae.simulation.interruption import Ending, end_at_once, ending_signals
from drake_dae.simulation.plots import PLOTS, save_plots
from drake_dae.simulation.record import Record
from drake_dae.simulation.record_writer import RecordWriter
from drake_dae.simulation.remarks import surface_remarks
from drake_dae.simulation.run_folder import FILES, MARK, PART, SCENARIO, run_folder, stage
from drake_dae.simulation.simulate import RunStatistics, simulate
from drake_dae.simulation.summary import Limits, summary
from drake_dae.simulation.view import RobotBlock, start_meshcat

ROWS = 1000
"""So many rows has the record of a rollout under error control, after the first."""


def run_command(options: argparse.Namespace) -> int:
    """Runs the scenario that the options name; returns the exit code."""
    path = find_scenario(options.scenario)
    scenario = load_scenario(path, options.settings)
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
    from drake_dae.diagrams.rollout.rollout import rollout, start_values

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
        limits = Limits.of(loop.plant.model) if isinstance(loop.plant, RobotBlock) else Limits()
        text = summary(record, predicted, limits, run.statistics, run.failure)
        if isinstance(loop.plant, RobotBlock):
            text = "\n".join([text, *surface_remarks(loop.plant.model, record)])
        if write.record:
            with _collected(problems):
                _write_record(record, run)
        with _collected(problems), stage(folder, "summary.txt") as place:
            (place / "summary.txt").write_text(text + "\n", encoding="utf-8")
    try:
        if ending.signal is not None:
            end_at_once(ending.signal)
        if write.plots and run.pictures:
            with _collected(problems), stage(folder, *PLOTS) as place, _frozen():
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
def _frozen() -> Iterator[None]:
    """Spares what was made up to here the garbage collector, which would look through it all.

    A figure makes so many objects that this takes as long as to draw it.
    """
    gc.freeze()
    try:
        yield
    finally:
        gc.unfreeze()


@contextmanager
def _collected(problems: list[str]) -> Iterator[None]:
    """Keeps what is wrong with a file for later: the other files are written, and the summary."""
    try:
        yield
    except OSError as error:
        problems.append(describe_os_error(error))
