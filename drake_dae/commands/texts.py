"""`drake-dae list`, `print` and `schema`: what one reads; the first two load no Drake."""

import argparse
import json

from drake_dae.errors import ScenarioError
from drake_dae.scenario.shipped import description, find_scenario, shipped_scenarios


def list_command(options: argparse.Namespace) -> tuple[int, dict[str, str]]:
    """Lists names and descriptions."""
    found = {name: description(path) for name, path in shipped_scenarios().items()}
    width = max(map(len, found), default=0)
    print(*(f"{name.ljust(width)}  {text}" for name, text in found.items()), sep="\n")
    return 0, found


def print_command(options: argparse.Namespace) -> int:
    """Prints the file of a scenario, or where it is."""
    from drake_dae.files import read_text

    path = find_scenario(options.scenario)
    try:
        print(f"{path}\n" if options.path else read_text(path), end="")
    except UnicodeDecodeError:
        raise ScenarioError((str(path), "the file is not UTF-8 text; save it as such")) from None
    return 0


def schema_command(options: argparse.Namespace) -> int:
    """Prints the JSON Schema."""
    from drake_dae.scenario.scenario import scenario_schema

    print(json.dumps(scenario_schema(), indent=1))
    return 0
