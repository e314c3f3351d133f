"""Dataclasses as forms of plain data: read by pydantic, put by dotted keys, written, described.

A dataclass is its own form: its fields are keys, with its defaults and its checks, and its
docstring explains them. A tag, as in `surface: !Sphere`, chooses among the classes of a family.
"""

import inspect
import json
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import MISSING, dataclass, fields, is_dataclass
from difflib import get_close_matches
from functools import cache, cached_property
from pathlib import Path
from sys import float_info
from types import NoneType, UnionType
from typing import (
    Annotated,
    Any,
    Generic,
    NotRequired,
    TypeVar,
    Union,
    get_args,
    get_origin,
    get_type_hints,
)

import numpy as np
import pydantic
from pydantic_core import ErrorDetails, core_schema
from typing_extensions import TypedDict

from drake_dae.arrays import brief
from drake_dae.errors import DrakeDaeError, ScenarioError
from drake_dae.scenario.typed_yaml import TAG

T = TypeVar("T")
S = TypeVar("S")


@contextmanager
def at(key: str) -> Iterator[None]:
    """Converts errors in the block to a ScenarioError with the key of the scenario."""
    try:
        yield
    except ScenarioError:
        raise  # It has a key already.
    except DrakeDaeError as error:
        raise ScenarioError((key, str(error))) from error


def each(key: str, items: Iterable[S], make: Callable[[S], T]) -> list[T]:
    """Applies a function to each item; errors get the key with the index of the item."""
    results = []
    for index, item in enumerate(items):
        with at(f"{key}.{index}"):
            results.append(make(item))
    return results


@dataclass(frozen=True)
class Family:
    """The classes among which a tag chooses, the first one without a tag.

    `plain` is a type that may stand in place of a member: str or float.
    """

    members: Mapping[str, type]
    plain: type | None = None

    def tag_of(self, data: Any) -> str | None:
        """The tag that data have, or stand for."""
        if isinstance(data, dict):
            return str(data.get(TAG, next(iter(self.members))))
        kinds = (int, float) if self.plain is float else (self.plain or (),)
        return "plain" if isinstance(data, kinds) and not isinstance(data, bool) else None


@dataclass(frozen=True)
class Key:
    """A key of a form: the type of its value, its default (`MISSING` if it has none), its text."""

    hint: Any
    default: Any
    text: str


@dataclass(frozen=True, eq=False)
class Value:
    """Annotates values that a function of value and folder converts; None where it is wrong.

    `words` say what is expected, as `schema` does.
    """

    words: str
    schema: Mapping[str, Any]
    convert: Callable[[Any, Path], Any]

    def __get_pydantic_core_schema__(
        self, source: Any, handler: pydantic.GetCoreSchemaHandler
    ) -> core_schema.CoreSchema:
        return core_schema.with_info_plain_validator_function(self._read)

    def __get_pydantic_json_schema__(
        self, source: Any, handler: pydantic.GetJsonSchemaHandler
    ) -> dict[str, Any]:
        return dict(self.schema)

    def _read(self, value: Any, info: core_schema.ValidationInfo) -> Any:
        converted = self.convert(value, info.context or Path())
        if converted is None:
            raise ValueError(f"expected {self.words}, got {_shown(value)}")
        return converted


def _are_numbers(values: Any) -> bool:
    return all(type(v) in (int, float) and abs(v) <= float_info.max for v in values)


def _vector(value: Any, size: int) -> Any:
    is_right = isinstance(value, (list, tuple)) and _are_numbers(value)
    return tuple(map(float, value)) if is_right and len(value) == (size or len(value)) else None


def _numbers(value: Any) -> Any:
    rows = value if isinstance(value, list) else [value]
    is_matrix = bool(rows) and all(isinstance(row, list) for row in rows)
    entries = [entry for row in rows for entry in row] if is_matrix else rows
    if not entries or not _are_numbers(entries):
        return None
    if is_matrix and len({len(row) for row in rows}) > 1:
        return None
    numbers = np.array(value, dtype=float)
    return numbers.tolist() if numbers.size > 1 else numbers.item()


def _number_or_list(value: Any) -> Any:
    return value if _are_numbers(value if isinstance(value, list) else [value]) else None


def _interval(value: Any) -> Any:
    is_pair = isinstance(value, (list, tuple)) and len(value) == 2
    return tuple(value) if is_pair and all(_number_or_list(v) is not None for v in value) else None


def in_folder(value: Any, folder: Path) -> str | None:
    """The path of a file, relative to a folder; None if it is no name of a file."""
    if not isinstance(value, (str, Path)) or not str(value) or "\0" in str(value):
        return None
    try:
        return str((folder / value).resolve())
    except (OSError, RuntimeError):  # A link that leads to itself; no working directory.
        return None


