"""A record as text: a line of names with units, then one line for each time."""

import csv
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from drake_dae.arrays import FloatArray, brief, listed, number_in, numbers
from drake_dae.dae import Signal
from drake_dae.errors import ModelError

TIME = "time"

_LABEL = re.compile(r"\s*(.+?)(?:\s+\[([^\]]*)\])?\s*")
"""A name, and perhaps its unit in brackets."""


@dataclass(frozen=True, eq=False)
class Recorded:
    """A vector signal over time.

    Attributes:
        values: The values, one row per time, shape (k, size).
        signals: The name and unit of each column.
    """

    values: FloatArray
    signals: tuple[Signal, ...]

    def __post_init__(self) -> None:
        object.__setattr__(self, "values", numbers("the values of a signal", self.values))
        object.__setattr__(self, "signals", tuple(self.signals))


Table = tuple[FloatArray, dict[str, Recorded]]
"""The times, and the signals by name."""


def label(signal: Signal) -> str:
    """A name with its unit."""
    return f"{signal.name} [{signal.unit}]" if signal.unit else signal.name


def write_csv(path: str | Path, time: FloatArray, signals: Mapping[str, Recorded]) -> None:
    """Writes the columns "time [s]" and "<signal>.<name> [<unit>]"; numbers have all their digits.

    Args:
        path: The file.
        time: The times in s, shape (k,).
        signals: The signals by name.
    """
    columns = [f"{name}.{label(s)}" for name, course in signals.items() for s in course.signals]
    rows = np.column_stack([time, *(course.values for course in signals.values())])
    with open(path, "w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow([f"{TIME} [s]", *columns])
        writer.writerows(rows.tolist())


def read_csv(path: str | Path, columns: Mapping[str, str] | None) -> Table:
    """Reads what `write_csv` writes, or the log of a robot.

    Args:
        path: The file.
        columns: A column of the file -> its name in a record, "time" or "<signal>.<name>", with or
            without a unit in brackets; other columns are left out. None if the file has these names
            itself.

    Raises:
        ModelError: The file cannot be read, it lacks a column or has two of one name, or some entry
            is not a number.
    """
    try:
        with open(path, newline="", encoding="utf-8-sig") as file:
            lines = csv.reader(file)
            chosen = _columns(path, next(lines, []), columns)
            rows = list(_numbers(path, lines, [place for place, *_ in chosen]))
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise ModelError(f"{path} cannot be read: {getattr(error, 'strerror', error)}") from None
    values = np.array(rows).reshape(-1, len(chosen))
    groups = dict[str, list[tuple[FloatArray, Signal]]]()
    time = values[:, 0]
    for column, (_, name, unit) in zip(values.T, chosen, strict=True):
        group, dot, entry = name.partition(".")
        if name == TIME:
            time = column
        elif dot:
            groups.setdefault(group, []).append((column, Signal(entry, unit)))
        else:
            raise ModelError(
                f"{path}: a column of a record is 'time' or '<signal>.<name>', such as "
                f"'control.joint1_motor', got {brief(name)}"
            )
    return time, {
        name: Recorded(np.column_stack([c for c, _ in columns]), tuple(s for _, s in columns))
        for name, columns in groups.items()
    }


def _columns(
    path: str | Path, head: Sequence[str], columns: Mapping[str, str] | None
) -> list[tuple[int, str, str]]:
    """Place, name and unit of the columns that are read."""
    if len(head) == 1 and ";" in head[0]:
        raise ModelError(f"{path} separates its columns by ';'; separate them by ','")
    parsed = [(i, *_name_and_unit(text)) for i, text in enumerate(head)]
    if columns is not None:
        available = {name: (i, unit) for i, name, unit in parsed}
        missing = [name for name in columns if _name_and_unit(name)[0] not in available]
        if missing:
            raise ModelError(
                f"{path} has no column {listed(missing)}; it has {listed(available, 30)}"
            )
        parsed = []
        for column, target in columns.items():
            place, unit = available[_name_and_unit(column)[0]]
            name, target_unit = _name_and_unit(target)
            parsed.append((place, name, target_unit or unit))
    names = [name for _, name, _ in parsed]
    if names.count(TIME) != 1:
        raise ModelError(
            f"{path} needs one column 'time', in s; it has {listed(names or head, 30)}"
        )
    (unit,) = (unit for _, name, unit in parsed if name == TIME)
    if unit not in ("", "s"):
        raise ModelError(f"{path} has times in {unit}; they must be in s")
    doubles = [name for name in names if names.count(name) > 1]
    if doubles:
        raise ModelError(f"{path} has two columns '{doubles[0]}'")
    return parsed


def _name_and_unit(text: str) -> tuple[str, str]:
    """Name and unit of a column."""
    match = _LABEL.fullmatch(text)
    return (match[1], match[2] or "") if match else (text, "")


def _numbers(
    path: str | Path, lines: Iterator[list[str]], places: Sequence[int]
) -> Iterator[list[float]]:
    for count, line in enumerate(lines, 2):
        if not line:
            continue
        numbers = [number_in(line[place]) if place < len(line) else None for place in places]
        if None in numbers:
            place = places[numbers.index(None)]
            entry = brief(line[place]) if place < len(line) else "nothing"
            raise ModelError(f"{path}: line {count} has {entry} where a number is needed")
        yield [number for number in numbers if number is not None]
