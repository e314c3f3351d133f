"""A motion that a CSV file tells."""

import csv
import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Self

import numpy as np

from drake_dae.arguments import checked
from drake_dae.arrays import FloatArray, positive, unknown_name
from drake_dae.dae.references.paths import check_order
from drake_dae.dae.references.splines import MOST_POINTS, SplineReference, TimeSpline
from drake_dae.errors import ReferenceSignalError


@checked(ReferenceSignalError)
@dataclass(frozen=True)
class CsvReference(SplineReference):
    """Columns of a CSV file over its column of times, smoothed; held before and after.

    Between rows the columns go straight. The reference is that motion q, averaged over a window: a
    uniform B-spline over q at times that are `smoothing` apart, with order + 2 of them in a window.
    What that costs is, to first order, (order + 2) / 24 smoothing^2 q''; `deviation` tells how far
    it is from the rows at most. Derivatives of noise grow as it is divided by powers of
    `smoothing`. Half a window before the first row it begins to move, if q begins in motion.

    Attributes:
        file: The file: a row of names, then rows of numbers; comma, semicolon or tab between.
        columns: The names of the columns, one for each output.
        time: The name of the column of times in s, which increase.
        smoothing: The time between points of the spline, in s; None for the median of that between
            rows.
        start_time: When the first row is met, in s.
        order: How many derivatives are continuous, from 2 to 12; at least mu of the outputs.

    Raises:
        ReferenceSignalError: A number is of no use. When the reference is used: there is no such
            file or column, or it holds something else than numbers.
    """

    file: str
    columns: Sequence[str]
    time: str = "time"
    smoothing: float | None = None
    start_time: float = 0.0
    order: int = 4

    def __post_init__(self) -> None:
        object.__setattr__(self, "columns", tuple(self.columns))
        if not self.columns:
            raise ReferenceSignalError("columns: empty, at least one name is needed")
        if self.smoothing is not None:
            positive("smoothing", self.smoothing, ReferenceSignalError)
        check_order(self.order)

    @property
    def size(self) -> int:
        return len(self.columns)

    def beside(self, folder: Path) -> Self:
        return replace(self, file=os.path.abspath(folder / self.file))

    @cached_property
    def table(self) -> FloatArray:
        """Times after the first one and the columns, shape (k, 1 + size)."""
        return _read(Path(self.file), [self.time, *self.columns])

    @cached_property
    def spline(self) -> TimeSpline:
        times = self.table[:, 0]
        step = self.smoothing or float(np.median(np.diff(times)))
        count = round(float(np.ceil(times[-1] / step - 1e-9))) + 1
        if count > MOST_POINTS:
            least = times[-1] / MOST_POINTS
            raise ReferenceSignalError(
                f"smoothing must be {least:.3g} s or more for {times[-1]:.3g} s, got {step:g} s"
            )
        moments = step * np.arange(count)
        points = np.column_stack([np.interp(moments, times, row) for row in self.table.T[1:]])
        # The k-th point has its largest weight at k steps after the first row.
        return TimeSpline(points, step, self.start_time - self.order / 2 * step, self.order)

    @property
    def deviation(self) -> FloatArray:
        """The largest distance of each column's rows from the reference, shape (size,)."""
        function = self.derivatives([0] * self.size)
        found = [function(self.start_time + time) for time in self.table[:, 0]]
        return np.abs(found - self.table[:, 1:]).max(axis=0)


def _read(file: Path, names: Sequence[str]) -> FloatArray:
    """Columns of a file, the first one increasing from 0, shape (k, len(names))."""
    try:
        with file.open(newline="", encoding="utf-8-sig") as stream:
            first = stream.readline()
            stream.seek(0)
            delimiter = max(",;\t", key=first.count)
            cells = [row for row in csv.reader(stream, delimiter=delimiter) if any(row)]
    except (OSError, ValueError, csv.Error) as error:
        reason = getattr(error, "strerror", None) or error
        raise ReferenceSignalError(f"cannot read '{file}': {reason}") from error
    header = [name.strip() for name in cells[0]] if cells else []
    for name in names:
        if name not in header:
            raise ReferenceSignalError(f"'{file}': {unknown_name('column', name, header)}")
    places = [header.index(name) for name in names]
    values = np.empty((len(cells) - 1, len(names)))
    for index, row in enumerate(cells[1:]):
        for column, place in enumerate(places):
            cell = row[place] if place < len(row) else ""
            values[index, column] = _number(cell, f"'{file}', row {index + 2}, {names[column]}")
    if len(values) < 2:
        raise ReferenceSignalError(f"'{file}' has {len(values)} rows of numbers, 2 are needed")
    steps = np.diff(values[:, 0])
    if not np.all(steps > 0):
        place = int(np.argmin(steps > 0))
        raise ReferenceSignalError(
            f"'{file}': {names[0]} must increase, row {place + 3} has {values[place + 1, 0]:g} "
            f"after {values[place, 0]:g}"
        )
    values[:, 0] -= values[0, 0]
    return values


def _number(cell: str, where: str) -> float:
    """A cell of the table as a finite number."""
    try:
        value = float(cell)
    except ValueError:
        value = np.nan
    if not np.isfinite(value):
        raise ReferenceSignalError(f"{where}: expected a number, got '{cell[:40]}'")
    return value
