"""The distance along a path over time: from rest to rest, within limits."""

from dataclasses import dataclass, replace
from math import comb, factorial, inf, sqrt

import casadi as ca
import numpy as np

from drake_dae.arguments import checked
from drake_dae.arrays import FloatArray, positive
from drake_dae.errors import ReferenceSignalError


@checked(ReferenceSignalError)
@dataclass(frozen=True)
class PathLimits:
    """The largest speed, acceleration and jerk along a path: Euclidean norms over its outputs.

    They limit the whole motion, so that a curve is slower than a line. The outputs must have one
    unit.

    Attributes:
        speed: The largest |r'|, in the outputs' unit per s.
        acceleration: The largest |r''|, in the outputs' unit per s^2.
        jerk: The largest |r'''|, in the outputs' unit per s^3; None for no limit.

    Raises:
        ReferenceSignalError: A limit is not positive.
    """

    speed: float
    acceleration: float
    jerk: float | None = None

    def __post_init__(self) -> None:
        for name in ("speed", "acceleration", "jerk"):
            if getattr(self, name) is not None:
                positive(name, getattr(self, name), ReferenceSignalError)

    @property
    def values(self) -> tuple[float, float, float]:
        """Speed, acceleration and jerk, infinite without a limit."""
        return self.speed, self.acceleration, inf if self.jerk is None else self.jerk


@dataclass(frozen=True)
class Travel:
    """The distance along a path over time, from rest at 0 to rest at `length`.

    The speed rises during `ramp`, is constant, and falls in the same way:

        s'(t) = speed S(t / ramp),   S(x) = x^order sum_k binom(order - 1 + k, k) (1 - x)^k,

    where S, with k < order, is the polynomial from 0 to 1 whose first order - 1 derivatives vanish
    at both ends. So s has `order` continuous derivatives; order 2 is a double S with bounded jerk.

    Attributes:
        length: The whole distance.
        speed: The speed between the ramps.
        ramp: The duration of the rise of the speed, and of its fall, in s.
        order: The number of continuous derivatives, at least 2.
    """

    length: float
    speed: float
    ramp: float
    order: int

    @property
    def duration(self) -> float:
        """The duration, in s."""
        return self.length / self.speed + self.ramp

    def derivatives(self, time: ca.SX, degree: int) -> list[ca.SX]:
        """Returns s, s', ..., s^(degree) at a symbolic time in s since the start, degree <= order.

        The second half is the first one reversed: s^(k) has the sign (-1)^(k - 1) there.
        """
        is_first = time < self.duration / 2
        passed = ca.fmax(ca.fmin(time, self.duration - time), 0)
        x = ca.fmin(passed / self.ramp, 1)
        # S by the Bernstein polynomials of degree 2 order - 1, without cancellation.
        steps = np.repeat([0.0, 1.0], self.order)
        integral = np.concatenate([[0.0], np.cumsum(steps) / steps.size])
        gone = self.speed * (self.ramp * _bernstein(integral, x) + ca.fmax(passed - self.ramp, 0))
        values = [ca.if_else(is_first, gone, self.length - gone)]
        for k in range(degree):
            value = self.speed / self.ramp**k * _bernstein(steps, x)
            values.append(value if k % 2 == 0 else ca.if_else(is_first, value, -value))
            steps = (steps.size - 1) * np.diff(steps)
        return values

    def slower(self, factor: float) -> "Travel":
        """Returns the same travel with all times longer by a factor."""
        return replace(self, speed=self.speed / factor, ramp=self.ramp * factor)


def rest_to_rest(length: float, limits: PathLimits, order: int) -> Travel:
    """Returns the shortest such travel along a straight line within limits.

    With the peaks c1 and c2 of S' and S'' the ramp takes max(c1 v / a, sqrt(c2 v / j)), and the
    speed v is the largest with which both ramps fit into the length.
    """
    speed, acceleration, jerk = limits.values
    m = order - 1
    scale = factorial(2 * m + 1) / factorial(m) ** 2  # S' = scale (x (1 - x))^m
    first = scale / 4**m
    second = scale * m * ((m - 1) / (4 * m - 2)) ** (m - 1) / sqrt(2 * m - 1)
    fastest = min(
        speed, sqrt(length * acceleration / first), (length**2 * jerk / second) ** (1 / 3)
    )
    ramp = max(first * fastest / acceleration, sqrt(second * fastest / jerk))
    return Travel(length, fastest, ramp, order)


def _bernstein(coefficients: FloatArray, x: ca.SX) -> ca.SX:
    """sum_j c_j binom(n, j) x^j (1 - x)^(n - j)."""
    n = coefficients.size - 1
    return ca.SX(0) + sum(
        float(c) * comb(n, j) * x**j * (1 - x) ** (n - j) for j, c in enumerate(coefficients) if c
    )
