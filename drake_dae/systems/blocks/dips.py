"""Distances that fall through zero within a step, and come out again."""

import numpy as np

from drake_dae.arrays import FloatArray

TOUCHING = 1e-11
"""A gap below this, in m, counts as closed."""


def lowest(
    step: float, gaps: FloatArray, rates: FloatArray, last: FloatArray, last_rates: FloatArray
) -> FloatArray:
    """The lowest values within a step, by the cubics in time through both ends; inf where at one.

    Args:
        step: How long it is, in s.
        gaps, rates: Distances and their rates where it begins, in m and m/s.
        last, last_rates: The same where it ends.
    """
    found = np.full(gaps.shape, np.inf)
    for i in np.flatnonzero((rates < 0.0) & (last_rates > 0.0) & (last > 0.0)):
        rise, b = last[i] - gaps[i], step * rates[i]
        c = 3.0 * rise - step * (2.0 * rates[i] + last_rates[i])
        d = step * (rates[i] + last_rates[i]) - 2.0 * rise
        root = c + np.sqrt(max(c * c - 3.0 * b * d, 0.0))
        if root > -b:  # Not where all of it is only round-off.
            s = -b / root  # There b + 2 c s + 3 d s^2 = 0, and it rises.
            found[i] = gaps[i] + s * (b + s * (c + s * d))
    return found
