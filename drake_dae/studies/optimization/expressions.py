"""The record of a run as symbols, and cost and limits as expressions of it."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from drake_dae.arguments import checked
from drake_dae.arrays import FloatArray, brief, numbers, unknown_name
from drake_dae.dae.system.layout import DerivativeLayout
from drake_dae.dae.system.signals import Signal
from drake_dae.errors import ModelError
from drake_dae.trace.given import numpy_explained, result_of

DERIVED = ("tracking_error", "desired_output")
"""Signals of a record of a closed loop that follow from its reference and its outputs."""


@checked(ModelError)
class RunSymbols:
    """A run of an optimization as CasADi expressions (MX), for its cost and its limits.

    `run["control"]` is a signal of the record, shape (j, k), with a row for each time;
    `run["control", "joint1_motor"]` is the column of one entry, shape (j, 1), by its name; and
    `run["link1.mass"]` is a variable, by the name that `free` or `more` has, shape (k, 1).

    Attributes:
        time: The times of the rows, in s, shape (j, 1).

    Args:
        times: These times.
        signals: Name of a signal -> names and units of its entries.
        variables: The names of the variables.
        layout: How the references of a closed loop are stacked; None for any other diagram.
    """

    def __init__(
        self,
        times: FloatArray,
        signals: Mapping[str, Sequence[Signal]],
        variables: Sequence[str],
        layout: DerivativeLayout | None = None,
    ) -> None:
        self.time = ca.DM(times)
        self._layout, self._signals = layout, dict(signals)
        if layout is not None and {"reference", "controlled_output"} <= signals.keys():
            self._signals |= dict.fromkeys(DERIVED, signals["controlled_output"])
        self._names = tuple(variables)
        self.variables = ca.MX.sym("variables", len(variables))
        self.used: dict[str, ca.MX] = {}

    def __getitem__(self, key: str | tuple[str, str]) -> ca.MX:
        name, entry = key if isinstance(key, tuple) and len(key) == 2 else (key, None)
        if not isinstance(name, str):
            raise ModelError(
                'a run has the names of signals and variables, as run["control"] or '
                f'run["control", "joint1"], got {brief(key)}'
            )
        if name not in self._signals:
            return self._variable(name)
        found = self._signal(name)
        if entry is None:
            return found
        names = [signal.name for signal in self._signals[name]]
        if entry not in names:
            raise ModelError(unknown_name(f"entry of {name}", entry, names))
        return found[:, names.index(entry)]

    def _signal(self, name: str) -> ca.MX:
        if name in DERIVED:
            assert self._layout is not None
            wanted = self._signal("reference")[:, self._layout.lowest.tolist()]
            own = self._signal("controlled_output")
            return wanted if name == "desired_output" else own - wanted
        if name not in self.used:
            shape = self.time.numel(), len(self._signals[name])
            self.used[name] = ca.MX.sym(name, *shape)
        return self.used[name]

    def _variable(self, name: str) -> ca.MX:
        entries = [i for i, own in enumerate(self._names) if own.partition("[")[0] == name]
        if name in self._names:
            entries = [self._names.index(name)]
        if not entries:
            known = dict.fromkeys([*self._signals, *(n.partition("[")[0] for n in self._names)])
            raise ModelError(unknown_name("signal or variable of the run", name, known))
        return self.variables[entries]


NamedLimits = Mapping[str, tuple[ArrayLike | None, Any, ArrayLike | None]]
"""Name -> (least value, expression, largest value), None for no bound."""


@dataclass(frozen=True, eq=False)
class Objective:
    """Cost and limits as functions of the record and of the variables.

    Attributes:
        run: The symbols.
        cost: The cost.
        names: The names of the limits.
        sizes: The number of entries of each limit.
        values: All entries below each other, shape (m, 1).
        low, high: Their bounds, shape (m,), infinite where there are none.
    """

    run: RunSymbols
    cost: ca.MX
    names: tuple[str, ...]
    sizes: tuple[int, ...]
    values: ca.MX
    low: FloatArray
    high: FloatArray

    @classmethod
    def of(
        cls,
        run: RunSymbols,
        cost: Callable[[RunSymbols], Any],
        limits: Callable[[RunSymbols], NamedLimits] | None,
    ) -> "Objective":
        """What functions of a user ask.

        Raises:
            ModelError: They return something else, or depend on nothing.
        """
        with numpy_explained("cost"):
            value = _expression("the cost", result_of("cost", cost, run))
        if value.shape != (1, 1):
            raise ModelError(
                f"the cost must be one number, got shape {value.shape}: take a sum, as "
                'casadi.sumsqr(run["control"]), or the last row, run["control"][-1, 0]'
            )
        found: Any = {}
        if limits is not None:
            with numpy_explained("limits"):
                found = result_of("limits", limits, run)
        if not isinstance(found, Mapping):
            raise ModelError(
                'limits must return a mapping, as {"torque": (-90.0, run["control"], 90.0)}, got '
                f"{brief(found)}"
            )
        columns, low, high, sizes = [ca.MX(0, 1)], [np.zeros(0)], [np.zeros(0)], []
        for name, given in found.items():
            column, lower, upper = _limit(name, given)
            columns.append(column)
            low.append(lower)
            high.append(upper)
            sizes.append(lower.size)
        names = tuple(map(str, found))
        bounds = np.concatenate(low), np.concatenate(high)
        return cls(run, value, names, tuple(sizes), ca.vertcat(*columns), *bounds)

    @property
    def signals(self) -> tuple[str, ...]:
        """The signals of the record that cost and limits read."""
        return tuple(self.run.used)

    @cached_property
    def evaluate(self) -> ca.Function:
        """(variables, signals...) -> cost and limits below each other, shape (1 + m, 1)."""
        return ca.Function("asked", self._symbols, [self._both])

    def tangents(self, count: int) -> ca.Function:
        """(variables, signals..., and changes of all) -> the changes of `evaluate`.

        Args:
            count: The number of changes, which stand side by side.
        """
        changes = [ca.MX.sym("d", s.shape[0], s.shape[1] * count) for s in self._symbols]
        pairs = zip(self._symbols, changes, strict=True)
        found = sum(
            (ca.jtimes(self._both, s, d) for s, d in pairs), ca.MX(self._both.numel(), count)
        )
        return ca.Function("tangents", [*self._symbols, *changes], [ca.densify(found)])

    def reads(self, changes: Mapping[str, FloatArray], only_cost: bool) -> list[bool]:
        """Whether cost or limits may depend on each variable.

        Args:
            changes: Name of a signal -> its changes with each variable, shape (n, j, k).
            only_cost: Whether the cost alone is asked for.
        """
        value = self.cost if only_cost else self._both
        of_variables, *of_signals = (_read(value, symbol) for symbol in self._symbols)
        found = of_variables[:, 0]
        for name, read in zip(self.signals, of_signals, strict=True):
            found = found | ((changes[name] != 0.0) & read).any(axis=(1, 2))
        return [bool(each) for each in found]

    @property
    def _symbols(self) -> list[ca.MX]:
        return [self.run.variables, *self.run.used.values()]

    @property
    def _both(self) -> ca.MX:
        return ca.densify(ca.vertcat(self.cost, self.values))


def _read(value: ca.MX, symbol: ca.MX) -> np.ndarray:
    """Which entries of a symbol a value depends on, in the symbol's shape."""
    found = np.zeros(symbol.numel(), dtype=bool)
    found[ca.jacobian_sparsity(value, symbol).get_triplet()[1]] = True
    return found.reshape(symbol.shape, order="F")


