"""Distances that are negative only within a step."""

import numpy as np

from drake_dae.arrays import FloatArray

TOUCHING = 1e-11
"""A gap below this, in m, counts as closed."""


def lowest(
    step: float, gaps: FloatArray, rates: FloatArray, last: FloatArray, last_rates: FloatArray
) -> FloatArray:
    """The minima of cubics in time within a step; inf for a minimum at one of its ends.

    Args:
        step: The duration of the step, in s.
        gaps, rates: Distances and their rates at its start, in m and m/s.
        last, last_rates: The same at its end.
    """
    minima = np.full(gaps.shape, np.inf)
    for i in np.flatnonzero((rates < 0.0) & (last_rates > 0.0) & (last > 0.0)):
        rise, b = last[i] - gaps[i], step * rates[i]
        c = 3.0 * rise - step * (2.0 * rates[i] + last_rates[i])
        d = step * (rates[i] + last_rates[i]) - 2.0 * rise
        root = c + np.sqrt(max(c * c - 3.0 * b * d, 0.0))
        if root > -b:  # Otherwise all of it is round-off.
            s = -b / root  # There b + 2 c s + 3 d s^2 = 0, with a positive second derivative.
            minima[i] = gaps[i] + s * (b + s * (c + s * d))
    return minima
