"""`drake-dae print`, `keys`, `schema`, `explain`, `cache`: scenarios, errors, machine code."""

import argparse
import json

from drake_dae.arrays import unknown_name
from drake_dae.errors import MachineCodeError, ScenarioError
from drake_dae.scenario.manual.remedies import remedies, remedy_section
from drake_dae.scenario.shipped import find_scenario
from drake_dae.trace.cache import cache_folder, clear, contents
from drake_dae.trace.compiler import find_compiler


def run_command(options: argparse.Namespace) -> int:
    """Prints what the options name; returns the exit code."""
    if options.command == "print":
        print(_scenario(options), end="")
        return 0
    if options.command == "cache":
        _cache(options.clear)
        return 0
    if options.command == "explain":
        print(_explained(options.code))
        return 0
    # The keys take most of a second to load.
    from drake_dae.scenario.manual.page import keys_page, named_keys
    from drake_dae.scenario.manual.schema import editor_schema

    if options.command == "schema":
        print(json.dumps(editor_schema(), indent=1))
    else:
        print(named_keys(options.key) if options.key else keys_page())
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


def _explained(code: str) -> str:
    """What to do about the errors of a code; all codes with their titles if it is empty.

    Raises:
        ScenarioError: There is no such code.
    """
    if not code:
        return "\n".join(f"{code}  {remedy.title}" for code, remedy in remedies().items())
    if code.upper() not in remedies():
        raise ScenarioError(("", unknown_name("code", code, remedies())))
    return remedy_section(code.upper())


def _cache(is_cleared: bool) -> None:
    """Prints the size of the cache of machine code, and the compiler; or empties the cache."""
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
