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
from drake_dae.references.splines import (
    MOST_POINTS,
    PiecewisePolynomials,
    PiecewiseReference,
    uniform_spline,
)

MOST = 1e15
"""Larger numbers are refused: a double has no useful digits left."""


@checked(ReferenceSignalError)
@dataclass(frozen=True)
class CsvReference(PiecewiseReference):
    """A smooth reference from columns of a CSV file; constant before the first and after the last.

    Columns are interpolated linearly between rows. The reference is this motion q, averaged over a
    window: a uniform B-spline over q at times that are `smoothing` apart, order + 2 in a window.
    The deviation from the rows is, to leading order, (order + 2) / 24 smoothing^2 q'', and of first
    order at a kink of q; more than `tolerance` is refused. Derivatives divide noise by powers of
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

    def pieces(self, degrees: Sequence[int]) -> PiecewisePolynomials:
        points, step = self._smoothed
        # The k-th point has its largest weight at k steps after the first row.
        begin = self.start_time - self.order / 2 * step
        return uniform_spline(points, step, begin, self.order, degrees)

    @cached_property
    def _smoothed(self) -> tuple[FloatArray, float]:
        """The points of the spline, shape (k, size), and the time between them in s."""
        (times, *columns), values = self.table.T, self.table[:, 1:]
        # The allowed deviation of each column; of a constant one, round-off.
        least = 1e-12 * np.abs(values).max(axis=0) + np.finfo(float).tiny
        allowed = np.maximum(self.tolerance * np.ptp(values, axis=0), least)
        finest = times[-1] / MOST_POINTS
        step = self.smoothing or max(float(np.median(np.diff(times))), finest)
        if step < finest * (1.0 - 1e-9):
            raise ReferenceSignalError(
                f"smoothing must be above {finest:.3g} s for {times[-1]:.3g} s, got {step:g} s"
            )
        while True:
            moments = step * np.arange(np.ceil(times[-1] / step - 1e-9) + 1.0)
            points = np.column_stack([np.interp(moments, times, column) for column in columns])
            begin, none = -self.order / 2 * step, [0] * self.size
            fitted = uniform_spline(points, step, begin, self.order, none).at(times)
            off = np.abs(fitted - values).max(axis=0)
            if np.all(off <= allowed):
                return points, step
            if self.smoothing is not None or step < 2.0 * finest:
                worst = int(np.argmax(off / allowed))
                raise ReferenceSignalError(
                    f"'{self.file}': smoothed over {step:.3g} s the reference is off its rows by "
                    f"{off[worst]:.3g} in '{self.columns[worst]}', and at most "
                    f"{allowed[worst]:.3g} is allowed, {self.tolerance:g} of the column's range. "
                    "Choose a smaller smoothing, give more rows where the path turns, or write a "
                    "larger tolerance"
                )
            step /= 2.0


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
        if header.count(name) > 1:
            raise ReferenceSignalError(
                f"'{file}': {header.count(name)} columns have the name '{name}'; each column that "
                "is read needs its own"
            )
    values = np.empty((len(rows), len(names)))
    for i, row in enumerate(rows):
        cells = dict(zip(header, row, strict=False))
        for j, name in enumerate(names):
            value = number_in(cell := cells.get(name, ""))
            if value is None or abs(value) > MOST:
                expected = "a number" if value is None else f"a number of at most {MOST:g}"
                raise ReferenceSignalError(
                    f"'{file}', row {i + 2}, {name}: expected {expected}, got '{cell[:40]}'"
                )
            values[i, j] = value
    if len(values) < 2:
        raise ReferenceSignalError(f"'{file}' has {len(values)} rows of numbers, 2 are needed")
    if not np.all(rises := np.diff(values[:, 0]) > 0):
        place = int(np.argmin(rises)) + 3
        raise ReferenceSignalError(f"'{file}': {names[0]} must increase, and not so in row {place}")
    values[:, 0] -= values[0, 0]
    return values
