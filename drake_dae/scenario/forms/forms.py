"""Dataclasses as forms of plain data: checked by pydantic, all that is wrong told at once.

A dataclass is its own form: its fields, defaults and checks are those that data must keep. A type
that is no data is `written` as another one; a member of a family is chosen by a tag.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import MISSING, dataclass, field, fields, is_dataclass, replace
from difflib import get_close_matches
from pathlib import Path
from sys import float_info
from types import UnionType
from typing import Annotated, Any, Generic, TypeVar, Union, get_args, get_origin, get_type_hints

import numpy as np
import pydantic
from pydantic_core import CoreSchema, ErrorDetails, core_schema

from drake_dae.arrays import brief, can_be_written
from drake_dae.errors import ScenarioError
from drake_dae.scenario.forms.docstrings import attribute_texts, introduction
from drake_dae.scenario.forms.typed_yaml import TAG

T = TypeVar("T")

_PLAIN = {str: "text", float: "a number"}
"""What stands for plain values where tags choose."""


@dataclass(frozen=True, eq=False)
class Form:
    """Annotates a dataclass, or a Drake class with `__fields__`: data have the keys of its fields.

    Attributes:
        written: Annotation of a field -> the type that stands for it in data.
        defaults: Name of a field -> value where data leave it out, if not that of the class.
        tag: The tag by which data choose the class, "!Sphere"; empty if there is no choice.
        needs_tag: Whether data without a tag mean another class.
        texts: Name of a field -> what it means, where the docstring of the class does not say it.
    """

    written: Mapping[Any, Any] = field(default_factory=dict)
    defaults: Mapping[str, Any] = field(default_factory=dict)
    tag: str = ""
    needs_tag: bool = False
    texts: Mapping[str, str] = field(default_factory=dict)

    def __get_pydantic_json_schema__(
        self, source: CoreSchema, handler: pydantic.GetJsonSchemaHandler
    ) -> dict[str, Any]:
        schema = handler(source)
        return {**schema, "description": introduction(schema.get("description", ""))}

    def __get_pydantic_core_schema__(
        self, source: type[Any], handler: pydantic.GetCoreSchemaHandler
    ) -> CoreSchema:
        texts = {**attribute_texts(source), **self.texts}
        entries = {
            name: core_schema.typed_dict_field(
                handler.generate_schema(
                    Annotated[self._type_in_data(hint), _Explained(texts.get(name, ""), default)]
                ),
                required=default is MISSING,
            )
            for name, hint, default in self._fields(source)
        }
        names, tag = list(entries), {TAG: self.tag} if self.tag else {}
        if tag:
            literal = core_schema.literal_schema([self.tag])
            entries[TAG] = core_schema.typed_dict_field(literal, required=self.needs_tag)

        def make(data: dict[str, Any]) -> Any:
            data.pop(TAG, None)
            return source(**{**self.defaults, **data})

        def dump(made: Any, dump_data: Callable[[Any], Any]) -> Any:
            return dump_data({**tag, **{name: getattr(made, name) for name in names}})

        data = core_schema.typed_dict_schema(
            entries,
            cls=source,
            extra_behavior="forbid",
            config=core_schema.CoreConfig(strict=True, allow_inf_nan=False),
        )
        return core_schema.no_info_after_validator_function(
            make,
            data,
            serialization=core_schema.wrap_serializer_function_ser_schema(dump, schema=data),
        )

    def _fields(self, source: type[Any]) -> Iterator[tuple[str, Any, Any]]:
        for name, hint, default in _fields_of(source):
            yield name, hint, self.defaults.get(name, default)

    def _type_in_data(self, hint: Any) -> Any:
        """What stands in data for a field with an annotation."""
        if is_dataclass(hint):
            return Annotated[hint, Form(self.written)]
        members = _members(hint)
        for annotation, form in self.written.items():
            if _members(annotation) <= members:
                return form | None if type(None) in members else form
        # In data a tuple is a list.
        return Annotated[hint, pydantic.Strict(False)] if get_origin(hint) is tuple else hint


@dataclass(frozen=True)
class _Explained:
    """Puts what a field means before what the JSON Schema says of its type, and its default."""

    text: str
    default: Any

    def __get_pydantic_json_schema__(
        self, source: CoreSchema, handler: pydantic.GetJsonSchemaHandler
    ) -> dict[str, Any]:
        schema = dict(handler(source))
        told = "\n\n".join(filter(None, (self.text, schema.get("description"))))
        schema.update({"description": told} if told else {})
        schema.update({"default": self.default} if _is_plain(self.default) else {})
        return schema


def _is_plain(value: Any) -> bool:
    """Whether a default is plain data; an object has defaults of its own."""
    if isinstance(value, (list, tuple)):
        return all(map(_is_plain, value))
    return value is None or value == {} or isinstance(value, (bool, int, float, str))


def _fields_of(source: type[Any]) -> Iterator[tuple[str, Any, Any]]:
    """The name, the annotation and the default of each field, `MISSING` where it has none."""
    if not is_dataclass(source):
        made: Any = source()
        yield from ((item.name, item.type, getattr(made, item.name)) for item in made.__fields__)
        return
    hints = get_type_hints(source, include_extras=True)
    for item in fields(source):
        if item.init:
            factory = item.default_factory
            yield item.name, hints[item.name], item.default if factory is MISSING else factory()


def _members(hint: Any) -> set[Any]:
    """The members of a Union; any other annotation is its own only member."""
    return set(get_args(hint)) if get_origin(hint) in (Union, UnionType) else {hint}


@dataclass(frozen=True, eq=False)
class Choice:
    """Annotates a Union of dataclasses: a tag chooses one, by default the first.

    The tag is the name of the class. A member that is annotated with a `Form` has its tag and its
    defaults. Members `str` and `float` are plain text and a number.

    Attributes:
        written: The types that stand for others in data, as in `Form`, for all members.
    """

    written: Mapping[Any, Any] = field(default_factory=dict)

    def __get_pydantic_core_schema__(
        self, source: Any, handler: pydantic.GetCoreSchemaHandler
    ) -> CoreSchema:
        forms: dict[type[Any], Form] = {}
        members = get_args(source)
        for member in (member for member in members if member not in _PLAIN):
            cls, own = get_args(member) or (member, Form())
            tag = own.tag or f"!{cls.__name__}"
            forms[cls] = replace(own, written=self.written, tag=tag, needs_tag=bool(forms))
        first = next(iter(forms.values())).tag

        def chosen(value: Any) -> str | None:
            if isinstance(value, dict):
                return str(value.get(TAG, first))
            for plain, types in ((str, str), (float, (int, float))):
                if plain in members and isinstance(value, types) and not isinstance(value, bool):
                    return _PLAIN[plain]
            return forms[type(value)].tag if type(value) in forms else None

        choices = {
            form.tag: handler.generate_schema(Annotated[cls, form]) for cls, form in forms.items()
        }
        if str in members:
            choices[_PLAIN[str]] = core_schema.str_schema(strict=True)
        if float in members:
            choices[_PLAIN[float]] = core_schema.float_schema(strict=True, allow_inf_nan=False)
        return core_schema.tagged_union_schema(choices, chosen)


def _numbers(value: Any) -> Any:
    """A number, a list of numbers or a list of rows; a list of one number is that number."""
    rows = value if isinstance(value, list) else [value]
    is_matrix = bool(rows) and all(isinstance(row, list) for row in rows)
    entries = [entry for row in rows for entry in row] if is_matrix else rows
    for entry in entries:
        if type(entry) not in (int, float) or not abs(entry) <= float_info.max:
            wanted = "a number, a list of numbers, or a matrix as a list of rows"
            raise ValueError(f"expected {wanted}, got {_show(entry)}")
    if is_matrix and len({len(row) for row in rows}) > 1:
        raise ValueError(f"the rows of {_show(value)} have different lengths")
    if not entries:
        raise ValueError("empty; give one number, or one for each")
    numbers = np.array(value, dtype=float)
    return numbers.tolist() if numbers.size > 1 else numbers.item()


_NUMBER = {"type": "number"}
_LIST = {"type": "array", "items": _NUMBER}

Numbers = Annotated[
    Any,
    pydantic.PlainValidator(_numbers),
    pydantic.PlainSerializer(lambda value: np.asarray(value, dtype=float).tolist()),
    pydantic.WithJsonSchema({"anyOf": [_NUMBER, _LIST, {"type": "array", "items": _LIST}]}),
]
"""A number, a list of numbers, or a matrix row by row."""


def _file(value: Any, info: pydantic.ValidationInfo) -> Path:
    """A file, where a relative path starts in the folder that the reader was given."""
    if not isinstance(value, (str, Path)) or not str(value):
        raise ValueError(f"expected the name of a file, got {_show(value)}")
    try:
        return (info.context or Path()) / value
    except ValueError:  # A null byte.
        raise ValueError(f"expected the name of a file, got {_show(value)}") from None


FileName = Annotated[
    Any,
    pydantic.PlainValidator(_file),
    pydantic.PlainSerializer(str),
    pydantic.WithJsonSchema({"type": "string"}),
]
"""The name of a file."""

Row = Annotated[tuple[float, ...], pydantic.Strict(False)]
"""A list of numbers."""

Pair = Annotated[Row, pydantic.Field(min_length=2, max_length=2)]
"""Two numbers."""

Triple = Annotated[Row, pydantic.Field(min_length=3, max_length=3)]
"""Three numbers."""


class Reader(Generic[T]):
    """Reads a dataclass from plain data, and writes it as such."""

    def __init__(self, form: type[T]) -> None:
        self._adapter: pydantic.TypeAdapter[T] = pydantic.TypeAdapter(Annotated[form, Form()])  # type: ignore[arg-type]
        self.schema: dict[str, Any] = self._adapter.json_schema()
        #: Dotted keys of the dictionaries with any names; "*" is any entry of a list.
        self.free_names = set(_free_names(self.schema, ""))

    def read(self, data: Any, folder: Path | None = None) -> T:
        """The dataclass that plain data describe.

        Args:
            data: The plain data.
            folder: Where relative names of files start; None for the working directory.

        Raises:
            ScenarioError: Keys are unknown or missing, or values are wrong; all of them are told.
        """
        unwritable = dict.fromkeys(_unwritable(data, ""))
        if unwritable:
            text = "a text has half of a letter (\\ud800 to \\udfff), which no file can hold"
            raise ScenarioError(*((key or "scenario", text) for key in unwritable))
        try:
            return self._adapter.validate_python(data, context=folder)
        except pydantic.ValidationError as error:
            # Each member of a Union says the same.
            problems = dict.fromkeys(self._problem(details, data) for details in error.errors())
            raise ScenarioError(*problems) from None

    def write(self, value: T) -> Any:
        """The plain data of which `read` makes the same value."""
        return self._adapter.dump_python(value, mode="json")

    def _problem(self, details: ErrorDetails, data: Any) -> tuple[str, str]:
        """The dotted key and the text of a problem."""
        kind, loc, value = details["type"], details["loc"], details["input"]
        if TAG in loc:
            place = _place(loc[: loc.index(TAG)], self.schema, data)
            return place.key, f"takes no tag, got {str(place.data[TAG])[:60]}"
        if kind in ("missing", "extra_forbidden"):
            place = _place(loc[:-1], self.schema, data)
            place = replace(place, schema=_with_parts(place.schema))
            if "properties" in place.schema:
                return place.key, _wrong_key(place, str(loc[-1]), value, kind == "missing")
            return place.key, _wrong_value(place.schema, place.data)  # Of a tuple.
        place = _place(loc, self.schema, data)
        if kind == "value_error":
            return place.key, str(details["ctx"]["error"])
        return place.key, _wrong_value(place.schema, value)


def _unwritable(data: Any, key: str) -> Iterator[str]:
    """The dotted keys of texts in plain data that no file can hold."""
    if isinstance(data, str) and not can_be_written(data):
        yield key
    pairs: Iterator[tuple[Any, Any]] = iter(())
    if isinstance(data, Mapping):
        pairs = iter(data.items())
    elif isinstance(data, (list, tuple)):
        pairs = iter(enumerate(data))
    for name, inner in pairs:
        if isinstance(name, str) and not can_be_written(name):
            yield key
        yield from _unwritable(inner, f"{key}.{name}" if key else str(name))


@dataclass(frozen=True, eq=False)
class _Place:
    """A place in data: its dotted key, its schema, and the tag that chose it, with all tags."""

    key: str
    schema: Mapping[str, Any]
    data: Any
    tag: str = ""
    tags: str = ""


_PARTS = {"oneOf", "items", "properties", "additionalProperties"}
"""What schemas have of data with parts."""


def _place(loc: Sequence[int | str], schema: Mapping[str, Any], data: Any) -> _Place:
    """Where pydantic's location is, in which a chosen tag is a part."""
    keys: list[str] = []
    tag = tags = ""
    for part in loc:
        schema = _with_parts(schema)
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
    return _Place(".".join(keys) or "scenario", schema, data, tag, tags)


