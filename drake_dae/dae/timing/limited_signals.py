"""The signals of a system that have limits, as expressions of state and control."""

import casadi as ca
import numpy as np

from drake_dae.dae.structure.structure import Structure
from drake_dae.dae.system.signals import Signal
from drake_dae.dae.timing.motion_limits import MotionLimits

APPROACH = 100.0
"""The largest rate at which states, such as speeds, approach their limits while a motion runs, in
1/s, where they are close to these."""

AT_ONCE = 1e-9
"""The time in s in which a state may reach a limit that is not close, if there are no samples."""


class LimitedSignals:
    """The controls, rates of states, constraint forces and friction cones that have limits.

    On N* they are y = y_0(x) + Y(x) u: x' = f* + h* u by (9), (10), and v = alpha + beta u by (25).

    Args:
        structure: The structure of the system.
        limits: The limits.

    Attributes:
        signals: Names and units, k of them: controls, rates, forces, cones.
        low, high: The lowest and highest values, shape (k,), infinite without a limit.
        are_forces: Which of them are constraint forces or friction cones, shape (k,).
        states: The indices of the limited states.
        state_signals: Names and units of the limited states.
        state_low, state_high: The lowest and highest values of the limited states.

    Raises:
        ModelError: A limit names no signal of the system.
    """

    def __init__(self, structure: Structure, limits: MotionLimits) -> None:
        limits.check(structure.system)
        self._structure, self._close = structure, limits.close
        system = structure.system
        inputs = system.constraint_input_signals
        forces = [signal.name for signal in inputs]
        rates = [signal.derivative(1) for signal in system.state_signals]
        signals = [*system.control_signals, *rates, *inputs]
        bounds = [
            limits.bounds("controls", system.control_signals),
            limits.bounds("rates", system.state_signals),
            limits.bounds("forces", inputs),
        ]
        rows = [np.zeros((0, len(forces)))]
        for cone in limits.cones:
            rows.append(cone.rows(forces))
            count = len(rows[-1])
            signals += [Signal(f"friction cone of {cone.normal}", "N")] * count
            bounds.append((np.full(count, -np.inf), np.zeros(count)))
        self._cones = np.vstack(rows)
        low, high = (np.concatenate([bound[i] for bound in bounds]) for i in range(2))
        self._rows: list[int] = np.flatnonzero(np.isfinite(low) | np.isfinite(high)).tolist()
        self.signals = tuple(signals[i] for i in self._rows)
        self.low, self.high = low[self._rows], high[self._rows]
        before = len(system.control_signals) + len(rates)
        self.are_forces = np.array(self._rows, dtype=int) >= before
        low, high = limits.bounds("states", system.state_signals)
        self.states: list[int] = np.flatnonzero(np.isfinite(low) | np.isfinite(high)).tolist()
        self.state_signals = tuple(system.state_signals[i] for i in self.states)
        self.state_low, self.state_high = low[self.states], high[self.states]

    def values(self, control: ca.SX) -> ca.SX:
        """Returns the limited signals for a control, shape (k, 1)."""
        motion = self._structure.derivatives
        rate, force = (  # (25), (35)
            ca.substitute(motion.expand(unknown), motion.control, control)
            for unknown in (motion.rate, motion.constraint_input)
        )
        signals = ca.vertcat(control, rate, force, ca.mtimes(ca.DM(self._cones), force))
        return ca.densify(signals[self._rows, :])

    def by_control(self) -> tuple[ca.SX, ca.SX]:
        """Returns y_0(x), shape (k, 1), and Y(x), shape (k, p)."""
        motion = self._structure.derivatives
        free, by = motion.by_control(ca.vertcat(motion.rate, motion.constraint_input))
        return self._chosen(free, by)

    def rates_of_states(self) -> tuple[ca.SX, ca.SX]:
        """Returns a and B of x' = a + B u of the limited states, shapes (k, 1) and (k, p)."""
        motion = self._structure.derivatives
        free, by = motion.by_control(motion.rate)
        return ca.densify(free[self.states, :]), ca.densify(by[self.states, :])

    def approach(self, sample_period: float = 0.0) -> tuple[ca.SX, ca.SX]:
        """Returns the least and the largest rates of the limited states, (k, 1), or infinity.

        States x stay below their limits X if x' <= 0 at X. A rate has to fall to 0 as soon as X is
        reached, so that it is lowered before:

            x' <= APPROACH (X - x)    close to X, where X - x < `MotionLimits.close` |X|,
            x' <= (X - x) / T         elsewhere, with the sample period T.

        x then passes X neither close to it nor within a sample. Along a motion that is nowhere
        close to X, such as a time-optimal one with a share of X, continuous rates are not limited,
        and may fall to 0 at once. APPROACH (X - x) everywhere would limit them even at rest, to
        APPROACH X, and so such motions.

        Args:
            sample_period: The time in s in which rates are constant; 0 if they are continuous.
        """
        fast = 1.0 / max(sample_period, AT_ONCE)
        ranges = np.abs([self.state_low, self.state_high])
        close = self._close * np.where(np.isfinite(ranges), ranges, 0.0).max(axis=0, initial=0.0)
        state = ca.vertsplit(self._structure.system.state[self.states])
        low, high = (
            [
                ca.if_else(sign * (bound - x) < near, min(APPROACH, fast), fast) * (bound - x)
                if np.isfinite(bound)
                else ca.SX(bound)
                for bound, x, near in zip(bounds.tolist(), state, close.tolist(), strict=True)
            ]
            for bounds, sign in ((self.state_low, -1.0), (self.state_high, 1.0))
        )
        return ca.vertcat(ca.SX(0, 1), *low), ca.vertcat(ca.SX(0, 1), *high)

    def _chosen(self, free: ca.SX, by: ca.SX) -> tuple[ca.SX, ca.SX]:
        system, cones = self._structure.system, ca.DM(self._cones)
        size, count = system.num_states, system.num_controls
        every = ca.vertcat(ca.SX.zeros(count), free, ca.mtimes(cones, free[size:, :]))
        slopes = ca.vertcat(ca.SX.eye(count), by, ca.mtimes(cones, by[size:, :]))
        return ca.densify(every[self._rows, :]), ca.densify(slopes[self._rows, :])
