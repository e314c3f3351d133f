"""Heights over a plane as a smooth SX function, fitted to a grid of data."""

from dataclasses import dataclass
from math import ceil
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from drake_dae.arrays import FloatArray

CELLS = 16
"""The default number of bells along the longer side."""

_BEYOND = 3
"""The number of bells beyond each edge, so that the edge is fitted as well as the middle."""

_LEAST = np.logspace(-8, -2, 7)
"""Thresholds for singular values, relative to the largest, whose components the data do not
determine. The smallest is taken for which the surface stays near the plane beyond its edges.
"""

_CALM = 1.5
"""The allowed distance from the plane there, relative to the range of the heights."""


@dataclass(frozen=True, eq=False)
class _Bells:
    """Bell curves g_j(x) = exp(-(x - x_j)^2 / 2 d^2) whose distance d is their width.

    At this width they span polynomials to 1e-8 of their size and are still distinct, so that the
    fit is well conditioned.

    Attributes:
        places: x_j in m, shape (k,).
        width: d in m.
    """

    places: NDArray[np.floating[Any]]
    width: float

    @classmethod
    def between(cls, low: float, high: float, distance: float) -> "_Bells":
        """Bells over an interval, with at most a given spacing."""
        count = max(ceil((high - low) / distance - 1e-9), 1)
        width = float((high - low) / count)
        return cls(low + width * np.arange(-_BEYOND, count + _BEYOND + 1), width)

    @property
    def around(self) -> FloatArray:
        """Places from well before the first bell to well beyond the last, m, shape (l,)."""
        return np.linspace(
            self.places[0] - 3 * self.width, self.places[-1] + 3 * self.width, 3 * self.places.size
        )

    def at(self, values: FloatArray) -> FloatArray:
        """All bells at some places, shape (values, bells)."""
        return np.exp(-(((values[:, None] - self.places) / self.width) ** 2) / 2)

    def of(self, value: ca.SX) -> ca.SX:
        """All bells of an expression, and their derivatives, shape (k, 2)."""
        off = (value - ca.DM(self.places)) / self.width
        bells = ca.exp(-(off**2) / 2)
        return ca.horzcat(bells, -off / self.width * bells)


@dataclass(frozen=True, eq=False)
class Relief:
    """Heights over a rectangle, with derivatives of all orders:

        h(x, y) = c_0 + c_1 x + c_2 y + sum_r a_r(x) b_r(y),

    a plane, and sums a_r and b_r of bell curves along x and y. A spline needs branches to find its
    cell, which SX does not have; bells reach the same accuracy without. Beyond the rectangle h
    approaches the plane, with a distance of at most 1.5 times the range of the heights.

    Attributes:
        x: The sides of the rectangle along x, m, shape (2,).
        y: The same along y.
        plane: c_0 in m, c_1, c_2.
        bells: Those along x and along y.
        factors: The factors of the bells in a_r, shape (kx, r), and b_r, shape (ky, r).
        largest: The largest distance of a height in the data from h, m.
        rms: The root mean square of this distance, m.
    """

    x: FloatArray
    y: FloatArray
    plane: FloatArray
    bells: tuple[_Bells, _Bells]
    factors: tuple[FloatArray, FloatArray]
    largest: float
    rms: float

    def height(self, x: ca.SX, y: ca.SX) -> tuple[ca.SX, ca.SX, ca.SX]:
        """h at a place, dh/dx and dh/dy."""
        (along, across), (factors_a, factors_b) = self.bells, self.factors
        a, da = ca.horzsplit(ca.mtimes(ca.DM(factors_a.T), along.of(x)))
        b, db = ca.horzsplit(ca.mtimes(ca.DM(factors_b.T), across.of(y)))
        base, slope_x, slope_y = (float(c) for c in self.plane)
        height = base + slope_x * x + slope_y * y + ca.dot(a, b)
        return height, slope_x + ca.dot(da, b), slope_y + ca.dot(a, db)

    def heights(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """h on a grid, shape (len(y), len(x))."""
        (along, across), (a, b) = self.bells, self.factors
        flat = self.plane[0] + self.plane[1] * x + self.plane[2] * y[:, None]
        return flat + (across.at(y) @ b) @ (along.at(x) @ a).T


def fit_relief(x: FloatArray, y: FloatArray, heights: FloatArray, resolution: float) -> Relief:
    """The least-squares fit to a grid of heights.

    Args:
        x: The coordinates of the columns, m, shape (c,), increasing.
        y: The coordinates of the rows, m, shape (r,), increasing.
        heights: Heights in m, shape (r, c), finite.
        resolution: The largest spacing of the bells, m: finer details are smoothed away.
    """
    flat = np.stack([np.ones_like(heights), 0 * heights + x, 0 * heights + y[:, None]], axis=-1)
    plane = np.linalg.lstsq(flat.reshape(-1, 3), heights.ravel())[0].astype(float)
    rest = heights - flat @ plane
    along, across = (_Bells.between(side[0], side[-1], resolution) for side in (x, y))
    at_x, at_y = along.at(x), across.at(y)
    beyond_x, beyond_y = along.at(along.around), across.at(across.around)
    for least in _LEAST:
        (basis_x, to_x), (basis_y, to_y) = _spanned(at_x, least), _spanned(at_y, least)
        shares = basis_y.T @ rest @ basis_x
        factors = to_y @ shares @ to_x.T
        if np.max(np.abs(beyond_y @ factors @ beyond_x.T)) <= _CALM * np.ptp(rest):
            break
    # In heights and not in factors, which magnify the round-off of the data a million times.
    left, sizes, right = np.linalg.svd(shares, full_matrices=False)
    a, b = to_x @ right.T, to_y @ (left * sizes)
    terms_a, terms_b = at_x @ a, at_y @ b

    # A few terms are often enough: a wave along one axis takes one. The others are smaller than the
    # residual of the fit, or than round-off.
    rms = float(np.sqrt(np.mean((rest - terms_b @ terms_a.T) ** 2)))
    negligible = max(0.1 * rms, 1e-10 * float(np.ptp(rest)))
    added = np.max(np.abs(terms_a), axis=0) * np.max(np.abs(terms_b), axis=0)
    count = int(np.sum(np.cumsum(added[::-1])[::-1] > negligible))
    error = rest - terms_b[:, :count] @ terms_a[:, :count].T
    return Relief(
        x[[0, -1]],
        y[[0, -1]],
        plane,
        (along, across),
        (a[:, :count], b[:, :count]),
        float(np.max(np.abs(error))),
        float(np.sqrt(np.mean(error**2))),
    )


def _spanned(bells: FloatArray, least: float) -> tuple[FloatArray, FloatArray]:
    """The space that bells span: orthonormal values at the data, and the bells' factors for them.

    Args:
        bells: The bells at the data, shape (data, bells).
        least: Singular values below this, relative to the largest, are left out.

    Returns:
        The values, shape (data, r), and the factors, shape (bells, r).
    """
    values, sizes, factors = np.linalg.svd(bells, full_matrices=False)
    kept = sizes > least * sizes[0]
    return values[:, kept], factors[kept].T / sizes[kept]
