"""The rate of a reference, lowered so that limits hold at the present state."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import casadi as ca
import numpy as np

from drake_dae.arrays import FloatArray
from drake_dae.dae.references.reference import Reference, with_degrees
from drake_dae.dae.timing.limited_signals import APPROACH, LimitedSignals
from drake_dae.dae.timing.motion_limits import MotionLimits
from drake_dae.dae.tracking.tracking import TrackingLaw
from drake_dae.errors import ReferenceSignalError
from drake_dae.trace.functions import TracedFunction

RATE = 20.0
"""The rate in 1/s at which s' returns to 1, and the largest at which it falls to 0."""

AHEAD = 0.02
"""Limits are satisfied at a time that is ahead by this, in s."""

FREE = 1e6
"""The largest |s''| where nothing limits it, in 1/s."""

SMALL = 1e-9
"""An effect on a signal, relative to its limits, below which s'' does not change it."""


@dataclass(frozen=True, eq=False)
class Governing:
    """The time s of a law's references, which runs as fast as limits allow at the present state.

    For any s(t) the reference r(s(t)) is admissible, so that errors obey (30), (31), whatever s
    does. With

        r' = r_s s',   r'' = r_ss s'^2 + r_s s''

    the control (28) at the present state, with its feedback, is affine in s'', and so are
    accelerations and constraint forces: each limit bounds s''. So

        s'' = max(low, min(high, RATE (1 - s'))),   -RATE s' <= s'' <= RATE (1 - s'),

    where s' = 1 is the reference's own rate, which is not exceeded. A limit is met AHEAD of time: a
    change of s' by AHEAD s'' counts with its effect on r_ss s'^2, as far as the limits hold now.
    Speeds v are kept below V by v' <= APPROACH (V - v) close to V, see `LimitedSignals.approach`,
    as far as the other limits allow. The accelerations are those of the model: a robot whose v' is
    d more exceeds V by d / APPROACH.
    Where low > high, s'' is their mean; there, and where s'' would have to be larger, a limit is
    exceeded.

    Exogenous signals of the law, such as the estimates of an observer, count as constant.

    Args:
        law: The law, without derivatives of exogenous signals.
        references: The references, in the order of the outputs; expressions of time.
        limits: The limits.
        sample_period: The time in s in which s'' is constant; 0 if it is continuous.

    Attributes:
        function: (path, state, parameters) -> reference, path_rate, room: path is (s, s'),
            parameters are those of the law; room is high - low, negative where no s'' is within all
            limits.

    Raises:
        ReferenceSignalError: The law has outputs of other degrees than 0 and 2, or needs
            derivatives of exogenous signals, or a reference is no expression of time.
        ModelError: A limit names no signal of the system.
    """

    law: TrackingLaw
    references: Sequence[Reference]
    limits: MotionLimits
    sample_period: float = 0.0

    @cached_property
    def function(self) -> TracedFunction:
        """The governed reference as a function; see the class."""
        law, layout = self.law, self.law.layout
        moves = any(law.exogenous_degrees)
        if any(d not in (0, 2) for d in law.degrees) or moves or law.deflection:
            raise ReferenceSignalError(
                "the time of references is governed for rigid joints and laws without "
                "contact_stiffness and without derivatives of exogenous signals"
            )
        path = ca.SX.sym("path", 2)
        s, rate = path[0], path[1]
        rows = self._reference(s)
        moving = layout.lowest[layout.dynamic]
        first, second = rows[(moving + 1).tolist()], rows[(moving + 2).tolist()]
        still = ca.SX(rows)
        still[(moving + 1).tolist()] = first * rate
        still[(moving + 2).tolist()] = second * rate**2
        commanded = law.commanded_derivatives(still)
        now, ahead = ca.SX.zeros(len(law.degrees)), ca.SX.zeros(len(law.degrees))
        now[layout.dynamic.tolist()] = first
        ahead[layout.dynamic.tolist()] = first + 2.0 * AHEAD * rate * second
        intervals = self._intervals(commanded, now, ahead)
        chosen = most = RATE * (1.0 - rate)
        for low, high in intervals:
            chosen = _within(chosen, low, high)
        chosen = ca.fmax(ca.fmin(chosen, most), -RATE * rate)
        reference = ca.SX(still)
        reference[(moving + 2).tolist()] += first * chosen
        inputs = {"path": path, "state": law.system.state, "parameters": law.inputs["parameters"]}
        outputs = {
            "reference": reference,
            "path_rate": ca.vertcat(rate, chosen),
            "room": high - low,
        }
        name = f"{law.system.name} governed reference"
        return TracedFunction(name, inputs, outputs, compiled=law.system.compiled)

    def _reference(self, time: ca.SX) -> ca.SX:
        """Returns R at a symbolic time of the reference."""
        rows = [ca.SX(0, 1)]
        for reference, degrees in with_degrees(self.references, self.law.degrees):
            row = reference.expression(degrees, time)
            if row is None:
                raise ReferenceSignalError(
                    f"a {type(reference).__name__} of so many pieces has no symbolic expression, "
                    "which a governor needs. Use a shorter path, or fewer points"
                )
            rows.append(row)
        return ca.vertcat(*rows)

    def _intervals(self, commanded: ca.SX, now: ca.SX, ahead: ca.SX) -> list[tuple[ca.SX, ca.SX]]:
        """Returns the allowed intervals of s'' by speeds, by other limits ahead of time, and now.

        Args:
            commanded: ubar of (28) for s'' = 0, shape (p, 1).
            now: d ubar / d s'', shape (p, 1).
            ahead: d ubar / d s'' with the effect AHEAD of time, shape (p, 1).
        """
        structure = self.law.damped_structure
        limited = LimitedSignals(structure, self.limits)
        # By a symbol: to solve with what is looked up in a table, as a long path, crashes CasADi.
        desired = ca.SX.sym("commanded", commanded.numel())
        solved, _ = structure.control_for(desired)
        control, *others = (
            ca.substitute(solved, desired, commanded + effect) for effect in (0.0, now, ahead)
        )
        slope_now, slope = (other - control for other in others)
        free, by = limited.by_control()
        values, slopes = free + ca.mtimes(by, control), ca.mtimes(by, slope)
        sizes = np.minimum(np.abs(limited.low), np.abs(limited.high))
        bounds = ca.SX(limited.low), ca.SX(limited.high)
        at_once = _interval(values, ca.mtimes(by, slope_now), *bounds, sizes)
        later = _interval(values, slopes, *bounds, sizes)
        free, by = limited.rates_of_states()
        low, high = limited.approach(self.sample_period)
        sizes = APPROACH * np.minimum(np.abs(limited.state_low), np.abs(limited.state_high))
        values, slopes = free + ca.mtimes(by, control), ca.mtimes(by, slope_now)
        return [_interval(values, slopes, low, high, sizes), later, at_once]


