"""`drake-dae new`, `analyze`, `sweep`, `page` and `export`: what is made of a scenario."""

import argparse
import shlex
import sys
import time
import warnings
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any

from pydrake.geometry import SceneGraph
from pydrake.systems.framework import Context

from drake_dae.arrays import number_in
from drake_dae.commands.writing import check_folder, complete, open_page, program, waiting
from drake_dae.errors import (
    DrakeDaeError,
    GeometryWarning,
    ModelError,
    RobotFileWarning,
    ScenarioError,
    SimulationError,
)
from drake_dae.files import check_unwritten
from drake_dae.robots import Vector
from drake_dae.running.simulate import simulate
from drake_dae.scenario.build import build_commanded, build_completed, build_scenario
from drake_dae.scenario.judging import find_feasibility, judge_run
from drake_dae.scenario.new import new_scenario
from drake_dae.scenario.robot_file.reading import robot_links
from drake_dae.scenario.scenario import load_scenario
from drake_dae.scenario.shipped import find_scenario
from drake_dae.scenario.start import start_scenario
from drake_dae.studies.study import FILES, Outcome
from drake_dae.studies.sweep import sweep
from drake_dae.studies.variations import parse_variations

_CHECKED, _COMPARED = 20.0, 2.0
"""The processor time in s after which a new scenario is no longer checked, and the longest run in s
to which exported code is compared."""


def new_command(options: argparse.Namespace) -> int:
    """Writes a scenario for a robot, and checks it by a run."""
    out = options.out or Path(f"{Path(options.robot).name.split('.')[0]}_{options.surface}.yaml")
    check_unwritten([out], options.force)
    if out.exists() and Path(options.robot).exists() and out.samefile(options.robot):
        raise ModelError(f"'{out}' is the robot's own file; name another file for the scenario")
    began, end = time.perf_counter(), time.process_time() + _CHECKED

    def tell(text: str) -> None:
        print(f"{time.perf_counter() - began:4.1f} s: {text}", file=sys.stderr, flush=True)

    def look(context: Context) -> None:
        if time.process_time() > end:
            now = context.get_time()
            text = f"not to its end: the run takes long, and came to {now:.3g} s without a fault"
            raise SimulationError(text, now, [])

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", GeometryWarning)
        tip, point = _tip(options.tip)
        _, text = new_scenario(options.robot, options.surface, tip, point, out.parent, tell)
        out.write_text(text, encoding="utf-8")
        print(f"written: {out}", flush=True)
        tell("checking it by a run")
        warnings.simplefilter("ignore", RobotFileWarning)  # It has been told.
        try:
            scenario = load_scenario(out)
            robot = robot_links(scenario.robot, SceneGraph(), drawn=False)
            completed, loop = build_completed(scenario, robot=robot)
            scenario, context = completed.scenario, start_scenario(completed.scenario, loop)
            # The first round: the second repeats it.
            half = replace(scenario, duration=scenario.duration / 2)
            run = simulate(loop.diagram, context, half.duration, half.integrator, look=look)
            verdict = str(judge_run(half, loop, context, loop.record(context), run))
        except DrakeDaeError as error:
            verdict = str(error)
    print(f"checked: {verdict}\nnow run: {program()} simulate {shlex.quote(str(out))}")
    return 0 if verdict.startswith("GOOD") else 2


def _tip(text: str) -> tuple[str, Vector]:
    """The frame and the point in a text "LINK" or "LINK:x,y,z"."""
    if "," not in text:
        return text, (0.0, 0.0, 0.0)
    frame, _, numbers = text.rpartition(":")
    point = [number for word in numbers.split(",") if (number := number_in(word)) is not None]
    if not frame or not numbers.count(",") + 1 == len(point) == 3:
        form = "LINK or LINK:x,y,z with three numbers in m"
        raise ScenarioError(("--tip", f"expected {form}, got '{text}'"))
    return frame, (point[0], point[1], point[2])


