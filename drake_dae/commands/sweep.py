"""`drake-dae sweep`: runs a scenario many times with other values."""

import argparse
import sys
from pathlib import Path

from drake_dae.errors import ModelError
from drake_dae.scenario.files import load_scenario
from drake_dae.scenario.shipped import find_scenario
from drake_dae.studies.study import FILES
from drake_dae.studies.sweep import sweep
from drake_dae.studies.variations import parse_variations


def run_command(options: argparse.Namespace) -> int:
    """Runs the study that the options describe; returns the exit code."""
    path = find_scenario(options.scenario)
    scenario = load_scenario(path, options.settings)
    variations = parse_variations(
        options.vary, scenario, options.random, options.seed, options.together
    )
    folder = options.out or Path("runs") / f"{path.stem}-sweep"
    file = folder / "runs.jsonl"
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
            cluster=options.cluster,
            progress=True,
            rollout=options.rollout,
        )
    except KeyboardInterrupt:
        print(f"runs that have ended are in {file}; the same command continues", file=sys.stderr)
        raise
    files = study.save(folder)
    names = ", ".join([file.name, *(written.name for written in files)])
    print(f"{study}\nwritten to {folder}/: {names}", flush=True)
    return 0
