"""A motion along a curve as polynomials in time.

Between the points of the curve r(s(t)) is a quintic polynomial. At both ends of each interval r, r'
and r'' are those of the curve, with

    r' = r_s s',   r'' = r_ss s'^2 + r_s s'',

and r'' is continuous except at rests. Forces, of degree 0, are
straight lines between the points.
"""

from collections.abc import Sequence

import numpy as np

from drake_dae.arrays import FloatArray
from drake_dae.dae.references.pieces import PiecewisePolynomials
from drake_dae.dae.system.layout import DerivativeLayout
from drake_dae.dae.timing.curve import Piece

# A quintic on [0, 1] with given values and first and second derivatives at both ends: the factors
# of 1, x, ..., x^5 from (p0, v0, a0, p1, v1, a1).
QUINTIC = np.array(
    [
        [1.0, 0.0, 0.0, 0.0, 0.0, 0.0],
        [0.0, 1.0, 0.0, 0.0, 0.0, 0.0],
        [0.0, 0.0, 0.5, 0.0, 0.0, 0.0],
        [-10.0, -6.0, -1.5, 10.0, -4.0, 0.5],
        [15.0, 8.0, 1.5, -15.0, 7.0, -1.0],
        [-6.0, -3.0, -0.5, 6.0, -3.0, 0.5],
    ]
)


def time_table(
    parts: Sequence[tuple[Piece, FloatArray, FloatArray, FloatArray]],
    layout: DerivativeLayout,
    start_time: float,
) -> PiecewisePolynomials:
    """Returns the polynomials of r along the pieces of a curve, a row for each output.

    Args:
        parts: Of each piece: it, the times of its points in s after its begin, b = s'^2 at these,
            a = s'' at these.
        layout: How R is stacked.
        start_time: When the first piece begins, in s.
    """
    breaks, factors = [np.array([start_time])], []
    for piece, times, b, a in parts:
        breaks.append(breaks[-1][-1] + times[1:])
        factors.append(_polynomials(piece, np.diff(times), b, a, layout))
    return PiecewisePolynomials(np.concatenate(breaks), np.concatenate(factors))


def at_rest_outside(table: PiecewisePolynomials) -> PiecewisePolynomials:
    """Returns the table with a second of rest before and after, so that r'' is 0 there."""
    breaks, factors = table.breaks, table.factors
    rests = np.zeros((2, *factors.shape[1:]))
    rests[0, :, 0], rests[1, :, 0] = factors[0, :, 0], factors[-1].sum(axis=-1)
    return PiecewisePolynomials(
        np.concatenate([breaks[:1] - 1.0, breaks, breaks[-1:] + 1.0]),
        np.concatenate([rests[:1], factors, rests[1:]]),
    )


def stacked(table: PiecewisePolynomials, degrees: Sequence[int]) -> PiecewisePolynomials:
    """Returns polynomials with their derivatives: r_1, ..., r_1^(mu_1), r_2, ..."""
    widths, rows = np.diff(table.breaks)[:, None], []
    for output, degree in enumerate(degrees):
        row = table.factors[:, output]
        powers = np.arange(row.shape[1])
        for k in range(degree + 1):
            rows.append(row / widths**k)
            row = np.pad((row * powers)[:, 1:], ((0, 0), (0, 1)))
    return PiecewisePolynomials(table.breaks, np.stack(rows, axis=1))


def _polynomials(
    piece: Piece, widths: FloatArray, b: FloatArray, a: FloatArray, layout: DerivativeLayout
) -> FloatArray:
    """The factors of (1, x, ..., x^5) in each interval, shape (N, outputs, 6)."""
    count, low = widths.size, layout.lowest
    coefficients = np.zeros((count, len(layout.degrees), 6))
    values = piece.values[:, low]
    coefficients[:, :, 0] = values[:-1]
    coefficients[:, :, 1] = np.diff(values, axis=0)
    if piece.is_pause:
        return coefficients
    speed = np.sqrt(b)
    width = widths[:, None]
    rates = piece.tangents * speed[:, None]
    bent = piece.curvatures * b[:, None]
    moving = layout.dynamic
    given = np.stack(
        [
            values[:-1, moving],
            rates[:-1] * width,
            (bent[:-1] + piece.tangents[:-1] * a[:-1, None]) * width**2,
            values[1:, moving],
            rates[1:] * width,
            (bent[1:] + piece.tangents[1:] * a[1:, None]) * width**2,
        ],
        axis=-1,
    )
    coefficients[:, moving] = given @ QUINTIC.T
    return coefficients