def analyze_command(options: argparse.Namespace) -> tuple[int, dict[str, Any]]:
    """Tells what the theory says of a scenario."""
    path = find_scenario(options.scenario)
    with waiting(f"analyzing {path.stem}"):
        report = find_feasibility(load_scenario(path, options.settings))
    if not options.json:
        print(f"{path.stem}\n\n{report}")
    return 2 if report.problems else 0, {"scenario": path.stem, **report.to_dict()}


def sweep_command(options: argparse.Namespace) -> tuple[int, dict[str, Any]]:
    """Runs a study, or what is left of it."""
    path = find_scenario(options.scenario)
    scenario = load_scenario(path, options.settings)
    variations = parse_variations(options.vary, options.random, options.seed, options.together)
    folder = options.out or Path("runs") / f"{path.stem}-sweep"
    check_folder(folder)
    file = folder / "runs.db"
    others = [name for name in FILES if (folder / name).exists()]
    if others and not file.exists():
        names = ", ".join(others)
        raise ModelError(f"'{folder}' holds {names}, not from a study; choose another folder")
    try:
        study = sweep(
            *(scenario, variations, file),
            workers=options.workers,
            progress=True,
            rollout=options.rollout,
            time_limit=options.time_limit,
        )
    except KeyboardInterrupt:
        print(f"runs that have ended are in {file}; the same command continues", file=sys.stderr)
        raise
    files = [file.name, *(written.name for written in study.save(folder))]
    print(f"{study}\nwritten to {folder}/: {', '.join(files)}", flush=True)
    missing = {n: r for n, r in enumerate(study.results) if r.outcome is not Outcome.FINISHED}
    report = {
        "scenario": path.stem,
        "folder": str(folder),
        "runs": len(study.results),
        "outcomes": Counter(str(result.outcome) for result in study.results),
        "not_finished": [
            {"run": run, "outcome": str(result.outcome), "reason": result.reason}
            for run, result in missing.items()
        ],
        "figures": study.extent(),
        "files": files,
    }
    if again := [str(run) for run, result in missing.items() if not result.outcome.is_final]:
        text = "died or took too long; the same command tries again"
        print(f"error: runs {', '.join(again[:10])} {text}", file=sys.stderr)
        return 1, report
    return 2 if missing and options.check else 0, report


def page_command(options: argparse.Namespace) -> int:
    """Compiles a scenario into a page."""
    from drake_dae.pictures.page import write_page

    path = find_scenario(options.scenario)
    scenario = load_scenario(path, options.settings)
    file = options.out or Path(f"{path.stem}.html")
    check_unwritten([file], options.force)
    print(f"compiling {path.stem} for a page; the first page on a machine takes longer", flush=True)
    with waiting(f"compiling {path.stem}"):
        built = build_commanded(scenario)
        title, notes = scenario.description or path.stem, built.left_out
        try:
            write_page(built.loop, built.context, file, None, title, notes)
        except ModelError as error:
            raise ModelError(f"{path.stem} cannot be a page: {error}") from error
    told = f"written: {file} ({file.stat().st_size / 1e6:.2f} MB)"
    print(told, *(f"not in it: {note}" for note in notes), sep="\n")
    if options.open:
        open_page(file)
    return 0


def export_command(options: argparse.Namespace) -> int:
    """Writes the controller and the whole loop as C99, as far as that can be."""
    from drake_dae.running.export import export_controller, export_loop

    path = find_scenario(options.scenario)
    folder = options.out or Path(f"{path.stem}_c99")
    check_folder(folder)
    scenario, files, missing = load_scenario(path, options.settings), list[Path](), list[str]()
    with waiting(f"exporting {path.stem}"), complete(folder) as place:
        made = *build_scenario(scenario), path.stem, place
        for what, export in {"controller": export_controller, "loop": export_loop}.items():
            try:
                files += export(*made, scenario.integrator, min(scenario.duration, _COMPARED))
            except ModelError as error:
                missing.append(f"the {what}: {error}")
        if not files:
            raise ModelError(f"{path.stem} cannot be exported; {'; '.join(missing)}")
        names = list(dict.fromkeys(file.name for file in files))
        check_unwritten((folder / name for name in names), options.force)
    print(f"written to {folder}/: {', '.join(names)}")
    for reason in missing:
        print(f"not among them: {reason}")
    return 0
