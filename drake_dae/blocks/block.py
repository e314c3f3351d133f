"""A block: one system as expressions of symbols, without Drake."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import ClassVar

import casadi as ca
import numpy as np

from drake_dae.arrays import FloatArray
from drake_dae.dae import Signal
from drake_dae.errors import ModelError
from drake_dae.trace.compiled import Compiled
from drake_dae.trace.functions import SINGULAR_PIVOT, Failure, FailureKind, TracedFunction

TIME = ca.SX.sym("time")
"""The time in s, in every block."""

NOTHING = ca.SX(0, 1)


def stacked(values: Sequence[ca.SX]) -> ca.SX:
    """Columns as one column."""
    return ca.vertcat(NOTHING, *values)


def is_same(value: ca.SX, symbol: ca.SX) -> bool:
    """Whether a value is a column of symbols as it stands."""
    return value.shape == symbol.shape and bool(symbol.numel()) and ca.is_equal(value, symbol)


@dataclass(frozen=True, eq=False)
class Held:
    """Values that change only at t_k = offset + k period, all from the values before t_k."""

    symbol: ca.SX
    next: ca.SX
    start: FloatArray  # (k,); nan where `begin` gives it
    period: float
    offset: float = 0.0
    # Whether it comes before other updates of its instant, as Drake's unrestricted ones, among them
    # the step of a discrete MultibodyPlant: both see the same instant. Otherwise it sees their
    # changes.
    is_unrestricted: bool = True
    begin: ca.SX | None = None  # the values at the start of a run where `start` is nan


def where_finite(value: ca.SX, *checks: ca.SX) -> ca.SX:
    """A value that is nan where some numbers are not finite."""
    total = sum((ca.sum1(ca.vec(check)) for check in checks), ca.SX(0))
    return ca.densify(value) + ca.if_else(ca.fabs(total) < np.inf, 0.0, np.nan)


@dataclass(frozen=True, eq=False)
class Requirement:
    """What must hold where values of a block are valid."""

    margin: ca.SX  # not negative where it holds
    reason: str  # the matrix that must be regular, or why there are no values
    fault: FailureKind = FailureKind.SINGULAR

    OUTSIDE: ClassVar[FailureKind] = FailureKind.OUTSIDE

    @classmethod
    def regular(cls, pivot: ca.SX, matrix: str) -> "Requirement":
        """A matrix must be regular; see `Factorization.pivot`."""
        return cls(pivot - SINGULAR_PIVOT, matrix)

    def of(self, value: ca.SX) -> ca.SX:
        """A value that is nan where this does not hold."""
        return ca.densify(value) + ca.if_else(self.margin >= 0.0, 0.0, np.nan)


@dataclass(frozen=True, eq=False)
class Projection:
    """The projection of a block's state onto a manifold, after each accepted step."""

    # (state, start, parameters) -> a Newton step in units of the block's scale, with the gradients
    # at the start.
    newton: ca.Function
    # (state, parameters) -> the state on the manifold, also where plain Newton steps do not
    # converge; the state itself if it is there. Raises InconsistentStateError.
    project: Callable[[FloatArray, FloatArray], FloatArray]
    parameters: ca.SX  # of both


