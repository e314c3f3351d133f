"""A low-pass filter with derivatives of its output."""

from dataclasses import dataclass
from math import comb

import casadi as ca
import numpy as np
from scipy.linalg import expm

from drake_dae.arrays import FloatArray


@dataclass(frozen=True, eq=False)
class Lags:
    """n + 1 first-order lags of rate k in series, for a signal d that is constant between samples:

        s_0' = k (d - s_0),    s_j' = k (s_(j-1) - s_j),    r = s_n = (k / (s + k))^(n+1) d.

    So r has n derivatives, r^(j) = k^j sum_i (-1)^(j-i) C(j, i) s_(n-i), which do not change if the
    same number is added to all s. For a constant d,

        r = d (1 - e^(-k t) (1 + k t + ... + (k t)^n / n!)),

    and r follows a ramp with a delay of (n + 1) / k.
    The next sample of s is step s + gain d, and slopes s are r', ..., r^(n).
    """

    rate: float
    degree: int
    step: FloatArray
    gain: FloatArray
    slopes: FloatArray

    @classmethod
    def of(cls, rate: float, period: float, degree: int) -> "Lags":
        """Returns the lags of rate k, sampled each `period` seconds, with n = `degree`."""
        size = degree + 1
        both = np.zeros((size + 1, size + 1))
        both[:size, :size] = rate * (np.eye(size, k=-1) - np.eye(size))
        both[0, size] = rate
        transition = expm(both * period)
        slopes = np.zeros((degree, size))
        for j in range(1, size):
            for i in range(j + 1):
                slopes[j - 1, degree - i] = rate**j * (-1) ** (j - i) * comb(j, i)
        return cls(rate, degree, transition[:size, :size], transition[:size, size], slopes)

    def after(self, lags: ca.SX, signal: ca.SX) -> ca.SX:
        """Returns s at the next sample for d of shape (k, 1), one column for each, (k, n + 1)."""
        return ca.mtimes(lags, self.step.T) + ca.mtimes(signal, self.gain[None, :])

    def derivatives(self, lags: ca.SX) -> ca.SX:
        """Returns r', ..., r^(n), one column for each, shape (k, n)."""
        return ca.mtimes(lags, self.slopes.T)
