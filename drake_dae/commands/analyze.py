"""`drake-dae analyze`: examines a scenario without running it."""

import argparse
import json

from drake_dae.scenario.feasibility.feasibility import find_feasibility
from drake_dae.scenario.files import load_scenario
from drake_dae.scenario.shipped import find_scenario


def run_command(options: argparse.Namespace) -> int:
    """Prints the report on the scenario that the options name; returns the exit code."""
    path = find_scenario(options.scenario)
    report = find_feasibility(load_scenario(path, options.settings))
    if options.json:
        print(json.dumps({"scenario": path.stem, **report.to_dict()}, indent=2))
    else:
        print(f"{path.stem}\n\n{report}")
    return 2 if report.problems else 0
