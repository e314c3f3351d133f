"""`drake-dae print`, `schema`, `cache`: scenarios, their keys, machine code."""

import argparse
import json

from drake_dae.errors import MachineCodeError, ScenarioError
from drake_dae.scenario.shipped import find_scenario


def run_command(options: argparse.Namespace) -> int:
    """Prints what the options name; returns the exit code."""
    if options.command == "print":
        print(_scenario(options), end="")
        return 0
    if options.command == "cache":
        _cache(options.clear)
        return 0
    from drake_dae.scenario.scenario import scenario_schema  # `print` needs no Drake.

    print(json.dumps(scenario_schema(), indent=1))
    return 0


def _scenario(options: argparse.Namespace) -> str:
    """The text of the scenario that the options name, or its path.

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


def _cache(is_cleared: bool) -> None:
    """Prints the size of the cache of machine code, and the compiler; or empties the cache."""
    from drake_dae.trace.cache import cache_folder, clear, contents
    from drake_dae.trace.compiler import find_compiler

    files = contents()
    size = sum(path.stat().st_size for path in files if path.is_file())
    what = f"{len(files)} files, {size / 1e6:.1f} MB"
    if is_cleared:
        clear()
        print(f"removed from {cache_folder()}: {what}")
        return
    print(f"cache     {cache_folder()}: {what}")
    try:
        print(f"compiler  {' '.join(find_compiler().command)}")
    except MachineCodeError as error:
        print(f"compiler  none: {error}")
