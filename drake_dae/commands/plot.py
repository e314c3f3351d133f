"""`drake-dae plot`, `render` and `diagram`: pictures of recorded runs, and of a loop's blocks."""

import argparse
import sys
from pathlib import Path

from pydrake.systems.framework import Context

from drake_dae.commands.run.files import RunFiles
from drake_dae.commands.run.folder import FILM, SCENARIO, load_run, runs_by_name, stage
from drake_dae.diagrams.closed_loop import ClosedLoop
from drake_dae.errors import ModelError
from drake_dae.files import check_unwritten
from drake_dae.pictures.film import save_film
from drake_dae.pictures.plots import PLOTS
from drake_dae.pictures.runs import plot_runs
from drake_dae.scenario.build import build_scenario
from drake_dae.scenario.files import load_scenario
from drake_dae.scenario.judging import judge_run
from drake_dae.scenario.parts.parts import Write
from drake_dae.scenario.scenario import Scenario
from drake_dae.simulation.records.record import Record

SUFFIXES = (".png", ".pdf", ".svg")


def run_command(options: argparse.Namespace) -> int:
    """Draws or renders what the options name; returns the exit code."""
    if options.command == "plot" and options.all:
        return _plot_all(options)
    path = _render(options) if options.command == "render" else _plot(options)
    print(f"written to {path}")
    return 0


def _render(options: argparse.Namespace) -> Path:
    """Films the run in a folder."""
    folder: Path = options.folder
    path: Path = options.out or folder / FILM
    check_unwritten([path], options.force)
    _, loop, context, record = _run_again(folder)
    with stage(path.parent, path.name) as temporary:
        save_film(loop, record, context, temporary / path.name)
    return path


def _run_again(folder: Path) -> tuple[Scenario, ClosedLoop, Context, Record]:
    """The scenario of the run in a folder, its loop, a context, and the record of the run.

    Raises:
        ModelError: The folder has no scenario or no record.
    """
    if not (folder / SCENARIO).is_file():
        raise ModelError(f"'{folder}' is no folder of a run: it has no {SCENARIO}")
    record = load_run(folder)
    scenario = load_scenario(folder / SCENARIO, [])
    return scenario, *build_scenario(scenario), record


def _plot_all(options: argparse.Namespace) -> int:
    """Draws the plots of runs into their folders; returns the exit code."""
    if options.signals or options.errors or options.out is not None:
        raise ModelError("--all draws all plots of each run, without --signals, --errors or --out")
    problems = []
    folders = list(runs_by_name(options.runs).values())
    check_unwritten((folder / name for folder in folders for name in PLOTS), options.force)
    for folder in folders:
        scenario, loop, context, record = _run_again(folder)
        files, wanted = RunFiles(folder), Write(plots=True, animation=False)
        files.write_pictures(judge_run(scenario, loop, context, record), loop, context, wanted)
        problems += files.problems
        if files.problems:  # Pictures there may be of an earlier time.
            continue
        written = [name for name in PLOTS if (folder / name).exists()]
        print(f"written to {folder}/: {', '.join(written)}")
    for line in problems:
        print(f"error: {line}", file=sys.stderr)
    return 1 if problems else 0


def _plot(options: argparse.Namespace) -> Path:
    """Draws signals of runs over each other."""
    path: Path = options.out or Path("plot.png")
    if path.suffix not in SUFFIXES:
        raise ModelError(f"a plot is a .png, .pdf or .svg, got '{path}'")
    check_unwritten([path], options.force)
    records = {name: load_run(run) for name, run in runs_by_name(options.runs).items()}
    names = [name for text in options.signals for name in text.split(",") if name]
    figure = plot_runs(records, names, options.errors)
    with stage(path.parent, path.name) as temporary:
        figure.savefig(temporary / path.name, dpi=110)
    return path
