"""YAML into dataclasses by Drake's typed loader, with errors in one line that name the key."""

import math
import types
import typing
from collections.abc import Sequence
from dataclasses import fields, is_dataclass
from difflib import get_close_matches

import numpy as np
import yaml  # type: ignore[import-untyped]
from pydrake.common.yaml import yaml_dump, yaml_load_data, yaml_load_typed

from drake_dae.errors import ScenarioError

REQUIRED = {"required": True}
"""Metadata of a field that must be given. Drake's loader makes every object empty before it fills
it, so that such a field needs a default all the same."""

Numbers = np.ndarray
"""Type of a field that takes a number, a list of numbers or a matrix row by row. Drake's loader
knows this one array type, of floats and of any shape."""

_BUILT_IN = "tag:yaml.org,2002:"
"""Before the names of YAML's own tags."""

T = typing.TypeVar("T")


def read_typed(schema: type[T], text: str, settings: Sequence[str] = (), name: str = "YAML") -> T:
    """Reads YAML into a dataclass.

    Args:
        schema: The dataclass. Of its fields, those of a Union type are written with the name of
            the chosen class as a tag, `!Sphere`; without one the first class is meant.
        text: YAML.
        settings: Changes "key=value" with dotted keys; the value is YAML.
        name: Of the text, for messages about its lines.

    Raises:
        ScenarioError: Broken YAML, a key that is unknown, missing or given twice, or a value of a
            wrong type.
    """
    data = _parse(text, name)
    if isinstance(data, dict) and "_tag" in data:
        raise ScenarioError(f"{name}: the whole takes no tag, got {data['_tag']}")
    if isinstance(data, dict):
        # As Drake has it: a place for anchors.
        data = {key: value for key, value in data.items() if not key.startswith("_")}
    data = {} if data is None else data
    _check(data, schema, "")
    for setting in settings:
        _apply(data, schema, setting)
        _check(data, schema, "")
    _check_required(data, schema, "")
    return typing.cast(T, yaml_load_typed(schema=schema, data=yaml_dump(data)))


def _parse(text: str, name: str) -> typing.Any:
    """YAML as lists, dictionaries and scalars; a tag becomes the entry "_tag", as Drake does it."""
    try:
        _check_nodes(yaml.compose(text, Loader=yaml.SafeLoader), name)
        return yaml_load_data(text, private=True)
    except ScenarioError:
        raise
    except yaml.MarkedYAMLError as error:
        line = f"line {error.problem_mark.line + 1}: " if error.problem_mark else ""
        what = ", ".join(part for part in (error.context, error.problem) if part)
        raise ScenarioError(f"{name}: {line}{what}") from None
    except (yaml.YAMLError, ValueError) as error:  # Control characters; a date that is none.
        raise ScenarioError(f"{name}: {' '.join(str(error).split())}") from None


def _check_nodes(root: typing.Any, name: str) -> None:
    """Refuses what the YAML loaders would take silently, or refuse without saying where."""
    nodes, seen = [root], set()
    while nodes:
        node = nodes.pop()
        if node is None or id(node) in seen:
            continue
        seen.add(id(node))  # An alias may even stand inside what it means.
        where = f"{name}: line {node.start_mark.line + 1}"
        if isinstance(node, yaml.MappingNode):
            names = set()
            for key, value in node.value:
                nodes.append(value)
                where = f"{name}: line {key.start_mark.line + 1}"
                if key.tag not in (f"{_BUILT_IN}str", f"{_BUILT_IN}merge"):
                    raise ScenarioError(f"{where}: the key {key.value!r} is not text; quote it")
                if key.value in names:
                    raise ScenarioError(f"{where}: the key '{key.value}' is given twice")
                names.add(key.value)
        elif not node.tag.startswith(_BUILT_IN):
            raise ScenarioError(f"{where}: the tag {node.tag} must be followed by keys, or by {{}}")
        elif isinstance(node, yaml.SequenceNode):
            nodes += node.value


def _apply(data: typing.Any, schema: typing.Any, setting: str) -> None:
    """Sets "a.b.0.c=value" in checked data."""
    key, separator, text = setting.partition("=")
    parts = key.split(".")
    if not separator or not all(parts):
        raise ScenarioError(f"--set {setting}: expected key=value, for example duration=5")
    value = _parse(text, key)
    place, path = data, ""
    while True:
        origin, arguments = typing.get_origin(schema), typing.get_args(schema)
        # The names in a dictionary may have dots themselves.
        part = ".".join(parts) if origin is dict else parts[0]
        parts = [] if origin is dict else parts[1:]
        if isinstance(place, list):
            if not (part.isascii() and part.isdecimal() and int(part) < len(place)):
                known = ", ".join(map(str, range(len(place)))) or "none"
                raise ScenarioError(f"{path}: no entry '{part}'; entries: {known}")
            slot: typing.Any = int(part)
        elif isinstance(place, dict):
            slot = part
        else:
            raise ScenarioError(f"{path}: {_show(place)} has no entry '{part}'")
        path = f"{path}.{part}" if path else part
        if not parts:
            place[slot] = value
            return
        if isinstance(place, dict) and slot not in place:
            place[slot] = {}
        schema = arguments[-1] if origin in (list, dict) else _keys(schema, place).get(part)
        place = place[slot]


