"""Dataclasses as forms of plain data, checked by pydantic with all problems at once.

A dataclass is its own form: its fields, defaults and checks apply to the data. A field whose type
is not plain data is `written` as another type. A tag chooses among the classes of a family.
"""

from collections.abc import Callable, Iterator, Mapping
from copy import copy
from dataclasses import MISSING, dataclass, field, fields, is_dataclass, replace
from types import UnionType
from typing import Annotated, Any, TypeVar, Union, get_args, get_origin, get_type_hints

import pydantic
from pydantic_core import CoreSchema, core_schema

from drake_dae.scenario.forms.docstrings import attribute_texts, introduction
from drake_dae.scenario.forms.typed_yaml import TAG

T = TypeVar("T")

PLAIN = {str: "text", float: "a number"}
"""The names of plain values in a choice by tag."""


@dataclass(frozen=True, eq=False)
class Form:
    """Annotates a dataclass, or a Drake class with `__fields__`: data have the keys of its fields.

    Attributes:
        written: Annotation of a field -> the type of its data.
        defaults: Name of a field -> its default in data, if it differs from that of the class.
        tag: The tag that chooses the class, "!Sphere"; empty if there is no choice.
        needs_tag: Whether the tag is required: without it another class is chosen.
        texts: Name of a field -> its text, if the docstring of the class has none.
        keys: The keys of data, in less time than for all fields; all fields if empty.
    """

    written: Mapping[Any, Any] = field(default_factory=dict)
    defaults: Mapping[str, Any] = field(default_factory=dict)
    tag: str = ""
    needs_tag: bool = False
    texts: Mapping[str, str] = field(default_factory=dict)
    keys: tuple[str, ...] = ()

    def __get_pydantic_json_schema__(
        self, source: CoreSchema, handler: pydantic.GetJsonSchemaHandler
    ) -> dict[str, Any]:
        schema = handler(source)
        return {**schema, "description": introduction(schema.get("description", ""))}

    def __get_pydantic_core_schema__(
        self, source: type[Any], handler: pydantic.GetCoreSchemaHandler
    ) -> CoreSchema:
        # A form at several places, as a reference, is made once: this halves the time of a reader.
        traits = self.tag, self.needs_tag, repr(self.defaults), repr(self.texts)
        key = source, id(self.written), traits, self.keys
        if key not in _MADE:
            _MADE[key] = self, self._core_schema(source, handler)
        return copy(_MADE[key][1])  # pydantic adds to it.

    def _core_schema(self, source: type[Any], handler: pydantic.GetCoreSchemaHandler) -> CoreSchema:
        texts = {**attribute_texts(source), **self.texts}
        fields_in_data = list(_fields_of(source, self.defaults))
        entries = {
            name: core_schema.typed_dict_field(
                handler.generate_schema(
                    Annotated[self._type_in_data(hint), _Explained(texts.get(name, ""), default)]
                ),
                required=default is MISSING,
            )
            for name, hint, default in fields_in_data
            if not self.keys or name in self.keys
        }
        names, tag = list(entries), {TAG: self.tag} if self.tag else {}
        # Drake's own defaults are not written: another Drake may not have the key any more.
        drakes = {} if is_dataclass(source) else {n: d for n, _, d in fields_in_data}
        unwritten = {name: drakes[name] for name in drakes if name not in self.defaults}
        if tag:
            literal = core_schema.literal_schema([self.tag])
            entries[TAG] = core_schema.typed_dict_field(literal, required=self.needs_tag)

        def make(data: dict[str, Any]) -> Any:
            data.pop(TAG, None)
            return source(**{**self.defaults, **data})

        def dump(made: Any, dump_data: Callable[[Any], Any]) -> Any:
            values = [(name, getattr(made, name)) for name in names]
            told = {n: v for n, v in values if n not in unwritten or v != unwritten[n]}
            return dump_data({**tag, **told})

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

    def _type_in_data(self, hint: Any) -> Any:
        """The type in data of a field with an annotation."""
        if is_dataclass(hint):
            return Annotated[hint, Form(self.written)]
        members = _members(hint)
        for annotation, form in self.written.items():
            if _members(annotation) <= members:
                return form | None if type(None) in members else form
        # In data a tuple is a list.
        return Annotated[hint, pydantic.Strict(False)] if get_origin(hint) is tuple else hint


