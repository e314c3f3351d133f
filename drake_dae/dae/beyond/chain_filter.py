"""A Kalman filter with constant gains for a position with an unknown acceleration."""

from dataclasses import dataclass

import numpy as np
from scipy.linalg import solve_discrete_are

from drake_dae.arrays import FloatArray, positive
from drake_dae.errors import ModelError


@dataclass(frozen=True, eq=False)
class ChainFilter:
    """The stationary Kalman filter of (q, v, a) from samples of q, and of v if it is measured:

        q' = v,    v' = known acceleration + a,    a' = white noise,

    where the known acceleration is that of the model. With samples T apart,

        prediction:   q = q + T v + T^2 / 2 a,   v = v + T (known acceleration + a),
        correction:   (q, v, a) = (q, v, a) + K (measured - predicted).

    The noise of a' is W = T sigma^2 w^6 with the standard deviation sigma of a position. Without a
    measured v the estimator's poles are then those of a Butterworth filter of third order with
    the cutoff w, up to terms of the order of w T (B. D. O. Anderson, J. B. Moore, Optimal
    Filtering, 1979, section 4.4, for the stationary filter). So w is the rate at which a model
    error is followed: a constant one leaves no error, and a ramp a' the error a' / w^3 in q.

    Attributes:
        gain: K, shape (3, 1), or (3, 2) with a measured v.
        covariance: That of (q, v, a) after a correction, relative to sigma^2, shape (3, 3).
        predicted: That before it.
        period: T in s.
    """

    gain: FloatArray
    covariance: FloatArray
    predicted: FloatArray
    period: float

    @classmethod
    def of(
        cls,
        rate: float,
        period: float,
        velocity_ratio: float | None = None,
        acceleration_ratio: float = 0.0,
    ) -> "ChainFilter":
        """The filter of a given rate.

        Args:
            rate: w in 1/s.
            period: T in s.
            velocity_ratio: The standard deviation of a measured velocity over sigma, in 1/s; None
                if no velocity is measured.
            acceleration_ratio: The standard deviation, from sample to sample, of white noise of
                the known acceleration over sigma, in 1/s^2.

        Raises:
            ModelError: A number is not positive, or w T is above 1, where a sample is too long.
        """
        positive("rate", rate), positive("period", period)
        if rate * period > 1.0:
            raise ModelError(
                f"a rate of {rate:g} 1/s is too high for samples {period:g} s apart: at most "
                f"{1.0 / period:g} 1/s"
            )
        step = transition(period)
        # Scaled by T: q, T v, T^2 a have about the size of sigma.
        size = period ** np.arange(3)
        step = size[:, None] * step / size
        noise = np.diag([0.0, (acceleration_ratio * period**2) ** 2, (rate * period) ** 6])
        shown = np.eye(3)[:1] if velocity_ratio is None else np.eye(3)[:2]
        error = np.eye(len(shown))
        if velocity_ratio is not None:
            error[1, 1] = (positive("velocity_ratio", velocity_ratio) * period) ** 2
        before = solve_discrete_are(step.T, shown.T, noise, error)
        gain = np.linalg.solve(shown @ before @ shown.T + error, shown @ before).T
        after = before - gain @ shown @ before
        both = np.outer(1.0 / size, 1.0 / size)
        return cls(
            gain / size[:, None] * size[: len(shown)], after * both, before * both, period
        )


def transition(period: float) -> FloatArray:
    """The step of (q, v, a) over a sample, shape (3, 3)."""
    return np.array([[1.0, period, period**2 / 2.0], [0.0, 1.0, period], [0.0, 0.0, 1.0]])
