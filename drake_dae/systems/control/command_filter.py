"""The filter that makes commanded changes of references smooth.      (28)

A law needs a reference r with mu derivatives, and a person gives a number c that jumps. So c passes
through mu + 1 lags of rate w, the first of limited speed:

    y_0' = sat(w (c - y_0), V),    y_j' = w (y_(j-1) - y_j),    j = 1, ..., mu,    r = y_mu.

Then r, r', ..., r^(mu) are continuous: r^(k) is a sum of y_(mu-k), ..., y_mu. They are within
limits: |y_0'| <= V, and a lag is a mean with positive weights, so that r does not overshoot,
|r'| <= V, and |r^(k)| <= (2 w)^(k-1) V.

The time s along the path is such a number as well: its speed s' is c behind lags, s' = 1 at first.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import casadi as ca
import numpy as np

from drake_dae.arguments import checked
from drake_dae.arrays import FloatArray, positive
from drake_dae.dae.system.layout import DerivativeLayout
from drake_dae.dae.system.signals import Signal
from drake_dae.errors import ModelError
from drake_dae.trace.functions import TracedFunction

SPEED = Signal("path.speed")
"""The command of s'."""


@checked(ModelError)
@dataclass(frozen=True)
class CommandLimits:
    """The rates and speeds at which references follow commands; see `CommandFilter`.

    Attributes:
        rates: Unit -> the rate w of its lags, in 1/s.
        speeds: Unit -> the largest speed V, in this unit per second.
        rate, speed: Those of all other units.

    Raises:
        ModelError: A number is not positive.
    """

    rates: Mapping[str, float] = field(default_factory=lambda: {"N": 40.0, "N m": 40.0})
    speeds: Mapping[str, float] = field(default_factory=lambda: {"m": 0.4, "N": 400.0, "N m": 40.0})
    rate: float = 12.0
    speed: float = 1.0

    def __post_init__(self) -> None:
        numbers = {"rate": self.rate, "speed": self.speed}
        numbers |= {f"rates[{unit!r}]": value for unit, value in self.rates.items()}
        numbers |= {f"speeds[{unit!r}]": value for unit, value in self.speeds.items()}
        for name, value in numbers.items():
            positive(f"{name} of CommandLimits", value)

    def of(self, unit: str) -> tuple[float, float]:
        """w and V of a unit."""
        return self.rates.get(unit, self.rate), self.speeds.get(unit, self.speed)


class CommandFilter:
    """R(t) of references at the time s along their path, with commanded changes added to them.

    Args:
        signals: Names and units of the references.
        degrees: mu_1, ..., mu_p.
        limits: The rates and speeds at which they follow.
        has_speed: Whether the speed s' along the path is commanded, too; otherwise s = t.
        depth: The least number of lags, for another filter with the same commands and more
            derivatives.

    Attributes:
        commands: Names and units of the commands: the speed, if it is commanded, then a change of
            each reference.
        defaults: Their defaults: speed 1, no change.
        num_states: The number of states: s and the stages of its speed, then the stages of each
            change.
        rate: (state, commands) -> the derivative of the state.
        stacked: (time, state, commands, base) -> R, where base is R of the references themselves
            at s, with derivatives by s.
    """

    def __init__(
        self,
        signals: Sequence[Signal],
        degrees: Sequence[int],
        limits: CommandLimits,
        *,
        has_speed: bool,
        depth: int = 0,
    ) -> None:
        self.has_speed, self._stages = has_speed, max([*degrees, 1])
        self.commands = ((SPEED,) if has_speed else ()) + tuple(signals)
        self.defaults = np.array([1.0] * has_speed + [0.0] * len(signals))
        command = ca.SX.sym("c", len(self.commands))
        state, rate = ca.SX(0, 1), ca.SX(0, 1)

        def lags(goal: ca.SX, count: int, unit: str) -> ca.SX:
            """Adds the stages of a command; returns the last."""
            nonlocal state, rate
            w, most = limits.of(unit)
            y = ca.SX.sym("y", count)
            first = ca.fmin(ca.fmax(w * (goal - y[0]), -most), most)
            state, rate = ca.vertcat(state, y), ca.vertcat(rate, first, w * (y[:-1, :] - y[1:, :]))
            return y[-1]

        time = s = ca.SX.sym("time")
        if has_speed:
            s = ca.SX.sym("s")
            speed = lags(command[0], self._stages, SPEED.unit)
            state, rate = ca.vertcat(s, state), ca.vertcat(speed, rate)
        changes = [
            lags(command[i + has_speed], max(degree + 1, depth), signal.unit)
            for i, (signal, degree) in enumerate(zip(signals, degrees, strict=True))
        ]
        self.num_states = int(state.numel())

        def along(value: ca.SX) -> ca.SX:
            """The derivative by the time."""
            return ca.jtimes(value, ca.vertcat(time, state), ca.vertcat(1.0, rate))

        base = ca.SX.sym("base", DerivativeLayout(tuple(degrees)).reference_size)
        rows, first = [ca.SX(0, 1)], 0
        for change, degree in zip(changes, degrees, strict=True):
            by_path = base[first : first + degree + 1]  # r and its derivatives by s
            value, path_rate = by_path[0], along(s)
            for order in range(degree + 1):
                rows.append(value + change)
                if order < degree:
                    # r(s(t)): the chain rule, where each derivative by s leads to the next one.
                    by_s = ca.jtimes(value, by_path[:-1, :], by_path[1:, :])
                    value, change = by_s * path_rate + along(value), along(change)
            first += degree + 1
        self.rate = TracedFunction(
            "command rate", {"state": state, "commands": command}, {"rate": rate}
        )
        self.stacked = TracedFunction(
            "commanded references",
            {"time": time, "state": state, "commands": command, "base": base},
            {"R": ca.vertcat(*rows)},
        )

    def start(self, time: float) -> FloatArray:
        """The state at the start, without changes."""
        state = np.zeros(self.num_states)
        if self.has_speed:
            state[0] = time
            state[1 : 1 + self._stages] = 1.0
        return state