def _names(value: Any) -> Any:
    names = value if isinstance(value, list) else [value]
    return value if all(isinstance(name, str) for name in names) else None


_NUMBER: dict[str, Any] = {"type": "number"}
_LIST: dict[str, Any] = {"type": "array", "items": _NUMBER}
_TEXT: dict[str, Any] = {"type": "string"}


def _fixed(size: int) -> Value:
    schema = {**_LIST, "minItems": size, "maxItems": size}
    return Value(f"{size} numbers", schema, lambda value, folder: _vector(value, size))


NUMBERS = Value(
    "a number, a list of numbers, or a matrix as a list of rows of one length",
    {"anyOf": [_NUMBER, _LIST, {"type": "array", "items": _LIST}]},
    lambda value, folder: _numbers(value),
)
ROW = Value("a list of numbers", _LIST, lambda value, folder: _vector(value, 0))
PAIR, TRIPLE = _fixed(2), _fixed(3)
NUMBER_OR_LIST = Value(
    "a number or a list of numbers",
    {"anyOf": [_NUMBER, _LIST]},
    lambda value, folder: _number_or_list(value),
)
INTERVAL = Value(
    "a lowest and a highest value, each a number or a list of numbers",
    {"type": "array", "minItems": 2, "maxItems": 2, "items": {"anyOf": [_NUMBER, _LIST]}},
    lambda value, folder: _interval(value),
)
FILE = Value("the name of a file", _TEXT, in_folder)
NAMES = Value(
    "a name or a list of names",
    {"anyOf": [_TEXT, {"type": "array", "items": _TEXT}]},
    lambda value, folder: _names(value),
)


def _shown(data: Any) -> str:
    """A value as the user wrote it, but short."""
    if data is None:
        return "nothing"
    text = str(data[TAG]) if isinstance(data, dict) and TAG in data else brief(data)
    return text if len(text) <= 60 else f"{text[:57]}..."


_WORDS = {
    "float_type": "a number",
    "finite_number": "a finite number",
    "int_type": "a whole number",
    "bool_type": "true or false",
    "string_type": "text",
    "list_type": "a list",
    "dict_type": "names with values",
}
"""What is expected, by pydantic's name of the problem."""


