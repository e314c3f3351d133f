"""A motion along a path whose acceleration is continuous."""

import numpy as np

from drake_dae.arrays import FloatArray


def smoothed(
    points: FloatArray, b: FloatArray, a: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Returns b, a and times at the points, for an acceleration that is linear in time.

    The acceleration at a point is the mean of those beside it, weighted by their intervals d,

        a_i = (b_(i+1) - b_(i-1)) / (2 (d_(i-1) + d_i)),

    with which b changes by d_(i-1) d_i / (d_(i-1) + d_i) times the jump of a, and is the same at
    both ends. Where a is smooth this is of second order in d; a jump takes two intervals. The time
    h of an interval fits its length and the speeds and accelerations at both ends,

        d = h (w_i + w_(i+1)) / 2 + h^2 (a_i - a_(i+1)) / 12.

    Args:
        points: s, shape (N + 1,).
        b: s'^2 at the points, shape (N + 1,).
        a: s'' between the points, shape (N,).

    Returns:
        b and a at the points, shape (N + 1,), and the times at the points after the first.
    """
    width = np.diff(points)
    share = np.full(width.size - 1, 1.0)
    weight = width[:-1] * width[1:] / (width[:-1] + width[1:])
    for _ in range(60):
        # b stays positive: where it would not, a jump is left as it is.
        lifted = b[1:-1] + share * weight * np.diff(a)
        if (lifted > 0.0).all():
            break
        share = np.where(lifted > 0.0, share, share / 2.0)
    at_points = np.concatenate([a[:1], (np.diff(b)[1:] + np.diff(b)[:-1]), a[-1:]])
    at_points[1:-1] /= 2.0 * (width[:-1] + width[1:])
    squares = b.copy()
    squares[1:-1] = lifted
    speed = np.sqrt(squares)
    mean = (speed[1:] + speed[:-1]) / 2.0
    bent = (at_points[:-1] - at_points[1:]) / 12.0
    root = np.sqrt(np.maximum(mean**2 + 4.0 * bent * width, 0.0))
    return squares, at_points, np.concatenate([[0.0], np.cumsum(2.0 * width / (mean + root))])
