"""`drake-dae simulate`, `plot` and `play`: runs, and pictures of the folders that they leave."""

import argparse
import shlex
import sys
import time
from contextlib import suppress
from dataclasses import replace
from datetime import datetime
from functools import partial
from itertools import count
from pathlib import Path
from typing import Any

from pydrake.systems.framework import Context

import drake_dae
from drake_dae.commands.writing import check_folder, complete, open_page, program, waiting
from drake_dae.diagrams.closed_loop import ClosedLoop
from drake_dae.diagrams.record import Record, RecordAfter, Recorded
from drake_dae.errors import ModelError, ScenarioError
from drake_dae.files import check_unwritten
from drake_dae.pictures import ANIMATION, PLOTS
from drake_dae.pictures.animation import make_animation
from drake_dae.running.interruption import Interruption, end_at_once, ending_signals
from drake_dae.running.judgement import RunStatistics
from drake_dae.running.simulate import simulate
from drake_dae.scenario.build import build_completed, build_scenario, for_rollout, roll_scenario
from drake_dae.scenario.judging import judge_run
from drake_dae.scenario.scenario import load_scenario, save_scenario, scenario_data
from drake_dae.scenario.shipped import find_scenario
from drake_dae.scenario.start import start_scenario
from drake_dae.scene.view import start_meshcat

SCENARIO, SUMMARY, RECORD = "scenario.yaml", "summary.txt", "record.npz"
FILES = (SCENARIO, SUMMARY, RECORD, *PLOTS, ANIMATION)
"""The files of a run in its folder."""


def simulate_command(options: argparse.Namespace) -> tuple[int, dict[str, Any]]:
    """Runs a scenario into a folder of its own."""
    # The scenario, and whether its files may be written.
    path = find_scenario(options.scenario)
    scenario, remarks = load_scenario(path, options.settings), list[str]()
    if options.open and not scenario.write.animation:
        text = "--open shows the animation, so write.animation must be true"
        raise ScenarioError(("write.animation", text))
    if options.rollout and options.meshcat:
        raise ScenarioError(("--meshcat", "leave it out: --rollout shows nothing while it runs"))
    if options.out is not None:
        check_folder(options.out)
        check_unwritten((options.out / name for name in FILES), options.force)

    # The loop at its start.
    began = time.perf_counter()
    if options.rollout:
        scenario, *remarks = for_rollout(scenario)
    if options.meshcat:
        rate = scenario.integrator.target_realtime_rate
        scenario.integrator.target_realtime_rate = rate or 1.0
    meshcat = start_meshcat() if options.meshcat else None
    with waiting(f"building {path.stem}"):
        completed, loop = build_completed(scenario, meshcat)
        scenario, context = completed.scenario, start_scenario(completed.scenario, loop)
    notes = [*completed.notes, *filter(None, remarks)]
    took = f"{path.stem}: built in {time.perf_counter() - began:.2f} s"
    print(took, *notes, sep="\n", flush=True)

    # The folder, and on a terminal somebody who looks.
    folder = options.out or _new_folder(f"{path.stem}-{datetime.now():%Y%m%d-%H%M%S}")
    folder.mkdir(parents=True, exist_ok=True)
    for name in FILES:
        (folder / name).unlink(missing_ok=True)
    first_line = f"# Scenario as run by drake-dae {drake_dae.__version__}"
    save_scenario(scenario, folder / SCENARIO, first_line)
    is_watched = meshcat is not None and sys.stdin is not None and sys.stdin.isatty()
    if meshcat is not None:
        waits = "; the run begins when this page is open" * is_watched
        print(f"watch at {meshcat.web_url()}{waits}", flush=True)
        while is_watched and not meshcat.GetNumActiveConnections():
            time.sleep(0.1)

    # The run.
    recorded: RecordAfter = partial(loop.record, context)
    statistics, ended, reason = None, None, ""

    def see(record: RecordAfter) -> bool:
        nonlocal recorded
        recorded = record
        return ending.signal is not None

    try:
        if options.rollout:
            began = time.perf_counter()
            with ending_signals(ending := Interruption()), waiting("rolling out"):
                rollout = roll_scenario(scenario, loop, context, look=see)
            see(rollout.record.after)
            if rollout.failure is not None:
                raise rollout.failure
            times, wall = rollout.record.time, time.perf_counter() - began
            simulated = float(times[-1] - times[0]) if times.size else 0.0
            statistics = RunStatistics(simulated, wall, rollout.steps, ending.signal)
        else:
            arguments = loop.diagram, context, scenario.duration, scenario.integrator
            statistics = simulate(*arguments, True, scenario.judgement.may_diverge)
    except BaseException as error:  # It is raised when the files of what was simulated are written.
        is_cut = isinstance(error, KeyboardInterrupt)
        ended, reason = error, "interrupted in the middle of a step" if is_cut else str(error)

    # Its files. A signal from here on takes effect between the record and the pictures.
    record, wanted = recorded(None), scenario.write
    summary, results = None, dict[str, Any]()
    if record.time.size:
        try:
            with ending_signals(ending := Interruption()):
                summary = judge_run(scenario, loop, context, record, statistics, reason)
                if wanted.record:
                    outputs = record.signals["tracking_error"].signals
                    predicted = Recorded(loop.predicted_error(record), outputs)
                    signals = {**record.signals, "predicted_error": predicted}
                    about = {"scenario": scenario_data(scenario)}
                    with complete(folder, RECORD) as place:
                        replace(record, signals=signals, about=about).save(place / RECORD)
                with complete(folder, SUMMARY) as place:
                    text = "\n".join([summary.text, *notes, ""])
                    (place / SUMMARY).write_text(text, encoding="utf-8")
            if ending.signal is not None:
                end_at_once(ending.signal)
            with waiting("drawing"):
                if wanted.plots and not isinstance(ended, KeyboardInterrupt):
                    from drake_dae.pictures.plots import save_plots  # Matplotlib takes a second.

                    with complete(folder, PLOTS[0]) as place:
                        save_plots(loop, record, context, place)
                if wanted.animation and not isinstance(ended, KeyboardInterrupt):
                    title = f"{path.stem}: {scenario.description}".removesuffix(": ")
                    with complete(folder, ANIMATION) as place:
                        page = make_animation(loop, record, context, title)
                        (place / ANIMATION).write_text(page, encoding="utf-8")
        finally:
            written = [name for name in FILES if (folder / name).exists()]
            if summary is not None:  # Else it could not be judged.
                results = {**summary.data, "files": written}
                print(f"{summary.text}\nwritten to {folder}/: {', '.join(written)}", flush=True)
            if ANIMATION in written:
                named = shlex.quote(str(folder))
                plots = "" if wanted.plots else f"; plots: {program()} plot {named} --all"
                print(f"watch it: {program()} play {named}{plots}", flush=True)

    # How it ended.
    if ended is not None:
        raise ended
    if is_watched:
        input("the view stays until you press Enter")
    if options.open and (folder / ANIMATION).is_file():
        open_page(folder / ANIMATION)
    assert statistics is not None
    cut = 128 + statistics.interrupted if statistics.interrupted else 0
    code = 2 if options.check and results.get("missed") else 0
    return cut or code, {"scenario": path.stem, "folder": str(folder), **results}


