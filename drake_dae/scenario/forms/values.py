"""Values in plain data without a dataclass: numbers, vectors, file names."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from sys import float_info
from typing import Any

import numpy as np
import pydantic
from pydantic_core import core_schema

from drake_dae.scenario.forms.forms import shown

_NUMBER = {"type": "number"}
_LIST = {"type": "array", "items": _NUMBER}


def _is_number(value: Any) -> bool:
    return type(value) in (int, float) and abs(value) <= float_info.max


@dataclass(frozen=True, eq=False)
class Value:
    """Annotates the type of values that a function converts.

    Attributes:
        words: What is expected.
        schema: The JSON Schema.
        convert: The function of a value and the folder of relative file names; it returns None for
            a value that is wrong.
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
            raise ValueError(f"expected {self.words}, got {shown(value)}")
        return converted


def _vector(value: Any, size: int) -> Any:
    right = isinstance(value, (list, tuple)) and all(map(_is_number, value))
    return tuple(map(float, value)) if right and len(value) == (size or len(value)) else None


def _numbers(value: Any) -> Any:
    rows = value if isinstance(value, list) else [value]
    is_matrix = bool(rows) and all(isinstance(row, list) for row in rows)
    entries = [entry for row in rows for entry in row] if is_matrix else rows
    if not entries or not all(map(_is_number, entries)):
        return None
    if is_matrix and len({len(row) for row in rows}) > 1:
        return None
    numbers = np.array(value, dtype=float)
    return numbers.tolist() if numbers.size > 1 else numbers.item()


def _number_or_list(value: Any) -> Any:
    entries = value if isinstance(value, list) else [value]
    return value if all(map(_is_number, entries)) else None


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


NUMBERS = Value(
    "a number, a list of numbers, or a matrix as a list of rows of one length",
    {"anyOf": [_NUMBER, _LIST, {"type": "array", "items": _LIST}]},
    lambda value, folder: _numbers(value),
)
ROW = Value("a list of numbers", _LIST, lambda value, folder: _vector(value, 0))


def _fixed(size: int) -> Value:
    schema = {**_LIST, "minItems": size, "maxItems": size}
    return Value(f"{size} numbers", schema, lambda value, folder: _vector(value, size))


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
FILE = Value("the name of a file", {"type": "string"}, in_folder)


def _names(value: Any, folder: Path) -> Any:
    names = value if isinstance(value, list) else [value]
    return value if all(isinstance(name, str) for name in names) else None


NAMES = Value(
    "a name or a list of names",
    {"anyOf": [{"type": "string"}, {"type": "array", "items": {"type": "string"}}]},
    _names,
)
