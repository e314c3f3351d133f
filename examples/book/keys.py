"""The page of all keys of a scenario, from its JSON Schema."""

import json
import re
from collections.abc import Iterator
from typing import Any

from drake_dae.scenario.forms.typed_yaml import TAG
from drake_dae.scenario.scenario import scenario_schema

_HEAD = """# The keys of a scenario

A scenario is a YAML file. `drake-dae print NAME` prints one to begin with, and all wrong keys and
values of a file are reported together. Where several forms fit, a tag chooses one, as in
`surface: !Sphere`; the first in a list of tags is meant without a tag. Keys without a default have
to be given.
"""


def keys_page() -> str:
    """Returns each form of a scenario with its keys, their defaults and meanings."""
    lines, seen = [_HEAD], set[str]()
    for title, form in forms(scenario_schema()):
        if title in seen:
            continue
        seen.add(title)
        lines += [f"## {title}", "", _first(form["description"]), ""]
        keys = {name: key for name, key in form["properties"].items() if name != TAG}
        if keys:
            lines += ["| Key | Takes | Default | Meaning |", "|---|---|---|---|"]
        for name, key in keys.items():
            default = f"`{json.dumps(key['default'])}`" if "default" in key else ""
            cells = f"`{name}`", _takes(key), default, _first(key.get("description", ""))
            lines.append("| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |")
        lines.append("")
    return "\n".join(lines)


def forms(schema: Any) -> Iterator[tuple[str, dict[str, Any]]]:
    """Generates tag or title and schema of each mapping with keys of its own, in order."""
    if isinstance(schema, list):
        for part in schema:
            yield from forms(part)
    elif isinstance(schema, dict):
        if isinstance(schema.get("properties"), dict):
            tag = schema["properties"].get(TAG, {}).get("const")
            yield tag or schema["title"], schema
        for value in schema.values():
            yield from forms(value)


def _takes(schema: dict[str, Any]) -> str:
    """Returns the values that a schema allows, in words."""
    for choice in ("oneOf", "anyOf"):
        if choice in schema:
            return ", ".join(dict.fromkeys(map(_takes, schema[choice])))
    if "const" in schema or "enum" in schema:
        return ", ".join(map(str, schema.get("enum", [schema.get("const")])))
    if "properties" in schema:
        ((title, _), *_) = forms(schema)
        return f"`{title}`"
    if "items" in schema:
        return f"list of {_takes(schema['items'])}"
    if isinstance(schema.get("additionalProperties"), dict):
        return f"name: {_takes(schema['additionalProperties'])}"
    return {"null": "nothing"}.get(schema.get("type", "any"), schema.get("type", "any"))


def _first(text: str) -> str:
    """Returns the first paragraph of a text, on one line, in the words of YAML."""
    return re.sub(r"\bNone\b", "nothing", " ".join(text.split("\n\n")[0].split()))
