"""`drake-dae plot` and `play`: pictures and animations of recorded runs."""

import argparse
from pathlib import Path

from pydrake.systems.framework import Context

from drake_dae.commands.folder import SCENARIO, load_run, runs_by_name, show
from drake_dae.commands.parser import Parser, waiting
from drake_dae.diagrams.closed_loop import ClosedLoop
from drake_dae.diagrams.record import Record
from drake_dae.errors import ModelError
from drake_dae.files import check_unwritten, complete
from drake_dae.pictures import PLOTS
from drake_dae.scenario.build import build_scenario
from drake_dae.scenario.scenario import load_scenario


def _plot_options(parser: Parser) -> None:
    parser.path("runs", "RUN", "a folder of a run, or a record.npz", nargs="+")
    signals = "what to draw, as wall.force,control (default: all outputs)"
    parser.repeatable("--signals", "NAMES", signals)
    parser.flag("--errors", "|z - r| of outputs, over the predicted one")
    parser.flag("--all", "all plots of each run, into its folder, as write.plots=true does")
    parser.flag(
        "--film",
        "the robot as it moves, with the paths and the forces of its contacts: a .gif, or a .png "
        "for four moments side by side",
    )
    parser.out("FILE", "a .png, .pdf or .svg (default: plot.png), or the film (film.gif)")


def _plot(options: argparse.Namespace) -> int:
    """Draws outputs of runs with their references, or other signals by name, or makes a film.

    Errors are drawn as predicted beside those measured, all runs in one picture.
    """
    runs = runs_by_name(options.runs)
    if options.all or options.film:
        if options.signals or options.errors or (options.all and (options.film or options.out)):
            raise ModelError("--all and --film take no other options, but --film an --out")
        return _plot_all(options, runs) if options.all else _film(options, runs)
    path: Path = options.out or Path("plot.png")
    if path.suffix not in (".png", ".pdf", ".svg"):
        raise ModelError(f"a plot is a .png, .pdf or .svg, got '{path}'")
    check_unwritten([path], options.force)
    names = [name for text in options.signals for name in text.split(",") if name]
    from drake_dae.pictures.plots import plot_runs

    figure = plot_runs({n: load_run(run) for n, run in runs.items()}, names, options.errors)
    with complete(path.parent, path.name) as place:
        figure.savefig(place / path.name, dpi=110)
    print(f"written to {path}")
    return 0


def _plot_all(options: argparse.Namespace, runs: dict[str, Path]) -> int:
    from drake_dae.pictures.plots import save_plots

    check_unwritten((folder / name for folder in runs.values() for name in PLOTS), options.force)
    for folder in runs.values():
        with waiting(f"drawing {folder}"):
            loop, context, record = _run_again(folder)
            save_plots(loop, record, context, folder)
        written = [name for name in PLOTS if (folder / name).exists()]
        print(f"written to {folder}/: {', '.join(written)}")
    return 0


def _film(options: argparse.Namespace, runs: dict[str, Path]) -> int:
    if len(runs) > 1:
        raise ModelError(f"a film is of one run, got {', '.join(runs)}")
    from drake_dae.pictures.film import save_film

    (folder,) = runs.values()
    path: Path = options.out or folder / "film.gif"
    check_unwritten([path], options.force)
    with waiting(f"filming {folder}"):
        loop, context, record = _run_again(folder)
        with complete(path.parent, path.name) as place:
            save_film(loop, record, context, place / path.name)
    print(f"written to {path}")
    return 0


def _run_again(folder: Path) -> tuple[ClosedLoop, Context, Record]:
    """The loop of the run in a folder, a context, and the record of the run."""
    if not (folder / SCENARIO).is_file():
        raise ModelError(f"'{folder}' is no folder of a run: it has no {SCENARIO}")
    record = load_run(folder)
    loop, context = build_scenario(load_scenario(folder / SCENARIO))
    if missing := loop.record(context).signals.keys() - record.signals.keys():
        names = ", ".join(sorted(missing))
        raise ModelError(f"the record in '{folder}' has not the signals of its loop: {names}")
    return loop, context, record


def _play_options(parser: Parser) -> None:
    parser.path("folder", "RUN", "the folder of a run")


def _play(options: argparse.Namespace) -> int:
    """Opens the animation of a run in the browser."""
    show(options.folder)
    return 0


COMMANDS = {"plot": (_plot_options, _plot), "play": (_play_options, _play)}
