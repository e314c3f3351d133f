"""Values in plain data without a dataclass: numbers, file names, vectors."""

from pathlib import Path
from sys import float_info
from typing import Annotated, Any

import numpy as np
import pydantic

from drake_dae.arrays import brief
from drake_dae.scenario.forms.typed_yaml import TAG


def shown(data: Any) -> str:
    """A value as the user wrote it, but short."""
    if data is None:
        return "nothing"
    if isinstance(data, dict) and TAG in data:
        return str(data[TAG])
    text = brief(data)
    return text if len(text) <= 60 else f"{text[:57]}..."


def _numbers(value: Any) -> Any:
    """A number, a list of numbers or a list of rows; a list of one number is that number."""
    rows = value if isinstance(value, list) else [value]
    is_matrix = bool(rows) and all(isinstance(row, list) for row in rows)
    entries = [entry for row in rows for entry in row] if is_matrix else rows
    for entry in entries:
        if type(entry) not in (int, float) or not abs(entry) <= float_info.max:
            wanted = "a number, a list of numbers, or a matrix as a list of rows"
            raise ValueError(f"expected {wanted}, got {shown(entry)}")
    if is_matrix and len({len(row) for row in rows}) > 1:
        raise ValueError(f"the rows of {shown(value)} have different lengths")
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
    """A file; relative paths are in the reader's folder."""
    if not isinstance(value, (str, Path)) or not str(value):
        raise ValueError(f"expected the name of a file, got {shown(value)}")
    try:
        return (info.context or Path()) / value
    except ValueError:  # A null byte.
        raise ValueError(f"expected the name of a file, got {shown(value)}") from None


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

Interval = Annotated[tuple[float | list[float], float | list[float]], pydantic.Strict(False)]
"""A lowest and a highest value, each a number or a list of numbers."""
