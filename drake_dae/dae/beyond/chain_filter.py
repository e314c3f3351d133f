"""A Kalman filter with constant gains for a position with an unknown acceleration."""

from dataclasses import dataclass

import numpy as np
from scipy.linalg import solve_discrete_are

from drake_dae.arrays import FloatArray, positive
from drake_dae.errors import ModelError


@dataclass(frozen=True, eq=False)
class ChainFilter:
    """The stationary Kalman filter of (q, v, a) from samples of q, and of v if it is measured:

        q' = v,    v' = known acceleration + a + white noise,    a' = white noise,

    where the known acceleration is that of the model. With samples T apart,

        prediction:   q = q + T v + T^2 / 2 a,   v = v + T (known acceleration + a),
        correction:   (q, v, a) = (q, v, a) + K (measured - predicted).

    Two rates choose the noises: R = T sigma^2 is the intensity of the noise of positions with the
    standard deviation sigma, R w^4 that of v', and R w^4 k_o^2 that of a'. If no velocity is
    measured, the filter's poles solve s^6 + w^4 s^2 - w^4 k_o^2 = 0, up to terms of the order of
    w T (H. Kwakernaak, R. Sivan, Linear Optimal Control Systems, 1972, theorem 4.14): for k_o << w
    a pair at the distance w with the damping ratio 0.71, for the velocity, and one at -k_o, the
    rate at which a model error a is followed.
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
