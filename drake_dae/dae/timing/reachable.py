"""The fastest motion along a path within limits that are linear in a = s'' and b = s'^2.

Between points s_i and s_(i+1) of a grid a is constant, so that b_(i+1) = b_i + 2 (s_(i+1) - s_i) a.
Backward, H_i is the largest b_i from which the motion can be brought to rest at the end:

    H_N = 0,   H_i = max {b : alpha a + beta (b + ds a) <= 1, 0 <= b + 2 ds a <= H_(i+1)},

with alpha and beta in the middle of the interval, so that the time is off by (ds)^2.

Forward, a is the largest that stays below H. The result is the largest b at every point, and so
the shortest time (Pham and Pham, "A new approach to time-optimal path parameterization based on
reachability analysis", 2018). Rest is within all limits, so that every b from 0 to H_i can brake.
"""

from dataclasses import dataclass

import numpy as np

from drake_dae.arrays import FloatArray
from drake_dae.dae.system.layout import Indices


@dataclass(frozen=True, eq=False)
class LinearLimits:
    """The limits alpha a + beta b <= 1, k of them at each of N + 1 points.

    Attributes:
        alpha, beta: Shape (N + 1, k).
    """

    alpha: FloatArray
    beta: FloatArray


@dataclass(frozen=True, eq=False)
class FastestMotion:
    """The fastest motion from rest to rest.

    Attributes:
        b: s'^2 at the points, shape (N + 1,).
        a: s'' between them, shape (N,).
        highest: H, shape (N + 1,).
        active: The line that limits each interval, shape (N,); -1 for the largest b of a point.
    """

    b: FloatArray
    a: FloatArray
    highest: FloatArray
    active: Indices


@np.errstate(all="ignore")  # Without any limit b is infinite.
def fastest_motion(points: FloatArray, lines: LinearLimits, largest: FloatArray) -> FastestMotion:
    """Computes the fastest motion from rest to rest.

    Args:
        points: s_0, ..., s_N, increasing, shape (N + 1,).
        lines: The limits.
        largest: The largest b at each point, shape (N + 1,); infinite without one.
    """
    double = 2.0 * np.diff(points)
    # The limits in the middle of an interval, by a and b of its begin.
    beta = (lines.beta[:-1] + lines.beta[1:]) / 2.0
    alpha = (lines.alpha[:-1] + lines.alpha[1:] + double[:, None] * beta) / 2.0
    # b + 2 ds a <= H with a line of alpha <= 0, and 0 <= b + 2 ds a with one of alpha >= 0.
    steep = double[:, None] * beta - alpha
    of_two = np.where(steep > 0.0, 1.0 / steep, np.inf)
    braking = np.where((steep > 0.0) & (alpha < 0.0), -alpha * of_two, 0.0)
    stopping = double[:, None] * of_two
    upper = np.where(alpha > 0.0, 1.0 / alpha, np.inf)
    falls = np.where(alpha > 0.0, beta / alpha, 0.0)
    at_point = np.minimum(largest[:-1], np.where(alpha >= 0.0, stopping, np.inf).min(axis=1))
    at_point = _with_both(alpha, beta, at_point)
    stopping = np.where(alpha < 0.0, stopping, np.inf)

    highest, brake = np.zeros(points.size), np.full(points.size, -1, dtype=np.intp)
    for i in range(points.size - 2, -1, -1):
        can = stopping[i] + braking[i] * highest[i + 1]
        line = int(can.argmin())
        highest[i], brake[i] = min((can[line], line), (at_point[i], -1))
        highest[i] = max(highest[i], 0.0)  # Of round-off.

    b, a = np.zeros(points.size), np.zeros(double.size)
    active = np.full(double.size, -1, dtype=np.intp)
    for i in range(double.size):
        room = upper[i] - falls[i] * b[i]
        line = int(room.argmin())
        most = (highest[i + 1] - b[i]) / double[i]
        if room[line] <= most:
            a[i], active[i] = room[line], line
        else:
            a[i], active[i] = most, brake[i]
        b[i + 1] = min(max(b[i] + double[i] * a[i], 0.0), highest[i + 1])
    return FastestMotion(b, a, highest, active)


def _with_both(alpha: FloatArray, beta: FloatArray, start: FloatArray) -> FloatArray:
    """The largest b at which some a is within all lines, shape (N,), at most `start`.

    The room between the lowest upper and the highest lower bound of a is concave in b: Newton's
    method from the right ends after finitely many steps.
    """
    lowered = start.copy()
    rows = np.arange(len(alpha))
    up, down = alpha > 0.0, alpha < 0.0
    with np.errstate(divide="ignore", invalid="ignore"):
        inverse = 1.0 / np.where(alpha == 0.0, 1.0, alpha)
        slope = beta * inverse
        for _ in range(100):
            finite = np.where(np.isfinite(lowered), lowered, 1e30)[:, None]
            bounds = inverse - slope * finite
            p = np.where(up, bounds, np.inf).argmin(axis=1)
            q = np.where(down, bounds, -np.inf).argmax(axis=1)
            has = up[rows, p] & down[rows, q]
            gap = bounds[rows, p] - bounds[rows, q]
            falls = slope[rows, p] - slope[rows, q]
            new = (inverse[rows, p] - inverse[rows, q]) / falls
            over = has & (gap < 0.0) & (falls > 0.0) & (new < lowered * (1.0 - 1e-14))
            if not over.any():
                break
            lowered[over] = new[over]
    return lowered
