"""Filters of samples: lags with derivatives, and a Kalman filter of an unknown acceleration."""

from dataclasses import dataclass
from math import comb

import casadi as ca
import numpy as np
from scipy.linalg import expm, solve_discrete_are

from drake_dae.arrays import FloatArray, positive
from drake_dae.errors import ModelError


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


@dataclass(frozen=True, eq=False)
class ChainFilter:
    """The stationary Kalman filter of (q, v, a) from samples of q, and of v if it is measured:

        q' = v,    v' = known acceleration + a + white noise,    a' = white noise,

    where the known acceleration is that of the model. With samples T apart,

        prediction:   q = q + T v + T^2 / 2 a,   v = v + T (known acceleration + a),
        correction:   (q, v, a) = (q, v, a) + K (measured - predicted).

    With the noise R = T sigma^2 of positions, that of v' is R w^4 and that of a' is R w^4 k_o^2.
    Without measured velocities the poles solve s^6 + w^4 s^2 - w^4 k_o^2 = 0, up to terms of the
    order of w T (Kwakernaak and Sivan, Linear Optimal Control Systems, 1972, theorem 4.14): for
    k_o << w a pair at the distance w, for the velocity, and one at -k_o, for the model error a.
    `covariance` is that of (q, v, a) after a correction, relative to sigma^2.
    """

    gain: FloatArray
    covariance: FloatArray
    period: float

    @classmethod
    def of(
        cls,
        state_rate: float,
        disturbance_rate: float,
        period: float,
        velocity_ratio: float | None = None,
    ) -> "ChainFilter":
        """Designs the filter for w and k_o, and for sigma_v / sigma if velocities are measured."""
        w, slow = positive("state_rate", state_rate), positive("disturbance_rate", disturbance_rate)
        if w * positive("period", period) > 1.0:
            raise ModelError(
                f"a state_rate of {w:g} 1/s is too high for samples {period:g} s apart: at most "
                f"{1.0 / period:g} 1/s"
            )
        # Scaled: q, T v, T^2 a in units of sigma.
        size = period ** np.arange(3)
        step = size[:, None] * transition(period) / size
        noise = np.diag([0.0, (w * period) ** 4, (w * period) ** 4 * (slow * period) ** 2])
        shown = np.eye(3)[:1] if velocity_ratio is None else np.eye(3)[:2]
        error = np.eye(len(shown))
        if velocity_ratio is not None:
            error[1, 1] = (positive("velocity_ratio", velocity_ratio) * period) ** 2
        before = solve_discrete_are(step.T, shown.T, noise, error)
        gain = np.linalg.solve(shown @ before @ shown.T + error, shown @ before).T
        after = before - gain @ shown @ before
        both = np.outer(1.0 / size, 1.0 / size)
        units = size[: len(shown)] / size[:, None]
        return cls(gain * units, after * both, period)


def transition(period: float) -> FloatArray:
    """Returns the transition matrix of (q, v, a) over a sample, shape (3, 3)."""
    return np.array([[1.0, period, period**2 / 2.0], [0.0, 1.0, period], [0.0, 0.0, 1.0]])
