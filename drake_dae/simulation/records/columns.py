"""A record as text: a line of names with units, then one line for each time."""

import csv
import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np

from drake_dae.arrays import FloatArray, brief, listed, number_in
from drake_dae.dae.system.signals import Signal
from drake_dae.errors import ModelError

TIME = "time"

_LABEL = re.compile(r"\s*(.+?)(?:\s+\[([^\]]*)\])?\s*")
"""A name, and perhaps its unit in brackets."""

Table = tuple[FloatArray, dict[str, tuple[FloatArray, tuple[Signal, ...]]]]
"""The times, and name of a signal -> its values, with names and units."""


def label(signal: Signal) -> str:
    """A name with its unit."""
    return f"{signal.name} [{signal.unit}]" if signal.unit else signal.name


def write_csv(
    path: str | Path, time: FloatArray, signals: Mapping[str, tuple[FloatArray, Sequence[Signal]]]
) -> None:
    """Writes the columns "time [s]" and "<signal>.<name> [<unit>]"; numbers have all their digits.

    Args:
        path: The file.
        time: The times in s, shape (k,).
        signals: Name of a signal -> its values, shape (k, n), and their names and units.
    """
    columns = [f"{name}.{label(one)}" for name, (_, own) in signals.items() for one in own]
    rows = np.column_stack([time, *(values for values, _ in signals.values())])
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
    labels = dict[str, list[tuple[int, Signal]]]()
    time = values[:, 0]
    for number, (_, name, unit) in enumerate(chosen):
        signal, dot, entry = name.partition(".")
        if name == TIME:
            time = values[:, number]
        elif dot:
            labels.setdefault(signal, []).append((number, Signal(entry, unit)))
        else:
            raise ModelError(
                f"{path}: a column of a record is 'time' or '<signal>.<name>', such as "
                f"'control.joint1_motor', got {brief(name)}"
            )
    return time, {
        signal: (values[:, [number for number, _ in own]], tuple(one for _, one in own))
        for signal, own in labels.items()
    }


def _columns(
    path: str | Path, head: Sequence[str], columns: Mapping[str, str] | None
) -> list[tuple[int, str, str]]:
    """Place, name and unit of the columns that are read."""
    if len(head) == 1 and ";" in head[0]:
        raise ModelError(f"{path} separates its columns by ';'; separate them by ','")
    parsed = [(i, *name_and_unit(text)) for i, text in enumerate(head)]
    if columns is not None:
        known = {name: (i, unit) for i, name, unit in parsed}
        missing = [name for name in columns if name_and_unit(name)[0] not in known]
        if missing:
            raise ModelError(f"{path} has no column {listed(missing)}; it has {listed(known, 30)}")
        chosen = []
        for given, meant in columns.items():
            place, unit = known[name_and_unit(given)[0]]
            name, said = name_and_unit(meant)
            chosen.append((place, name, said or unit))
        parsed = chosen
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


def name_and_unit(text: str) -> tuple[str, str]:
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
