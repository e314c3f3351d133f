"""Least squares over a sequence of states with common unknowns, by QR factorizations."""

from dataclasses import dataclass
from typing import Self

import numpy as np
from scipy.linalg import solve_triangular

from drake_dae.arrays import FloatArray


@dataclass(frozen=True, eq=False)
class StateChain:
    """Square-root information of common unknowns theta, with all states eliminated.

    The unknowns are changes of the states z_0, ..., z_J, each of shape (n,), and of theta, shape
    (p,). They minimize the sum of squares of

        a_j dz_j + b_j dtheta + c_j                     for each state j, and
        (f_j dz_j + g_j dtheta + d_j - dz_(j+1)) / s_j  from each state to the next one.

    QR factorizations eliminate one state after the other, as in a square-root information filter.
    This remains accurate for unstable motions and for states without any measurement.

    Source: Bierman, Factorization Methods for Discrete Sequential Estimation, 1977, chapter 6.

    Attributes:
        common: [R, q] of the remaining cost |R dtheta + q|^2, shape (p, p + 1).
    """

    common: FloatArray
    _state_rows: FloatArray

    @classmethod
    def of(
        cls,
        measured: FloatArray,
        moves: FloatArray,
        loose: FloatArray,
        weak: FloatArray,
    ) -> Self:
        """Eliminates all states.

        Args:
            measured: [a_j, b_j, c_j], shape (J + 1, k, n + p + 1).
            moves: [f_j, g_j, d_j], shape (J, n, n + p + 1).
            loose: s, shape (J, n).
            weak: The prior standard deviation of each entry of the first state, shape (n,).
        """
        n, width = len(weak), measured.shape[2]
        p = width - n - 1
        condensed = qr_factor(measured) if measured.shape[1] > width else measured
        prior = np.zeros((n, width))
        prior[:, :n] = np.diag(1.0 / weak)
        rows = np.zeros((len(measured), n, 2 * n + p + 1))
        for j, (move, s) in enumerate(zip(moves, loose, strict=True)):
            present = np.vstack([prior, condensed[j]])
            k = len(present)
            stacked = np.zeros((k + n, 2 * n + p + 1))  # Columns: dz_j, dz_(j+1), dtheta, 1.
            stacked[:k, :n], stacked[:k, 2 * n :] = present[:, :n], present[:, n:]
            stacked[k:, :n], stacked[k:, 2 * n :] = (
                move[:, :n] / s[:, None],
                move[:, n:] / s[:, None],
            )
            stacked[k:, n : 2 * n] = -np.diag(1.0 / s)
            factor = qr_factor(stacked)
            rows[j], prior = factor[:n], factor[n:, n:]
        factor = qr_factor(np.vstack([prior, condensed[-1]]))
        rows[-1, :, :n], rows[-1, :, 2 * n :] = factor[:n, :n], factor[:n, n:]
        remaining = factor[n : n + p, n:]
        common = np.zeros((p, p + 1))
        common[: len(remaining)] = remaining
        return cls(common, rows)

    def states(self, change: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Returns the best changes of the states for a change of theta, and their derivatives.

        Args:
            change: dtheta, shape (p,).

        Returns:
            dz, shape (J + 1, n), and its derivative by dtheta, shape (J + 1, n, p).
        """
        n, p = self._state_rows.shape[1], change.size
        # Column 0 has the change itself, the others have the derivatives.
        common = np.zeros((p + 1, p + 1))
        common[:p, 0], common[:p, 1:], common[p, 0] = change, np.eye(p), 1.0
        states = np.zeros((len(self._state_rows) + 1, n, p + 1))
        for j in reversed(range(len(self._state_rows))):
            row = self._state_rows[j]
            right = row[:, n : 2 * n] @ states[j + 1] + row[:, 2 * n :] @ common
            states[j] = -solve_triangular(row[:, :n], right, check_finite=False)
        return states[:-1, :, 0], states[:-1, :, 1:]


def qr_factor(matrices: FloatArray) -> FloatArray:
    """The triangular factor R of A = Q R, of one matrix A or of a stack of them."""
    return np.asarray(np.linalg.qr(matrices, mode="r"))


def separate_deviations(measured: FloatArray, scale: FloatArray, weak: float) -> FloatArray:
    """The standard deviations of the states, each estimated from its own piece.

    The result is the median over all pieces, shape (n,).
    """
    count, n = len(measured), scale.size
    bound = np.broadcast_to(np.eye(n) / weak, (count, n, n))
    # From the QR factor: the eigenvalues of the information matrix differ by more than 1e16.
    factors = qr_factor(np.concatenate([measured[:, :, :n] * scale, bound], axis=1))
    deviations = np.linalg.norm(np.linalg.inv(factors), axis=2)
    median: FloatArray = np.median(deviations, axis=0)
    return scale * np.minimum(median, 1.0)
