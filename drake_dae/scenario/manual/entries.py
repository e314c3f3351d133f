"""All keys of a scenario: meaning, values and defaults, read from its forms."""

import re
from collections.abc import Iterator, Mapping
from copy import deepcopy
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from drake_dae.scenario.forms.problems import TYPES
from drake_dae.scenario.forms.typed_yaml import TAG, load_yaml
from drake_dae.scenario.scenario import scenario_schema

NOTHING = object()
"""The default of a key that must be given."""

OWN = object()
"""The default of a key that has a form with defaults of its own."""

EXAMPLES = Path(__file__).parent / "examples.yaml"

_ONE = (
    r"(?:m/s\^2|m/s|rad/s\^2|kg m\^2|N m s/rad|N s/m|m/\(N s\)|N m/rad|N m/A|N/m|N/s|rad/s"
    r"|1/s(?:\^mu_i|\^mu)?|N m|rad|degrees|ohm|Pa|s/m|H|m|s|N|kg)"
)
_UNIT = re.compile(
    rf"(?:, |\bin )({_ONE}(?:(?:, \.\.\., | or | \(){_ONE}\)?)?)(?=[,.;:)\s]|$)"
    r"|\bin the (outputs?'s? units?)"
)


@dataclass(frozen=True)
class ManualKey:
    """A key of a form.

    Attributes:
        name: The key.
        text: Its meaning.
        takes: The values that it accepts, in words.
        unit: The unit of its numbers; empty for none.
        default: Its default as plain data, `OWN`, or `NOTHING` if it must be given.
        is_number: Whether it takes numbers.
    """

    name: str
    text: str
    takes: str
    unit: str
    default: Any
    is_number: bool


@dataclass(frozen=True)
class ManualEntry:
    """A form of a scenario: a mapping with keys of its own.

    Attributes:
        title: Its tag, or its name where it has none.
        where: Its first dotted key in the scenario; "*" is any name or number.
        text: Its meaning.
        keys: Its keys.
        examples: Examples, which together contain all of its keys.
        data: The plain data of a scenario that contains the form.
        path: The path of the form in these data.
    """

    title: str
    where: str
    text: str
    keys: tuple[ManualKey, ...]
    examples: tuple[Mapping[str, Any], ...]
    data: Any
    path: tuple[str | int, ...]

    def scenario(self, value: Any) -> Any:
        """The plain data of a scenario with a value of this form."""
        return _with(self.data, self.path, value)


@cache
def entries() -> tuple[ManualEntry, ...]:
    """Each form of a scenario once, in the order of the scenario's keys."""
    examples = load_yaml(EXAMPLES.read_text("utf-8"), EXAMPLES.name)
    return tuple(_entries(scenario_schema(), None, (), examples, set()))


def _entries(
    schema: Mapping[str, Any],
    data: Any,
    path: tuple[str | int, ...],
    examples: Mapping[str, Any],
    seen: set[str],
) -> Iterator[ManualEntry]:
    """The forms in the schema of the data at a path, except those seen before."""
    for member in (*schema.get("anyOf", ()), *schema.get("oneOf", ())):
        yield from _entries(member, data, path, examples, seen)
    if "items" in schema:
        yield from _entries(schema["items"], _with(data, path, [None]), (*path, 0), examples, seen)
    if isinstance(schema.get("additionalProperties"), dict):
        inner = schema["additionalProperties"]
        yield from _entries(inner, _with(data, path, {"any": None}), (*path, "any"), examples, seen)
    if "properties" not in schema:
        return
    properties = schema["properties"]
    tag = {TAG: properties[TAG]["const"]} if TAG in properties else {}
    title = tag.get(TAG, schema["title"])
    if title in seen:
        return
    seen.add(title)
    example = examples.get(title, {})
    variants = tuple({**tag, **v} for v in (example if isinstance(example, list) else [example]))
    required = [name for name in schema.get("required", ()) if name != TAG]
    keys = tuple(
        ManualKey(
            name,
            inner.get("description", ""),
            _takes(inner),
            unit_of(inner.get("description", "")) if _is_number(inner) else "",
            NOTHING if name in required else inner.get("default", OWN),
            _is_number(inner),
        )
        for name, inner in properties.items()
        if name != TAG
    )
    where = ".".join("*" if part in (0, "any") else str(part) for part in path)
    yield ManualEntry(title, where, schema["description"], keys, variants, data, path)
    for name, inner in properties.items():
        if name != TAG:
            inside = _with(data, path, {**variants[0], name: None})
            yield from _entries(inner, inside, (*path, name), examples, seen)


def unit_of(text: str) -> str:
    """The unit in a text, "in N m" or "..., m, ..."; empty if there is none."""
    match = _UNIT.search(text)
    return (match[1] or match[2]) if match else ""


def _with(data: Any, path: tuple[str | int, ...], value: Any) -> Any:
    """Plain data with another value at a path."""
    if not path:
        return value
    changed = inner = deepcopy(data)
    for part in path[:-1]:
        inner = inner[part]
    inner[path[-1]] = value
    return changed


def _takes(schema: Mapping[str, Any]) -> str:
    """The values that a schema allows, in words."""
    if "oneOf" in schema:
        tags = (
            member["properties"][TAG]["const"]
            for member in schema["oneOf"]
            if "properties" in member
        )
        texts = (_takes(member) for member in schema["oneOf"] if "properties" not in member)
        return ", ".join([*texts, *tags])
    if "anyOf" in schema:
        return ", or ".join(dict.fromkeys(map(_takes, schema["anyOf"])))
    if "enum" in schema or "const" in schema:
        return ", ".join(map(str, schema.get("enum", [schema.get("const")])))
    if "properties" in schema:
        return f"keys of {schema['title']}"
    if "items" in schema:
        inner = _takes(schema["items"])
        if "minItems" in schema:
            return f"{schema['minItems']} numbers"
        return {"a number": "a list of numbers"}.get(inner, f"a list: {inner}")
    if isinstance(schema.get("additionalProperties"), dict):
        return f"names, each with {_takes(schema['additionalProperties'])}"
    return TYPES.get(schema.get("type", ""), "any value")


def _is_number(schema: Mapping[str, Any]) -> bool:
    """Whether a schema has numbers outside of forms of their own."""
    inner = [*schema.get("anyOf", ()), schema.get("items"), schema.get("additionalProperties")]
    return schema.get("type") == "number" or any(_is_number(part) for part in inner if part)
