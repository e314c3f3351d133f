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
from casadi import SX
from numpy.typing import ArrayLike
from pydantic_core import ErrorDetails, InitErrorDetails, PydanticCustomError, core_schema
from typing_extensions import TypedDict

from drake_dae.arrays import brief
from drake_dae.errors import DrakeDaeError, ScenarioError
from drake_dae.robots import Pair, Vector
from drake_dae.scenario.typed_yaml import TAG, first_name
from drake_dae.trace.compiled import Compiled

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

    def tag_of(self, data: Any) -> str:
        """The tag of data, "!" of plain data, and what is no tag of any other."""
        if isinstance(data, dict):
            return str(data.get(TAG, next(iter(self.members))))
        kinds = (int, float) if self.plain is float else (self.plain or (),)
        return "!" if isinstance(data, kinds) and not isinstance(data, bool) else ""

    def check(self, data: Any) -> Any:
        """Refuses what has no tag of a member and is not plain."""
        if self.tag_of(data) not in (*self.members, "!"):
            also = {str: "text, or ", float: "a number, or "}.get(self.plain or list, "")
            tags = ", ".join(self.members)
            raise ValueError(f"expected {also}one of {tags}, got {_shown(data)}")
        return data


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
        return handler.generate_schema(Annotated[self.hint, *more])

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
FILE = Expected("the name of a file", str, in_folder)
INTERVAL = Expected(
    "a lowest and a highest value, each a number or a list of numbers",
    Annotated[list[float | list[float]], _TWO],
    tuple,
)
VALUES: dict[Any, Any] = {
    Callable[..., SX] | str: str,
    str | Path: FILE,
    str | Sequence[str]: Expected("a name or a list of names", str | list[str]),
    Compiled: Expected("true, false or auto", bool | Literal["auto"]),
    float | list[float]: Expected("a number or a list of numbers", float | list[float]),
    ArrayLike: Expected(
        "a number, a list of numbers, or a matrix as a list of rows of one length",
        float | list[float] | list[list[float]],
        _rectangular,
    ),
    Vector: Expected("3 numbers", Annotated[list[float], _THREE], tuple),
    Pair: Expected("2 numbers", Annotated[list[float], _TWO], tuple),
}
"""What stands in data for the types of values in annotations."""


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
    "greater_than_equal": "0 or more",
    "int_type": "a whole number",
    "bool_type": "true or false",
    "string_type": "text",
    "list_type": "a list",
    "dict_type": "names with values",
}
"""What is expected, by pydantic's name of the problem."""


def _told(error: ErrorDetails, tag: str, names: Sequence[str], no_tag: str) -> InitErrorDetails:
    """A problem inside a form in our words; its context has the wrong key, if it is about one."""
    kind, loc, value, wrong = error["type"], error["loc"], error["input"], ""
    keys = f"keys: {', '.join(names) or 'none'}"
    if kind == "told":
        text, wrong = error["ctx"]["text"], error["ctx"]["wrong"]
    elif kind == "value_error":
        text = str(error["ctx"]["error"])
    elif kind == "missing":
        loc, text = loc[:-1], f"{tag}needs the key '{loc[-1]}'; {keys}{no_tag}"
    elif kind == "extra_forbidden" and loc[-1] == TAG:
        loc, text = loc[:-1], f"takes no tag, got {value}"
    elif kind == "extra_forbidden":
        loc, wrong = loc[:-1], str(loc[-1])
        near = get_close_matches(wrong, names, n=1)
        hint = f"did you mean '{near[0]}'?" if near else f"{keys}{no_tag}"
        text = f"{tag}has no key '{wrong}'; {hint}"
    else:
        words = _WORDS.get(kind, error["msg"].removeprefix("Input should be "))
        text = f"expected {words if loc else keys}, got {_shown(value)}"
        if kind == "string_type" and isinstance(value, (bool, int, float)):
            text += "; text that reads as something else goes in quotes"
    return {"type": _problem(text, wrong), "loc": loc, "input": value}


def _problem(text: str, wrong: str = "") -> PydanticCustomError:
    """A problem to report, with the wrong key if it is about one."""
    return PydanticCustomError("told", "{text}", {"text": text, "wrong": wrong})