class Reader(Generic[T]):
    """Makes a dataclass of plain data, and plain data of it."""

    def __init__(
        self,
        form: type[T],
        families: Mapping[Any, Family] | None = None,
        values: Mapping[Any, Any] | None = None,
        keys: Mapping[type, Mapping[str, Key]] | None = None,
    ) -> None:
        self._form, self._families, self._values = form, families or {}, values or {}
        self._keys, self._types = keys or {}, dict[Any, Any]()
        self._tags = {c: t for f in self._families.values() for t, c in f.members.items()}
        self._adapter: pydantic.TypeAdapter[T] = pydantic.TypeAdapter(self._type(form))

    @cached_property
    def schema(self) -> dict[str, Any]:
        """The JSON Schema of the plain data without tags, as an editor of YAML sees them."""
        # Without its tag data may fit several members of a family.
        text = json.dumps(self._adapter.json_schema()).replace('"oneOf"', '"anyOf"')
        return dict(json.loads(text))

    @property
    def tags(self) -> list[str]:
        """All tags."""
        return list(dict.fromkeys(self._tags.values()))

    def read(
        self,
        data: Any,
        folder: Path | None = None,
        place_of: Callable[[str], str] = lambda key: "",
    ) -> T:
        """Makes the dataclass of plain data; names of files are relative to a folder.

        `place_of` says where a key stands, for the messages.
        """
        try:
            return self._adapter.validate_python(data, context=folder)
        except pydantic.ValidationError as error:
            problems = [self._problem(details, data) for details in error.errors()]
            raise ScenarioError(*((k, f"{t} {place_of(at)}") for k, t, at in problems)) from None

    def write(self, value: Any) -> Any:
        """Plain data that read as this value: of a form the keys that differ from the defaults."""
        if type(value) in self._keys or is_dataclass(value):
            data = {TAG: self._tags[type(value)]} if type(value) in self._tags else {}
            for name, key in self.keys_of(type(value)).items():
                written = self.write(getattr(value, name))
                if key.default is MISSING or written != self.write(key.default):
                    data[name] = written
            return data
        if isinstance(value, Mapping):
            return {name: self.write(inner) for name, inner in value.items()}
        if isinstance(value, (list, tuple)):
            return [self.write(inner) for inner in value]
        if isinstance(value, (np.ndarray, np.generic)):
            return value.tolist()
        return str(value) if isinstance(value, Path) else value

    def put(self, data: Any, key: str, value: Any) -> None:
        """Sets an entry of plain data at a dotted key, in place; chosen names may have dots too."""
        parts, path, hint = key.split("."), "", self._form
        if not all(parts):
            raise ScenarioError((brief(key), "expected a dotted key, for example start.errors"))
        while True:
            has_names = get_origin(_only(hint)) in (dict, Mapping)
            count = _name_length(data, parts) if has_names else 1
            slot: Any = ".".join(parts[:count])
            if isinstance(data, list):
                if not (slot.isascii() and slot.isdecimal() and int(slot) < len(data)):
                    indices = ", ".join(map(str, range(len(data)))) or "none"
                    raise ScenarioError((path, f"no entry '{slot}'; entries: {indices}"))
                slot = int(slot)
            elif not isinstance(data, dict):
                raise ScenarioError((path, f"{brief(data)} has no entry '{slot}'"))
            parts = parts[count:]
            if not parts:
                data[slot] = value
                return
            if (family := self._family(hint)) is not None:
                hint = family.members.get(family.tag_of(data) or "")  # type: ignore[assignment]
            hint = self._inside(hint, slot)
            path = f"{path}.{slot}" if path else str(slot)
            if isinstance(data, dict) and data.get(slot) is None:
                data[slot] = {}
            data = data[slot]

    def keys_of(self, form: type) -> Mapping[str, Key]:
        """The keys of a form."""
        return self._keys.get(form) or keys_of(form)

    def _family(self, hint: Any) -> Family | None:
        members = _members(hint)
        return next((f for base, f in self._families.items() if base in members), None)

    def _is_form(self, hint: Any) -> bool:
        return isinstance(hint, type) and (hint in self._keys or is_dataclass(hint))

    def _type(self, hint: Any) -> Any:
        """The pydantic type of data for an annotation."""
        if get_origin(hint) is Annotated:
            inner, *more = get_args(hint)
            return _annotated(self._type(inner), *more)
        members = _members(hint)
        value = next((v for base, v in self._values.items() if _members(base) <= members), None)
        if value is None and (family := self._family(hint)) is not None:
            if id(family) not in self._types:
                self._types[id(family)] = self._choice(family)
            value = self._types[id(family)]
        if value is not None:
            return value | None if NoneType in members else value
        if self._is_form(hint):
            if hint not in self._types:
                self._types[hint] = self._data(hint)
            return self._types[hint]
        origin, parts = get_origin(hint), get_args(hint)
        if origin in (Union, UnionType):
            return Union[tuple(self._type(part) for part in parts)]  # noqa: UP007
        if origin in (list, Sequence):
            return list[self._type(parts[0])]  # type: ignore[misc]
        if origin in (dict, Mapping):
            return dict[str, self._type(parts[1])]  # type: ignore[misc]
        return hint

    def _data(self, form: type) -> Any:
        """The type of the data of a form."""
        entries: dict[str, Any] = {}
        for name, key in self.keys_of(form).items():
            more = {} if key.default is MISSING else {"default": self.write(key.default)}
            about = pydantic.Field(description=key.text or None, json_schema_extra=more)
            entry = _annotated(self._type(key.hint), about)
            entries[name] = entry if key.default is MISSING else NotRequired[entry]
        make_type: Any = TypedDict
        data = make_type(self._tags.get(form, form.__name__), entries)
        data.__doc__ = introduction(form.__doc__ or "")
        data.__pydantic_config__ = pydantic.ConfigDict(
            extra="forbid", strict=True, allow_inf_nan=False
        )
        own = self._keys.get(form, {}).items()
        defaults = {name: key.default for name, key in own if key.default is not MISSING}
        return Annotated[data, pydantic.AfterValidator(lambda given: form(**{**defaults, **given}))]

    def _choice(self, family: Family) -> Any:
        """The type of the data of a family."""
        untagged = pydantic.BeforeValidator(lambda data: {k: data[k] for k in data if k != TAG})
        members = [
            _annotated(self._data(cls), untagged, pydantic.Tag(tag))
            for tag, cls in family.members.items()
        ]
        if family.plain is not None:
            members.append(_annotated(family.plain, pydantic.Tag("plain")))
        return Annotated[Union[tuple(members)], pydantic.Discriminator(family.tag_of)]  # noqa: UP007

    def _inside(self, hint: Any, part: str | int) -> Any:
        """The annotation of a part of data: of a key, an entry of a list, a member by its tag."""
        if (family := self._family(hint)) is not None:
            return family.members.get(str(part))
        hint = _only(hint)
        if self._is_form(hint):
            key = self.keys_of(hint).get(str(part))
            return None if key is None else key.hint
        return (get_args(hint) or [None])[-1]

    def _problem(self, error: ErrorDetails, data: Any) -> tuple[str, str, str]:
        """The dotted key of a problem, its text, and the key at whose place it is."""
        loc, kind, value = error["loc"], error["type"], error["input"]
        last = str(loc[-1]) if TAG in loc or kind in ("missing", "extra_forbidden") else ""
        hint, keys, tag, tags = self._form, list[str](), "", ""
        for part in loc[: loc.index(TAG)] if TAG in loc else loc[:-1] if last else loc:
            family, hint = self._family(hint), self._inside(hint, part)
            if family is None:
                keys, data, tag, tags = [*keys, str(part)], data[part], "", ""
            else:
                tag, tags = f"{part} ", ", ".join(family.members)
        key, form = ".".join(keys), _only(hint)
        names = list(self.keys_of(form)) if self._is_form(form) else []
        listed = f"keys: {', '.join(names) or 'none'}"
        if tag and isinstance(data, dict) and TAG not in data:
            listed += f". No tag is given; there are {tags}"
        place = key
        if TAG in loc:
            text = f"takes no tag, got {data[TAG]}"
        elif kind == "missing":
            text = f"{tag}needs the key '{last}'; {listed}"
        elif kind == "extra_forbidden":
            near = get_close_matches(last, names, n=1)
            listed = f"did you mean '{near[0]}'?" if near else listed
            text, place = f"{tag}has no key '{last}'; {listed}", ".".join([*keys, last])
        elif kind == "value_error":
            text = str(error["ctx"]["error"])
        elif (family := self._family(hint)) is not None:
            also = {str: "text, or ", float: "a number, or "}.get(family.plain or list, "")
            text = f"expected {also}one of {', '.join(family.members)}, got {_shown(value)}"
        else:
            expected = _WORDS.get(kind, error["msg"].removeprefix("Input should be "))
            expected = listed if kind == "dict_type" and names else expected
            text = f"expected {expected}, got {_shown(value)}"
            if kind == "string_type" and isinstance(value, (bool, int, float)):
                text += "; text that reads as something else goes in quotes"
        return key or "scenario", text, place


