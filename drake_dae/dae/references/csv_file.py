"""A reference from a CSV file."""

import csv
import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Self

import numpy as np

from drake_dae.arguments import checked
from drake_dae.arrays import FloatArray, number_in, positive, unknown_name
from drake_dae.dae.references.paths import check_order
from drake_dae.dae.references.splines import MOST_POINTS, SplineReference, TimeSpline, rounded_up
from drake_dae.errors import ReferenceSignalError
from drake_dae.files import read_text

MOST = 1e15
"""Larger numbers are refused: a double has no useful digits left."""


@checked(ReferenceSignalError)
@dataclass(frozen=True)
class CsvReference(SplineReference):
    """A smooth reference from columns of a CSV file; constant before the first and after the last.

    Columns are interpolated linearly between rows. The reference is this motion q, averaged over a
    window: a uniform B-spline over q at times that are `smoothing` apart, order + 2 in a window.
    The deviation from the rows is, to leading order, (order + 2) / 24 smoothing^2 q''; its maximum
    is `deviation`, and more than `tolerance` is refused. At a kink of q, as on a path of few rows,
    the deviation is of first order in `smoothing`. Derivatives divide noise by powers of
    `smoothing`: choose both numbers for noisy rows. If the velocity of q is not zero at the
    first row, the reference starts half a window before it.

    Attributes:
        file: The file: a row of names, then rows of numbers; comma, semicolon or tab between.
        columns: The names of the columns, one for each output.
        time: The name of the column of times in s, which increase.
        smoothing: The time between points of the spline, in s; None for the median of that between
            rows, halved until the reference is within the tolerance.
        start_time: The time of the first row, in s.
        order: The number of continuous derivatives, from 2 to 12; at least mu of the outputs.
        tolerance: The allowed deviation from the rows, as a fraction of the range of each column.

    Raises:
        ReferenceSignalError: A number is not valid. When the reference is used: there is no such
            file or column, it contains other values than numbers, or the deviation exceeds the
            tolerance.
    """

    file: str
    columns: Sequence[str]
    time: str = "time"
    smoothing: float | None = None
    start_time: float = 0.0
    order: int = 4
    tolerance: float = 0.02

    def __post_init__(self) -> None:
        object.__setattr__(self, "columns", tuple(self.columns))
        if not self.columns:
            raise ReferenceSignalError("columns: empty, at least one name is needed")
        if self.smoothing is not None:
            positive("smoothing", self.smoothing, ReferenceSignalError)
        positive("tolerance", self.tolerance, ReferenceSignalError)
        check_order(self.order)

    @property
    def size(self) -> int:
        return len(self.columns)

    def beside(self, folder: Path) -> Self:
        return replace(self, file=os.path.abspath(folder / self.file))

    @cached_property
    def table(self) -> FloatArray:
        """The times since the first row, and the columns, shape (k, 1 + size)."""
        return _read(Path(self.file), [self.time, *self.columns])

    @cached_property
    def spline(self) -> TimeSpline:
        times = self.table[:, 0]
        if self.smoothing is not None:
            spline = self._smoothed(self.smoothing)
        else:
            spline = self._smoothed(max(float(np.median(np.diff(times))), times[-1] / MOST_POINTS))
            while self._excess(spline) > 1.0 and 2 * len(spline.points) < MOST_POINTS:
                spline = self._smoothed(spline.step / 2)
        if self._excess(spline) > 1.0:
            off = self._off(spline)
            worst = int(np.argmax(off / self._allowed))
            raise ReferenceSignalError(
                f"'{self.file}': smoothed over {spline.step:.3g} s the reference is off its rows "
                f"by {off[worst]:.3g} in '{self.columns[worst]}', and at most "
                f"{self._allowed[worst]:.3g} is allowed, {self.tolerance:g} of the column's range. "
                "Choose a smaller smoothing, give more rows where the path turns, or write a "
                "larger tolerance"
            )
        return spline

    def _smoothed(self, step: float) -> TimeSpline:
        """Returns the spline with a spacing of its points in s."""
        times = self.table[:, 0]
        count = float(np.ceil(times[-1] / step - 1e-9)) + 1
        if count > MOST_POINTS + 1:
            least = times[-1] / MOST_POINTS
            raise ReferenceSignalError(
                f"smoothing must be {rounded_up(least)} s or more for {times[-1]:.3g} s, got "
                f"{step:g} s"
            )
        moments = step * np.arange(int(count))
        points = np.column_stack([np.interp(moments, times, row) for row in self.table.T[1:]])
        # The k-th point has its largest weight at k steps after the first row.
        return TimeSpline(points, step, self.start_time - self.order / 2 * step, self.order)

    @property
    def deviation(self) -> FloatArray:
        """The largest distance of each column's rows from the reference, shape (size,)."""
        return self._off(self.spline)

    @property
    def remark(self) -> str:
        """The deviation from the rows, as text."""
        pairs = zip(self.columns, self.deviation, strict=True)
        distances = ", ".join(f"{off:.2g} in {column}" for column, off in pairs)
        return (
            f"CsvReference '{Path(self.file).name}': smoothed over {self.spline.step:.3g} s, its "
            f"largest distances from its rows are {distances}"
        )

    def _off(self, spline: TimeSpline) -> FloatArray:
        """The largest deviation of a spline from the rows, shape (size,)."""
        fitted = spline.pieces([0] * self.size).at_all(self.start_time + self.table[:, 0])
        return np.abs(fitted - self.table[:, 1:]).max(axis=0)

    def _excess(self, spline: TimeSpline) -> float:
        """The largest ratio of deviation to tolerance."""
        return float(np.max(self._off(spline) / self._allowed))

    @cached_property
    def _allowed(self) -> FloatArray:
        """The allowed deviation of each column, shape (size,)."""
        values = self.table[:, 1:]
        # Round-off for a constant column.
        least = 1e-12 * np.abs(values).max(axis=0) + np.finfo(float).tiny
        return np.maximum(self.tolerance * np.ptp(values, axis=0), least)


