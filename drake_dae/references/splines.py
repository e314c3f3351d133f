"""Motions through many points: splines in time, within limits."""

from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from math import factorial
from typing import Any

import casadi as ca
import numpy as np
import scipy  # SciPy loads its large parts when they are used.
from numpy.typing import ArrayLike

from drake_dae.arguments import checked
from drake_dae.arrays import FloatArray, numbers, positive, vector
from drake_dae.errors import ReferenceSignalError
from drake_dae.references.paths import PathLimits
from drake_dae.references.reference import Reference, check_continuity, check_order

MOST_POINTS = 20_000
"""The largest number of points; more would take longer to prepare than to follow."""


UNROLLED = 200
"""The largest number of polynomials that an expression contains one by one; more are looked up in
a table, which runs side by side cannot do."""


@dataclass(frozen=True, eq=False)
class PiecewisePolynomials:
    """Piecewise polynomials in time: factors[i] @ (1, x, x^2, ...) in piece i.

    Here x = (t - breaks[i]) / (breaks[i + 1] - breaks[i]), breaks in s, shape (n + 1,), and factors
    has shape (n, rows, degree + 1). Before and after, the value is constant.
    """

    breaks: FloatArray
    factors: FloatArray

    @classmethod
    def of(
        cls, spline: Any, knots: FloatArray, times: FloatArray, unit: float, degrees: Sequence[int]
    ) -> "PiecewisePolynomials":
        """Those of r_1, ..., r_1^(mu_1), r_2, ..., r a spline of SciPy in times of a unit."""
        widths, powers = np.diff(knots)[:, None], range(spline.k + 1)
        terms = [spline.derivative(m)(knots[:-1]) * widths**m / factorial(m) for m in powers]
        table = [np.stack(terms, axis=2)]
        for _ in range(max(degrees)):
            slopes = table[-1][:, :, 1:] * np.array(powers[1:]) / widths[:, :, None]
            table.append(np.pad(slopes, ((0, 0), (0, 0), (0, 1))))
        rows = [table[j][:, i] / unit**j for i, mu in enumerate(degrees) for j in range(mu + 1)]
        return cls(times, np.stack(rows, axis=1))

    def at(self, times: FloatArray) -> FloatArray:
        """Returns the values at times in s, shape (len(times), rows)."""
        inside = np.clip(times, self.breaks[0], self.breaks[-1])
        piece = np.searchsorted(self.breaks[1:-1], inside, "right")
        x = (inside - self.breaks[piece]) / np.diff(self.breaks)[piece]
        powers = np.arange(self.factors.shape[2], dtype=float)
        return np.einsum("trp,tp->tr", self.factors[piece], x[:, None] ** powers)

    def expression(self, time: ca.SX) -> ca.SX:
        """Returns the values at a symbolic time, shape (rows, 1)."""
        count, rows, size = self.factors.shape
        # The begin of each piece, its width, and its factors that are not zero in all pieces.
        columns = self.factors.reshape(count, -1)
        places: list[int] = np.flatnonzero(columns.any(axis=0)).tolist()
        table = np.column_stack([self.breaks[:-1], np.diff(self.breaks), columns[:, places]])
        inside = ca.fmin(ca.fmax(time, self.breaks[0]), self.breaks[-1])
        if count <= UNROLLED:
            # The row of this time: the sum of all rows times 0 or 1.
            passed = [time >= moment for moment in self.breaks[1:-1]]
            row = ca.mtimes(ca.DM(table.T), ca.vertcat(1, *passed) - ca.vertcat(*passed, 0))
        else:
            pieces = np.arange(count + 1.0)
            exact = {"lookup_mode": ["exact"]}
            binary = {"lookup_mode": ["binary"]}
            index = ca.interpolant("piece", "linear", [self.breaks], pieces, binary)
            begin = ca.interpolant("begin", "linear", [pieces], self.breaks, exact)
            entries = ca.interpolant("row", "linear", [pieces[:-1]], table.ravel(), exact)
            found = ca.fmin(ca.floor(index(inside)), count - 1)
            # Where round-off has moved a time just before a break past it.
            row = entries(found - (inside < begin(found)))
        factors = ca.SX(rows * size, 1)
        factors[places] = row[2:]
        monomials = ca.vertcat(*[((inside - row[0]) / row[1]) ** k for k in range(size)])
        return ca.mtimes(ca.reshape(factors, size, rows).T, monomials)


