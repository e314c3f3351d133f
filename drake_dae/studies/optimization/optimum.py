"""The result of an optimization, as values and as text."""

import signal
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from pydrake.systems.framework import Context

from drake_dae.analysis.tables import count_of
from drake_dae.arguments import checked
from drake_dae.arrays import FloatArray, listed, unknown_name
from drake_dae.errors import ModelError
from drake_dae.running.rollout.rollout import Rollout
from drake_dae.studies.optimization.variables import Variable

ACTIVE = 1e-4
"""A limit that is closer to its bound than this, relative to the bound, is active."""


@checked(ModelError)
@dataclass(frozen=True)
class LimitState:
    """How a limit stands in a run.

    Attributes:
        name: Its name.
        violation: By how much its worst entry is beyond its bound, in its unit; 0 if none is.
        active: How many entries are at a bound.
        entries: How many there are.
    """

    name: str
    violation: float
    active: int
    entries: int


@checked(ModelError)
@dataclass(frozen=True, eq=False)
class Optimum:
    """The best numbers of a loop that were found.

    Attributes:
        context: The context with these numbers, at the start.
        run: The run with them.
        variables: What was free, with the values before.
        values: The values that were found, shape (n,).
        more: Name -> value of the variables of cost and limits alone.
        cost_before, cost: The cost before and after.
        limits: How each limit stands after.
        iterations: How many iterations IPOPT made.
        runs: How many runs were made.
        converged: Whether IPOPT converged: the values are a local optimum that meets all limits.
        status: What IPOPT says, such as "Solve_Succeeded".
        without_effect: The variables that neither cost nor limits depend on.
        interrupted: The signal that ended the search early; None if there was none.
    """

    context: Context = field(repr=False)
    run: Rollout = field(repr=False)
    variables: tuple[Variable, ...]
    values: FloatArray
    more: Mapping[str, float]
    cost_before: float
    cost: float
    limits: tuple[LimitState, ...]
    iterations: int
    runs: int
    converged: bool
    status: str
    without_effect: tuple[str, ...] = ()
    interrupted: signal.Signals | None = None

    def __getitem__(self, name: str) -> float:
        """The value of a variable.

        Raises:
            ModelError: There is none of this name.
        """
        found = {v.name: float(x) for v, x in zip(self.variables, self.values, strict=True)}
        found |= self.more
        if name not in found:
            raise ModelError(unknown_name("variable", name, found))
        return found[name]

    @property
    def violated(self) -> tuple[str, ...]:
        """The names of the limits that are not met."""
        return tuple(limit.name for limit in self.limits if limit.violation > 0.0)

    @property
    def active(self) -> tuple[str, ...]:
        """The names of the limits that are active, and then of the variables at a bound."""
        found = [limit.name for limit in self.limits if limit.active]
        for one, value in zip(self.variables, self.values.tolist(), strict=True):
            if min(value - one.low, one.high - value) <= ACTIVE * one.size:
                found.append(one.name)
        return tuple(found)

    def text(self) -> str:
        """The result as lines of text."""
        rows: list[Sequence[str]] = [("variable", "before", "after", "from", "to", "unit")]
        for one, value in zip(self.variables, self.values, strict=True):
            numbers = (f"{x:.6g}" for x in (one.start, value, one.low, one.high))
            rows.append((one.name, *numbers, one.unit))
        widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
        lines = [
            "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip()
            for row in rows
        ]
        return "\n".join([*lines, "", *self.remarks()])

    def remarks(self) -> list[str]:
        """What is to be known about the values."""
        made = f"{count_of(self.iterations, 'iteration')}, {count_of(self.runs, 'run')}"
        found = [f"Cost: {self.cost_before:.6g} before, {self.cost:.6g} after ({made})."]
        if self.interrupted is not None:
            found.append("The search was interrupted; this is the best so far.")
        elif not self.converged:
            found.append(f"IPOPT did not converge ({self.status}); this is the best so far.")
        for limit in self.limits:
            if limit.violation > 0.0:
                found.append(f"Limit {limit.name} is not met: beyond it by {limit.violation:.3g}.")
        if self.violated and self.status == "Infeasible_Problem_Detected":
            found.append(
                "No numbers near these meet all limits: give wider limits or bounds, or more free "
                "variables."
            )
        if self.active:
            found.append(f"Active: {listed(self.active, 20)[1:-1]}.")
        if self.without_effect:
            names = listed(self.without_effect, 20)[1:-1]
            found.append(f"Without effect on cost and limits, left as before: {names}.")
        return found

    def to_dict(self) -> dict[str, Any]:
        """The result as plain values."""
        pairs = zip(self.variables, self.values.tolist(), strict=True)
        return {
            "variables": {
                one.name: {"before": one.start, "after": value, "unit": one.unit}
                for one, value in pairs
            },
            "more": dict(self.more),
            "cost": {"before": self.cost_before, "after": self.cost},
            "limits": {limit.name: vars(limit) for limit in self.limits},
            "active": list(self.active),
            "iterations": self.iterations,
            "runs": self.runs,
            "converged": self.converged,
            "status": self.status,
            "without_effect": list(self.without_effect),
            "interrupted": self.interrupted is not None,
        }


def limit_states(
    names: Sequence[str],
    sizes: Sequence[int],
    values: FloatArray,
    low: FloatArray,
    high: FloatArray,
) -> tuple[LimitState, ...]:
    """How limits stand.

    Args:
        names, sizes: As of `Objective`.
        values, low, high: Their entries and bounds, shape (m,).
    """
    found, first = [], 0
    scale = limit_sizes(low, high)
    beyond = np.maximum(low - values, values - high)
    for name, size in zip(names, sizes, strict=True):
        own = slice(first, first + size)
        first += size
        relative = beyond[own] / scale[own]
        worst = int(np.argmax(relative))
        violation = float(beyond[own][worst]) if relative[worst] > MET else 0.0
        active = int(np.count_nonzero(relative > -ACTIVE))
        found.append(LimitState(name, violation, active, size))
    return tuple(found)


MET = 1e-6
"""A limit that is beyond its bound by less than this, relative to the bound, is met."""


def limit_sizes(low: FloatArray, high: FloatArray) -> FloatArray:
    """How large the entries of limits are: their larger bound, or 1 where it is 0."""
    bounds = [np.where(np.isfinite(each), np.abs(each), 0.0) for each in (low, high)]
    found = np.maximum(*bounds)
    return np.where(found > 0.0, found, 1.0)
