"""Least squares over a chain of states with common unknowns, by orthogonal factors."""

from dataclasses import dataclass
from typing import Self

import numpy as np
from scipy.linalg import solve_triangular

from drake_dae.arrays import FloatArray


@dataclass(frozen=True, eq=False)
class StateChain:
    """The information that a chain of states has about common unknowns, and about its states.

    The unknowns are changes of the states z_0, ..., z_J, each of shape (n,), and of theta, shape
    (p,). They minimize the sum of squares of

        a_j dz_j + b_j dtheta + c_j               for each state, and
        (f_j dz_j + g_j dtheta + d_j - dz_(j+1)) / s_j  between one and the next.

    States are eliminated one after the other by orthogonal transformations, as in a square root
    information filter. This remains accurate for unstable motions, and for states without any
    measurement.

    Source: Bierman, Factorization Methods for Discrete Sequential Estimation, 1977, chapter 6.

    Attributes:
        common: R and q of what is left for dtheta: |R dtheta + q|^2, shape (p, p + 1).
    """

    common: FloatArray
    _rows: FloatArray

    @classmethod
    def of(
        cls,
        own: FloatArray,
        moves: FloatArray,
        loose: FloatArray,
        weak: FloatArray,
    ) -> Self:
        """Eliminates all states.

        Args:
            own: [a_j, b_j, c_j], shape (J + 1, k, n + p + 1).
            moves: [f_j, g_j, d_j], shape (J, n, n + p + 1).
            loose: s, shape (J, n).
            weak: The deviation of each entry of the first state without a measurement, shape (n,).
        """
        n, width = len(weak), own.shape[2]
        p = width - n - 1
        condensed = triangle(own) if own.shape[1] > width else own
        known = np.zeros((n, width))
        known[:, :n] = np.diag(1.0 / weak)
        last = len(own) - 1
        rows = np.zeros((last + 1, n, 2 * n + p + 1))
        for j in range(last + 1):
            now = np.vstack([known, condensed[j]])
            if j == last:
                found = triangle(now)
                rows[j, :, :n], rows[j, :, 2 * n :] = found[:n, :n], found[:n, n:]
                known = found[n:, n:]
                break
            both = np.zeros((len(now) + n, 2 * n + p + 1))
            both[: len(now), :n], both[: len(now), 2 * n :] = now[:, :n], now[:, n:]
            both[len(now) :, :n] = moves[j, :, :n] / loose[j][:, None]
            both[len(now) :, n : 2 * n] = -np.diag(1.0 / loose[j])
            both[len(now) :, 2 * n :] = moves[j, :, n:] / loose[j][:, None]
            found = triangle(both)
            rows[j] = found[:n]
            known = found[n:, n:]
        common = np.zeros((p, p + 1))
        common[: len(known[:p])] = known[:p]
        return cls(common, rows)

    def states(self, change: FloatArray) -> tuple[FloatArray, FloatArray]:
        """The changes of the states that belong to one of theta, and their derivatives.

        Args:
            change: dtheta, shape (p,).

        Returns:
            dz, shape (J + 1, n), and how it follows dtheta, shape (J + 1, n, p).
        """
        n, p = self._rows.shape[1], change.size
        # The columns: the change itself, and the derivatives.
        common = np.zeros((p + 1, p + 1))
        common[:p, 0], common[:p, 1:], common[p, 0] = change, np.eye(p), 1.0
        found = np.zeros((len(self._rows) + 1, n, p + 1))
        for j in range(len(self._rows) - 1, -1, -1):
            row = self._rows[j]
            given = row[:, n : 2 * n] @ found[j + 1] + row[:, 2 * n :] @ common
            found[j] = -solve_triangular(row[:, :n], given, check_finite=False)
        return found[:-1, :, 0], found[:-1, :, 1:]


def triangle(matrices: FloatArray) -> FloatArray:
    """The triangular factors R of one matrix or of many, A = Q R."""
    return np.asarray(np.linalg.qr(matrices, mode="r"))


def alone(own: FloatArray, scale: FloatArray, weak: float) -> FloatArray:
    """The deviations of the states that a piece leads to by itself: their median, shape (n,)."""
    count, n = len(own), scale.size
    bound = np.broadcast_to(np.eye(n) / weak, (count, n, n))
    # By the factor and not by the information, whose eigenvalues differ by more than 1e16.
    factors = triangle(np.concatenate([own[:, :, :n] * scale, bound], axis=1))
    deviations = np.linalg.norm(np.linalg.inv(factors), axis=2)
    found: FloatArray = scale * np.minimum(np.median(deviations, axis=0), 1.0)
    return found
