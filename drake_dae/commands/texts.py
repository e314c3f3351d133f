"""`drake-dae list`, `print`, `schema`: what one reads; the first two load no Drake."""

import argparse
import json

from drake_dae.commands.parser import Parser
from drake_dae.errors import ScenarioError
from drake_dae.scenario.shipped import (
    DEFAULT_SCENARIO,
    description,
    find_scenario,
    shipped_scenarios,
)


def _list_options(parser: Parser) -> None:
    parser.json("print names and descriptions")


def _list(options: argparse.Namespace) -> tuple[int, dict[str, str]]:
    """Lists the shipped scenarios."""
    found = {name: description(path) for name, path in shipped_scenarios().items()}
    width = max(map(len, found), default=0)
    print(*(f"{name.ljust(width)}  {text}" for name, text in found.items()), sep="\n")
    return 0, found


def _print_options(parser: Parser) -> None:
    parser.add_argument("scenario", nargs="?", default=DEFAULT_SCENARIO, help="which one")
    parser.flag("--path", "print where its file is instead")


def _print(options: argparse.Namespace) -> int:
    """Prints a shipped scenario with its comments, as the beginning of your own."""
    from drake_dae.files import read_text

    path = find_scenario(options.scenario)
    try:
        print(f"{path}\n" if options.path else read_text(path), end="")
    except UnicodeDecodeError:
        raise ScenarioError((str(path), "the file is not UTF-8 text; save it as such")) from None
    return 0


def _schema(options: argparse.Namespace) -> int:
    """Prints the JSON Schema of a scenario, by which editors complete and check keys."""
    from drake_dae.scenario.scenario import scenario_schema

    print(json.dumps(scenario_schema(), indent=1))
    return 0


COMMANDS = {
    "list": (_list_options, _list),
    "print": (_print_options, _print),
    "schema": (lambda parser: None, _schema),
}
