"""`drake-dae new`, `analyze`, `page` and `export`: what is made of a robot or a scenario."""

import argparse
import logging
import shlex
import sys
import time
import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any

from pydrake.systems.framework import Context

from drake_dae.arrays import number_in
from drake_dae.commands.parser import (
    Parser,
    check_folder,
    complete,
    open_page,
    program,
    waiting,
)
from drake_dae.errors import (
    DrakeDaeError,
    GeometryWarning,
    ModelError,
    ScenarioError,
    SimulationError,
)
from drake_dae.files import check_unwritten
from drake_dae.robots import Vector
from drake_dae.running.simulate import simulate
from drake_dae.scenario.build import build_completed, build_scenario
from drake_dae.scenario.judging import find_feasibility, judge_run
from drake_dae.scenario.new import placed_scenario
from drake_dae.scenario.robot_file.reading import RobotLinks
from drake_dae.scenario.scenario import Scenario, load_scenario
from drake_dae.scenario.shipped import DEFAULT_SCENARIO, find_scenario
from drake_dae.scenario.start import start_scenario

_LONGEST = 20.0
"""The processor time in s after which a new scenario is no longer checked."""


def _new_options(parser: Parser) -> None:
    parser.add_argument("robot", help="a URDF, SDFormat, MJCF or model-directives file")
    surfaces = ("plane", "cylinder", "sphere")
    parser.add_argument(
        "--surface", choices=surfaces, default="plane", help="the surface (default: plane)"
    )
    parser.add_argument(
        "--tip",
        default="",
        metavar="LINK[:x,y,z]",
        help="the link or frame in contact, and the contact point in it in m (default: the end of "
        "the longest chain)",
    )
    parser.out("FILE", "the file (default: <robot>_<surface>.yaml)")


def _new(options: argparse.Namespace) -> int:
    """Writes a scenario for a robot of which only the file is known.

    It finds base, chain and tip, locks grippers and wheels, places a surface within good reach of
    the tip, and makes the tip circle and press there within the limits. Comments give the reasons.
    A run checks it: the exit code is 0 if that is GOOD, and 2 otherwise.
    """
    out = options.out or Path(f"{Path(options.robot).name.split('.')[0]}_{options.surface}.yaml")
    check_unwritten([out], options.force)
    if out.exists() and Path(options.robot).exists() and out.samefile(options.robot):
        raise ModelError(f"'{out}' is the robot's own file; name another file for the scenario")
    # The simulation reports what it leaves out, and Drake's parser warns of every tag.
    logging.getLogger("drake").setLevel(logging.ERROR)
    began, used = time.perf_counter(), time.process_time()

    def tell(text: str) -> None:
        print(f"{time.perf_counter() - began:4.1f} s: {text}", file=sys.stderr, flush=True)

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", GeometryWarning)
        tip, point = _tip(options.tip)
        where = options.robot, options.surface, tip, point, out.parent
        _, text, robot = placed_scenario(*where, tell)
        out.write_text(text, encoding="utf-8")
        print(f"written: {out}", flush=True)
        tell("checking it by a run")
        verdict = _check(load_scenario(out), robot, used + _LONGEST)
    print(f"checked: {verdict}\nnow run: {program()} simulate {shlex.quote(str(out))}")
    return 0 if verdict.startswith("GOOD") else 2


def _check(scenario: Scenario, robot: RobotLinks, end: float) -> str:
    """The verdict of a run of a new scenario, or why there is none up to an end."""

    def look(context: Context) -> None:
        if time.process_time() > end:
            now = context.get_time()
            text = f"not to its end: the run takes long, and came to {now:.3g} s without a fault"
            raise SimulationError(text, now, [])

    try:
        completed, loop = build_completed(scenario, robot=robot)
        context = start_scenario(completed.scenario, loop)
        # The first round: the second repeats it.
        half = replace(completed.scenario, duration=scenario.duration / 2)
        run = simulate(loop.diagram, context, half.duration, half.integrator, look=look)
        summary = judge_run(half, loop, context, loop.record(context), run)
    except DrakeDaeError as error:
        return str(error)
    return str(summary.judgement)


def _tip(text: str) -> tuple[str, Vector]:
    """The frame and the point in a text "LINK" or "LINK:x,y,z"."""
    frame, comma, y_and_z = text.partition(",")
    if not comma:
        return text, (0.0, 0.0, 0.0)
    frame, _, x = frame.rpartition(":")
    words = x, *y_and_z.split(",")
    point = [number for word in words if (number := number_in(word)) is not None]
    if not frame or not len(words) == len(point) == 3:
        form = "LINK or LINK:x,y,z with three numbers in m"
        raise ScenarioError(("--tip", f"expected {form}, got '{text}'"))
    return frame, (point[0], point[1], point[2])


def _analyze_options(parser: Parser) -> None:
    parser.scenario(DEFAULT_SCENARIO)
    parser.json("print the report")
    parser.epilog = "exit code: 0, or 2 if a problem was found (the lines PROBLEM)"


def _analyze(options: argparse.Namespace) -> tuple[int, dict[str, Any]]:
    """Examines the robot of a scenario and what its reference takes.

    Of the robot: relative degrees, index, Assumptions (1)-(5), zero dynamics. Of the reference: the
    nearest singularity, control and joint forces against their limits, contact forces, joint
    limits, and when it leaves what the robot can reach.
    """
    path = find_scenario(options.scenario)
    with waiting(f"analyzing {path.stem}"):
        report = find_feasibility(load_scenario(path, options.settings))
    if not options.json:
        print(f"{path.stem}\n\n{report}")
    return 2 if report.problems else 0, {"scenario": path.stem, **report.to_dict()}


LONGEST = 2.0
"""The longest run to which exported code is compared, in s."""


def _page_options(parser: Parser) -> None:
    parser.scenario(DEFAULT_SCENARIO)
    parser.out("FILE", "the page (default: <scenario>.html)")
    parser.flag("--open", "open the page in a browser")


def _page(options: argparse.Namespace) -> int:
    """Writes a scenario as one HTML file in which it runs, without server and network.

    There are sliders, a target and surfaces that are dragged, links that are pushed, and plots of
    force and error with the prediction. It needs zig: pip install ziglang.
    """
    from drake_dae.pictures.page.page import write_page
    from drake_dae.scenario.rolled import build_commanded

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


def _export_options(parser: Parser) -> None:
    parser.scenario(DEFAULT_SCENARIO)
    parser.out("FOLDER", "folder for the files (default: <scenario>_c99)")


def _export(options: argparse.Namespace) -> int:
    """Writes a scenario as plain C99: the whole loop, and its sampled controller as one step.

    There are no dependencies; sizes, names and units stand in the code. `make` in the folder
    compiles programs that compare with runs of Drake's Simulator.
    """
    from drake_dae.running.export.controller import export_controller
    from drake_dae.running.export.loop import export_loop

    path = find_scenario(options.scenario)
    folder = options.out or Path(f"{path.stem}_c99")
    check_folder(folder)
    scenario, files, missing = load_scenario(path, options.settings), list[Path](), list[str]()
    with waiting(f"exporting {path.stem}"), complete(folder) as place:
        made = *build_scenario(scenario), path.stem, place
        for what, export in {"controller": export_controller, "loop": export_loop}.items():
            try:
                files += export(*made, scenario.integrator, min(scenario.duration, LONGEST))
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


COMMANDS = {
    "new": (_new_options, _new),
    "analyze": (_analyze_options, _analyze),
    "page": (_page_options, _page),
    "export": (_export_options, _export),
}
