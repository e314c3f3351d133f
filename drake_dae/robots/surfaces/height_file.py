"""Tables of heights, from files and from arrays."""

import csv
import struct
from io import BytesIO
from math import prod
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from drake_dae.arrays import FloatArray, number_in, numbers
from drake_dae.errors import ModelError, describe_os_error
from drake_dae.files import read_bytes

MOST_HEIGHTS = 10_000_000
"""The largest number of heights: a fit to them takes a gigabyte."""


def read_heights(file: Path) -> FloatArray:
    """The heights in a file, first row lowest."""
    readers = {".csv": _read_csv, ".npy": _read_npy, ".png": _read_png}
    if file.suffix.lower() not in readers:
        raise ModelError(f"'{file.name}' is no .csv, .npy or .png")
    try:
        rows = readers[file.suffix.lower()](read_bytes(file))
    except OSError as error:
        raise ModelError(describe_os_error(error)) from None
    except Exception as error:  # NumPy (whose headers are Python) and Pillow raise many kinds.
        text = " ".join(str(error).split())[:200]
        raise ModelError(f"'{file.name}' has no table of heights: {text}") from None
    return height_table(f"'{file.name}'", rows)


def _read_csv(data: bytes) -> FloatArray:
    """Rows of numbers, separated by semicolons, tabs, commas or blanks, tried in this order.

    Raises:
        ValueError: A cell is no number, or the rows have different lengths.
    """
    lines = [line.strip(" \r") for line in data.decode("utf-8-sig").splitlines()]
    lines = [line for line in lines if line.strip(" \t,;")]
    between = next((mark for mark in ";\t," if any(mark in line for line in lines)), None)
    rows = csv.reader(lines, delimiter=between) if between else map(str.split, lines)
    cells = [[cell.strip() for cell in row] for row in rows]
    if cells and all(not row[-1] for row in cells):
        cells = [row[:-1] for row in cells]  # A separator after the last number of each row.
    heights = [
        [_height(cell, row, column) for column, cell in enumerate(line, start=1)]
        for row, line in enumerate(cells, start=1)
    ]
    lengths = [len(row) for row in heights]
    if len(set(lengths)) > 1:
        other = next(i for i, length in enumerate(lengths) if length != lengths[0])
        raise ValueError(f"row 1 has {lengths[0]} heights, row {other + 1} has {lengths[other]}")
    return np.array(heights)


def _height(cell: str, row: int, column: int) -> float:
    """A cell as a number."""
    value = number_in(cell)
    if value is None:
        decimal = number_in(cell.replace(",", ".")) is not None
        hint = "; write decimals with a point" if decimal else ""
        got = f"'{cell[:20]}'" if cell else "an empty cell"
        raise ValueError(f"row {row}, column {column}: expected a number, got {got}{hint}")
    return value


def _read_npy(data: bytes) -> NDArray[Any]:
    """The array of an .npy file.

    Raises:
        ValueError: It contains something else, or is shorter than its header says.
    """
    file = BytesIO(data)
    if not data.startswith(b"\x93NUMPY"):
        raise ValueError("it does not begin as an .npy file")
    version = np.lib.format.read_magic(file)
    read = {(1, 0): np.lib.format.read_array_header_1_0}
    shape, _, kind = read.get(version, np.lib.format.read_array_header_2_0)(file)
    if kind.kind not in "iuf":
        raise ValueError(f"its entries are {kind}, and no real numbers")
    if prod(shape) * kind.itemsize > len(data):
        raise ValueError(f"it claims shape {shape}, which is more than it holds")
    file.seek(0)
    return np.load(file, allow_pickle=False)


def _read_png(data: bytes) -> NDArray[Any]:
    """The brightness of an image, its lowest row first.

    Raises:
        ValueError: It has more than `MOST_HEIGHTS` pixels.
    """
    from matplotlib.image import imread

    if data[:8] != b"\x89PNG\r\n\x1a\n" or len(data) < 24:
        raise ValueError("it does not begin as a .png file")
    width, height = struct.unpack(">II", data[16:24])
    if width * height > MOST_HEIGHTS:
        raise ValueError(f"{width} times {height} pixels; at most {MOST_HEIGHTS} are read")
    pixels = imread(BytesIO(data), format="png")[::-1].astype(float)
    return pixels if pixels.ndim == 2 else pixels[..., :3].mean(axis=2)


def height_table(what: str, rows: ArrayLike) -> FloatArray:
    """Rows as an array.

    Raises:
        ModelError: They are not a table of numbers, or too few.
    """
    heights = numbers(f"{what}: heights", rows)
    if heights.ndim != 2 or min(heights.shape) < 2:
        raise ModelError(
            f"{what}: two rows of two heights are the least, got shape {heights.shape}"
        )
    if heights.size > MOST_HEIGHTS:
        raise ModelError(f"{what}: {heights.size} heights; at most {MOST_HEIGHTS} are read")
    bad = np.argwhere(~np.isfinite(heights))
    if bad.size:
        row, column = bad[0] + 1
        raise ModelError(f"{what}: row {row}, column {column} is no height")
    return heights
