"""`drake-dae export`: writes law, plant and projection of a scenario as C99."""

import argparse
from pathlib import Path

from drake_dae.diagrams.build import build_loop, start_scenario
from drake_dae.diagrams.export.export import export_code
from drake_dae.diagrams.scenario import load_scenario
from drake_dae.diagrams.shipped import find_scenario


def run_command(options: argparse.Namespace) -> int:
    """Writes the code of the scenario that the options name; returns the exit code."""
    path = find_scenario(options.scenario)
    scenario = load_scenario(path, options.settings)
    loop = build_loop(scenario)
    context = start_scenario(scenario, loop)
    folder = options.out or Path(f"{path.stem}_c99")
    files = export_code(loop, context, path.stem, folder)
    print(f"written to {folder}/: {', '.join(file.name for file in files)}")
    return 0