class Reader:
    """Makes a dataclass of plain data, and plain data of it.

    `families` stand in data for types in annotations, as `VALUES` do; `keys` are those of classes
    that are no dataclasses, or have other defaults.
    """

    def __init__(
        self, form: type, families: Mapping[Any, Family], keys: Mapping[type, Mapping[str, Key]]
    ) -> None:
        self._families, self._keys = families, keys
        self._types, self._free = dict[Any, Any](), set[str]()  # Keys whose names are free.
        self._tags = {c: t for f in families.values() for t, c in f.members.items()}
        self.tags = list(dict.fromkeys(self._tags.values()))
        self._adapter = pydantic.TypeAdapter[Any](self._type(form))

    @cached_property
    def schema(self) -> dict[str, Any]:
        """The JSON Schema of the plain data without tags, as an editor of YAML sees them."""
        # Without its tag data may fit several members of a family.
        text = json.dumps(self._adapter.json_schema()).replace('"oneOf"', '"anyOf"')
        return dict(json.loads(text))

    def read(
        self, data: Any, folder: Path | None = None, place_of: Callable[[str], str] = lambda key: ""
    ) -> Any:
        """Makes the dataclass; files are in `folder`, and `place_of` tells where a key stands."""
        try:
            return self._adapter.validate_python(data, context=folder)
        except pydantic.ValidationError as error:
            problems = []
            for one in error.errors():
                path = [str(part) for part in one["loc"] if str(part)[:1] != "!"]  # A tag.
                place = place_of(".".join([*path, one["ctx"]["wrong"]]).rstrip("."))
                problems.append((".".join(path) or "scenario", f"{one['ctx']['text']} {place}"))
            raise ScenarioError(*problems) from None

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

    def put(self, data: Any, key: str, value: Any, path: str = "") -> None:
        """Sets an entry of plain data at a dotted key, in place; chosen names may have dots too."""
        if not all(key.split(".")):
            raise ScenarioError((brief(key), "expected a dotted key, for example start.errors"))
        slot: Any = key.partition(".")[0]
        if isinstance(data, list):
            if not (slot.isascii() and slot.isdecimal() and int(slot) < len(data)):
                indices = ", ".join(map(str, range(len(data)))) or "none"
                raise ScenarioError((path, f"no entry '{slot}'; entries: {indices}"))
        elif not isinstance(data, dict):
            raise ScenarioError((path, f"{brief(data)} has no entry '{slot}'"))
        elif path.rpartition(".")[2] in self._free:
            slot = first_name([n for n in data if isinstance(data[n], (dict, list))], key) or key
        rest, path = key[len(slot) + 1 :], f"{path}.{slot}".lstrip(".")
        slot = int(slot) if isinstance(data, list) else slot
        if not rest:
            data[slot] = value
            return
        if isinstance(data, dict) and data.get(slot) is None:
            data[slot] = {}
        self.put(data[slot], rest, value, path)

    def _keys_of(self, form: type) -> Mapping[str, Key]:
        return self._keys.get(form) or keys_of(form)

    def _is_form(self, hint: Any) -> bool:
        return isinstance(hint, type) and (hint in self._keys or is_dataclass(hint))

    def _type(self, hint: Any) -> Any:
        """The pydantic type of data for an annotation."""
        origin, parts, members = get_origin(hint), get_args(hint), _members(hint)
        if origin is Annotated:
            return Annotated[self._type(parts[0]), *parts[1:]]
        value = next((v for base, v in VALUES.items() if _members(base) <= members), None)
        value = Annotated[Any, value] if isinstance(value, Expected) else value
        family = next((f for base, f in self._families.items() if base in members), None)
        if value is None and family is not None:
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
            return Union[tuple(map(self._type, parts))]  # noqa: UP007
        if origin in (list, Sequence):
            return list[self._type(parts[0])]  # type: ignore[misc]
        if origin in (dict, Mapping):
            return dict[str, self._type(parts[1])]  # type: ignore[misc]
        return hint

    def _data(self, form: type, family: Family | None = None) -> Any:
        """The type of the data of a form."""
        entries, keys = dict[str, Any](), self._keys_of(form)
        for name, key in keys.items():
            if any(get_origin(one) in (dict, Mapping) for one in _members(key.hint)):
                self._free.add(name)
            more = {} if key.default is MISSING else {"default": self.write(key.default)}
            about = pydantic.Field(description=key.text or None, json_schema_extra=more)
            entry: Any = Annotated[self._type(key.hint), about]
            entries[name] = entry if key.default is MISSING else NotRequired[entry]
        make_type: Any = TypedDict
        data = make_type(self._tags.get(form, form.__name__), entries)
        data.__doc__ = introduction(form.__doc__ or "")
        data.__pydantic_config__ = pydantic.ConfigDict(
            extra="forbid", strict=True, allow_inf_nan=False
        )
        own = {
            n: k.default for n, k in self._keys.get(form, {}).items() if k.default is not MISSING
        }
        tag = "" if family is None else f"{self._tags[form]} "
        tags = "" if family is None else f". No tag is given; there are {', '.join(family.members)}"

        def read(given: Any, inner: pydantic.ValidatorFunctionWrapHandler) -> Any:
            is_tagged = isinstance(given, dict) and TAG in given
            if is_tagged and family is not None:
                given = {name: given[name] for name in given if name != TAG}
            try:
                return form(**{**own, **inner(given)})
            except pydantic.ValidationError as error:
                rest = "" if is_tagged else tags
                problems = [_told(one, tag, [*keys], rest) for one in error.errors()]
            except ValueError as error:
                raise _problem(str(error)) from None
            raise pydantic.ValidationError.from_exception_data(form.__name__, problems)

        return Annotated[data, pydantic.WrapValidator(read)]

    def _choice(self, family: Family) -> Any:
        """The type of the data of a family."""
        members = [
            Annotated[self._data(form, family), pydantic.Tag(tag)]
            for tag, form in family.members.items()
        ]
        if family.plain is not None:
            members.append(Annotated[family.plain, pydantic.Tag("!")])
        choose = pydantic.Discriminator(family.tag_of), pydantic.BeforeValidator(family.check)
        return Annotated[Union[tuple(members)], *choose]  # noqa: UP007


def _members(hint: Any) -> set[Any]:
    """The members of a Union; any other annotation is its own only member."""
    return set(get_args(hint)) if get_origin(hint) in (Union, UnionType) else {hint}


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
