"""Dataclasses as forms of plain data, and plain data as YAML.

A dataclass is its own form: its fields are keys, with its defaults and its checks, and its
docstring explains them. A tag, as in `surface: !Sphere`, chooses among the classes of a family; in
plain data it is an entry "_tag" as Drake has it.
"""

import inspect
import json
import re
import typing
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import MISSING, dataclass, fields, is_dataclass
from difflib import get_close_matches
from functools import cache, cached_property
from pathlib import Path
from types import NoneType, UnionType
from typing import Annotated, Any, ClassVar, Literal, NotRequired, TypeVar, Union

import numpy as np
import pydantic
import yaml  # type: ignore[import-untyped]
from casadi import SX
from numpy.typing import ArrayLike
from pydantic_core import ErrorDetails, InitErrorDetails, PydanticCustomError
from typing_extensions import TypedDict

from drake_dae.arrays import brief, can_be_written
from drake_dae.errors import DrakeDaeError, ScenarioError
from drake_dae.robots import Pair, Vector
from drake_dae.trace.compiled import Compiled

T = TypeVar("T")
S = TypeVar("S")

TAG = "_tag"
"""The key under which a mapping holds its tag."""

MOST_VALUES, MOST_TEXT = 100_000, 1_000_000
"""The limits of a file; an alias counts as often as it is used. Shipped scenarios have 200 values
in 4,000 characters."""


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


@dataclass(frozen=True)
class Key:
    """A key of a form: the type of its value, its default (`MISSING` if it has none), its text."""

    hint: Any
    default: Any
    text: str


def expected(words: str) -> pydantic.WrapValidator:
    """What an annotation takes, in words, which answer all other data."""

    def read(value: Any, inner: pydantic.ValidatorFunctionWrapHandler) -> Any:
        try:
            return inner(value)
        except pydantic.ValidationError:
            raise ValueError(f"expected {words}, got {_shown(value)}") from None

    return pydantic.WrapValidator(read)


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
_TUPLE = pydantic.AfterValidator(tuple)
Positive = Annotated[float, pydantic.Field(gt=0.0)]
FileName = Annotated[str, pydantic.AfterValidator(in_folder), expected("the name of a file")]
INTERVAL = "a lowest and a highest value, each a number or a list of numbers"
Interval = Annotated[list[float | list[float]], _TWO, expected(INTERVAL)]
MATRIX = "a number, a list of numbers, or a matrix as a list of rows of one length"
VALUES: dict[Any, Any] = {
    Callable[..., SX] | str: str,
    str | Path: FileName,
    str | Sequence[str]: Annotated[str | list[str], expected("a name or a list of names")],
    Compiled: Annotated[bool | Literal["auto"], expected("true, false or auto")],
    float | list[float]: Annotated[float | list[float], expected("a number or a list of numbers")],
    ArrayLike: Annotated[
        float | list[float] | list[list[float]],
        pydantic.AfterValidator(_rectangular),
        expected(MATRIX),
    ],
    Vector: Annotated[list[float], _THREE, _TUPLE, expected("3 numbers")],
    Pair: Annotated[list[float], _TWO, _TUPLE, expected("2 numbers")],
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
    "greater_than": "a positive number",
    "greater_than_equal": "0 or more",
    "bool_type": "true or false",
    "string_type": "text",
    "dict_type": "names with values",
}
"""What is expected, by pydantic's name of the problem, where its own words are a programmer's."""


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
        self._keys, self._data_for = keys, {**VALUES, **families}
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
        origin, parts, members = typing.get_origin(hint), typing.get_args(hint), _members(hint)
        if origin is Annotated:
            return Annotated[self._type(parts[0]), *parts[1:]]
        for base, data in self._data_for.items():
            if _members(base) <= members:
                found = self._once(data, self._choice) if isinstance(data, Family) else data
                return found | None if NoneType in members else found
        if self._is_form(hint):
            return self._once(hint, self._form)
        if origin in (Union, UnionType):
            return Union[tuple(map(self._type, parts))]  # noqa: UP007
        if origin in (list, Sequence):
            return list[self._type(parts[0])]  # type: ignore[misc]
        if origin in (dict, Mapping):
            return dict[str, self._type(parts[1])]  # type: ignore[misc]
        return hint

    def _once(self, key: Any, make: Callable[[Any], Any]) -> Any:
        if key not in self._types:
            self._types[key] = make(key)
        return self._types[key]

    def _form(self, form: type, family: Family | None = None) -> Any:
        """The type of the data of a form."""
        entries, keys = dict[str, Any](), self._keys_of(form)
        for name, key in keys.items():
            if any(typing.get_origin(one) in (dict, Mapping) for one in _members(key.hint)):
                self._free.add(name)
            more = {} if key.default is MISSING else {"default": self.write(key.default)}
            about = pydantic.Field(description=key.text or None, json_schema_extra=more)
            entry: Any = Annotated[self._type(key.hint), about]
            entries[name] = entry if key.default is MISSING else NotRequired[entry]
        make_type: Any = TypedDict
        data = make_type(self._tags.get(form, form.__name__), entries)
        data.__doc__ = re.split(r"^\w+:$", inspect.cleandoc(form.__doc__ or ""), flags=re.M)[
            0
        ].strip()
        data.__pydantic_config__ = pydantic.ConfigDict(
            extra="forbid", strict=True, allow_inf_nan=False
        )
        own = {n: k.default for n, k in self._keys.get(form, {}).items()}
        own = {name: default for name, default in own.items() if default is not MISSING}
        tag, tags = "", ""
        if family is not None:
            tag = f"{self._tags[form]} "
            tags = f". No tag is given; there are {', '.join(family.members)}"

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
            Annotated[self._form(form, family), pydantic.Tag(tag)]
            for tag, form in family.members.items()
        ]
        words = f"one of {', '.join(family.members)}"
        if family.plain is not None:
            members.append(Annotated[family.plain, pydantic.Tag("!")])
            words = f"{'text' if family.plain is str else 'a number'}, or {words}"
        choose = pydantic.Discriminator(family.tag_of, "tag", words)
        return Annotated[Union[tuple(members)], choose]  # noqa: UP007