def _within(value: ca.SX, low: ca.SX, high: ca.SX) -> ca.SX:
    """Clips a value to an interval; returns the middle of an empty interval."""
    inside = ca.fmax(low, ca.fmin(high, value))
    return ca.if_else(low <= high, inside, (low + high) / 2.0)


def _interval(
    values: ca.SX, slopes: ca.SX, low: ca.SX, high: ca.SX, sizes: FloatArray
) -> tuple[ca.SX, ca.SX]:
    """Returns the least and the largest a with low <= values + slopes a <= high.

    Args:
        values, slopes, low, high: Expressions, shape (k, 1).
        sizes: The sizes of the limits, shape (k,).
    """
    least, most = ca.SX(-FREE), ca.SX(FREE)
    for i, limit in enumerate(sizes.tolist()):
        size = limit if np.isfinite(limit) and limit > 0.0 else 1.0
        acts = ca.fabs(slopes[i]) > SMALL * size
        inverse = ca.if_else(acts, 1.0 / slopes[i], 0.0)
        for bound, is_upper in ((low[i], False), (high[i], True)):
            if bound.is_constant() and not np.isfinite(float(bound)):
                continue
            reached = (bound - values[i]) * inverse
            is_most = slopes[i] > 0.0 if is_upper else slopes[i] < 0.0
            most = ca.fmin(most, ca.if_else(ca.logic_and(acts, is_most), reached, FREE))
            is_least = ca.logic_and(acts, ca.logic_not(is_most))
            least = ca.fmax(least, ca.if_else(is_least, reached, -FREE))
    return least, most
