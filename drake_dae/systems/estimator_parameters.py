"""A Kalman filter of a model's parameters, from the disturbance that they leave."""

from collections.abc import Sequence

import casadi as ca
import numpy as np

from drake_dae.arrays import FloatArray
from drake_dae.dae import DaeSystem, IdentifiedTerms, Observation

GAP = 1e-5
"""The standard deviation of a measured distance to a surface, in m."""

COMPLIANCE = 3e-5, 1e-4
"""The standard deviations of a contact's unknown compliances c_1 in m/N and c_2 in m/N^(1/2)."""

MEMORY, NOISY_MEMORY = 100.0, 1000.0
"""The times in s in which a mass or a friction may move by its range: with a measured state, and
with an estimated one, whose noise moves what the motion does not excite."""

FADING = 10.0
"""The time in s in which what was measured of a place or a compliance fades. It covers the motion
along a path and back; with 3 s and with 30 s the places of the tests are as good."""

_DEVELOPED = 0.9
"""A joint moves where its Coulomb friction has this share of its full size."""

_SETTLING = 1.0
"""The time in s in which the size of what no parameter explains is averaged."""

_LEAST = 1e-6
"""The least share of the start in this size, so that it stays positive."""


class ParameterFilter:
    """Estimates parameters theta with their covariance P, from the disturbance r that is left.

    The true parameters leave r = 0 and, in contact, a depth that the force makes,

        -phi(x) = c_1 lambda + c_2 lambda^(1/2),    c_1, c_2 >= 0.

    A spring has c_1 alone, hydroelastic contact c_2. With the filtered regressor Y of the estimator

        r = Y (theta* - theta) + noise,
        -phi - c_1 lambda - c_2 lambda^(1/2) = dphi/dtheta (theta* - theta) + noise.

    r is scaled by the root of the diagonal of M; its noise is s^2, the mean square of what
    remained, times the samples in which it does not change, 2 / (k_o T). The noise of a distance
    has a part from theta: with the second derivatives H of phi the line above is off by delta^T H
    delta / 2, with the mean square

        (tr H P)^2 / 4 + tr (H P H P) / 2,

    without which the first samples count for too much.

    P_0 is the variance of numbers that are equally likely within their bounds. Masses and frictions
    change: their P returns to P_0 in `memory` s. What was measured of places and compliances fades
    with the time constant F = `FADING`, since no model of a surface is exact:

        (P^-1)' = (P_0^-1 - P^-1) / F,    P' = (P - P P_0^-1 P) / F.

    theta* is within its bounds, and c_1, c_2 >= 0. After a sample the estimate is projected on the
    numbers within the bounds of each parameter, and of each contact's compliances, in the metric of
    P^-1, which raises no (theta - theta*)^T P^-1 (theta - theta*). To clip a number alone leaves
    what is correlated with it where it is. Coefficients of friction are the last in theta.
    """

    def __init__(
        self,
        identified: IdentifiedTerms,
        within: tuple[FloatArray, FloatArray],
        frictions: int,
        largest_friction: float,
        rate: float,
        period: float,
        memory: float = MEMORY,
    ) -> None:
        self._period, self._samples = period, max(2.0 / (rate * period), 1.0)
        self._memory = memory
        self._low = np.concatenate([within[0], np.zeros(frictions)])
        self._high = np.concatenate([within[1], np.full(frictions, largest_friction)])
        self._num, self._contacts = self._low.size, len(identified.pressed)
        deviations = (self._high - self._low) / 12.0**0.5
        self._prior = np.concatenate([deviations, *self._contacts * [COMPLIANCE]]) ** 2
        count = self._prior.size
        self._fades = np.zeros(count)
        self._fades[[*identified.places, *range(self._num, count)]] = 1.0
        lower = ca.Sparsity.lower(count)
        self.change, self._compliances, triangle, self._spread = parts = [
            ca.SX.sym(name, size)
            for name, size in (
                ("change", self._num),
                ("compliances", 2 * self._contacts),
                ("covariance", lower.nnz()),
                ("spread", 1),
            )
        ]
        self.held = ca.vertcat(*parts)
        self._covariance = ca.tril2symm(ca.SX(lower, triangle))
        self.deviations = ca.sqrt(ca.fmax(ca.diag(self._covariance), 0))[: self._num]
        prior = ca.DM(np.diag(self._prior))[lower].nonzeros()
        self.start = np.array([*np.zeros(self._num + 2 * self._contacts), *prior, 1.0])

    def after(
        self,
        theta: ca.SX,
        r: ca.SX,
        regressor: ca.SX,
        inertia: ca.SX,
        gaps: tuple[ca.SX, ca.SX, ca.SX],
        forces: ca.SX,
        is_closed: ca.SX,
        is_used: ca.SX,
    ) -> ca.SX:
        """What is held after a sample; nothing is estimated while `is_used` is 0.

        `inertia` is the diagonal of M. `gaps` are the distances in contact, (j, 1), with first and
        second derivatives, (j, c') and (j c', c'); there `forces` act, and press where closed.
        """
        num, P, scale = self._num, self._forgotten(), 1.0 / ca.sqrt(inertia)
        rest, rows = scale * r, scale * regressor
        rows = ca.horzcat(rows, ca.SX(rows.shape[0], 2 * self._contacts))
        noise = self._spread * self._samples
        measured = [(rows[i, :], rest[i], noise, is_used) for i in range(rest.numel())]
        distances, slopes, bends = gaps
        known = slopes.shape[1]
        for j in range(self._contacts):
            compliant = ca.SX(1, 2 * self._contacts)
            compliant[2 * j : 2 * j + 2] = ca.vertcat(forces[j], ca.sqrt(ca.fmax(forces[j], 0)))
            row = ca.horzcat(slopes[j, :], ca.SX(1, num - known), compliant)
            gap = -(distances[j] + ca.mtimes(compliant, self._compliances))
            bent = ca.mtimes(bends[j * known : (j + 1) * known, :], P[:known, :known])
            off = ca.trace(bent) ** 2 / 4.0 + ca.trace(ca.mtimes(bent, bent)) / 2.0
            variance = (GAP**2 + off) * self._samples
            measured.append((row, gap, variance, is_used * is_closed[j]))
        change = ca.SX.zeros(num + 2 * self._contacts)
        for row, error, variance, used in measured:
            row = ca.densify(row)
            moved = ca.mtimes(P, row.T)
            gain = used * moved / (variance + ca.mtimes(row, moved))
            change += gain * (error - ca.mtimes(row, change))
            P = _symmetric(P - ca.mtimes(gain, moved.T))
        before = ca.vertcat(theta, self._compliances)
        values = self._bounded(before + change, P)
        change = values - before
        remaining = ca.sumsqr(rest - ca.mtimes(rows, change)) / rest.numel()
        gained = is_used * min(self._period / _SETTLING, 1.0)
        spread = self._spread + gained * (ca.fmax(remaining, _LEAST) - self._spread)
        triangle = ca.vertcat(*(P[j:, j] for j in range(P.shape[0])))
        return ca.vertcat(change[:num], values[num:], triangle, spread)

    def _forgotten(self) -> ca.SX:
        """P a sample later."""
        fades, P = self._fades, self._covariance
        share = (1.0 - fades) * self._period / self._memory
        kept = ca.SX(np.outer(fades, fades)) * P
        grown = kept - ca.mtimes([kept, ca.DM(np.diag(1.0 / self._prior)), kept])
        keep = 1.0 - share / 2.0
        changing = np.outer(keep, keep) * P + ca.DM(np.diag(share * self._prior))
        return _symmetric(changing + self._period / FADING * grown)

    def _bounded(self, values: ca.SX, P: ca.SX) -> ca.SX:
        """theta with compliances after these projections, and with each parameter in its bounds."""
        num = self._num
        for i in range(num):
            inside = ca.fmin(ca.fmax(values[i], self._low[i]), self._high[i])
            values = values + P[:, i] / P[i, i] * (inside - values[i])
        for i in range(num, num + 2 * self._contacts, 2):
            pair = slice(i, i + 2)
            values = values + ca.mtimes(P[:, pair], _pushes(values[pair], P[pair, pair]))
        # A projection may take along another parameter beyond its bound, where the law needs it.
        inside = ca.fmin(ca.fmax(values[:num], self._low), self._high)
        return ca.vertcat(inside, values[num:])


