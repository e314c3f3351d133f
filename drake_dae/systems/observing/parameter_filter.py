"""A Kalman filter of a model's parameters, from the disturbance that they leave."""

from dataclasses import dataclass
from itertools import accumulate

import casadi as ca
import numpy as np

from drake_dae.arrays import FloatArray
from drake_dae.dae import IdentifiedTerms

GAP = 1e-5
"""The standard deviation of a measured distance to a surface, in m."""

COMPLIANCE = 3e-5, 1e-4
"""The standard deviations of a contact's unknown compliances c_1 in m/N and c_2 in m/N^(1/2)."""

MEMORY = 100.0
"""The time in s in which a mass or a friction may move by its range."""

FADING = 10.0
"""The time in s in which what was measured of a place or a compliance fades. It covers the motion
along a path and back; with 3 s and with 30 s the places of the tests are as good."""

_SETTLING = 1.0
"""The time in s in which the size of what no parameter explains is averaged."""

_LEAST = 1e-6
"""The least share of the start in this size, so that it stays positive."""


@dataclass(frozen=True, eq=False)
class FilterMemory:
    """The discrete state of a `ParameterFilter`, as columns that are stacked.

    Attributes:
        values: The estimated parameters theta, followed by the compliances, shape (c,).
        covariance: The lower triangle of P, by columns, shape (c (c + 1) / 2,).
        regressor: Y, shape (k c,).
        momentum, drift: dp/dtheta and that of the rate of p without inputs, of the sample before,
            shape (k c,) each.
        spread: s^2, the mean square of the disturbance that is left, shape (1,).
    """

    values: ca.SX
    covariance: ca.SX
    regressor: ca.SX
    momentum: ca.SX
    drift: ca.SX
    spread: ca.SX

    @classmethod
    def of(cls, size: int, count: int) -> "FilterMemory":
        """Symbols for k positions and c numbers."""
        parts = (count, count * (count + 1) // 2, *3 * (size * count,), 1 if count else 0)
        return cls(*(ca.SX.sym("filter", part) for part in parts))

    @property
    def column(self) -> ca.SX:
        """The whole state as one column."""
        return ca.vertcat(*vars(self).values())

    @property
    def parts(self) -> dict[str, slice]:
        """The name of each attribute -> its part of the column."""
        ends = accumulate(part.numel() for part in vars(self).values())
        return {
            name: slice(end - part.numel(), end)
            for (name, part), end in zip(vars(self).items(), ends, strict=True)
        }


@dataclass(frozen=True, eq=False)
class Sampled:
    """A sample of the functions of a `ParameterFilter`, as expressions.

    Attributes:
        momentum, drift, inputs: The derivatives of `IdentifiedTerms.slopes`, shape (k, c') each.
        friction: C of the contacts that slide, zero for others, shape (k, f).
        gaps, gap_slopes, gap_bends: The distances in contact, shape (j, 1), their derivatives, (j,
            c'), and their second derivatives, (j c', c').
        forces: The constraint force at each of these distances, shape (j, 1).
        is_closed: 1 for each of these contacts that is closed, shape (j, 1).
        inertia: The diagonal of M, shape (k, 1).
        hold: Not 0 while nothing is estimated.
    """

    momentum: ca.SX
    drift: ca.SX
    inputs: ca.SX
    friction: ca.SX
    gaps: ca.SX
    gap_slopes: ca.SX
    gap_bends: ca.SX
    forces: ca.SX
    is_closed: ca.SX
    inertia: ca.SX
    hold: ca.SX


class ParameterFilter:
    """Estimates parameters theta with their covariance P, from the disturbance r that is left.

    The true parameters leave r = 0 and, in contact, a depth that the force makes,

        -phi(x) = c_1 lambda + c_2 lambda^(1/2),    c_1, c_2 >= 0.

    A spring has c_1 alone, and a ball on a compliant layer, as in Drake's hydroelastic contact, c_2
    alone; one of Hertz is between them. With the low-pass filtered regressor Y of the observer, a
    sample measures

        r = Y (theta* - theta) + noise,
        -phi - c_1 lambda - c_2 lambda^(1/2) = dphi/dtheta (theta* - theta) + noise.

    r is scaled by the root of the diagonal of M; its noise is s^2, the mean square of what
    remained, times the samples in which it does not change, 2 / (k_o T). The noise of a distance
    has a part from theta: with the second derivatives H of phi the line above is off by delta^T H
    delta / 2, with the mean square

        (tr H P)^2 / 4 + tr (H P H P) / 2,

    which is 0.7 mm for a plane within 10 mm and 0.15 rad of where it is drawn, and nothing once its
    place is known. Without it the first samples count for too much, and their errors stay.

    P_0 is the variance of numbers that are equally likely within their bounds. Between samples
    masses and frictions change: their P returns to P_0 in `MEMORY`. Places and compliances do not
    change, but what was measured of them fades with the time constant F = `FADING`, since no model
    of a surface is exact. So the information P^-1 returns to that of the bounds,

        (P^-1)' = (P_0^-1 - P^-1) / F,    P' = (P - P P_0^-1 P) / F.

    Where the motion excites a direction, the place fits what was measured in the last seconds,
    wherever the tool was; where it does not, the standard deviation stays that of the bounds.

    theta* is within its bounds, and c_1, c_2 >= 0. After a sample the estimate is projected on the
    numbers within the bounds of each parameter, and of each contact's compliances, in the metric of
    P^-1. As they are convex and hold theta*, no projection raises

        (theta - theta*)^T P^-1 (theta - theta*),

    and without noise no sample does. To clip a number alone leaves what is correlated with it where
    it is, and with gains that fit a free number: at each sample the rest then moves away from
    theta*, in ideal contact by a factor of e in 15 ms.

    Args:
        identified: The parameters.
        frictions: Largest coefficient of friction of each contact.
        size: k, the number of velocities.
        rate, period: k_o in 1/s, T in s.

    Attributes:
        memory: The symbols of the discrete state.
        start: Its initial value.
        num_parameters, count: The number of theta with frictions, and with compliances.
    """

    def __init__(
        self,
        identified: IdentifiedTerms,
        start: FloatArray,
        largest_friction: float,
        size: int,
        rate: float,
        period: float,
    ) -> None:
        known, self._period = identified.low.size, period
        frictions, contacts = start.size - known, len(identified.pressed)
        self.num_parameters = start.size
        count = start.size + 2 * contacts
        self._low = np.concatenate([identified.low, np.zeros(frictions)])
        self._high = np.concatenate([identified.high, np.full(frictions, largest_friction)])
        self._size, self._count, self._contacts = size, count, contacts
        deviations = (self._high - self._low) / 12.0**0.5
        self._prior = np.concatenate([deviations, *contacts * [COMPLIANCE]]) ** 2
        self._samples = 2.0 / (rate * period)
        stays = np.zeros(count)
        stays[[*identified.places, *range(start.size, count)]] = 1.0
        self._stays = stays
        self.memory = memory = FilterMemory.of(size, count)
        self.start = np.zeros(memory.column.numel())
        self.start[memory.parts["values"]] = np.concatenate([start, np.zeros(2 * contacts)])
        rows, columns = np.tril_indices(count)
        by_columns = np.lexsort((rows, columns))
        triangle = np.diag(self._prior)[rows[by_columns], columns[by_columns]]
        self.start[memory.parts["covariance"]] = triangle
        self.start[memory.parts["spread"]] = 1.0

    def _values(self, friction: ca.SX) -> ca.SX:
        values, end = ca.SX(self.memory.values), self.num_parameters
        values[end - friction.numel() : end] = friction
        return values

    def told(self, column: ca.SX, friction: ca.SX) -> tuple[ca.SX, ca.SX]:
        """theta with the given coefficients of friction, and its standard deviations."""
        symbols = [self.memory.column]
        values, covariance = ca.substitute(
            [self._values(friction), self._covariance], symbols, [column]
        )
        deviations = ca.sqrt(ca.fmax(ca.diag(covariance), 0))
        return values[: self.num_parameters], deviations[: self.num_parameters]

    @property
    def prior(self) -> FloatArray:
        """The standard deviations before the first sample, shape (c,)."""
        return np.sqrt(self._prior[: self.num_parameters])

    @property
    def _covariance(self) -> ca.SX:
        lower = ca.SX(ca.Sparsity.lower(self._count), self.memory.covariance)
        return ca.tril2symm(lower)

    def _forgotten(self) -> ca.SX:
        """P a sample later."""
        stays, P = self._stays, self._covariance
        share = (1.0 - stays) * self._period / MEMORY
        kept = ca.SX(np.outer(stays, stays)) * P
        grown = kept - ca.mtimes([kept, ca.DM(np.diag(1.0 / self._prior)), kept])
        keep = 1.0 - share / 2.0
        changing = np.outer(keep, keep) * P + ca.DM(np.diag(share * self._prior))
        return changing + self._period / FADING * grown

    def _bounded(self, values: ca.SX, P: ca.SX) -> ca.SX:
        """theta with compliances after these projections, and with each parameter in its bounds."""
        count = self.num_parameters
        for i in range(count):
            inside = ca.fmin(ca.fmax(values[i], self._low[i]), self._high[i])
            values = values + P[:, i] / P[i, i] * (inside - values[i])
        for i in range(count, self._count, 2):
            pair = slice(i, i + 2)
            values = values + ca.mtimes(P[:, pair], _pushes(values[pair], P[pair, pair]))
        # A projection may take along another parameter beyond its bound, where the law needs it.
        inside = ca.fmin(ca.fmax(values[:count], self._low), self._high)
        return ca.vertcat(inside, values[count:])

    def regressor(self, sample: Sampled) -> ca.SX:
        """-G, the derivative of a sample of d with respect to theta* - theta, shape (k, c)."""
        memory, shape = self.memory, (self._size, self._count)
        wide = self._size, 2 * self._contacts
        momentum, drift = self._slopes(sample)
        before = (ca.reshape(part, *shape) for part in (memory.momentum, memory.drift))
        last, drifted = before
        inputs = ca.horzcat(sample.inputs, sample.friction, ca.SX(*wide))
        return (drift + drifted) / 2.0 + inputs - (momentum - last) / self._period

    def _slopes(self, sample: Sampled) -> tuple[ca.SX, ca.SX]:
        nothing = ca.SX(self._size, self._count - sample.momentum.shape[1])
        return ca.horzcat(sample.momentum, nothing), ca.horzcat(sample.drift, nothing)

    def after(
        self, sample: Sampled, regressor: ca.SX, r: ca.SX, friction: ca.SX, is_first: ca.SX
    ) -> tuple[ca.SX, ca.SX]:
        """The discrete state after a sample, and the change of theta with compliances.

        Args:
            sample: The sample.
            regressor: Y, low-pass filtered as r is, shape (k, c).
            r: The disturbance that is left, shape (k, 1).
            friction: The estimated coefficients of friction, shape (f, 1).
            is_first: Not 0 at the first sample.
        """
        before = self._values(friction)
        memory, count = self.memory, self._count
        P = self._forgotten()
        scale = 1.0 / ca.sqrt(sample.inertia)
        rest, rows = scale * r, scale * regressor
        used = ca.logic_not(ca.logic_or(is_first, sample.hold))
        noise = memory.spread * self._samples
        measured = [(rows[i, :], rest[i], noise, used) for i in range(self._size)]
        for j in range(self._contacts):
            own = slice(2 * j, 2 * j + 2)
            compliant = ca.SX(1, 2 * self._contacts)
            compliant[own] = ca.vertcat(sample.forces[j], ca.sqrt(ca.fmax(sample.forces[j], 0)))
            known = sample.gap_slopes.shape[1]
            row = ca.horzcat(
                sample.gap_slopes[j, :], ca.SX(1, self.num_parameters - known), compliant
            )
            gap = -(sample.gaps[j] + ca.mtimes(compliant, before[self.num_parameters :]))
            bent = ca.mtimes(sample.gap_bends[j * known : (j + 1) * known, :], P[:known, :known])
            off = ca.trace(bent) ** 2 / 4.0 + ca.trace(ca.mtimes(bent, bent)) / 2.0
            variance = (GAP**2 + off) * self._samples
            measured.append((row, gap, variance, used * sample.is_closed[j]))
        change = ca.SX.zeros(count)
        for row, error, variance, is_used in measured:
            row = ca.densify(row)
            moved = ca.mtimes(P, row.T)
            gain = is_used * moved / (variance + ca.mtimes(row, moved))
            change += gain * (error - ca.mtimes(row, change))
            P -= ca.mtimes(gain, moved.T)
        values = self._bounded(before + change, P)
        change = values - before
        remaining = ca.sumsqr(rest - ca.mtimes(rows, change)) / self._size
        gained = used * self._period / _SETTLING
        spread = memory.spread + gained * (ca.fmax(remaining, _LEAST) - memory.spread)
        triangle = ca.vertcat(*(P[j:, j] for j in range(count)))
        slopes = (ca.vec(part) for part in self._slopes(sample))
        column = ca.vertcat(values, triangle, ca.vec(regressor), *slopes, spread)
        return column, change


def _pushes(pair: ca.SX, block: ca.SX) -> ca.SX:
    """y of the projection c + B y of two numbers c on c >= 0 in the metric of B^-1, shape (2, 1).

    y >= 0, c + B y >= 0, y^T (c + B y) = 0: one of them is pushed, if that raises the other enough,
    or both are.
    """
    alone = ca.fmax(-pair, 0) / ca.diag(block)
    first, second = ca.vertcat(alone[0], 0), ca.vertcat(0, alone[1])
    determinant = block[0, 0] * block[1, 1] - block[0, 1] * block[1, 0]
    adjugate = ca.blockcat([[block[1, 1], -block[0, 1]], [-block[1, 0], block[0, 0]]])
    both = -ca.mtimes(adjugate, pair) / determinant
    is_first = (pair + ca.mtimes(block, first))[1] >= 0
    is_second = (pair + ca.mtimes(block, second))[0] >= 0
    return ca.if_else(is_first, first, ca.if_else(is_second, second, both))
