"""`drake-dae sweep`: run a scenario many times with other values."""

import argparse
import json
import sys
from collections import Counter
from contextlib import redirect_stdout
from pathlib import Path
from typing import Any

from drake_dae.analysis.tables import count_of
from drake_dae.errors import ModelError
from drake_dae.files import check_folder
from drake_dae.scenario.files import load_scenario
from drake_dae.scenario.shipped import find_scenario

JOURNAL = "runs.db"
"""The name of the file with the results, from which the command continues."""


def run_command(options: argparse.Namespace) -> int:
    """Runs the study that the options describe; returns the exit code."""
    if not options.json:
        return _sweep(options)[0]
    with redirect_stdout(sys.stderr):
        code, report = _sweep(options)
    print(json.dumps(report, indent=2))
    return code


def _sweep(options: argparse.Namespace) -> tuple[int, dict[str, Any]]:
    """Runs the study; returns the exit code, and the results for JSON."""
    # They load SciPy's integrators, which no other command needs.
    from drake_dae.studies.runs import Outcome
    from drake_dae.studies.study import FILES
    from drake_dae.studies.sweep import sweep
    from drake_dae.studies.variations import parse_variations

    path = find_scenario(options.scenario)
    scenario = load_scenario(path, options.settings)
    variations = parse_variations(options.vary, options.random, options.seed, options.together)
    folder = options.out or Path("runs") / f"{path.stem}-sweep"
    check_folder(folder)
    file = folder / JOURNAL
    others = [name for name in FILES if (folder / name).exists()]
    if others and not file.exists():
        raise ModelError(
            f"'{folder}' holds {', '.join(others)}, not from a study; choose another folder"
        )
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
    unfinished = {
        run: result
        for run, result in enumerate(study.results)
        if result.outcome is not Outcome.FINISHED
    }
    report = {
        "scenario": path.stem,
        "folder": str(folder),
        "runs": len(study.results),
        "outcomes": Counter(str(result.outcome) for result in study.results),
        "not_finished": [
            {"run": run, "outcome": str(result.outcome), "reason": result.reason}
            for run, result in unfinished.items()
        ],
        "figures": study.extent(),
        "files": files,
    }
    if again := [str(run) for run, result in unfinished.items() if not result.outcome.is_final]:
        text = f"{count_of(len(again), 'run')} died or took too long; the same command tries again"
        print(f"error: {text}: {', '.join(again[:10])}", file=sys.stderr)
        return 1, report
    return 2 if unfinished and options.check else 0, report