def _check(data: typing.Any, schema: typing.Any, path: str) -> None:
    """Refuses what Drake's typed loader would, and names the key."""
    where = path or "scenario"
    origin, arguments = typing.get_origin(schema), typing.get_args(schema)
    if _is_union(schema) and _form(data, schema) is None:
        forms = ", ".join(f"!{form.__name__}" for form in arguments)
        raise ScenarioError(f"{where}: expected one of {forms}, got {_show(data)}")
    if origin is list:
        if not isinstance(data, list):
            raise ScenarioError(f"{where}: expected a list, got {_show(data)}")
        for index, item in enumerate(data):
            _check(item, arguments[0], f"{where}.{index}")
    elif origin is dict:
        if not isinstance(data, dict):
            raise ScenarioError(f"{where}: expected names with values, got {_show(data)}")
        for key, item in data.items():
            _check(item, arguments[1], f"{where}.{key}")
    elif schema is Numbers:
        _check_numbers(data, where)
    elif _is_object(_form(data, schema)):
        known = _keys(schema, data)
        if not isinstance(data, dict):
            raise ScenarioError(f"{where}: expected keys {', '.join(known)}, got {_show(data)}")
        for key, item in data.items():
            if key == "_tag" and _is_union(schema):
                continue
            if key == "_tag":
                raise ScenarioError(f"{where}: takes no tag, got {item}")
            if key not in known:
                raise ScenarioError(f"{where}: {_unknown(key, data, schema)}")
            _check(item, known[key], f"{path}.{key}" if path else key)
    elif not _is_scalar(data, schema):
        kinds = {float: "a number", int: "a whole number", bool: "true or false", str: "text"}
        quotes = schema is str and isinstance(data, (bool, int, float))
        hint = "; text that reads as something else goes in quotes" if quotes else ""
        raise ScenarioError(f"{where}: expected {kinds[schema]}, got {_show(data)}{hint}")


def _check_numbers(data: typing.Any, where: str) -> None:
    """Refuses what is neither a number, nor a list of them, nor such lists of equal lengths."""
    rows = data if isinstance(data, list) else [data]
    matrix = bool(rows) and all(isinstance(row, list) for row in rows)
    entries = [entry for row in rows for entry in row] if matrix else rows
    wrong = [entry for entry in entries if not _is_scalar(entry, float)]
    if wrong:
        raise ScenarioError(
            f"{where}: expected a number, a list of numbers, or a matrix as a list of rows, got "
            f"{_show(wrong[0])}"
        )
    if matrix and len({len(row) for row in rows}) > 1:
        raise ScenarioError(f"{where}: the rows of {_show(data)} have different lengths")


def _check_required(data: typing.Any, schema: typing.Any, path: str) -> None:
    """Refuses checked data that lacks a required key."""
    if typing.get_origin(schema) is list:
        for index, item in enumerate(data):
            _check_required(item, typing.get_args(schema)[0], f"{path}.{index}")
    form = _form(data, schema)
    if not is_dataclass(form):
        return
    known = _keys(schema, data)
    for item in fields(form):
        inner = f"{path}.{item.name}" if path else item.name
        if item.name in data:
            _check_required(data[item.name], item.type, inner)
        elif item.metadata.get("required"):
            where = f"{path or 'scenario'}: {_title(schema, data)}"
            raise ScenarioError(f"{where}needs the key '{item.name}'; keys: {', '.join(known)}")


def _is_union(schema: typing.Any) -> bool:
    return typing.get_origin(schema) in (typing.Union, types.UnionType)


def _form(data: typing.Any, schema: typing.Any) -> typing.Any:
    """The class that data is meant for: the schema itself, or the tagged one of a Union."""
    if not _is_union(schema):
        return schema
    forms = {f"!{form.__name__}": form for form in typing.get_args(schema)}
    if not isinstance(data, dict):
        return None
    return forms.get(data.get("_tag", next(iter(forms))))


def _is_object(form: typing.Any) -> bool:
    """Whether it has keys: a dataclass, or one of Drake's own serializable classes."""
    return is_dataclass(form) or hasattr(form, "__fields__")


def _keys(schema: typing.Any, data: typing.Any) -> dict[str, typing.Any]:
    """Name -> type of the fields; none for what is no object."""
    form = _form(data, schema)
    if is_dataclass(form):
        return {item.name: item.type for item in fields(form)}
    return {item.name: item.type for item in getattr(form, "__fields__", ())}


def _title(schema: typing.Any, data: typing.Any) -> str:
    return f"!{_form(data, schema).__name__} " if _is_union(schema) else ""


def _unknown(key: str, data: typing.Any, schema: typing.Any) -> str:
    known = _keys(schema, data)
    near = get_close_matches(key, known, n=1)
    hint = f"did you mean '{near[0]}'? " if near else ""
    text = f"{_title(schema, data)}has no key '{key}'; {hint}keys: {', '.join(known) or 'none'}"
    if _is_union(schema) and "_tag" not in data:
        forms = ", ".join(f"!{form.__name__}" for form in typing.get_args(schema))
        text += f". No tag is given; there are {forms}"
    return text


def _is_scalar(data: typing.Any, schema: typing.Any) -> bool:
    if schema is float and not isinstance(data, bool):
        try:
            return math.isfinite(float(data))
        except (TypeError, ValueError, OverflowError):
            return False
    if schema is int:
        return isinstance(data, int) and not isinstance(data, bool)
    return isinstance(data, schema)


def _show(data: typing.Any) -> str:
    """A value as the user wrote it, but short."""
    if data is None:
        return "nothing"
    if isinstance(data, dict) and "_tag" in data:
        return str(data["_tag"])
    text = repr(data)
    return text if len(text) <= 60 else f"{text[:57]}..."