def _read(file: Path, names: Sequence[str]) -> FloatArray:
    """Reads columns of a file, the first one increasing from 0, shape (k, len(names))."""
    header, cells = read_cells(file)
    for name in names:
        if name not in header:
            raise ReferenceSignalError(f"'{file}': {unknown_name('column', name, header)}")
    values = numbers_of(file, header, cells, names)
    steps = np.diff(values[:, 0])
    if not np.all(steps > 0):
        row = int(np.argmin(steps > 0))
        raise ReferenceSignalError(
            f"'{file}': {names[0]} must increase, row {row + 3} has {values[row + 1, 0]:g} "
            f"after {values[row, 0]:g}"
        )
    values[:, 0] -= values[0, 0]
    return values


def read_cells(file: Path) -> tuple[list[str], list[list[str]]]:
    """Reads the names of the columns of a file, and its other rows that are not empty.

    Raises:
        ReferenceSignalError: It cannot be read.
    """
    try:
        lines = read_text(file).splitlines()
        delimiter = max(",;\t", key=lines[0].count if lines else len)
        cells = [row for row in csv.reader(lines, delimiter=delimiter) if any(row)]
    except (OSError, ValueError, csv.Error) as error:
        reason = getattr(error, "strerror", None) or error
        raise ReferenceSignalError(f"cannot read '{file}': {reason}") from error
    return [name.strip() for name in cells[0]] if cells else [], cells[1:]


def numbers_of(
    file: Path, header: Sequence[str], cells: Sequence[Sequence[str]], names: Sequence[str]
) -> FloatArray:
    """Converts columns to numbers, shape (k, len(names)) with k >= 2.

    Raises:
        ReferenceSignalError: A cell is no number, or there are too few rows.
    """
    places = [header.index(name) for name in names]
    values = np.empty((len(cells), len(names)))
    for index, row in enumerate(cells):
        for column, index_in_row in enumerate(places):
            cell = row[index_in_row] if index_in_row < len(row) else ""
            values[index, column] = _number(cell, f"'{file}', row {index + 2}, {names[column]}")
    if len(values) < 2:
        raise ReferenceSignalError(f"'{file}' has {len(values)} rows of numbers, 2 are needed")
    return values


def _number(cell: str, where: str) -> float:
    """Converts a cell of the table to a finite number."""
    value = number_in(cell)
    if value is None or abs(value) > MOST:
        expected = "a number" if value is None else f"a number of at most {MOST:g}"
        raise ReferenceSignalError(f"{where}: expected {expected}, got '{cell[:40]}'")
    return value
