"""`drake-dae print`, `keys` and `schema`: a shipped scenario, and the keys of all."""

import argparse
import json

from drake_dae.errors import ScenarioError
from drake_dae.scenario.shipped import find_scenario


def run_command(options: argparse.Namespace) -> int:
    """Prints what the options name; returns the exit code."""
    if options.command == "print":
        print(_scenario(options), end="")
        return 0
    # The keys take most of a second to load.
    from drake_dae.scenario.manual.page import keys_page
    from drake_dae.scenario.manual.schema import editor_schema

    print(json.dumps(editor_schema(), indent=1) if options.command == "schema" else keys_page())
    return 0


def _scenario(options: argparse.Namespace) -> str:
    """The file of the scenario that the options name, or its path.

    Raises:
        ScenarioError: The file cannot be read.
    """
    path = find_scenario(options.scenario)
    if options.path:
        return f"{path}\n"
    try:
        return path.read_text("utf-8")
    except UnicodeDecodeError:
        raise ScenarioError((str(path), "the file is not UTF-8 text; save it as such")) from None
