"""Motions through many points: uniform B-splines in time, within limits."""

from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from drake_dae.arguments import checked
from drake_dae.arrays import FloatArray, numbers, positive
from drake_dae.dae.references.paths import check_order
from drake_dae.dae.references.pieces import PiecewisePolynomials, PiecewiseReference
from drake_dae.dae.references.travel import PathLimits
from drake_dae.errors import ReferenceSignalError

MOST_POINTS = 20_000
"""The largest number of points; more would take longer to prepare than to follow."""


@dataclass(frozen=True, eq=False)
class TimeSpline:
    """r(t) = sum_k c_k N((t - start_time) / step - k), N the uniform B-spline of order + 1.

    Before, it rests at the first point and after, at the last; `order` derivatives are continuous.
    Its derivatives are averages of differences of neighbouring points, and so bounded: |r^(j)| <=
    max |Delta^j c| / step^j.

    Attributes:
        points: c_0, ..., c_(n-1), shape (n, k).
        step: The time between two points, in s.
        start_time: The time at which it leaves the first point, in s.
        order: The number of continuous derivatives.
    """

    points: FloatArray
    step: float
    start_time: float
    order: int

    @property
    def degree(self) -> int:
        """The degree of the polynomials."""
        return self.order + 1

    @property
    def spans(self) -> int:
        """The number of polynomials between the rests."""
        return len(self.points) + self.degree - 2

    @property
    def duration(self) -> float:
        """The duration of the motion, in s."""
        return self.spans * self.step

    @cached_property
    def differences(self) -> list[FloatArray]:
        """Delta^j c / step^j for j = 0, ..., order; the first and the last point repeated."""
        repeated = self.degree - 1
        orders = [np.pad(self.points, ((repeated, repeated), (0, 0)), mode="edge")]
        while len(orders) <= self.order:
            orders.append(np.diff(orders[-1], axis=0) / self.step)
        return orders

    def pieces(self, degrees: Sequence[int]) -> PiecewisePolynomials:
        """Returns the polynomials of r_1, ..., r_1^(mu_1), r_2, ..., for degrees mu <= order."""
        rows = {
            j: sliding_window_view(self.differences[j], self.degree - j + 1, axis=0)
            @ basis_pieces(self.degree - j).T
            for j in range(max(degrees) + 1)
        }
        factors = np.zeros((self.spans, sum(degrees) + len(degrees), self.degree + 1))
        places = [(i, j) for i, degree in enumerate(degrees) for j in range(degree + 1)]
        for row, (i, j) in enumerate(places):
            factors[:, row, : self.degree - j + 1] = rows[j][:, i]
        breaks = self.start_time + self.step * np.arange(self.spans + 1, dtype=np.float64)
        return PiecewisePolynomials(breaks, factors)


def basis_pieces(degree: int) -> FloatArray:
    """Returns the uniform B-splines on a span: entry (i, k) is the factor of x^i for point k.

    By the recursion of Cox and de Boor, shape (degree + 1, degree + 1).
    """
    pieces = np.ones((1, 1))
    for p in range(1, degree + 1):
        higher = np.zeros((p + 1, p + 1))
        for k in range(p + 1):
            for constant, slope, source in ((p - k, 1, k - 1), (k + 1, -1, k)):
                if 0 <= source < p:
                    higher[:p, k] += constant / p * pieces[:, source]
                    higher[1:, k] += slope / p * pieces[:, source]
        pieces = higher
    return pieces


class SplineReference(PiecewiseReference):
    """A reference that is a `TimeSpline`."""

    @property
    @abstractmethod
    def spline(self) -> TimeSpline:
        """The spline."""

    @property
    def size(self) -> int:
        return int(self.spline.points.shape[1])

    def pieces(self, degrees: Sequence[int]) -> PiecewisePolynomials:
        return self.spline.pieces(degrees)


