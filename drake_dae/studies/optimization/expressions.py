"""The record of a run as symbols, and cost and limits as expressions of these symbols."""

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

CONTROLLED = "controlled_output"

DERIVED = ("tracking_error", "desired_output")
"""Signals of a closed loop's record that are computed from its reference and its outputs."""


@checked(ModelError)
class RunSymbols:
    """A run of an optimization as CasADi expressions (MX), for its cost and its limits.

    `run["control"]` is a signal of the record, shape (j, k), with a row for each time.
    `run["control", "joint1_motor"]` is the column of the entry of this name, shape (j, 1).
    `run["link1.mass"]` is a variable, by its name in `free` or `more`, shape (k, 1).

    Attributes:
        time: The times of the rows, in s, shape (j, 1).

    Args:
        times: The times of the rows.
        signals: Name of a signal -> names and units of its entries.
        variables: The names of the variables.
        layout: The order of a closed loop's references; None for any other diagram.
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
        if layout is not None and {"reference", CONTROLLED} <= signals.keys():
            self._signals |= dict.fromkeys(DERIVED, signals[CONTROLLED])
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
        columns = self._signal(name)
        if entry is None:
            return columns
        names = [signal.name for signal in self._signals[name]]
        if entry not in names:
            raise ModelError(unknown_name(f"entry of {name}", entry, names))
        return columns[:, names.index(entry)]

    def _signal(self, name: str) -> ca.MX:
        if name in DERIVED:
            assert self._layout is not None
            desired = self._signal("reference")[:, self._layout.lowest.tolist()]
            return desired if name == "desired_output" else self._signal(CONTROLLED) - desired
        if name not in self.used:
            shape = self.time.numel(), len(self._signals[name])
            self.used[name] = ca.MX.sym(name, *shape)
        return self.used[name]

    def _variable(self, name: str) -> ca.MX:
        if name in self._names:
            return self.variables[self._names.index(name)]
        parameters = [own.partition("[")[0] for own in self._names]
        if name not in parameters:
            names = dict.fromkeys([*self._signals, *parameters])
            raise ModelError(unknown_name("signal or variable of the run", name, names))
        return self.variables[[i for i, own in enumerate(parameters) if own == name]]


NamedLimits = Mapping[str, tuple[ArrayLike | None, Any, ArrayLike | None]]
"""Name -> (least value, expression, largest value), with None for no bound."""


@dataclass(frozen=True, eq=False)
class Objective:
    """Cost and limits as functions of the record and of the variables.

    Attributes:
        run: The symbols of the record and the variables.
        cost: The expression of the cost.
        names: The names of the limits.
        sizes: The number of entries of each limit.
        values: The entries of all limits, stacked, shape (m, 1).
        low, high: The bounds of `values`, infinite for none, shape (m,).
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
        """Evaluates a user's functions `cost` and `limits` with the symbols.

        Raises:
            ModelError: A result is not of the required form, or does not depend on the run.
        """
        with numpy_explained("cost"):
            value = _expression("the cost", result_of("cost", cost, run))
        if value.shape != (1, 1):
            raise ModelError(
                f"the cost must be one number, got shape {value.shape}: take a sum, as "
                'casadi.sumsqr(run["control"]), or the last row, run["control"][-1, 0]'
            )
        named: Any = {}
        if limits is not None:
            with numpy_explained("limits"):
                named = result_of("limits", limits, run)
        if not isinstance(named, Mapping):
            raise ModelError(
                'limits must return a mapping, as {"torque": (-90.0, run["control"], 90.0)}, got '
                f"{brief(named)}"
            )
        columns, low, high = [ca.MX(0, 1)], [np.zeros(0)], [np.zeros(0)]
        for name, limit in named.items():
            column, lower, upper = _limit(name, limit)
            columns.append(column)
            low.append(lower)
            high.append(upper)
        names, sizes = tuple(map(str, named)), tuple(lower.size for lower in low[1:])
        bounds = np.concatenate(low), np.concatenate(high)
        return cls(run, value, names, sizes, ca.vertcat(*columns), *bounds)

    @property
    def signals(self) -> tuple[str, ...]:
        """The signals of the record that cost and limits read."""
        return tuple(self.run.used)

    @cached_property
    def evaluate(self) -> ca.Function:
        """(variables, signals...) -> [cost, limits], stacked, shape (1 + m, 1)."""
        return ca.Function("objective", self._symbols, [self._both])

    def tangents(self, count: int) -> ca.Function:
        """(variables, signals..., directions of all) -> directional derivatives of `evaluate`.

        Args:
            count: The number of directions, which are stacked side by side.
        """
        changes = [ca.MX.sym("d", s.shape[0], s.shape[1] * count) for s in self._symbols]
        pairs = zip(self._symbols, changes, strict=True)
        total = sum(
            (ca.jtimes(self._both, s, d) for s, d in pairs), ca.MX(self._both.numel(), count)
        )
        return ca.Function("tangents", [*self._symbols, *changes], [ca.densify(total)])

    def reads(self, changes: Mapping[str, FloatArray], only_cost: bool) -> list[bool]:
        """Whether cost or limits may depend on each variable.

        Args:
            changes: Name of a signal -> its derivatives by each variable, shape (n, j, k).
            only_cost: Whether limits are ignored.
        """
        value = self.cost if only_cost else self._both
        of_variables, *of_signals = (_dependence(value, symbol) for symbol in self._symbols)
        depends = of_variables[:, 0]
        for name, of_signal in zip(self.signals, of_signals, strict=True):
            depends = depends | ((changes[name] != 0.0) & of_signal).any(axis=(1, 2))
        return depends.tolist()

    @property
    def _symbols(self) -> list[ca.MX]:
        return [self.run.variables, *self.run.used.values()]

    @property
    def _both(self) -> ca.MX:
        return ca.densify(ca.vertcat(self.cost, self.values))


def _dependence(value: ca.MX, symbol: ca.MX) -> np.ndarray:
    """Whether a value depends on each entry of a symbol, in the symbol's shape."""
    depends = np.zeros(symbol.numel(), dtype=bool)
    depends[ca.jacobian_sparsity(value, symbol).get_triplet()[1]] = True
    return depends.reshape(symbol.shape, order="F")


def _limit(name: Any, limit: Any) -> tuple[ca.MX, FloatArray, FloatArray]:
    """Checks a limit, and returns its entries, column by column, and their bounds."""
    what = f"limit '{name}'"
    if not isinstance(limit, tuple) or len(limit) != 3:
        raise ModelError(
            f"{what} must be (least value, expression, largest value), None for no bound, got "
            f"{brief(limit)}"
        )
    value = _expression(what, limit[1])
    bounds = []
    for bound, unbounded in ((limit[0], -np.inf), (limit[2], np.inf)):
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


def _expression(what: str, value: Any) -> ca.MX:
    """Returns a user's value as an expression.

    Raises:
        ModelError: The value is no expression, or does not depend on the run.
    """
    try:
        expression = ca.MX(value)
    except (NotImplementedError, RuntimeError, TypeError):
        raise ModelError(
            f'{what} must be a CasADi expression of the run, as casadi.sumsqr(run["control"]), got '
            f"{brief(value)}"
        ) from None
    if not ca.symvar(expression):
        raise ModelError(f"{what} does not depend on the run: it is {brief(value)}")
    return expression
