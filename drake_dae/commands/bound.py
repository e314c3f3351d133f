"""`drake-dae bound`: bounds the errors of a scenario for ranges of what is not known."""

import argparse
import json

from drake_dae.errors import ScenarioError
from drake_dae.scenario.files import load_scenario, save_scenario
from drake_dae.scenario.shipped import find_scenario
from drake_dae.studies.bounding.bound import bound_errors
from drake_dae.studies.variations import parse_choices


def run_command(options: argparse.Namespace) -> int:
    """Prints the bound for the ranges in the options; returns the exit code."""
    if options.out is not None and options.out.exists():
        text = f"'{options.out}' exists, and is not overwritten; choose another name"
        raise ScenarioError(("--out", text))
    path = find_scenario(options.scenario)
    scenario = load_scenario(path, options.settings)
    found = bound_errors(
        scenario,
        parse_choices(options.vary, scenario),
        after=options.after,
        corners=options.corners,
        seed=options.seed,
        rollout=options.rollout,
    )
    if options.json:
        print(json.dumps({"scenario": path.stem, **found.to_dict()}, indent=2))
    else:
        print(f"{path.stem}\n\n{found}")
    if found.failed:
        return 2
    if options.out is not None:
        save_scenario(found.bounded_scenario, options.out)
        if not options.json:
            print(f"written: {options.out}")
    return 0
