"""`drake-dae sweep`: runs a scenario many times with other values."""

import argparse
import sys
from collections import Counter
from pathlib import Path
from typing import Any

from drake_dae.commands.writing import check_folder
from drake_dae.errors import ModelError
from drake_dae.scenario.scenario import load_scenario
from drake_dae.scenario.shipped import find_scenario
from drake_dae.studies.runs import Outcome
from drake_dae.studies.study import FILES
from drake_dae.studies.sweep import sweep
from drake_dae.studies.variations import parse_variations


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
