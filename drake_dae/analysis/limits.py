"""Limits of a robot: which is exceeded most along a motion, and what slower references change."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import StrEnum
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np

from drake_dae.analysis.tables import digits
from drake_dae.arrays import FloatArray, unknown_name
from drake_dae.dae import DaeSystem, PinnedMotion, Signal, Structure
from drake_dae.dae.pinned_motion import PinnedOutputs, PinnedSet
from drake_dae.diagrams.record import Record
from drake_dae.errors import ModelError
from drake_dae.robots import FrictionCone, RobotModel
from drake_dae.trace.functions import TracedFunction

SLACK, CLOSE = 1e-9, 1e-6
"""The share by which a limit may be passed, since a start may be on it; and the relative accuracy
of the rate."""


class LimitKind(StrEnum):
    """What a limit is on."""

    CONTROL = "control"
    EFFORT = "joint force"
    POSITION = "position"
    SPEED = "speed"
    FORCE = "constraint force"
    CONE = "friction cone"


@dataclass(frozen=True)
class Excess:
    """A signal where it exceeds its limit most; the limit of a force that can only push is 0."""

    signal: Signal
    kind: LimitKind
    value: float  # Of a friction cone |F_t| - mu F_n, whose limit is 0.
    time: float
    limit: float

    def __str__(self) -> str:
        name, unit, when = self.signal.name, f" {self.signal.unit}".rstrip(), f"{self.time:.4g} s"
        if self.kind is LimitKind.POSITION:
            value, limit = f"{digits(self.value)}{unit}", f"{digits(self.limit)}{unit}"
            return f"{name} comes to {value} at {when}, beyond its limit of {limit}"
        value = f"{abs(self.value):.4g}{unit}"
        if self.kind is LimitKind.CONE:
            return f"{name} is left by {value} at {when}"
        if not self.limit:
            return f"{name} would pull with {value} at {when}: a real contact opens"
        share = f"{self.value / self.limit:.3g} times its limit of {abs(self.limit):.4g}{unit}"
        return f"{name} has {value} at {when}, {share}"


@dataclass(frozen=True, eq=False)
class SignalRange:
    """The least and the largest value of a signal along a motion, when they are, and its limits."""

    signal: Signal
    kind: LimitKind
    least: float
    least_time: float
    largest: float
    largest_time: float
    low: float
    high: float
    beyond_time: float | None  # The first time beyond a limit.

    @property
    def room(self) -> float:
        """The least distance from a limit; negative beyond it, infinite without one."""
        room = min(self.least - self.low, self.high - self.largest)
        return 0.0 if room < 0.0 and self.beyond_time is None else room

    @property
    def share(self) -> float:
        """How much of the half range between its limits is used; nan without both, or a range."""
        width = self.high - self.low
        return 1.0 - 2.0 * self.room / width if 0.0 < width < np.inf else np.nan

    @property
    def excess(self) -> Excess | None:
        """Where it is beyond its limits most; None if it keeps them."""
        if self.beyond_time is None:
            return None
        if self.low - self.least > self.largest - self.high:
            return Excess(self.signal, self.kind, self.least, self.least_time, self.low)
        return Excess(self.signal, self.kind, self.largest, self.largest_time, self.high)

    def to_dict(self) -> dict[str, Any]:
        """The range as plain numbers; None for an infinite limit."""
        return {
            "name": self.signal.name,
            "unit": self.signal.unit,
            "least": {"value": self.least, "time": self.least_time},
            "largest": {"value": self.largest, "time": self.largest_time},
            "low": self.low if np.isfinite(self.low) else None,
            "high": self.high if np.isfinite(self.high) else None,
            "beyond_time": self.beyond_time,
        }


@dataclass(frozen=True, eq=False)
class SignalLimits:
    """Limits low <= s <= high of k signals s(x, u, lambda), where lambda are all constraint forces.

    `values` is s in `system.state` and the `symbols` of u and lambda, and `bounds` are low and
    high, shape (2, k), infinite without a limit.
    """

    system: DaeSystem
    signals: Sequence[Signal]
    kinds: Sequence[LimitKind]
    values: ca.SX
    bounds: FloatArray
    symbols: tuple[ca.SX, ca.SX]

    @cached_property
    def _recorded(self) -> TracedFunction:
        u, force = self.symbols
        return self.system.trace(
            "limited", {"s": ca.densify(self.values)}, {"u": u, "force": force}
        )

    @cached_property
    def pinned(self) -> TracedFunction:
        """s as a function of x, u and the constraint inputs v."""
        (u, force), v = self.symbols, ca.SX.sym("v", self.system.num_constraints)
        values = ca.substitute(ca.densify(self.values), force, self.system.forces(v))
        return self.system.trace("limited", {"s": values}, {"u": u, "v": v})

    def of_motion(self, motion: PinnedMotion) -> FloatArray:
        """The rows of s along a motion with pinned outputs."""
        rows = motion.states, motion.controls, motion.constraint_inputs, motion.parameters
        return np.array([self.pinned(*row)[0] for row in zip(*rows, strict=True)])

    def of_record(self, record: Record) -> FloatArray:
        """The rows of s in a record of the system."""
        rows = (record[name].T for name in ("state", "control", "constraint_force"))
        # CasADi evaluates all columns at once.
        values: FloatArray = self._recorded.function(*rows, self.system.parameter_values)[0].full()
        return values.T

    def ranges(self, times: FloatArray, values: FloatArray) -> tuple[SignalRange, ...]:
        """The range of each signal along rows of s, with times."""
        found = []
        for i in range(len(self.signals) if times.size else 0):
            column, (low, high) = values[:, i], self.bounds[:, i].tolist()
            size = np.max(np.abs(column))
            # The first of those that differ by round-off.
            least = int(np.argmax(column <= column.min() + SLACK * size))
            largest = int(np.argmax(column >= column.max() - SLACK * size))
            slack = SLACK * max(1.0, size)
            beyond = (column < low - slack) | (column > high + slack)
            lowest, highest = ((float(column[k]), float(times[k])) for k in (least, largest))
            first = float(times[np.argmax(beyond)]) if beyond.any() else None
            of = self.signals[i], self.kinds[i]
            found.append(SignalRange(*of, *lowest, *highest, low, high, first))
        return tuple(found)

    def worst(self, times: FloatArray, values: FloatArray) -> Excess | None:
        """The excess that depends on the pace and is the largest share of its limit, or signal."""
        shares = {}
        for r in self.ranges(times, values):
            if r.kind is not LimitKind.POSITION and (excess := r.excess):
                size = abs(excess.limit) or max(abs(r.least), abs(r.largest))
                shares[excess] = abs(excess.value - excess.limit) / size
        return max(shares, key=lambda excess: shares[excess], default=None)


def robot_limits(model: RobotModel, cones: Sequence[FrictionCone] = ()) -> SignalLimits:
    """The limits of drives, joint forces, positions, speeds, pushing forces and friction cones."""
    dae, links, loops = model.dae, model.links, model.loop_joints
    control, forces = ca.SX.sym("u", dae.num_controls), dae.force_signals
    force, names = ca.SX.sym("force", len(forces)), [signal.name for signal in forces]
    nq, nv, half = links.q.numel(), links.v.numel(), len(loops.signals) // 2
    q, v = slice(nq), slice(nq, nq + nv)
    most, effort, (low, high) = model.control_limits, links.effort_limits, loops.limits
    pushes = [one for constraint in model.constraints for one in constraint.is_unilateral]
    least, free = np.where(pushes, 0.0, -np.inf), np.full(len(names), np.inf)
    groups: list[tuple[LimitKind, Sequence[Signal], ca.SX, Any, Any]] = [
        (LimitKind.CONTROL, dae.control_signals, control, -most, most),
        (LimitKind.EFFORT, links.actuator_signals, model.joint_force, -effort, effort),
        (LimitKind.POSITION, dae.state_signals[q], dae.state[q], *links.position_limits),
        (LimitKind.SPEED, dae.state_signals[v], dae.state[v], *links.velocity_limits),
        (LimitKind.POSITION, loops.signals[:half], loops.state[:half], low[:half], high[:half]),
        (LimitKind.SPEED, loops.signals[half:], loops.state[half:], low[half:], high[half:]),
        (LimitKind.FORCE, forces, force, least, free),
    ]
    for cone in cones:
        for name in (cone.normal, *cone.tangents):
            if name not in names:
                raise ModelError(unknown_name("constraint force", name, names))
        normal = names.index(cone.normal)
        tangents = ca.norm_2(force[[names.index(name) for name in cone.tangents]])
        signal = Signal(f"the friction cone of {cone.normal}", forces[normal].unit)
        value = tangents - cone.limit * force[normal]
        groups.append((LimitKind.CONE, [signal], value, [-np.inf], [0.0]))
    groups = [group for group in groups if group[2] is not None]  # Rigid joints have no stages.
    bounds = [np.array([low, high], dtype=float).reshape(2, -1) for *_, low, high in groups]
    return SignalLimits(
        dae,
        [signal for _, signals, *_ in groups for signal in signals],
        [kind for kind, signals, *_ in groups for _ in signals],
        ca.vertcat(*(values for *_, values, _, _ in groups)),
        np.hstack(bounds),
        (control, force),
    )


@dataclass(frozen=True)
class LimitsAlong:
    """The largest excess along references r(t), and the remedy: r(c t) with c = `rate`, or none."""

    excess: Excess
    rate: float | None
    remedy: str


def limits_along(
    structure: Structure,
    limits: SignalLimits,
    reference: Callable[[float], FloatArray],
    motion: PinnedMotion,
) -> LimitsAlong | None:
    """Which limit the reference of a motion exceeds most, and the remedy; None if it keeps all.

    r(s) with s = c t has the derivatives c^j r^(j). On Z(R) speeds grow with c, the accelerations
    in u (28) and v (35) with c^2, gravity and commanded forces not at all. The time with the
    largest excess is slowed by bisection until its limits hold, then the next one.
    """
    times, p, layout, system = motion.times, motion.parameters, structure.layout, structure.system
    excess = limits.worst(times, limits.of_motion(motion))
    if excess is None:
        return None
    if system.exogenous.moving or structure.zero_dynamics_dimension:
        free = "exogenous signals" if system.exogenous.moving else "the zero dynamics"
        text = f"not decided for slower references: {free} keep their pace"
        return LimitsAlong(excess, None, text)
    pinned, goals = PinnedOutputs(structure), np.array([reference(float(time)) for time in times])
    powers = np.concatenate([np.arange(degree + 1) for degree in layout.reference_degrees])

    def worst(rate: float, chosen: Sequence[int] = range(times.size)) -> Excess | None:
        rows = []
        for i in chosen:
            at = PinnedSet(pinned, goals[i] * rate**powers, p[i])
            point = at.point(at.state(motion.states[i]))
            rows.append(limits.pinned(point.state, point.control, point.constraint_input, p[i])[0])
        return limits.worst(times[list(chosen)], np.array(rows))

    if (rest := worst(0.0)) is not None:
        return LimitsAlong(excess, None, f"slower references do not help: at rest {rest}")
    rate, now = 1.0, worst(1.0)
    while now is not None:
        i, low, high = int(np.searchsorted(times, now.time)), 0.0, rate
        while high - low > CLOSE * high:
            middle = 0.5 * (low + high)
            low, high = (middle, high) if worst(middle, [i]) is None else (low, middle)
        rate, now = low, worst(low)
    text = f"all references must be {1.0 / rate:.4g} times slower to keep the limits"
    return LimitsAlong(excess, rate, text)
