"""A reference from a CSV file."""

import csv
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from drake_dae.arguments import checked
from drake_dae.arrays import FloatArray, number_in, positive, unknown_name
from drake_dae.errors import ReferenceSignalError
from drake_dae.files import read_text
from drake_dae.references.reference import check_order
from drake_dae.references.splines import MOST_POINTS, SplineReference, TimeSpline, rounded_up

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

    file: str | Path
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
        check_order(self.order, 2, 12)

    @property
    def size(self) -> int:
        return len(self.columns)

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
            while (
                np.any(self._off(spline) > self._allowed) and 2 * len(spline.points) < MOST_POINTS
            ):
                spline = self._smoothed(spline.step / 2)
        off = self._off(spline)
        if np.any(off > self._allowed):
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
        """Returns the spline whose points are `step` seconds apart."""
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
        """The largest deviation of a spline from each column, shape (size,)."""
        fitted = spline.pieces([0] * self.size).at(self.start_time + self.table[:, 0])
        return np.abs(fitted - self.table[:, 1:]).max(axis=0)

    @cached_property
    def _allowed(self) -> FloatArray:
        """The allowed deviation of each column; of a constant one, round-off. Shape (size,)."""
        values = self.table[:, 1:]
        least = 1e-12 * np.abs(values).max(axis=0) + np.finfo(float).tiny
        return np.maximum(self.tolerance * np.ptp(values, axis=0), least)


def _read(file: Path, names: Sequence[str]) -> FloatArray:
    """Reads columns of a file, the first one increasing from 0, shape (k, len(names))."""
    try:
        lines = read_text(file).splitlines()
        delimiter = max(",;\t", key=lines[0].count if lines else len)
        header, *rows = [row for row in csv.reader(lines, delimiter=delimiter) if any(row)] or [[]]
    except (OSError, ValueError, csv.Error) as error:
        reason = getattr(error, "strerror", None) or error
        raise ReferenceSignalError(f"cannot read '{file}': {reason}") from error
    header = [name.strip() for name in header]
    for name in names:
        if name not in header:
            raise ReferenceSignalError(f"'{file}': {unknown_name('column', name, header)}")
    values = np.empty((len(rows), len(names)))
    for i, row in enumerate(rows):
        for j, name in enumerate(names):
            place = header.index(name)
            cell = row[place] if place < len(row) else ""
            value = number_in(cell)
            if value is None or abs(value) > MOST:
                expected = "a number" if value is None else f"a number of at most {MOST:g}"
                raise ReferenceSignalError(
                    f"'{file}', row {i + 2}, {name}: expected {expected}, got '{cell[:40]}'"
                )
            values[i, j] = value
    if len(values) < 2:
        raise ReferenceSignalError(f"'{file}' has {len(values)} rows of numbers, 2 are needed")
    steps = np.diff(values[:, 0])
    if not np.all(steps > 0):
        i = int(np.argmin(steps > 0))
        raise ReferenceSignalError(
            f"'{file}': {names[0]} must increase, row {i + 3} has {values[i + 1, 0]:g} "
            f"after {values[i, 0]:g}"
        )
    values[:, 0] -= values[0, 0]
    return values