def _limit(name: Any, given: Any) -> tuple[ca.MX, FloatArray, FloatArray]:
    """The entries of a limit, column by column, and their bounds."""
    what = f"limit '{name}'"
    if not isinstance(given, tuple) or len(given) != 3:
        raise ModelError(
            f"{what} must be (least value, expression, largest value), None for no bound, got "
            f"{brief(given)}"
        )
    value = _expression(what, given[1])
    bounds = []
    for bound, unbounded in ((given[0], -np.inf), (given[2], np.inf)):
        values = numbers(f"a bound of {what}", unbounded if bound is None else bound)
        if np.isnan(values).any():
            raise ModelError(f"a bound of {what} is nan")
        if values.ndim == 1 and value.shape[1] == 1:
            values = values[:, None]
        try:
            wide = np.broadcast_to(values, value.shape)
        except ValueError:
            raise ModelError(
                f"a bound of {what} must be a number or have the shape {value.shape} of its "
                f"expression, got shape {values.shape}"
            ) from None
        bounds.append(wide.reshape(-1, order="F"))
    low, high = bounds
    if not value.numel() or (np.isinf(low).all() and np.isinf(high).all()):
        raise ModelError(f"{what} bounds nothing")
    if (low > high).any():
        i = int(np.argmax(low > high))
        raise ModelError(
            f"{what} cannot be met: its least value {low[i]:g} is above its largest {high[i]:g}"
        )
    return ca.vec(value), low, high


def _expression(what: str, given: Any) -> ca.MX:
    """An expression of a run.

    Raises:
        ModelError: It is none, or depends on nothing.
    """
    try:
        found = ca.MX(given)
    except (NotImplementedError, RuntimeError, TypeError):
        raise ModelError(
            f'{what} must be a CasADi expression of the run, as casadi.sumsqr(run["control"]), got '
            f"{brief(given)}"
        ) from None
    if not ca.symvar(found):
        raise ModelError(f"{what} does not depend on the run: it is {brief(given)}")
    return found