def _with_parts(schema: Mapping[str, Any]) -> Mapping[str, Any]:
    """What there may be or nothing, if it has parts; else the schema itself."""
    inside = [one for one in schema.get("anyOf", ()) if one.get("type") != "null"]
    return inside[0] if len(inside) == 1 and not _PARTS.isdisjoint(inside[0]) else schema


def _wrong_key(place: _Place, name: str, value: Any, is_missing: bool) -> str:
    """What is wrong with a key that is missing or should not be there."""
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
    """What a schema expects instead of a value."""
    if "oneOf" in schema:
        expected = f"one of {_tags(schema)}"
    elif "properties" in schema:
        expected = f"keys {', '.join(schema['properties'])}"
    elif "minItems" in schema:
        expected = f"{schema['minItems']} numbers"
    else:
        expected = _in_words(schema)
    text = f"expected {expected}, got {_show(value)}"
    if schema.get("type") == "string" and isinstance(value, (bool, int, float)):
        text += "; text that reads as something else goes in quotes"
    return text


_IN_WORDS = {
    "number": "a number",
    "integer": "a whole number",
    "boolean": "true or false",
    "string": "text",
    "array": "a list",
    "object": "names with values",
    "null": "nothing",
}


def _in_words(schema: Mapping[str, Any]) -> str:
    """What a plain value must be."""
    if "anyOf" in schema:
        return " or ".join(map(_in_words, schema["anyOf"]))
    if "oneOf" in schema:
        return f"one of {_tags(schema)}"
    if "enum" in schema or "const" in schema:
        return "one of " + ", ".join(map(str, schema.get("enum", [schema.get("const")])))
    return _IN_WORDS.get(schema.get("type", ""), "something else")


def without_tags(schema: Any) -> Any:
    """A schema of the same data without the entries "_tag", as a plain reader of YAML gives them.

    Where a tag chooses, any form fits.
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
    return _PLAIN[float if schema["type"] == "number" else str]


def _tags(schema: Mapping[str, Any]) -> str:
    return ", ".join(map(_tag, schema["oneOf"]))


def _free_names(schema: Mapping[str, Any], path: str) -> Iterator[str]:
    schema = _with_parts(schema)
    if isinstance(schema.get("additionalProperties"), dict):
        yield path
    for one in schema.get("oneOf", ()):
        yield from _free_names(one, path)
    inside = {"*": schema["items"]} if isinstance(schema.get("items"), dict) else {}
    for name, inner in {**schema.get("properties", {}), **inside}.items():
        yield from _free_names(inner, f"{path}.{name}" if path else name)


def _show(data: Any) -> str:
    """A value as the user wrote it, but short."""
    if data is None:
        return "nothing"
    if isinstance(data, dict) and TAG in data:
        return str(data[TAG])
    text = brief(data)
    return text if len(text) <= 60 else f"{text[:57]}..."