_MADE: dict[Any, tuple[Form, CoreSchema]] = {}
"""What a `Form` makes of a class, with the form itself, whose `written` is known by identity."""


@dataclass(frozen=True)
class _Explained:
    """Adds the text of a field, and its default, to the JSON Schema of its type."""

    text: str
    default: Any

    def __get_pydantic_json_schema__(
        self, source: CoreSchema, handler: pydantic.GetJsonSchemaHandler
    ) -> dict[str, Any]:
        schema = dict(handler(source))
        combined = "\n\n".join(filter(None, (self.text, schema.get("description"))))
        schema.update({"description": combined} if combined else {})
        schema.update({"default": self.default} if _is_plain(self.default) else {})
        return schema


def _is_plain(value: Any) -> bool:
    """Whether a default is plain data, and not an object."""
    if isinstance(value, (list, tuple)):
        return all(map(_is_plain, value))
    return value is None or value == {} or isinstance(value, (bool, int, float, str))


def _fields_of(source: type[Any], defaults: Mapping[str, Any]) -> Iterator[tuple[str, Any, Any]]:
    """The name, the annotation and the default of each field, `MISSING` where it has none."""
    if not is_dataclass(source):
        made: Any = source()
        for item in made.__fields__:
            yield item.name, item.type, defaults.get(item.name, getattr(made, item.name))
        return
    hints = get_type_hints(source, include_extras=True)
    for item in fields(source):
        if item.init:
            factory = item.default_factory
            default = item.default if factory is MISSING else factory()
            yield item.name, hints[item.name], defaults.get(item.name, default)


def _members(hint: Any) -> set[Any]:
    """The members of a Union; any other annotation is its own only member."""
    return set(get_args(hint)) if get_origin(hint) in (Union, UnionType) else {hint}


@dataclass(frozen=True, eq=False)
class Choice:
    """Annotates a Union of dataclasses: a tag chooses one, by default the first.

    The tag is "!" and the name of the class, without a "Form" at its end. A member annotated with a
    `Form` has the tag and the defaults of that `Form`. Members `str` and `float` are plain text and
    a number.

    Attributes:
        written: The types that stand for others in data, as in `Form`, for all members.
    """

    written: Mapping[Any, Any] = field(default_factory=dict)

    def __get_pydantic_core_schema__(
        self, source: Any, handler: pydantic.GetCoreSchemaHandler
    ) -> CoreSchema:
        forms: dict[type[Any], Form] = {}
        members = get_args(source)
        for member in (member for member in members if member not in PLAIN):
            cls, form = get_args(member) or (member, Form())
            tag = form.tag or f"!{cls.__name__.removesuffix('Form')}"
            forms[cls] = replace(form, written=self.written, tag=tag, needs_tag=bool(forms))
        first = next(iter(forms.values())).tag

        def chosen(value: Any) -> str | None:
            if isinstance(value, dict):
                return str(value.get(TAG, first))
            for plain, types in ((str, str), (float, (int, float))):
                if plain in members and isinstance(value, types) and not isinstance(value, bool):
                    return PLAIN[plain]
            return forms[type(value)].tag if type(value) in forms else None

        choices = {
            form.tag: handler.generate_schema(Annotated[cls, form]) for cls, form in forms.items()
        }
        if str in members:
            choices[PLAIN[str]] = core_schema.str_schema(strict=True)
        if float in members:
            choices[PLAIN[float]] = core_schema.float_schema(strict=True, allow_inf_nan=False)
        return core_schema.tagged_union_schema(choices, chosen)
