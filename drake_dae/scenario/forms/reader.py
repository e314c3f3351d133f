"""Reads dataclasses from plain data and writes them, with all problems at once."""

from collections.abc import Iterator, Mapping
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, Generic, TypeVar

import pydantic

from drake_dae.arrays import can_be_written
from drake_dae.errors import ScenarioError
from drake_dae.scenario.forms.forms import Form
from drake_dae.scenario.forms.problems import problem

T = TypeVar("T")


class Reader(Generic[T]):
    """Reads a dataclass from plain data, and converts it to plain data.

    Args:
        form: The dataclass.
        keys: The fields that are read and written; all if empty.
    """

    def __init__(self, form: type[T], keys: tuple[str, ...] = ()) -> None:
        whole = Annotated[form, Form(keys=keys)]  # type: ignore[valid-type]
        self._adapter: pydantic.TypeAdapter[T] = pydantic.TypeAdapter(whole)

    @cached_property
    def schema(self) -> dict[str, Any]:
        """The JSON Schema of the plain data."""
        return self._adapter.json_schema()

    @cached_property
    def free_names(self) -> set[str]:
        """Dotted keys of the dictionaries with any names; "*" is any entry of a list."""
        # The schema of pydantic: the JSON Schema takes longer than a short run.
        return set(_free_names(self._adapter.core_schema, ""))

    def read(self, data: Any, folder: Path | None = None) -> T:
        """Makes the dataclass of plain data.

        Args:
            data: The plain data.
            folder: The folder of relative file names; None for the working directory.

        Raises:
            ScenarioError: Keys are unknown or missing, or values are wrong; all problems are
                listed.
        """
        if "\\ud" in repr(data) and (unwritable := dict.fromkeys(_unwritable(data, ""))):
            text = "a text has half of a letter (\\ud800 to \\udfff), which no file can hold"
            raise ScenarioError(*((key or "scenario", text) for key in unwritable))
        try:
            return self._adapter.validate_python(data, context=folder)
        except pydantic.ValidationError as error:
            # Each member of a Union reports the same.
            problems = dict.fromkeys(
                problem(self.schema, details, data) for details in error.errors()
            )
            raise ScenarioError(*problems) from None

    def write(self, value: T) -> Any:
        """Converts a value to plain data, the inverse of `read`."""
        return self._adapter.dump_python(value, mode="json")


def _unwritable(data: Any, key: str) -> Iterator[str]:
    """The dotted keys of texts in plain data that cannot be written to a file."""
    if isinstance(data, str) and not can_be_written(data):
        yield key
    if isinstance(data, (list, tuple)):
        data = dict(enumerate(data))
    for name, inner in data.items() if isinstance(data, Mapping) else ():
        if isinstance(name, str) and not can_be_written(name):
            yield key
        yield from _unwritable(inner, f"{key}.{name}" if key else str(name))


def _free_names(schema: Mapping[str, Any], path: str) -> Iterator[str]:
    """The dotted keys below a path whose data are dictionaries with any names."""
    if schema["type"] == "dict":
        yield path
    elif schema["type"] == "list":
        yield from _free_names(schema.get("items_schema", {"type": "any"}), _below(path, "*"))
    elif schema["type"] == "typed-dict":
        for name, field in schema["fields"].items():
            yield from _free_names(field["schema"], _below(path, name))
    elif schema["type"] == "tagged-union":
        for member in schema["choices"].values():
            yield from _free_names(member, path)
    elif "schema" in schema:  # A nullable value, a check.
        yield from _free_names(schema["schema"], path)


def _below(path: str, name: str) -> str:
    return f"{path}.{name}" if path else name
