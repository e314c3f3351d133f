"""Lines and circles, from rest to rest within limits."""

from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from math import comb, copysign, factorial, inf, sqrt, tau

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from drake_dae.arguments import checked
from drake_dae.arrays import FloatArray, positive, vector
from drake_dae.errors import ReferenceSignalError
from drake_dae.references.formulas import as_columns
from drake_dae.references.reference import Reference, check_continuity, check_order


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

    The speed rises during `ramp` seconds, is constant, and falls in the same way:

        s'(t) = speed S(t / ramp),   S(x) = x^order sum_k binom(order - 1 + k, k) (1 - x)^k,

    where S, with k < order, is the polynomial from 0 to 1 whose first order - 1 derivatives vanish
    at both ends. So s has `order` continuous derivatives; order 2 is a double S with bounded jerk.
    """

    length: float
    speed: float
    ramp: float
    order: int

    @property
    def duration(self) -> float:
        return self.length / self.speed + self.ramp

    def derivatives(self, time: ca.SX, degree: int) -> list[ca.SX]:
        """Returns s, s', ..., s^(degree) at a time in s since the start, degree <= order."""
        # The second half is the first one reversed: s^(k) has the sign (-1)^(k - 1) there.
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


def _bernstein(coefficients: FloatArray, x: ca.SX) -> ca.SX:
    """sum_j c_j binom(n, j) x^j (1 - x)^(n - j)."""
    n = coefficients.size - 1
    return ca.SX(0) + sum(
        float(c) * comb(n, j) * x**j * (1 - x) ** (n - j) for j, c in enumerate(coefficients) if c
    )


class PathReference(Reference):
    """A motion along a path, r(t) = p(s(t - start_time)), from rest to rest within limits."""

    limits: PathLimits | None
    start_time: float
    order: int

    @property
    @abstractmethod
    def length(self) -> float:
        """An upper bound of the length of the path, in the outputs' unit."""

    @abstractmethod
    def point(self, distance: ca.SX) -> ca.SX:
        """Returns the point p(s) of the path, shape (size, 1)."""

    def along(self, passed: ca.SX, degree: int) -> list[ca.SX]:
        """Returns s, s', ..., s^(degree) at a time in s after the start."""
        return self.travel.derivatives(passed, degree)

    @cached_property
    def travel(self) -> Travel:
        """The distance along the path over time after the start."""
        assert self.limits is not None
        # The shortest one along a straight line, with S' = scale (x (1 - x))^m.
        speed, acceleration, jerk = self.limits.values
        m = self.order - 1
        scale = factorial(2 * m + 1) / factorial(m) ** 2
        first = scale / 4**m
        second = scale * m * ((m - 1) / (4 * m - 2)) ** (m - 1) / sqrt(2 * m - 1)
        by_acceleration = sqrt(self.length * acceleration / first)
        fastest = min(speed, by_acceleration, (self.length**2 * jerk / second) ** (1 / 3))
        ramp = max(first * fastest / acceleration, sqrt(second * fastest / jerk))
        travel = Travel(self.length, fastest, ramp, self.order)
        # On a curve it is slower; sampled, with an error between the samples below 0.1 %.
        time = ca.SX.sym("t")
        _, *derivatives = self._derivatives(travel.derivatives(time, 3))
        peaks = ca.Function("peaks", [time], [ca.norm_2(derivative) for derivative in derivatives])
        end, shares = travel.duration, np.linspace(0.0, 1.0, 401)
        moments = np.concatenate(
            [ramp * shares, ramp + (end - 2 * ramp) * shares, end - ramp * shares]
        )
        largest = [float(np.max(values.full())) for values in peaks(ca.DM(moments).T)]
        excess = [peak / limit for peak, limit in zip(largest, self.limits.values, strict=True)]
        slower = max(excess[0], excess[1] ** (1 / 2), excess[2] ** (1 / 3))
        if slower <= 1.0 + 1e-9:
            return travel
        slower *= 1.001
        return replace(travel, speed=travel.speed / slower, ramp=travel.ramp * slower)

    def expression(self, degrees: Sequence[int], time: ca.SX) -> ca.SX:
        if self.limits is not None:
            check_continuity(self, self.order, degrees)
        values = self._derivatives(self.along(time - self.start_time, max(degrees)))
        return ca.vertcat(*[values[k][i] for i, mu in enumerate(degrees) for k in range(mu + 1)])

    def _derivatives(self, along: Sequence[ca.SX]) -> list[ca.SX]:
        """r, r', ... for s, s', ..., by the chain rule."""
        s = ca.SX.sym("s", len(along))
        values = [self.point(s[0])]
        for _ in along[1:]:
            values.append(ca.jtimes(values[-1], s, ca.vertcat(s[1:], 0)))
        return [ca.substitute(value, s, ca.vertcat(*along)) for value in values]


