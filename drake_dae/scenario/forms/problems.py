"""Problems of plain data, in the terms of the scenario file."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from difflib import get_close_matches
from typing import Any

from pydantic_core import ErrorDetails

from drake_dae.scenario.forms.forms import PLAIN
from drake_dae.scenario.forms.typed_yaml import TAG
from drake_dae.scenario.forms.values import shown


def problem(schema: Mapping[str, Any], details: ErrorDetails, data: Any) -> tuple[str, str]:
    """The dotted key and the text of a problem that pydantic reports."""
    kind, loc, value = details["type"], details["loc"], details["input"]
    if TAG in loc:
        place = _place(loc[: loc.index(TAG)], schema, data)
        return place.key, f"takes no tag, got {str(place.data[TAG])[:60]}"
    if kind in ("missing", "extra_forbidden"):
        place = _place(loc[:-1], schema, data)
        place = replace(place, schema=with_parts(place.schema))
        if "properties" in place.schema:
            return place.key, _wrong_key(place, str(loc[-1]), value, kind == "missing")
        return place.key, _wrong_value(place.schema, place.data)  # Of a tuple.
    place = _place(loc, schema, data)
    if kind == "value_error":
        return place.key, str(details["ctx"]["error"])
    return place.key, _wrong_value(place.schema, value)


@dataclass(frozen=True, eq=False)
class _DataPlace:
    """A value in data: its dotted key, its schema, its tag, and all possible tags."""

    key: str
    schema: Mapping[str, Any]
    data: Any
    tag: str = ""
    tags: str = ""


_PARTS = {"oneOf", "items", "properties", "additionalProperties"}
"""The entries of a schema that describe parts."""


def _place(loc: Sequence[int | str], schema: Mapping[str, Any], data: Any) -> _DataPlace:
    """The place of a location of pydantic's, which contains the chosen tags."""
    keys: list[str] = []
    tag = tags = ""
    for part in loc:
        schema = with_parts(schema)
        if "anyOf" in schema:
            break  # The rest of the location is about one of several types.
        if "oneOf" in schema:
            tag, tags = str(part), _tags(schema)
            schema = next(one for one in schema["oneOf"] if _tag(one) == tag)
        else:
            keys.append(str(part))
            inner = schema.get("items", schema.get("additionalProperties"))
            schema = schema.get("properties", {}).get(part, inner)
            data, tag = data[part], ""
    return _DataPlace(".".join(keys) or "scenario", schema, data, tag, tags)


def with_parts(schema: Mapping[str, Any]) -> Mapping[str, Any]:
    """The inner schema of an optional value with parts; any other schema unchanged."""
    inside = [one for one in schema.get("anyOf", ()) if one.get("type") != "null"]
    return inside[0] if len(inside) == 1 and not _PARTS.isdisjoint(inside[0]) else schema


def _wrong_key(place: _DataPlace, name: str, value: Any, is_missing: bool) -> str:
    """The text for a key that is missing or unknown."""
    names = [name for name in place.schema["properties"] if name != TAG]
    title, known = f"{place.tag} " if place.tag else "", f"keys: {', '.join(names) or 'none'}"
    if is_missing:
        return f"{title}needs the key '{name}'; {known}"
    near = get_close_matches(name, names, n=1)
    hint = f"did you mean '{near[0]}'? " if near else ""
    text = f"{title}has no key '{name}'; {hint}{known}"
    if place.tag and TAG not in place.data:
        text += f". No tag is given; there are {place.tags}"
    return text


def _wrong_value(schema: Mapping[str, Any], value: Any) -> str:
    """The text for a wrong value: what the schema expects."""
    if "oneOf" in schema:
        expected = f"one of {_tags(schema)}"
    elif "properties" in schema:
        expected = f"keys {', '.join(schema['properties'])}"
    elif "minItems" in schema:
        expected = f"{schema['minItems']} numbers"
    else:
        expected = _in_words(schema)
    text = f"expected {expected}, got {shown(value)}"
    if schema.get("type") == "string" and isinstance(value, (bool, int, float)):
        text += "; text that reads as something else goes in quotes"
    return text


TYPES = {
    "number": "a number",
    "integer": "a whole number",
    "boolean": "true or false",
    "string": "text",
    "array": "a list",
    "object": "names with values",
    "null": "nothing",
}


def _in_words(schema: Mapping[str, Any]) -> str:
    """The values that a schema allows, in words."""
    if "anyOf" in schema:
        return " or ".join(map(_in_words, schema["anyOf"]))
    if "oneOf" in schema:
        return f"one of {_tags(schema)}"
    if "enum" in schema or "const" in schema:
        return "one of " + ", ".join(map(str, schema.get("enum", [schema.get("const")])))
    return TYPES.get(schema.get("type", ""), "something else")


def without_tags(schema: Any) -> Any:
    """The schema of data without the entries "_tag", as a plain reader of YAML returns them.

    Without a tag any of the forms may match, so "oneOf" becomes "anyOf".
    """
    if isinstance(schema, list):
        return [without_tags(one) for one in schema]
    if not isinstance(schema, dict):
        return schema
    plain = {
        ("anyOf" if key == "oneOf" else key): without_tags(value)
        for key, value in schema.items()
        if key != TAG
    }
    if TAG in schema.get("properties", {}):
        plain["title"] = schema["properties"][TAG]["const"]
    if TAG in schema.get("required", ()):
        plain["required"] = [name for name in schema["required"] if name != TAG]
    return plain


def _tag(schema: Mapping[str, Any]) -> str:
    if "properties" in schema:
        return str(schema["properties"][TAG]["const"])
    return PLAIN[float if schema["type"] == "number" else str]


def _tags(schema: Mapping[str, Any]) -> str:
    return ", ".join(map(_tag, schema["oneOf"]))