def _spline_within(
    points: FloatArray, limits: PathLimits, start_time: float, order: int
) -> TimeSpline:
    """Returns the fastest spline over points with derivatives within limits.

    Args:
        points: The points, shape (n, k).
        limits: The largest speed, acceleration and jerk, of the points.
        start_time: The time at which it leaves the first point, in s.
        order: The number of continuous derivatives.
    """
    padded = np.pad(points, ((order, order), (0, 0)), mode="edge")
    steps = [
        (np.linalg.norm(np.diff(padded, j, axis=0), axis=1).max() / limit) ** (1 / j)
        for j, limit in enumerate(limits.values, start=1)
    ]
    return TimeSpline(points, float(max(steps)), start_time, order)


def _along_edges(corners: FloatArray, spacing: float) -> FloatArray:
    """Returns points along straight edges, no farther apart than a spacing, with all corners."""
    points = [corners[:1]]
    for first, last in pairwise(corners):
        count = int(np.ceil(np.linalg.norm(last - first) / spacing - 1e-9))
        points.append(first + np.linspace(0.0, 1.0, count + 1)[1:, None] * (last - first))
    return np.concatenate(points)


@checked(ReferenceSignalError)
@dataclass(frozen=True)
class PolylineReference(SplineReference):
    """A path of straight edges between points, with rounded corners, from rest to rest.

    It leaves an edge at the distance `corner` before its end, and joins the next one at the same
    distance. It is a uniform B-spline over points on the edges, 2 corner / order apart: the speed
    is constant on straight parts and lower at corners. It is the largest speed within all limits,
    so that larger corners are faster.

    Attributes:
        points: The points, in the outputs' unit, shape (n, k).
        limits: The largest speed, acceleration and jerk.
        corner: The distance from a point at which the path leaves the edges, in the outputs' unit.
        start_time: The start of the motion, in s.
        order: The number of continuous derivatives, from 2 to 12; at least mu of the outputs.

    Raises:
        ReferenceSignalError: A number is not valid, there are fewer than two points, two in a row
            are the same, or they are too many.
    """

    points: Sequence[Sequence[float]]
    limits: PathLimits
    corner: float
    start_time: float = 0.0
    order: int = 4

    def __post_init__(self) -> None:
        points = settle_points(self)
        length = np.linalg.norm(np.diff(points, axis=0), axis=1).sum()
        _check_spline(self.corner, self.order, float(length))

    @cached_property
    def spline(self) -> TimeSpline:
        points = _along_edges(np.array(self.points), 2 * self.corner / self.order)
        return _spline_within(points, self.limits, self.start_time, self.order)


def settle_points(reference: Any) -> FloatArray:
    """Converts the field `points` to a tuple of rows, and returns it as an array, shape (n, k).

    Raises:
        ReferenceSignalError: They are not rows of finite numbers, fewer than two, or two in
            succession are equal.
    """
    points = numbers("points", reference.points, ReferenceSignalError)
    if points.ndim != 2 or len(points) < 2 or not points.size or not np.isfinite(points).all():
        raise ReferenceSignalError(
            "points must be two or more, as a list of rows of finite numbers, got shape "
            f"{points.shape}"
        )
    rows = tuple(map(tuple, points.tolist()))
    object.__setattr__(reference, "points", rows)
    lengths = np.linalg.norm(np.diff(points, axis=0), axis=1)
    if not lengths.all():
        i = int(np.argmin(lengths))
        raise ReferenceSignalError(f"points {i} and {i + 1} are the same, {rows[i]}")
    return points


def _check_spline(corner: float, order: int, length: float) -> None:
    """Checks the rounding of corners.

    Raises:
        ReferenceSignalError: The corner is not positive or very small, or the order out of range.
    """
    positive("corner", corner, ReferenceSignalError)
    check_order(order)
    least = length * order / 2 / MOST_POINTS
    if corner < least:
        raise ReferenceSignalError(
            f"corner must be {rounded_up(least)} or more for a path of length {length:.3g}, got "
            f"{corner:g}"
        )


def rounded_up(value: float) -> str:
    """Formats a positive number with three digits, rounded up."""
    text = f"{value:.3g}"
    return text if float(text) >= value else f"{1.01 * value:.3g}"
