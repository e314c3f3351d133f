"""A smooth motion through points."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from math import factorial

import numpy as np
from numpy.typing import ArrayLike

from drake_dae.arguments import checked
from drake_dae.arrays import FloatArray, vector
from drake_dae.dae.references.paths import check_order
from drake_dae.dae.references.pieces import PiecewisePolynomials, PiecewiseReference
from drake_dae.dae.references.splines import settle_points
from drake_dae.dae.references.travel import PathLimits
from drake_dae.errors import ReferenceSignalError


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
        points = settle_points(self)
        check_order(self.order, 6)
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
        function = _pieces(moments, np.array(self.points), self.order, [3] * self.size).at
        samples = np.linspace(0.0, moments[-1], 200 * len(edges) + 1)
        values = np.array([function(time).reshape(self.size, 4)[:, 1:] for time in samples])
        peaks = np.linalg.norm(values, axis=1).max(axis=0)
        # The error between the samples is below 0.1 %.
        powers = 1.0 / np.arange(1, 4)
        return 1.001 * moments * max((peaks / self.limits.values) ** powers)

    def pieces(self, degrees: Sequence[int]) -> PiecewisePolynomials:
        moments = self.start_time + self._moments
        return _pieces(moments, np.array(self.points), self.order, degrees)


def _pieces(
    times: FloatArray, points: FloatArray, order: int, degrees: Sequence[int]
) -> PiecewisePolynomials:
    """The spline through points at times, and its derivatives, as polynomials."""
    from scipy.interpolate import make_interp_spline  # It takes long to load.

    # In a time unit with spacing about 1, so that derivatives of all orders have similar sizes.
    scale = (times[-1] - times[0]) / (len(times) - 1)
    knots, degree = (times - times[0]) / scale, 2 * order + 1
    rest = [(j, np.zeros(points.shape[1])) for j in range(1, order + 1)]
    spline = make_interp_spline(knots, points, degree, bc_type=(rest, rest))
    widths = np.diff(knots)[:, None]
    table = [spline(knots[:-1], nu=m) / factorial(m) for m in range(degree + 1)]
    rows = []
    for column, mu in enumerate(degrees):
        for j in range(mu + 1):
            row = np.zeros((len(widths), degree + 1))
            for m in range(j, degree + 1):
                grown = factorial(m) / factorial(m - j) / scale**j
                row[:, m - j] = table[m][:, column] * widths[:, 0] ** (m - j) * grown
            rows.append(row)
    return PiecewisePolynomials(times, np.stack(rows, axis=1))
