"""`drake-dae plot`, `render` and `diagram`: pictures of recorded runs, and of a loop's blocks."""

import argparse
from pathlib import Path

from drake_dae.commands.run.folder import FILM, SCENARIO, load_run, runs_by_name, stage
from drake_dae.errors import ModelError
from drake_dae.pictures.diagram import save_diagram
from drake_dae.pictures.film import save_film
from drake_dae.pictures.runs import plot_runs
from drake_dae.scenario.build import build_scenario
from drake_dae.scenario.files import load_scenario
from drake_dae.scenario.shipped import find_scenario

SUFFIXES = (".png", ".pdf", ".svg")


def run_command(options: argparse.Namespace) -> int:
    """Draws or renders what the options name; returns the exit code."""
    draw = {"render": _render, "plot": _plot, "diagram": _diagram}[options.command]
    path = draw(options)
    print(f"written to {path}")
    return 0


def _render(options: argparse.Namespace) -> Path:
    """Films the run in a folder."""
    folder: Path = options.folder
    if not (folder / SCENARIO).is_file():
        raise ModelError(f"'{folder}' is no folder of a run: it has no {SCENARIO}")
    record = load_run(folder)
    loop, context = build_scenario(load_scenario(folder / SCENARIO, []))
    path: Path = options.out or folder / FILM
    with stage(path.parent, path.name) as temporary:
        save_film(loop, record, context, temporary / path.name)
    return path


def _diagram(options: argparse.Namespace) -> Path:
    """Draws the blocks of a scenario's loop and their wires."""
    file = find_scenario(options.scenario)
    path: Path = options.out or Path(f"{file.stem}.svg")
    loop, _ = build_scenario(load_scenario(file, options.settings))
    with stage(path.parent, path.name) as temporary:
        save_diagram(loop.diagram, temporary / path.name)
    return path


def _plot(options: argparse.Namespace) -> Path:
    """Draws signals of runs over each other."""
    path: Path = options.out
    if path.suffix not in SUFFIXES:
        raise ModelError(f"a plot is a .png, .pdf or .svg, got '{path}'")
    records = {name: load_run(run) for name, run in runs_by_name(options.runs).items()}
    names = [name for text in options.signals for name in text.split(",") if name]
    figure = plot_runs(records, names, options.errors)
    with stage(path.parent, path.name) as temporary:
        figure.savefig(temporary / path.name, dpi=110)
    return path
