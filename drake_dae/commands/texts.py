"""`drake-dae print`, `schema`, `cache`: scenarios, their keys, machine code."""

import argparse
import json
from collections.abc import Iterator, Mapping
from typing import Any

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
    print(json.dumps(editor_schema(), indent=1))
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


def editor_schema() -> dict[str, Any]:
    """`scenario_schema` without the entries "_tag", so that editors complete and check keys.

    An editor passes the value after a tag, so any form fits where a tag chooses.
    """
    from drake_dae.scenario.scenario import scenario_schema  # `print` needs no Drake.

    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "$comment": f"Tags, for an editor: {', '.join(custom_tags())}",
        **scenario_schema(tags=False),
        "patternProperties": {"^_": True},
    }


def custom_tags() -> list[str]:
    """All tags, as the YAML language server takes them: "!Sphere mapping"."""
    from drake_dae.scenario.scenario import scenario_schema

    return [f"{tag} mapping" for tag in dict.fromkeys(_tags(scenario_schema()))]


def _tags(schema: Mapping[str, Any]) -> Iterator[str]:
    for value in schema.values():
        for part in value if isinstance(value, list) else [value]:
            if isinstance(part, dict):
                if "_tag" in part:
                    yield part["_tag"]["const"]
                yield from _tags(part)
