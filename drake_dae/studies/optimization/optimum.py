"""The result of an optimization, as values and as text."""

import signal
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from pydrake.systems.framework import Context

from drake_dae.analysis.tables import Table, count_of
from drake_dae.arguments import checked
from drake_dae.arrays import FloatArray, listed, unknown_name
from drake_dae.errors import ModelError
from drake_dae.running.rollout.rollout import Rollout
from drake_dae.studies.optimization.expressions import Objective
from drake_dae.studies.optimization.variables import Variable

ACTIVE = 1e-4
"""A limit is active if it is closer to its bound than this, relative to the bound."""

MET = 1e-6
"""A limit is met if it is beyond its bound by at most this, relative to the bound."""


@checked(ModelError)
@dataclass(frozen=True)
class LimitState:
    """The state of a limit in a run: met, active or violated.

    Attributes:
        name: The name of the limit.
        violation: The largest distance of an entry beyond its bound, in the unit of the limit; 0 if
            all entries are within their bounds.
        active: The number of entries at a bound.
        entries: The number of all entries.
    """

    name: str
    violation: float
    active: int
    entries: int


@checked(ModelError)
@dataclass(frozen=True, eq=False)
class Optimum:
    """The result of an optimization.

    Attributes:
        context: A context of the loop with the best values, at the start time.
        run: The run with the best values.
        variables: The free variables, with their initial guess.
        values: The best values, shape (n,).
        more: Name -> best value of the further variables of cost and limits.
        cost_before, cost: The cost with the initial guess and with the best values.
        limits: The state of each limit with the best values.
        iterations: The number of IPOPT's iterations.
        runs: The number of runs.
        converged: Whether IPOPT converged: the values are a local optimum that meets all limits.
        status: IPOPT's return status, such as "Solve_Succeeded".
        without_effect: The variables without effect on cost and limits.
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
            ModelError: There is no variable of this name.
        """
        values = {v.name: float(x) for v, x in zip(self.variables, self.values, strict=True)}
        values |= self.more
        if name not in values:
            raise ModelError(unknown_name("variable", name, values))
        return values[name]

    @property
    def violated(self) -> tuple[str, ...]:
        """The names of the limits that are not met."""
        return tuple(limit.name for limit in self.limits if limit.violation > 0.0)

    @property
    def active(self) -> tuple[str, ...]:
        """The names of the active limits, followed by those of the variables at a bound."""
        pairs = zip(self.variables, self.values.tolist(), strict=True)
        at_bound = [
            variable.name
            for variable, value in pairs
            if min(value - variable.low, variable.high - value) <= ACTIVE * variable.size
        ]
        return (*(limit.name for limit in self.limits if limit.active), *at_bound)

    def text(self) -> str:
        """The result as lines of text."""
        head = ("variable", "before", "after", "from", "to", "unit")
        rows = []
        for variable, value in zip(self.variables, self.values, strict=True):
            numbers = (variable.start, value, variable.low, variable.high)
            rows.append((variable.name, *(f"{number:.6g}" for number in numbers), variable.unit))
        return "\n".join([*Table(head, rows, left=len(head)).lines(), "", *self.remarks()])

    def remarks(self) -> list[str]:
        """Sentences on cost, convergence, limits and variables without effect."""
        made = f"{count_of(self.iterations, 'iteration')}, {count_of(self.runs, 'run')}"
        remarks = [f"Cost: {self.cost_before:.6g} before, {self.cost:.6g} after ({made})."]
        if self.interrupted is not None:
            remarks.append("The search was interrupted; this is the best so far.")
        elif not self.converged:
            remarks.append(f"IPOPT did not converge ({self.status}); this is the best so far.")
        for limit in self.limits:
            if limit.violation > 0.0:
                remarks.append(
                    f"Limit {limit.name} is not met: beyond it by {limit.violation:.3g}."
                )
        if self.violated and self.status == "Infeasible_Problem_Detected":
            remarks.append(
                "No numbers near these meet all limits: give wider limits or bounds, or more free "
                "variables."
            )
        if self.active:
            remarks.append(f"Active: {listed(self.active, 20)[1:-1]}.")
        if self.without_effect:
            names = listed(self.without_effect, 20)[1:-1]
            remarks.append(f"Without effect on cost and limits, left as before: {names}.")
        return remarks

    def to_dict(self) -> dict[str, Any]:
        """The result as plain values."""
        pairs = zip(self.variables, self.values.tolist(), strict=True)
        return {
            "variables": {
                variable.name: {"before": variable.start, "after": value, "unit": variable.unit}
                for variable, value in pairs
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


def limit_states(objective: Objective, values: FloatArray) -> tuple[LimitState, ...]:
    """The states of all limits.

    Args:
        objective: The limits with their bounds.
        values: The entries of all limits, shape (m,).
    """
    low, high = objective.low, objective.high
    beyond = np.maximum(low - values, values - high)
    relative = beyond / limit_sizes(low, high)
    states, first = [], 0
    for name, size in zip(objective.names, objective.sizes, strict=True):
        worst = first + int(np.argmax(relative[first : first + size]))
        violation = float(beyond[worst]) if relative[worst] > MET else 0.0
        active = int(np.count_nonzero(relative[first : first + size] > -ACTIVE))
        states.append(LimitState(name, violation, active, size))
        first += size
    return tuple(states)


def limit_sizes(low: FloatArray, high: FloatArray) -> FloatArray:
    """The sizes of the entries of limits: the larger absolute bound, or 1 if that is 0."""
    bounds = [np.where(np.isfinite(bound), np.abs(bound), 0.0) for bound in (low, high)]
    sizes = np.maximum(*bounds)
    return np.where(sizes > 0.0, sizes, 1.0)