class PiecewiseReference(Reference):
    """A piecewise polynomial reference with `order` continuous derivatives."""

    order: int

    @abstractmethod
    def pieces(self, degrees: Sequence[int]) -> PiecewisePolynomials:
        """Returns the polynomials of r_1, ..., r_1^(mu_1), r_2, ..., for degrees mu <= order."""

    def expression(self, degrees: Sequence[int], time: ca.SX) -> ca.SX:
        check_continuity(self, self.order, degrees)
        return self.pieces(degrees).expression(time)


def uniform_spline(
    points: FloatArray, step: float, start_time: float, order: int, degrees: Sequence[int]
) -> PiecewisePolynomials:
    """r(t) = sum_k c_k N((t - start_time) / step - k), N the uniform B-spline of order + 1.

    The points c_k have shape (n, k). Before, it rests at the first one and after, at the last;
    `order` derivatives are continuous. They are averages of differences of neighbouring points,
    and so bounded: |r^(j)| <= max |Delta^j c| / step^j.
    """
    held = np.pad(points, ((order, order), (0, 0)), mode="edge")
    spline = scipy.interpolate.BSpline(np.arange(-order - 1.0, len(held) + 1.0), held, order + 1)
    knots = np.arange(len(points) + order, dtype=np.float64)
    return PiecewisePolynomials.of(spline, knots, start_time + step * knots, step, degrees)


@checked(ReferenceSignalError)
@dataclass(frozen=True)
class PolylineReference(PiecewiseReference):
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
        corners = _check_points(self)
        positive("corner", self.corner, ReferenceSignalError)
        check_order(self.order, 2, 12)
        length = float(np.linalg.norm(np.diff(corners, axis=0), axis=1).sum())
        if self.corner < (least := length * self.order / 2 / MOST_POINTS):
            raise ReferenceSignalError(
                f"corner must be above {least:.3g} for a path of length {length:.3g}, got "
                f"{self.corner:g}"
            )

    @property
    def size(self) -> int:
        return len(self.points[0])

    def pieces(self, degrees: Sequence[int]) -> PiecewisePolynomials:
        corners, order = np.array(self.points), self.order
        spacing = 2 * self.corner / order
        edges = [corners[:1]]
        for first, last in pairwise(corners):
            count = int(np.ceil(np.linalg.norm(last - first) / spacing - 1e-9))
            edges.append(first + np.linspace(0.0, 1.0, count + 1)[1:, None] * (last - first))
        points = np.concatenate(edges)
        padded = np.pad(points, ((order, order), (0, 0)), mode="edge")
        steps = [
            (np.linalg.norm(np.diff(padded, j, axis=0), axis=1).max() / limit) ** (1 / j)
            for j, limit in enumerate(self.limits.values, start=1)
        ]
        return uniform_spline(points, float(max(steps)), self.start_time, order, degrees)