def _members(hint: Any) -> set[Any]:
    """The members of a Union; any other annotation is its own only member."""
    return set(typing.get_args(hint)) if typing.get_origin(hint) in (Union, UnionType) else {hint}


@cache
def keys_of(form: type) -> Mapping[str, Key]:
    """The keys of a dataclass: the fields that its constructor takes."""
    hints, texts = typing.get_type_hints(form, include_extras=True), dict[str, str]()
    for cls in reversed(form.__mro__):  # Their texts are in docstrings, also of bases.
        _, _, rest = inspect.cleandoc(cls.__doc__ or "").partition("\nAttributes:\n")
        section = re.split(r"^\S", rest, maxsplit=1, flags=re.MULTILINE)[0]
        for entry in re.split(r"^    (?=\w)", section, flags=re.MULTILINE)[1:]:
            names, _, text = entry.partition(":")
            texts |= dict.fromkeys(names.split(", "), " ".join(text.split()))
    return {
        item.name: Key(
            hints[item.name],
            item.default if item.default_factory is MISSING else item.default_factory(),
            texts.get(item.name, ""),
        )
        for item in fields(form)
        if item.init
    }


_REPLACED = ("int", "float", "timestamp")


class _Loader(yaml.SafeLoader):
    """YAML 1.1 with numbers as in JSON, and tags."""

    yaml_implicit_resolvers: ClassVar = {  # Without the types whose forms are replaced below.
        first: [pair for pair in pairs if pair[0].rpartition(":")[2] not in _REPLACED]
        for first, pairs in yaml.SafeLoader.yaml_implicit_resolvers.items()
    }

    def construct_tagged(self, tag: str, node: yaml.Node) -> dict[str, Any]:
        if not isinstance(node, yaml.MappingNode):
            raise _error(f"the tag !{tag} must be followed by keys, or by {{}}", node)
        return {TAG: f"!{tag}", **self.construct_mapping(node, deep=True)}


class _Dumper(yaml.SafeDumper):
    """Keeps the order of keys, and writes tags."""

    def represent_tagged(self, data: dict[str, Any]) -> yaml.MappingNode:
        entries = [(key, value) for key, value in data.items() if key != TAG]
        return self.represent_mapping(data.get(TAG, "tag:yaml.org,2002:map"), entries)