def _annotated(hint: Any, *more: Any) -> Any:
    for part in more:
        hint = Annotated[hint, part]
    return hint


def _members(hint: Any) -> set[Any]:
    """The members of a Union; any other annotation is its own only member."""
    return set(get_args(hint)) if get_origin(hint) in (Union, UnionType) else {hint}


def _only(hint: Any) -> Any:
    """An annotation without None and without what is said about it."""
    while get_origin(hint) is Annotated or NoneType in _members(hint):
        if get_origin(hint) is Annotated:
            hint = get_args(hint)[0]
        else:
            rest = [*(_members(hint) - {NoneType})]
            hint = rest[0] if len(rest) == 1 else None
            if hint is None:
                return None
    return hint


def _name_length(data: Any, parts: Sequence[str]) -> int:
    """The number of parts of a dotted key that form a name with dots."""
    for count in range(len(parts), 0, -1) if isinstance(data, dict) else ():
        name = ".".join(parts[:count])
        if name in data and (count == len(parts) or isinstance(data[name], (dict, list))):
            return count
    return len(parts)


@cache
def keys_of(form: type) -> Mapping[str, Key]:
    """The keys of a dataclass: the fields that its constructor takes."""
    hints, texts = get_type_hints(form, include_extras=True), attribute_texts(form)
    return {
        item.name: Key(
            hints[item.name],
            item.default if item.default_factory is MISSING else item.default_factory(),
            texts.get(item.name, ""),
        )
        for item in fields(form)
        if item.init
    }


@cache
def introduction(docstring: str) -> str:
    """A docstring up to its first section, such as "Attributes:"."""
    text = inspect.cleandoc(docstring)
    return re.split(r"^\w+:$", text, maxsplit=1, flags=re.MULTILINE)[0].strip()


def attribute_texts(source: type) -> dict[str, str]:
    """Name of an attribute -> its text in the docstring of the class or of one of its bases."""
    found: dict[str, str] = {}
    for cls in reversed(source.__mro__):
        _, _, rest = inspect.cleandoc(cls.__doc__ or "").partition("\nAttributes:\n")
        section = re.split(r"^\S", rest, maxsplit=1, flags=re.MULTILINE)[0]
        for entry in re.split(r"^    (?=\w)", section, flags=re.MULTILINE)[1:]:
            names, _, text = entry.partition(":")
            found |= dict.fromkeys(names.split(", "), " ".join(text.split()))
    return found