@checked(ReferenceSignalError)
@dataclass(frozen=True)
class WaypointsReference(PiecewiseReference):
    """The smoothest curve through points at given times, from rest to rest.

    It minimizes the integral of |r^(order + 1)|^2, the jerk with order 2 and the snap with order 3:
    a spline of degree 2 order + 1. Between points it may overshoot, more so with uneven times; a
    `PolylineReference` does not.

    With limits the times are in proportion to the distances between the points, and as short as
    the limits allow.

    Attributes:
        points: The points, in the outputs' unit, shape (n, k).
        times: The time at each point, in s after `start_time`, shape (n,); None with limits.
        limits: The largest speed, acceleration and jerk; None with times.
        start_time: The start of the motion, in s.
        order: The number of continuous derivatives, which vanish at both ends, from 2 to 6; at
            least mu of the outputs.

    Raises:
        ReferenceSignalError: A number is not valid, there are fewer than two points, two in
            succession are equal, times do not increase, or there are both times and limits, or
            none.
    """

    points: Sequence[Sequence[float]]
    times: ArrayLike | None = None
    limits: PathLimits | None = None
    start_time: float = 0.0
    order: int = 4

    def __post_init__(self) -> None:
        points = _check_points(self)
        check_order(self.order, 2, 6)
        if (self.times is None) == (self.limits is None):
            raise ReferenceSignalError(
                "waypoints take either times, or limits from which these follow, got "
                f"{'none' if self.times is None else 'both'}"
            )
        if self.times is not None:
            times = vector("times", self.times, len(points), ReferenceSignalError)
            if not np.all(np.diff(times) > 0) or times[0] < 0:
                raise ReferenceSignalError(
                    f"times must increase from 0 or later, got {self.times!r}"
                )
            object.__setattr__(self, "times", tuple(times.tolist()))

    @property
    def size(self) -> int:
        return len(self.points[0])

    @property
    def duration(self) -> float:
        """The time at the last point, in s after `start_time`."""
        return float(self._moments[-1])

    @cached_property
    def _moments(self) -> FloatArray:
        """The time at each point, after the start, shape (n,)."""
        if self.limits is None:
            return np.array(self.times)
        edges = np.linalg.norm(np.diff(self.points, axis=0), axis=1)
        moments = np.concatenate([[0.0], np.cumsum(edges)]) / edges.mean()
        samples = np.linspace(0.0, moments[-1], 200 * len(edges) + 1)
        values = self._through(moments, [3] * self.size).at(samples)
        peaks = np.linalg.norm(values.reshape(-1, self.size, 4)[:, :, 1:], axis=1).max(axis=0)
        # The error between the samples is below 0.1 %.
        powers = 1.0 / np.arange(1, 4)
        return 1.001 * moments * max((peaks / self.limits.values) ** powers)

    def pieces(self, degrees: Sequence[int]) -> PiecewisePolynomials:
        return self._through(self.start_time + self._moments, degrees)

    def _through(self, times: FloatArray, degrees: Sequence[int]) -> PiecewisePolynomials:
        """The spline through the points at times, and its derivatives, as polynomials."""
        # In a time unit with spacing about 1: derivatives of all orders have similar sizes.
        unit = (times[-1] - times[0]) / (len(times) - 1)
        knots, points = (times - times[0]) / unit, np.array(self.points)
        rest = [(j, np.zeros(self.size)) for j in range(1, self.order + 1)]
        spline = scipy.interpolate.make_interp_spline(
            knots, points, 2 * self.order + 1, bc_type=(rest, rest)
        )
        return PiecewisePolynomials.of(spline, knots, times, unit, degrees)


def _check_points(reference: PolylineReference | WaypointsReference) -> FloatArray:
    """Converts the field `points` to a tuple of rows, and returns it as an array, shape (n, k)."""
    points = numbers("points", reference.points, ReferenceSignalError)
    if points.ndim != 2 or len(points) < 2 or not points.size:
        raise ReferenceSignalError(
            f"points must be two or more, as a list of rows, got shape {points.shape}"
        )
    rows = tuple(map(tuple, points.tolist()))
    object.__setattr__(reference, "points", rows)
    lengths = np.linalg.norm(np.diff(points, axis=0), axis=1)
    if not lengths.all():
        i = int(np.argmin(lengths))
        raise ReferenceSignalError(f"points {i} and {i + 1} are the same, {rows[i]}")
    return points
