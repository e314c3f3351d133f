"""`drake-dae keys` and `drake-dae schema`: the keys of a scenario."""

import argparse
import json

from drake_dae.scenario.manual.page import keys_page
from drake_dae.scenario.manual.schema import editor_schema


def run_command(options: argparse.Namespace) -> int:
    """Prints the page of all keys, or the JSON Schema; returns the exit code."""
    print(json.dumps(editor_schema(), indent=1) if options.command == "schema" else keys_page())
    return 0