@checked(ReferenceSignalError)
@dataclass(frozen=True)
class LineReference(PathReference):
    """A straight move from rest at `start` to rest at `end`, as fast as limits allow.

    Attributes:
        start: The values before, in the outputs' unit, shape (k,), or one number for all.
        end: The values after, in the outputs' unit.
        limits: The largest speed, acceleration and jerk.
        start_time: The start of the move, in s.
        order: The number of continuous derivatives, from 2 to 12; at least mu of the outputs.

    Raises:
        ReferenceSignalError: A number is not finite or not valid, or start is end.
    """

    start: ArrayLike
    end: ArrayLike
    limits: PathLimits
    start_time: float = 0.0
    order: int = 4

    def __post_init__(self) -> None:
        as_columns(self, "start", "end")
        check_order(self.order, 2, 12)
        if not self.length:
            raise ReferenceSignalError(f"start and end must differ, both are {self.start!r}")

    @property
    def size(self) -> int:
        return np.size(self.start)

    @property
    def length(self) -> float:
        return float(np.linalg.norm(np.subtract(self.end, self.start)))

    def point(self, distance: ca.SX) -> ca.SX:
        first, last = ca.DM(self.start), ca.DM(self.end)
        return first + distance / self.length * (last - first)


@checked(ReferenceSignalError)
@dataclass(frozen=True)
class CircleReference(PathReference):
    """A circle: r = center + radius (cos a, sin a), for two outputs.

    With `period` it turns without end, a = phase + 2 pi (t - start_time) / period. With `limits` it
    makes a number of turns from rest to rest.

    Attributes:
        center: The center, in the outputs' unit, shape (2,).
        radius: The radius, in the outputs' unit.
        period: The time of one turn, in s; None with limits.
        limits: The largest speed, acceleration and jerk; None with a period.
        turns: The number of turns with limits; negative for clockwise.
        phase: The angle a at the start, in rad.
        start_time: The start of the motion, in s; with a period, when the angle is `phase`.
        order: The number of continuous derivatives with limits, from 2 to 12; at least mu of the
            outputs.

    Raises:
        ReferenceSignalError: A number is not valid, or there are both a period and limits, or none.
    """

    center: ArrayLike
    radius: float
    period: float | None = None
    limits: PathLimits | None = None
    turns: float = 1.0
    phase: float = 0.0
    start_time: float = 0.0
    order: int = 4

    size = 2

    def __post_init__(self) -> None:
        center = vector("center", self.center, 2, ReferenceSignalError)
        object.__setattr__(self, "center", tuple(center.tolist()))
        positive("radius", self.radius, ReferenceSignalError)
        check_order(self.order, 2, 12)
        if (self.period is None) == (self.limits is None):
            raise ReferenceSignalError(
                "a circle takes either a period, for periodic motion, or limits, for motion from "
                f"rest to rest, got {'none' if self.period is None else 'both'}"
            )
        if self.period == 0.0 or self.turns == 0.0:
            raise ReferenceSignalError("period and turns must not be zero")

    @property
    def length(self) -> float:
        return tau * abs(self.turns) * self.radius

    def point(self, distance: ca.SX) -> ca.SX:
        angle = self.phase + copysign(1.0, self.turns) * distance / self.radius
        return ca.DM(self.center) + self.radius * ca.vertcat(ca.cos(angle), ca.sin(angle))

    def along(self, passed: ca.SX, degree: int) -> list[ca.SX]:
        if self.period is None:
            return super().along(passed, degree)
        speed = copysign(tau * self.radius, self.turns) / self.period
        return [speed * passed, ca.SX(speed), *[ca.SX(0)] * degree][: degree + 1]

    @property
    def repeats(self) -> float | None:
        return None if self.period is None else abs(self.period)
