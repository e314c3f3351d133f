"""`drake-dae show`: prints a scenario file."""

import argparse

from drake_dae.errors import ScenarioError
from drake_dae.scenario.shipped import find_scenario


def run_command(options: argparse.Namespace) -> int:
    """Prints the file of the scenario that the options name, or its path.

    Raises:
        ScenarioError: The file cannot be read.
    """
    path = find_scenario(options.scenario)
    if options.path:
        print(path)
        return 0
    try:
        print(path.read_text("utf-8"), end="")
    except UnicodeDecodeError:
        raise ScenarioError((str(path), "the file is not UTF-8 text; save it as such")) from None
    return 0
