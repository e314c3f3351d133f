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
from types import NoneType, UnionType
from typing import (
    Annotated,
    Any,
    Generic,
    Literal,
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
from drake_dae.scenario.typed_yaml import TAG, first_name

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


@dataclass(frozen=True, eq=False)
class Family:
    """The classes among which a tag chooses, the first without a tag; `plain` is str or float."""

    members: Mapping[str, type]
    plain: type | None = None

    def tag_of(self, data: Any) -> str | None:
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
class Expected:
    """Annotates data like a hint; `convert` makes a value of it, `words` answer all other data."""

    words: str
    hint: Any
    convert: Callable[..., Any] = lambda value: value

    def __get_pydantic_core_schema__(
        self, source: Any, handler: pydantic.GetCoreSchemaHandler
    ) -> core_schema.CoreSchema:
        more = pydantic.AfterValidator(self.convert), pydantic.WrapValidator(self._read)
        return handler.generate_schema(_annotated(self.hint, *more))

    def _read(self, value: Any, inner: pydantic.ValidatorFunctionWrapHandler) -> Any:
        try:
            return inner(value)
        except pydantic.ValidationError:
            raise ValueError(f"expected {self.words}, got {_shown(value)}") from None


def _rectangular(value: Any) -> Any:
    rows = value if isinstance(value, list) else [value]
    if not rows or len({len(row) if isinstance(row, list) else -1 for row in rows}) > 1:
        raise ValueError
    return value


def in_folder(name: str, info: pydantic.ValidationInfo) -> str:
    """The path of a file, relative to a folder."""
    if not name or "\0" in name:
        raise ValueError
    try:
        return str(((info.context or Path()) / name).resolve())
    except (OSError, RuntimeError):  # A link that leads to itself; no working directory.
        raise ValueError from None


_TWO, _THREE = (pydantic.Field(min_length=size, max_length=size) for size in (2, 3))
PAIR = Expected("2 numbers", Annotated[list[float], _TWO], tuple)
TRIPLE = Expected("3 numbers", Annotated[list[float], _THREE], tuple)
NUMBERS = Expected(
    "a number, a list of numbers, or a matrix as a list of rows of one length",
    float | list[float] | list[list[float]],
    _rectangular,
)
NUMBER_OR_LIST = Expected("a number or a list of numbers", float | list[float])
INTERVAL = Expected(
    "a lowest and a highest value, each a number or a list of numbers",
    Annotated[list[float | list[float]], _TWO],
    tuple,
)
COMPILED = Expected("true, false or auto", bool | Literal["auto"])
FILE = Expected("the name of a file", str, in_folder)
NAMES = Expected("a name or a list of names", str | list[str])


def _shown(data: Any) -> str:
    """A value as the user wrote it, but short."""
    if data is None:
        return "nothing"
    text = str(data[TAG]) if isinstance(data, dict) and TAG in data else brief(data)
    return text if len(text) <= 60 else f"{text[:57]}..."


_WORDS = {
    "float_type": "a number",
    "finite_number": "a finite number",
    "greater_than": "a positive number",
    "int_type": "a whole number",
    "bool_type": "true or false",
    "string_type": "text",
    "list_type": "a list",
    "dict_type": "names with values",
}
"""What is expected, by pydantic's name of the problem."""


class Reader(Generic[T]):
    """Makes a dataclass of plain data, and plain data of it.

    `families` and `values` stand in data for types in annotations; `keys` are those of classes that
    are no dataclasses, or have other defaults.
    """

    def __init__(
        self,
        form: type[T],
        families: Mapping[Any, Family],
        values: Mapping[Any, Any],
        keys: Mapping[type, Mapping[str, Key]],
    ) -> None:
        self._form, self._families, self._values, self._keys = form, families, values, keys
        self._types = dict[Any, Any]()
        self._tags = {c: t for f in families.values() for t, c in f.members.items()}
        self.tags = list(dict.fromkeys(self._tags.values()))
        self._adapter: pydantic.TypeAdapter[T] = pydantic.TypeAdapter(self._type(form))

    @cached_property
    def schema(self) -> dict[str, Any]:
        """The JSON Schema of the plain data without tags, as an editor of YAML sees them."""
        # Without its tag data may fit several members of a family.
        text = json.dumps(self._adapter.json_schema()).replace('"oneOf"', '"anyOf"')
        return dict(json.loads(text))

    def read(
        self,
        data: Any,
        folder: Path | None = None,
        place_of: Callable[[str], str] = lambda key: "",
    ) -> T:
        """Makes the dataclass; files are in `folder`, and `place_of` tells where a key stands."""
        try:
            return self._adapter.validate_python(data, context=folder)
        except pydantic.ValidationError as error:
            problems = [self._problem(details, data) for details in error.errors()]
            raise ScenarioError(*((k, f"{t} {place_of(at)}") for k, t, at in problems)) from None

    def write(self, value: Any) -> Any:
        """Plain data that read as this value: of a form the keys that differ from the defaults."""
        if self._is_form(type(value)):
            data = {TAG: self._tags[type(value)]} if type(value) in self._tags else {}
            for name, key in self._keys_of(type(value)).items():
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
        if not all(key.split(".")):
            raise ScenarioError((brief(key), "expected a dotted key, for example start.errors"))
        path, rest, hint = "", key, self._form
        while rest:
            slot: Any = rest.partition(".")[0]
            if isinstance(data, list):
                if not (slot.isascii() and slot.isdecimal() and int(slot) < len(data)):
                    indices = ", ".join(map(str, range(len(data)))) or "none"
                    raise ScenarioError((path, f"no entry '{slot}'; entries: {indices}"))
            elif not isinstance(data, dict):
                raise ScenarioError((path, f"{brief(data)} has no entry '{slot}'"))
            elif get_origin(_only(hint)) in (dict, Mapping):
                inner = [name for name in data if isinstance(data[name], (dict, list))]
                slot = first_name(inner, rest) or rest
            rest, path = rest[len(slot) + 1 :], f"{path}.{slot}".lstrip(".")
            if (family := self._family(hint)) is not None:
                hint = family.members.get(family.tag_of(data) or "")  # type: ignore[assignment]
            hint = self._inside(hint, slot)
            slot = int(slot) if isinstance(data, list) else slot
            if not rest:
                data[slot] = value
            elif isinstance(data, dict) and data.get(slot) is None:
                data[slot] = {}
            data = data[slot]

    def _keys_of(self, form: type) -> Mapping[str, Key]:
        return self._keys.get(form) or keys_of(form)

    def _family(self, hint: Any) -> Family | None:
        members = _members(hint)
        return next((f for base, f in self._families.items() if base in members), None)

    def _is_form(self, hint: Any) -> bool:
        return isinstance(hint, type) and (hint in self._keys or is_dataclass(hint))

    def _type(self, hint: Any) -> Any:
        """The pydantic type of data for an annotation."""
        origin, parts, members = get_origin(hint), get_args(hint), _members(hint)
        if origin is Annotated:
            return _annotated(self._type(parts[0]), *parts[1:])
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
        for name, key in self._keys_of(form).items():
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
            key = self._keys_of(hint).get(str(part))
            return None if key is None else key.hint
        return (get_args(hint) or [None])[-1]

    def _problem(self, error: ErrorDetails, data: Any) -> tuple[str, str, str]:
        """The dotted key of a problem, its text, and the key at whose place it is."""
        loc, kind, value = error["loc"], error["type"], error["input"]
        is_key = kind in ("missing", "extra_forbidden")
        count = loc.index(TAG) if TAG in loc else len(loc) - is_key
        hint, keys, tag, tags = self._form, list[str](), "", ""
        for part in loc[:count]:
            family, hint = self._family(hint), self._inside(hint, part)
            if family is None:
                keys, data, tag, tags = [*keys, str(part)], data[part], "", ""
            else:
                tag, tags = f"{part} ", ", ".join(family.members)
        key, place, form = ".".join(keys), ".".join(keys), _only(hint)
        names = list(self._keys_of(form)) if self._is_form(form) else []
        listed = f"keys: {', '.join(names) or 'none'}"
        if tag and isinstance(data, dict) and TAG not in data:
            listed += f". No tag is given; there are {tags}"
        if TAG in loc:
            text = f"takes no tag, got {data[TAG]}"
        elif kind == "missing":
            text = f"{tag}needs the key '{loc[-1]}'; {listed}"
        elif kind == "extra_forbidden":
            near = get_close_matches(str(loc[-1]), names, n=1)
            listed = f"did you mean '{near[0]}'?" if near else listed
            text, place = f"{tag}has no key '{loc[-1]}'; {listed}", ".".join([*keys, str(loc[-1])])
        elif kind == "value_error":
            text = str(error["ctx"]["error"])
        elif (family := self._family(hint)) is not None:
            also = {str: "text, or ", float: "a number, or "}.get(family.plain or list, "")
            text = f"expected {also}one of {', '.join(family.members)}, got {_shown(value)}"
        else:
            words = _WORDS.get(kind, error["msg"].removeprefix("Input should be "))
            words = listed if kind == "dict_type" and names else words
            text = f"expected {words}, got {_shown(value)}"
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
    """An annotation without None and without what is said about it; None for several types."""
    while get_origin(hint) is Annotated:
        hint = get_args(hint)[0]
    if NoneType not in (members := _members(hint)):
        return hint
    rest = [*(members - {NoneType})]
    return _only(rest[0]) if len(rest) == 1 else None


@cache
def keys_of(form: type) -> Mapping[str, Key]:
    """The keys of a dataclass: the fields that its constructor takes."""
    hints, texts = get_type_hints(form, include_extras=True), _attribute_texts(form)
    return {
        item.name: Key(
            hints[item.name],
            item.default if item.default_factory is MISSING else item.default_factory(),
            texts.get(item.name, ""),
        )
        for item in fields(form)
        if item.init
    }


def introduction(docstring: str) -> str:
    """A docstring up to its first section, such as "Attributes:"."""
    text = inspect.cleandoc(docstring)
    return re.split(r"^\w+:$", text, maxsplit=1, flags=re.MULTILINE)[0].strip()


def _attribute_texts(source: type) -> dict[str, str]:
    """Name of an attribute -> its text in the docstring of the class or of one of its bases."""
    found: dict[str, str] = {}
    for cls in reversed(source.__mro__):
        _, _, rest = inspect.cleandoc(cls.__doc__ or "").partition("\nAttributes:\n")
        section = re.split(r"^\S", rest, maxsplit=1, flags=re.MULTILINE)[0]
        for entry in re.split(r"^    (?=\w)", section, flags=re.MULTILINE)[1:]:
            names, _, text = entry.partition(":")
            found |= dict.fromkeys(names.split(", "), " ".join(text.split()))
    return found
