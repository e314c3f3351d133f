"""Quintic polynomials in time, with as few pieces as an accuracy of the accelerations allows."""

from collections.abc import Callable

import numpy as np

from drake_dae.arrays import FloatArray
from drake_dae.dae.references.pieces import PiecewisePolynomials
from drake_dae.dae.system.layout import Indices
from drake_dae.dae.timing.time_table import QUINTIC

ACCURACY = 5e-4
"""The largest error of accelerations and forces, as a share of their largest values."""

CLOSE = 1e-6
"""The largest distance from the path, as a share of the range of an output."""


def coarser(table: PiecewisePolynomials, moving: Indices) -> PiecewisePolynomials:
    """Returns a table with fewer and longer pieces.

    A longer piece has r, r' and r'' of the given table at both ends, so that the result has as many
    continuous derivatives. Outputs that have no derivatives are interpolated at up to six times.

    Args:
        table: Quintic polynomials of r, a row for each output, shape (n, outputs, 6).
        moving: The outputs with derivatives.
    """
    breaks, factors = table.breaks, table.factors
    others = np.setdiff1d(np.arange(factors.shape[1]), moving)
    first, last = _ends(factors[:, moving], np.diff(breaks))
    values = np.vstack([factors[:, others, 0], factors[-1:, others].sum(axis=-1)])
    sizes = np.abs(first[:, :, 2]).max(axis=0) + np.finfo(float).tiny
    lengths = np.ptp(first[:, :, 0], axis=0) + np.finfo(float).tiny
    ranges = np.abs(values).max(axis=0) + np.finfo(float).tiny

    def joined(i: int, j: int) -> FloatArray | None:
        """The polynomials from break i to break j, None if they are not accurate enough."""
        width = breaks[j] - breaks[i]
        x = (breaks[i : j + 1] - breaks[i]) / width
        coefficients = np.zeros((factors.shape[1], 6))
        units = np.array([1.0, width, width**2])
        ends = np.concatenate([first[i] * units, last[j - 1] * units], axis=1)
        coefficients[moving] = ends @ QUINTIC.T
        powers = x[:, None] ** np.arange(6)
        bent = powers[:, :4] @ (coefficients[moving, 2:] * [2.0, 6.0, 12.0, 20.0]).T / width**2
        off = np.abs(np.stack([bent[1:] - last[i:j, :, 2], bent[:-1] - first[i:j, :, 2]]))
        away = np.abs(powers[:-1] @ coefficients[moving].T - first[i:j, :, 0])
        if (off > ACCURACY * sizes).any() or (away > CLOSE * lengths).any():
            return None
        if others.size:
            chosen = np.unique(np.linspace(i, j, 6).round().astype(int))
            fitted = np.linalg.solve(powers[chosen - i][:, : chosen.size], values[chosen])
            coefficients[others, : chosen.size] = fitted.T
            if (
                np.abs(powers @ coefficients[others].T - values[i : j + 1]) > ACCURACY * ranges
            ).any():
                return None
        return coefficients

    breaks_kept, rows, i = [0], [], 0
    while i < len(factors):
        reached, row = _furthest(joined, i, len(factors))
        rows.append(factors[i] if row is None else row)
        breaks_kept.append(reached)
        i = reached
    return PiecewisePolynomials(breaks[breaks_kept], np.stack(rows))


def _furthest(
    joined: Callable[[int, int], FloatArray | None], i: int, end: int
) -> tuple[int, FloatArray | None]:
    """Finds the furthest break up to which pieces are joined, by doubling and bisection."""
    good, row, step = i + 1, None, 2
    while i + step <= end and (polynomials := joined(i, i + step)) is not None:
        good, row, step = i + step, polynomials, 2 * step
    low, high = good, min(i + step, end + 1)
    while high - low > 1:
        middle = (low + high) // 2
        if (polynomials := joined(i, middle)) is None:
            high = middle
        else:
            low, row = middle, polynomials
    return low, row


def _ends(factors: FloatArray, widths: FloatArray) -> tuple[FloatArray, FloatArray]:
    """r, r' and r'' at the begin and at the end of each piece, shape (n, outputs, 3)."""
    powers, width = np.arange(6.0), widths[:, None]
    first = np.stack(
        [factors[:, :, 0], factors[:, :, 1] / width, 2.0 * factors[:, :, 2] / width**2], axis=-1
    )
    last = np.stack(
        [
            factors.sum(axis=-1),
            (factors * powers).sum(axis=-1) / width,
            (factors * powers * (powers - 1.0)).sum(axis=-1) / width**2,
        ],
        axis=-1,
    )
    return first, last