_Loader.add_multi_constructor("!", _Loader.construct_tagged)
_Dumper.add_representer(dict, _Dumper.represent_tagged)
# YAML 1.1 also has 1_000, 010 for eight and 1:30 for ninety. Here these are text, and 1e5 a number.
_NUMBERS = {
    "int": r"[-+]?(0|[1-9][0-9]*)$",
    "float": r"[-+]?([0-9]+\.[0-9]*|\.[0-9]+|[0-9]+(?=[eE]))([eE][-+]?[0-9]+)?$"
    r"|[-+]?\.(inf|Inf|INF)$|\.(nan|NaN|NAN)$",
}
for _kind, _form in _NUMBERS.items():
    for _class in (_Loader, _Dumper):
        _class.add_implicit_resolver(
            f"tag:yaml.org,2002:{_kind}", re.compile(_form), list("-+.0123456789")
        )


def _error(problem: str, node: yaml.Node) -> yaml.MarkedYAMLError:
    return yaml.constructor.ConstructorError(problem=problem, problem_mark=node.start_mark)


def _walk(node: yaml.Node, key: str, line: int, lines: dict[str, int]) -> None:
    """Notes the line of each dotted key, and checks keys and texts."""
    if len(lines) >= MOST_VALUES:
        text = f"more than {MOST_VALUES} values, counting aliases as often as they are used"
        raise _error(text, node)
    lines[key], parts, names = line, list[tuple[str, yaml.Node, yaml.Node]](), set[str]()
    if isinstance(node, yaml.SequenceNode):
        parts = [(str(index), part, part) for index, part in enumerate(node.value)]
    for name, _ in node.value if isinstance(node, yaml.MappingNode) else ():
        if name.tag not in ("tag:yaml.org,2002:str", "tag:yaml.org,2002:merge"):
            shown = brief(name.value) if isinstance(name, yaml.ScalarNode) else "of a mapping"
            raise _error(f"the key {shown} is not text; quote it", name)
        if name.value in names:
            raise _error(f"the key '{name.value}' is given twice", name)
        names.add(name.value)
    if isinstance(node, yaml.MappingNode):
        parts = [(name.value, name, part) for name, part in node.value]
    for text in [*names, node.value if isinstance(node, yaml.ScalarNode) else ""]:
        if not can_be_written(text):
            problem = "the text has half of a letter (\\ud800 to \\udfff), which no file can hold"
            raise _error(problem, node)
    for part_name, start, part in parts:
        below = f"{key}.{part_name}" if key else part_name
        _walk(part, below, start.start_mark.line + 1, lines)


def load_yaml(text: str, name: str) -> Any:
    """YAML as lists, dictionaries and plain values; a tag becomes the entry "_tag"."""
    return load_lines(text, name)[0]


def load_lines(text: str, name: str) -> tuple[Any, Callable[[str], int | None]]:
    """What `load_yaml` returns, and the line of a dotted key; None if the text does not have it."""
    if len(text) > MOST_TEXT:
        raise ScenarioError((name, f"more than {MOST_TEXT} characters, got {len(text)}"))
    data, lines = None, dict[str, int]()
    try:
        loader = _Loader(text)
        node = loader.get_single_node()
        if node is not None:
            _walk(node, "", node.start_mark.line + 1, lines)
            data = loader.construct_document(node)
    except yaml.MarkedYAMLError as error:
        line = f"line {error.problem_mark.line + 1}: " if error.problem_mark else ""
        problem = ", ".join(part for part in (error.context, error.problem) if part)
        if "<document start>" in problem:
            problem = "more than one value; several stand in brackets, as in [[-4], [-8]]"
        raise ScenarioError((name, line + problem)) from None
    except yaml.YAMLError as error:  # Control characters.
        raise ScenarioError((name, str(error))) from None
    except RecursionError:
        raise ScenarioError((name, "too many lists or keys in each other")) from None
    except (ArithmeticError, AttributeError, LookupError, TypeError, ValueError):
        # Of PyYAML, where a tag such as !!int or !!timestamp has a value that is none.
        raise ScenarioError((name, "a tag of YAML (!!...) does not fit its value")) from None
    return data, lines.get


def first_name(names: Iterable[str], key: str) -> str | None:
    """The longest of some names with which a dotted key begins; None if it begins with none."""
    found = [name for name in names if f"{key}.".startswith(f"{name}.")]
    return max(found, key=len, default=None)


def dump_yaml(data: Any) -> str:
    """The text of plain data, which `load_yaml` reads back equal."""
    options = {"allow_unicode": True, "default_flow_style": None, "width": 100}
    return str(yaml.dump(data, Dumper=_Dumper, **options))