class Regressor:
    """Y = -dr/dtheta at the filter's samples, which are slower than those of r.

    By the derivatives of the momentum p, of its rate without inputs and of the part from the
    inputs, d theta leaves over a sample T the disturbance

        own = mean of (drift + inputs) - (p - p before) / T,

    low-pass filtered as r is, along the free directions and along the constrained ones. Friction of
    contacts has its own columns. That of joints turns within a sample: its mean is that of states
    between both, `steps` of them. `jumps` are the changes of r, and of p and its rate if the state
    `is_exact`, by the last change of theta.
    """

    def __init__(
        self,
        system: DaeSystem,
        observation: Observation,
        rates: Sequence[float],
        period: float,
        steps: int,
        is_exact: bool,
    ) -> None:
        self._gains, self._period = [-np.expm1(-rate * period) for rate in rates], period
        self._middles = ((np.arange(steps) + 0.5) / steps).tolist()
        parameters, size = observation.identified.parameters, len(observation.rows)
        names = [p.name for p in parameters for _ in range(p.value.size)]
        dry = [p for p in parameters if p.name in system.dry]
        self._dry = [i for i, name in enumerate(names) if name in system.dry]
        symbols = ca.vertcat(ca.SX(0, 1), *(p.symbol for p in dry))
        turning = ca.densify(ca.jacobian(system.f[list(observation.rows)], symbols))
        self._turning = ca.Function("turning", [system.state, system.parameter_symbol], [turning])
        self._value = ca.SX.sym("regressor", size, len(names) + len(observation.frictions))
        self._slopes = [ca.SX.sym("slopes", size, len(names)) for _ in range(3)]
        self._state = ca.SX.sym("state", system.num_states)
        named = ("disturbance", "momentum", "drift") if is_exact else ("disturbance",)
        self.jumps = {name: ca.SX.sym(f"jump of {name}", size) for name in named}
        self.held = _column(self._state, self._value, *self._slopes, *self.jumps.values())

    def after(
        self,
        state: ca.SX,
        parameters: ca.SX,
        slopes: Sequence[ca.SX],
        slides: ca.SX,
        free: ca.SX,
        is_used: ca.SX,
    ) -> ca.SX:
        """Y after a sample, (k, c); the columns `slides` are of friction of contacts."""
        (momentum, drift, inputs), (before, drifted, pushed) = slopes, self._slopes
        mean = (drift + inputs + drifted + pushed) / 2.0
        own = mean - (momentum - before) / self._period
        total = ca.SX(momentum.shape[0], len(self._dry))
        for share in self._middles if self._dry else ():
            turning = self._turning(self._state + share * (state - self._state), parameters)
            # A joint that rests may have any friction.
            sizes = ca.vertcat(*(ca.mmax(ca.fabs(c)) for c in ca.horzsplit(turning)))
            total += ca.mtimes(turning, ca.diag(sizes > _DEVELOPED))
        own[:, self._dry] = total / len(self._middles)
        signal = ca.horzcat(own, slides)
        fast, slow = (gain * (signal - self._value) for gain in self._gains)
        return self._value + is_used * (slow + ca.mtimes(free, fast - slow))

    def held_after(
        self, state: ca.SX, value: ca.SX, slopes: Sequence[ca.SX], change: ca.SX
    ) -> ca.SX:
        """What is held after a sample that changes theta."""
        jumps = [-ca.mtimes(value, change)]
        if len(self.jumps) > 1:
            jumps += [ca.mtimes(slope, change[: slope.shape[1]]) for slope in slopes[:2]]
        return _column(state, value, *slopes, *jumps)


def _symmetric(matrix: ca.SX) -> ca.SX:
    """Both halves by the expressions of the lower one, which are half as many."""
    return ca.tril2symm(ca.tril(matrix))


def _column(*parts: ca.SX) -> ca.SX:
    return ca.vertcat(*map(ca.vec, parts))


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
