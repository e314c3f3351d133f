"""`drake-dae sweep`: runs a scenario many times with other values."""

import argparse
import sys
from collections import Counter
from pathlib import Path
from typing import Any

from drake_dae.commands.parser import Parser, check_folder
from drake_dae.errors import ModelError
from drake_dae.scenario.scenario import load_scenario
from drake_dae.scenario.shipped import DEFAULT_SCENARIO, find_scenario
from drake_dae.studies.runs import Outcome
from drake_dae.studies.study import FILES
from drake_dae.studies.sweep import sweep
from drake_dae.studies.variations import parse_variations


def _options(parser: Parser) -> None:
    parser.scenario(DEFAULT_SCENARIO)
    parser.repeatable(
        "--vary",
        "KEY=VALUES",
        'what varies, for example "start.errors.tool.z=0..0.05:6" (six even values), '
        '"law.gains.all=[[-4], [-8]]" (these), "plant.parameters.link1.mass=9.5..10.5" with '
        '--random, "plant.parameters.wall.position=[[0.69..0.71, 0, 0]]" likewise, or '
        '"sensors.force.seed=1..20:20"',
        required=True,
    )
    chosen = parser.add_mutually_exclusive_group()
    count: dict[str, Any] = {"type": int, "metavar": "COUNT"}
    random = "number of runs with random values, even in their ranges, instead of a grid"
    chosen.add_argument("--random", **count, help=random)
    together = "the first values of all keys, then the second ones, instead of a grid"
    chosen.add_argument("--together", action="store_true", help=together)
    parser.add_argument("--seed", type=int, default=0, help="of random values (0)")
    parser.flag("--rollout", "as `simulate --rollout` does: many times as fast")
    parser.add_argument("--workers", **count, help="how many processes (default: one per core)")
    parser.add_argument(
        "--time-limit",
        type=float,
        default=3600.0,
        metavar="SECONDS",
        help="how long a run may take by the clock until its process is ended (3600)",
    )
    parser.flag("--check", "exit code 2 if a run did not finish")
    parser.json("print outcomes and figures")
    parser.path("--out", "FOLDER", "folder for the results (default: runs/<scenario>-sweep)")


def _sweep(options: argparse.Namespace) -> tuple[int, dict[str, Any]]:
    """Runs a scenario once for every combination of the values of some keys, on all cores.

    It writes a table and a plot with figures of each run. The same command continues a study that
    was killed, and tries runs again whose process died or was too slow (exit code 1).
    """
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
            scenario,
            variations,
            file,
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


COMMANDS = {"sweep": (_options, _sweep)}