def _new_folder(name: str) -> Path:
    """Makes a folder below runs/ that no other run has, also none that begins at this moment."""
    for i in count(1):
        folder = Path("runs", name if i == 1 else f"{name}-{i}")
        with suppress(FileExistsError):
            folder.mkdir(parents=True)
            break
    return folder


def plot_command(options: argparse.Namespace) -> int:
    """Draws signals of runs, or all plots of each, or a film."""
    from drake_dae.pictures.film import save_film
    from drake_dae.pictures.plots import plot_runs, save_plots

    runs, is_film = options.runs, options.film
    if len({*runs}) < len(runs):
        raise ModelError(f"each run is named once, got {', '.join(map(str, runs))}")
    more = options.signals or options.errors or (options.all and (is_film or options.out))
    if (options.all or is_film) and more:
        raise ModelError("--all and --film take no other options, but --film an --out")
    if options.all:
        check_unwritten((folder / name for folder in runs for name in PLOTS), options.force)
        for folder in runs:
            with waiting(f"drawing {folder}"):
                again = _run_again(folder)
                with complete(folder, PLOTS[0]) as place:
                    save_plots(*again, place)
            written = [name for name in PLOTS if (folder / name).exists()]
            print(f"written to {folder}/: {', '.join(written)}")
        return 0
    if is_film and len(runs) > 1:
        raise ModelError(f"a film is of one run, got {', '.join(map(str, runs))}")
    path = options.out or (runs[0] / "film.gif" if is_film else Path("plot.png"))
    if not is_film and path.suffix not in (".png", ".pdf", ".svg"):
        raise ModelError(f"a plot is a .png, .pdf or .svg, got '{path}'")
    check_unwritten([path], options.force)
    with waiting(f"drawing {path.name}"):
        if is_film:
            draw = partial(save_film, *_run_again(runs[0]))
        else:
            records = {str(run): _load_record(run) for run in runs}
            names = [name for text in options.signals for name in text.split(",") if name]
            draw = partial(plot_runs(records, names, options.errors).savefig, dpi=110)
        with complete(path.parent, path.name) as place:
            draw(place / path.name)
    print(f"written to {path}")
    return 0


def _load_record(path: Path) -> Record:
    """The record of a run: of its folder, or a file."""
    record = Record.load(path / RECORD if path.is_dir() else path)
    if not record.time.size:
        raise ModelError(f"the record in '{path}' has no rows")
    return record


def _run_again(folder: Path) -> tuple[ClosedLoop, Record, Context]:
    """The loop of the run in a folder, the record of the run, and a context."""
    record = _load_record(folder)
    loop, context = build_scenario(load_scenario(folder / SCENARIO))
    if missing := loop.record(context).signals.keys() - record.signals.keys():
        names = ", ".join(sorted(missing))
        raise ModelError(f"the record in '{folder}' has not the signals of its loop: {names}")
    return loop, record, context


def play_command(options: argparse.Namespace) -> int:
    """Opens the animation of a run in the browser."""
    folder, page = options.folder, options.folder / ANIMATION
    if not (folder / SCENARIO).is_file():
        raise ModelError(f"'{folder}' is no folder of a run")
    if not page.is_file():
        raise ModelError(
            f"'{folder}' has no {ANIMATION}: a run writes it at its end, unless write.animation is "
            f"false; `{program()} simulate {folder / SCENARIO}` repeats the run"
        )
    open_page(page)
    return 0
