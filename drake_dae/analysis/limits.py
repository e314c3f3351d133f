"""Limits along references: which is exceeded most, and how much slower the references must be."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import casadi as ca
import numpy as np

from drake_dae.arrays import FloatArray
from drake_dae.dae.structure.structure import Structure
from drake_dae.dae.system.signals import Signal
from drake_dae.dae.system.system import DaeSystem
from drake_dae.dae.zero_dynamics.pinned_motion import PinnedMotion
from drake_dae.dae.zero_dynamics.pinned_outputs import PinnedOutputs

SLACK, CLOSE = 1e-9, 1e-6
"""The share by which a limit may be passed, and the relative accuracy of the rate."""


@dataclass(frozen=True)
class Excess:
    """A signal where it exceeds its limit most: its value, the time in s, and the limit.

    The limit is 0 for a force that can only push, and for |F_t| - mu F_n of a friction cone, which
    is then positive.
    """

    signal: Signal
    value: float
    time: float
    limit: float

    def __str__(self) -> str:
        name, unit = self.signal.name, f" {self.signal.unit}".rstrip()
        if not self.limit:
            what = "is left by" if self.value > 0.0 else "would pull with"
            return f"{name} {what} {abs(self.value):.4g}{unit} at {self.time:.4g} s"
        share = f"{self.value / self.limit:.3g} times its limit of {abs(self.limit):.4g}{unit}"
        return f"{name} has {abs(self.value):.4g}{unit} at {self.time:.4g} s, {share}"


class SignalLimits:
    """Limits low <= s <= high of signals s(x, u, lambda), where lambda are all constraint forces.

    Args:
        system: The system.
        signals: Names and units of s, k of them.
        values: s, shape (k, 1), in `system.state` and the symbols.
        bounds: low and high, shape (2, k), infinite without a limit.
        symbols: Those of u and lambda.
    """

    def __init__(
        self,
        system: DaeSystem,
        signals: Sequence[Signal],
        values: ca.SX,
        bounds: FloatArray,
        symbols: tuple[ca.SX, ca.SX],
    ) -> None:
        self.signals, self.bounds, values = tuple(signals), bounds, ca.densify(values)
        (u, force), v = symbols, ca.SX.sym("v", system.num_constraints)
        self.values = system.trace("limited", {"s": values}, {"u": u, "force": force})
        pinned = {"s": ca.substitute(values, force, system.forces(v))}
        self.pinned_values = system.trace("limited", pinned, {"u": u, "v": v})

    def worst(self, values: FloatArray, times: FloatArray, sizes: FloatArray) -> Excess | None:
        """Returns the largest excess of rows of s, as a share of its limit, or of `sizes` for 0."""
        sizes = np.where(self.bounds == 0.0, sizes, np.abs(self.bounds))
        over = np.array([self.bounds[0] - values, values - self.bounds[1]])
        with np.errstate(invalid="ignore", divide="ignore"):  # -inf / inf without a limit.
            shares = np.nan_to_num(over / sizes[:, None, :], nan=-np.inf)
        most = shares.max()  # The first of those that differ by round-off.
        side, row, i = np.argwhere(shares >= most - SLACK * abs(most))[0]
        if not most > SLACK:
            return None
        limit = float(self.bounds[side, i])
        return Excess(self.signals[i], float(values[row, i]), float(times[row]), limit)


@dataclass(frozen=True)
class LimitsAlong:
    """The largest excess along references, and the remedy.

    The references r(c t) keep all limits with `rate`, the largest such c in (0, 1); where it is
    None, `reason` says why.
    """

    excess: Excess
    rate: float | None
    reason: str = ""

    @property
    def remedy(self) -> str:
        """What to do, as a phrase."""
        if self.rate is None:
            return self.reason
        return f"all references must be {1.0 / self.rate:.4g} times slower to keep the limits"


def limits_along(
    structure: Structure,
    limits: SignalLimits,
    reference: Callable[[float], FloatArray],
    motion: PinnedMotion,
) -> LimitsAlong | None:
    """Returns which limit references exceed most, and the remedy; None if they keep all limits.

    The references r(s) with s = c t have the derivatives c^j r^(j). On Z(R) speeds grow with c, the
    accelerations in u (28) and v (35) with c^2, gravity and commanded forces not at all. The time
    with the largest excess is slowed by bisection until its limits hold, then the next one. The
    motion is that along the reference t -> R(t), of `ZeroDynamics.motion`.
    """
    times, p, layout, system = motion.times, motion.parameters, structure.layout, structure.system
    rows = zip(motion.states, motion.controls, motion.constraint_inputs, p, strict=True)
    values = np.array([limits.pinned_values(*row)[0].copy() for row in rows])
    sizes = np.abs(values).max(axis=0, initial=0.0)
    excess = limits.worst(values, times, sizes) if values.size else None
    if excess is None:
        return None
    if system.exogenous.moving or structure.zero_dynamics_dimension:
        free = "exogenous signals" if system.exogenous.moving else "the zero dynamics"
        return LimitsAlong(
            excess, None, f"not decided for slower references: {free} keep their pace"
        )
    pinned, goals = PinnedOutputs(structure), np.array([reference(float(time)) for time in times])
    powers = np.concatenate([np.arange(degree + 1) for degree in layout.reference_degrees])
    commanded = layout.lowest[[j for j in range(system.num_outputs) if system.m[j, :].nnz()]]

    def slowed(i: int, rate: float, force: float = 1.0) -> FloatArray:
        goal = goals[i] * rate**powers
        goal[commanded] *= force
        at = pinned.at(goal, p[i])
        point = at.point(at.state(motion.states[i]))
        return limits.pinned_values(point.state, point.control, point.constraint_input, p[i])[0]

    def worst(rate: float, chosen: Sequence[int] = range(times.size)) -> Excess | None:
        every = np.array([slowed(i, rate).copy() for i in chosen])
        return limits.worst(every, times[list(chosen)], sizes)

    if (rest := worst(0.0)) is not None:
        i, column = int(np.searchsorted(times, rest.time)), limits.signals.index(rest.signal)
        alone = slowed(i, 0.0, force=0.0)[column]
        alone *= abs(alone) > SLACK * sizes[column]  # Else round-off.
        text = f"slower references do not help: at rest {rest}; by gravity alone it has {alone:.4g}"
        return LimitsAlong(excess, None, f"{text} {rest.signal.unit}".rstrip())
    rate, now = 1.0, worst(1.0)
    while now is not None:
        i, low, high = int(np.searchsorted(times, now.time)), 0.0, rate
        while high - low > CLOSE * high:
            middle = 0.5 * (low + high)
            low, high = (middle, high) if worst(middle, [i]) is None else (low, middle)
        rate, now = low, worst(low)
    return LimitsAlong(excess, rate)