@dataclass(frozen=True, eq=False)
class Block:
    """A system as expressions of its symbols: pure functions, closed under composition.

    Expressions depend on TIME, `state`, `parameters`, the symbols of `held` and of `inputs`, and on
    nothing else. What an output reads is what its expression depends on, so that feedthrough needs
    no declaration. Values that are not valid are nan; `requirements` tell why.

    Attributes:
        name: The name of the system.
        inputs: Name of an input port -> its column of symbols. Noise of deviation 1 is an input.
        outputs: Name of an output port -> its column.
        state, derivative: x and x', columns; empty without continuous state.
        held: Name -> values that change at samples, in the order of Drake's groups.
        parameters: The column of all numeric parameters.
        start: "state" and "parameters" -> the default, shapes (n,) and (k,); 0 if left out.
        defaults: Name of an input that needs no wire -> its value without one, an expression of
            other symbols.
        projection: The projection of the state onto a manifold; None without one.
        scale: The sizes of the states for error norms, shape (n,); ones if None.
        requirements: What must hold for some values; they are nan elsewhere, by `Requirement.of`.
        signals: Name of a port, or "state" -> names and units of its entries, as far as known.
    """

    name: str
    inputs: Mapping[str, ca.SX] = field(default_factory=dict)
    outputs: Mapping[str, ca.SX] = field(default_factory=dict)
    state: ca.SX = NOTHING
    derivative: ca.SX = NOTHING
    held: Mapping[str, Held] = field(default_factory=dict)
    parameters: ca.SX = NOTHING
    start: Mapping[str, FloatArray] = field(default_factory=dict)
    defaults: Mapping[str, ca.SX] = field(default_factory=dict)
    projection: Projection | None = None
    scale: FloatArray | None = None
    requirements: tuple[Requirement, ...] = ()
    signals: Mapping[str, Sequence[Signal]] = field(default_factory=dict)

    def check(self) -> None:
        """Refuses sizes that do not fit, and expressions of other symbols.

        Raises:
            ModelError: With the value and what would be right.
        """
        sizes = {"derivative": (self.derivative.numel(), self.state.numel())}
        for name, each in self.held.items():
            size = each.symbol.numel()
            sizes[f"next of '{name}'"] = each.next.numel(), size
            sizes[f"start of '{name}'"] = np.size(each.start), size
        for name, (found, wanted) in sizes.items():
            if found != wanted:
                raise ModelError(
                    f"block '{self.name}': {name} must have {wanted} entries, got {found}"
                )
        known = {symbol.element_hash() for symbol in ca.symvar(stacked([*self.columns().values()]))}
        values = {"derivative": self.derivative, **self.outputs}
        values |= {f"next of '{name}'": each.next for name, each in self.held.items()}
        for name, value in values.items():
            free = [s.name() for s in ca.symvar(value) if s.element_hash() not in known]
            if free:
                raise ModelError(
                    f"block '{self.name}': {name} depends on {', '.join(free)}, which is none of "
                    "its inputs, states, held values or parameters"
                )

    def columns(self) -> dict[str, ca.SX]:
        """Source -> its symbols: "time", "state", "parameters", "held <name>", "input <name>"."""
        held = {f"held {name}": each.symbol for name, each in self.held.items()}
        inputs = {f"input {name}": symbol for name, symbol in self.inputs.items()}
        named = {"time": TIME, "state": self.state, **held, **inputs, "parameters": self.parameters}
        return {name: column for name, column in named.items() if column.numel()}

    def sources(self, *values: ca.SX) -> list[str]:
        """The names of the columns on which some values depend, in the order of `columns`."""
        used = {s.element_hash() for s in ca.symvar(stacked([ca.vec(each) for each in values]))}
        return [name for name, own in self._symbols.items() if not used.isdisjoint(own)]

    @cached_property
    def _symbols(self) -> dict[str, frozenset[int]]:
        """Name of a column -> the hashes of its symbols."""
        columns = {name: ca.symvar(column) for name, column in self.columns().items()}
        return {name: frozenset(s.element_hash() for s in own) for name, own in columns.items()}

    def rates(self) -> dict[tuple[float, float, bool], list[str]]:
        """(period, offset, is_unrestricted) -> the held values that are updated together."""
        rates: dict[tuple[float, float, bool], list[str]] = {}
        for name, each in self.held.items():
            rates.setdefault((each.period, each.offset, each.is_unrestricted), []).append(name)
        return rates

    def mapped(self, change: Callable[[list[ca.SX]], Sequence[ca.SX]]) -> "Block":
        """The block with all its expressions changed together, such as by other symbols."""
        held, projection, required = self.held, self.projection, self.requirements
        begins = {name: each.begin for name, each in held.items() if each.begin is not None}
        after = (each.next for each in held.values())
        margins = (each.margin for each in required)
        named = *self.outputs.values(), *self.defaults.values()
        projected = [] if projection is None else [projection.parameters]
        changed = iter(
            change([self.derivative, *named, *after, *begins.values(), *margins, *projected])
        )
        derivative = next(changed)
        outputs, defaults, nexts, begins = (
            {name: next(changed) for name in names}
            for names in (self.outputs, self.defaults, held, begins)
        )
        return replace(
            self,
            outputs=outputs,
            defaults=defaults,
            derivative=derivative,
            held={
                name: replace(each, next=nexts[name], begin=begins.get(name))
                for name, each in held.items()
            },
            requirements=tuple(replace(each, margin=next(changed)) for each in required),
            projection=projection and replace(projection, parameters=next(changed)),
        )

    def default(self, name: str) -> FloatArray:
        """The state or the parameters at the start."""
        column = self.state if name == "state" else self.parameters
        return np.array(np.broadcast_to(self.start.get(name, np.zeros(1)), column.numel()), float)


class BlockFunction(TracedFunction):
    """Some values of a block as a function of the columns, `sources`, that they depend on."""

    def __init__(
        self, block: Block, what: str, values: Mapping[str, ca.SX], compiled: Compiled = False
    ) -> None:
        columns, self.sources = block.columns(), tuple(block.sources(*values.values()))
        inputs = {name.removeprefix("input "): columns[name] for name in self.sources}
        super().__init__(f"{block.name} {what}".strip(), inputs, values, compiled=compiled)
        self._requirements = block.requirements

    def failure(self) -> Failure:
        """The failure of the last evaluation: the first requirement that did not hold."""
        failure = super().failure()
        given = np.concatenate([np.zeros(0), *self._arrays.arguments])
        for required in self._requirements if failure.fault is FailureKind.VALUE else ():
            symbols, options = [stacked(self._symbols)], {"allow_free": True}
            margin = ca.Function("margin", symbols, [required.margin], options)
            if not (margin.has_free() or float(margin(given)) >= 0.0):
                return Failure(self.name, required.fault, {}, required.reason)
        return failure
