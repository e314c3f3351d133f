"""The command `drake-dae`."""

import argparse
import json
import logging
import os
import sys
import time
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from datetime import datetime
from pathlib import Path
from tempfile import TemporaryDirectory

from pydrake.systems.framework import Context

import drake_dae
from drake_dae.diagrams.build import build_scenario
from drake_dae.diagrams.closed_loop import ClosedLoop
from drake_dae.diagrams.feasibility import find_feasibility
from drake_dae.diagrams.scenario import (
    DEFAULT_SCENARIO,
    Scenario,
    find_scenario,
    load_scenario,
    save_scenario,
    shipped_scenarios,
)
from drake_dae.errors import DrakeDaeError, NonMinimumPhaseWarning, ScenarioError
from drake_dae.simulation.animation import make_animation
from drake_dae.simulation.plots import PLOTS, save_plots
from drake_dae.simulation.simulate import RunStatistics, simulate
from drake_dae.simulation.summary import Limits, summary
from drake_dae.simulation.view import start_meshcat
from drake_dae.systems.robot_plant import RobotPlant

FILES = ("scenario.yaml", "summary.txt", "record.npz", *PLOTS, "animation.html")
"""What a run leaves in its folder."""

_MARK = "# Scenario as run by drake-dae"
"""Begins the scenario in a run's folder: only such a folder is written to again."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs the command line; returns the exit code.

    0, or 1 for an error, 2 for a problem that `analyze` found (as for wrong usage), 130 after
    Ctrl-C.
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
    run = commands.add_parser("simulate", parents=[named], help="run a scenario")
    run.add_argument(
        "--out", type=Path, help="folder for the results (default: runs/<scenario>-<time>)"
    )
    run.add_argument(
        "--meshcat", action="store_true", help="show the robot while it runs, in a browser"
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
    options = parser.parse_args(arguments)
    # Drake tells where each Meshcat listens, also the one that only records.
    logging.getLogger("drake").setLevel(logging.WARNING)
    try:
        if options.command == "list":
            return _list()
        if options.command == "analyze":
            with _warnings(NonMinimumPhaseWarning):  # The report tells it.
                return _analyze(options)
        with _warnings():
            return _simulate(options)
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
        print(f"error: {error.filename or 'output'}: {error.strerror or error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        return 130


def _list() -> int:
    paths = shipped_scenarios()
    width = max(map(len, paths), default=0)
    for name, path in paths.items():
        print(f"{name.ljust(width)}  {load_scenario(path).description}")
    return 0


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
    found = find_feasibility(load_scenario(path, options.settings))
    if options.json:
        print(json.dumps({"scenario": path.stem, **found.to_dict()}, indent=2))
    else:
        print(f"{path.stem}\n\n{found}")
    return 2 if found.problems else 0


def _simulate(options: argparse.Namespace) -> int:
    path = find_scenario(options.scenario)
    scenario = load_scenario(path, options.settings)
    if options.meshcat:
        scenario.integrator.target_realtime_rate = scenario.integrator.target_realtime_rate or 1.0
    meshcat = start_meshcat() if options.meshcat or scenario.write.animation else None
    began = time.perf_counter()
    loop, context = build_scenario(scenario, meshcat, live=options.meshcat)
    print(f"{path.stem}: built in {time.perf_counter() - began:.2f} s", flush=True)
    folder = _prepare(options.out or _unused(f"{path.stem}-{datetime.now():%Y%m%d-%H%M%S}"))
    save_scenario(scenario, folder / "scenario.yaml", f"{_MARK} {drake_dae.__version__}")
    if options.meshcat and meshcat is not None:
        print(f"watch at {meshcat.web_url()}", flush=True)
    run, failure = None, ""
    try:
        run = simulate(loop.diagram, context, scenario.duration, scenario.integrator, progress=True)
    except DrakeDaeError as error:
        failure = str(error)
        raise
    except KeyboardInterrupt:
        failure = "interrupted in the middle of a step"
        raise
    finally:
        # Also when the run fails or is interrupted: what was recorded is kept.
        _write(loop, context, scenario, folder, run, failure)
    return 130 if run.interrupted else 0


def _unused(name: str) -> Path:
    """A folder below runs/ that is not there yet."""
    folder, number = Path("runs") / name, 1
    while folder.exists():
        number += 1
        folder = Path("runs") / f"{name}-{number}"
    return folder


def _prepare(folder: Path) -> Path:
    """Makes the folder of a run; the files of an earlier one are removed, others never."""
    try:
        if folder.exists() and not folder.is_dir():
            raise ScenarioError(("--out", f"'{folder}' is a file; name a folder"))
        folder.mkdir(parents=True, exist_ok=True)
        present = [folder / name for name in FILES if (folder / name).exists()]
        if present:
            scenario = folder / FILES[0]
            if not (scenario.exists() and scenario.read_text("utf-8").startswith(_MARK)):
                found = ", ".join(file.name for file in present)
                text = f"'{folder}' holds {found}, not from an earlier run; choose another folder"
                raise ScenarioError(("--out", text))
        for file in present:
            file.unlink()
        # A folder that cannot be written to is found now, not at the end of the run.
        (folder / FILES[0]).touch()
    except ScenarioError:
        raise
    except (OSError, ValueError) as error:  # A null byte in the path, text of another encoding.
        reason = getattr(error, "strerror", None) or error
        raise ScenarioError(("--out", f"cannot write to '{folder}': {reason}")) from None
    return folder


def _write(
    loop: ClosedLoop,
    context: Context,
    scenario: Scenario,
    folder: Path,
    run: RunStatistics | None,
    failure: str,
) -> None:
    record = loop.record(context)
    if record.time.size == 0:
        return
    predicted = loop.predicted_error(record)
    limits = Limits.of(loop.plant.model) if isinstance(loop.plant, RobotPlant) else Limits()
    text = summary(record, predicted, limits, run, failure)
    with _stage(folder) as stage:
        (stage / "summary.txt").write_text(text + "\n", encoding="utf-8")
        if scenario.write.record:
            record.save(stage / "record.npz")
    if scenario.write.plots:
        with _stage(folder) as stage:
            save_plots(record, predicted, limits.control, stage)
    if scenario.write.animation:
        with _stage(folder) as stage:
            page = make_animation(loop, record, context)
            (stage / "animation.html").write_text(page, encoding="utf-8")
    files = [name for name in FILES if (folder / name).exists()]
    print(text)
    print(f"written to {folder}/: {', '.join(files)}")


@contextmanager
def _stage(folder: Path) -> Iterator[Path]:
    """A place to write files, which appear in the folder when they are complete."""
    with TemporaryDirectory(prefix=".unfinished-", dir=folder) as stage:
        yield Path(stage)
        for file in Path(stage).iterdir():
            file.replace(folder / file.name)
