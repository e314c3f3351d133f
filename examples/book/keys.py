"""The page of all keys of a scenario, from its JSON Schema."""

import json
import re
from collections.abc import Iterator
from typing import Any

from drake_dae.scenario.scenario import scenario_schema

_HEAD = """# The keys of a scenario

A scenario is a YAML file. `drake-dae print NAME` prints one to begin with, and all wrong keys and
values of a file are reported together. Where several forms fit, a tag chooses one, as in
`surface: !Sphere`; the first in a list of tags is meant without a tag. Keys without a default have
to be given.
"""


def keys_page() -> str:
    """Returns each form of a scenario with its keys, their defaults and meanings."""
    lines = [_HEAD]
    for title, form in forms(scenario_schema()):
        lines += [f"## {title}", "", _first(form["description"]), ""]
        if form["properties"]:
            lines += ["| Key | Takes | Default | Meaning |", "|---|---|---|---|"]
        for name, key in form["properties"].items():
            default = f"`{json.dumps(key['default'])}`" if "default" in key else ""
            cells = f"`{name}`", _takes(key), default, _first(key.get("description", ""))
            lines.append("| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |")
        lines.append("")
    return "\n".join(lines)


def forms(schema: dict[str, Any]) -> Iterator[tuple[str, dict[str, Any]]]:
    """Generates tag or title and schema of each mapping with keys of its own."""
    for form in (schema, *schema["$defs"].values()):
        yield form["title"], form


def _takes(schema: dict[str, Any]) -> str:
    """Returns the values that a schema allows, in words."""
    if "$ref" in schema:
        return f"`{schema['$ref'].rpartition('/')[2].replace('_', '!')}`"
    if "anyOf" in schema:
        return ", ".join(dict.fromkeys(map(_takes, schema["anyOf"])))
    if "const" in schema or "enum" in schema:
        return ", ".join(map(str, schema.get("enum", [schema.get("const")])))
    if "items" in schema:
        return f"list of {_takes(schema['items'])}"
    if isinstance(schema.get("additionalProperties"), dict):
        return f"name: {_takes(schema['additionalProperties'])}"
    kind = schema.get("type", "any")
    return " or ".join(kind) if isinstance(kind, list) else {"null": "nothing"}.get(kind, kind)


def _first(text: str) -> str:
    """Returns the first paragraph of a text, on one line, in the words of YAML."""
    return re.sub(r"\bNone\b", "nothing", " ".join(text.split("\n\n")[0].split()))
