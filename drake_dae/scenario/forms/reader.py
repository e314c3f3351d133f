"""Reads dataclasses from plain data and writes them, with all problems at once."""

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Annotated, Any, Generic, TypeVar

import pydantic

from drake_dae.arrays import can_be_written
from drake_dae.errors import ScenarioError
from drake_dae.scenario.forms.forms import Form, ReadingContext
from drake_dae.scenario.forms.problems import problem, with_parts

T = TypeVar("T")


class Reader(Generic[T]):
    """Reads a dataclass from plain data, and writes it."""

    def __init__(self, form: type[T]) -> None:
        whole = Annotated[form, Form(is_part=False)]  # type: ignore[valid-type]
        self._adapter: pydantic.TypeAdapter[T] = pydantic.TypeAdapter(whole)
        self.schema: dict[str, Any] = self._adapter.json_schema()
        #: Dotted keys of the dictionaries with any names; "*" is any entry of a list.
        self.free_names = set(_free_names(self.schema, ""))

    def read(self, data: Any, folder: Path | None = None, known: dict[Any, Any] | None = None) -> T:
        """The dataclass that plain data describe.

        Args:
            data: The plain data.
            folder: The folder of relative file names; None for the working directory.
            known: As of `ReadingContext`.

        Raises:
            ScenarioError: Keys are unknown or missing, or values are wrong; all problems are
                listed.
        """
        # What repr shows as it is has no such letter, and most data have none.
        suspicious = "\\ud" in repr(data)
        unwritable = dict.fromkeys(_unwritable(data, "")) if suspicious else {}
        if unwritable:
            text = "a text has half of a letter (\\ud800 to \\udfff), which no file can hold"
            raise ScenarioError(*((key or "scenario", text) for key in unwritable))
        try:
            return self._adapter.validate_python(data, context=ReadingContext(folder, known))
        except pydantic.ValidationError as error:
            # Each member of a Union reports the same.
            problems = dict.fromkeys(
                problem(self.schema, details, data) for details in error.errors()
            )
            raise ScenarioError(*problems) from None

    def write(self, value: T) -> Any:
        """The plain data of a value, the inverse of `read`."""
        return self._adapter.dump_python(value, mode="json")


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


def _free_names(schema: Mapping[str, Any], path: str) -> Iterator[str]:
    schema = with_parts(schema)
    if isinstance(schema.get("additionalProperties"), dict):
        yield path
    for one in schema.get("oneOf", ()):
        yield from _free_names(one, path)
    inside = {"*": schema["items"]} if isinstance(schema.get("items"), dict) else {}
    for name, inner in {**schema.get("properties", {}), **inside}.items():
        yield from _free_names(inner, f"{path}.{name}" if path else name)
