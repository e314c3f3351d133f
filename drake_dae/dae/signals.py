"""Names, units and numbers of the scalars that a system is made of, and how they are stacked."""

from collections.abc import Collection, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from drake_dae.arguments import checked
from drake_dae.arrays import FloatArray, brief, can_be_written, numbers, unknown_name
from drake_dae.errors import ModelError

Indices = np.typing.NDArray[np.intp]

# The number of symbols for derivatives of an exogenous parameter; long chains need 8.
DERIVATIVES = 10
# The largest value of a parameter; positive ones are at least its inverse. Equations multiply up
# to five parameters before they divide.
LARGEST = 1e60


@checked(ModelError)
@dataclass(frozen=True)
class Signal:
    """One scalar component of a vector signal: its name and its unit.

    Attributes:
        name: Its name, unique in its vector.
        unit: Its SI unit as text, "" for a pure number.
    """

    name: str
    unit: str = ""

    def __post_init__(self) -> None:
        if not can_be_written(self.name):
            raise ModelError(
                "the name of a signal has half of a letter (\\ud800 to \\udfff), which no file can "
                f"hold: {self.name!a}"
            )

    def derivative(self, order: int) -> "Signal":
        """Returns the signal of a time derivative: x -> x', x'', ..., with the matching unit."""
        if order == 0:
            return self
        per_time = "/s" if order == 1 else f"/s^{order}"
        return Signal(self.name + "'" * order, (self.unit or "1") + per_time)


def signals(names: Sequence[str], unit: str = "") -> tuple[Signal, ...]:
    """Returns signals of the given names that share a unit."""
    return tuple(Signal(name, unit) for name in names)


def places_of(
    what: str, names: Collection[str], signals: Sequence[Signal], owner: str = ""
) -> list[int]:
    """Returns the indices of signals by their names."""
    known = [signal.name for signal in signals]
    for name in names:
        if name not in known:
            raise ModelError(f"{owner}{unknown_name(what, name, known)}")
    return [known.index(name) for name in names]


@checked(ModelError)
@dataclass(frozen=True, eq=False)
class Parameter:
    """A number, or a vector of numbers, whose value can change without tracing the equations again.

    An exogenous one is a signal w(t) with known derivatives: the position of a moving surface, a
    known load, time.

    Attributes:
        name: Its name, unique in its system, for example "link1.mass".
        value: The default, shape (k,); a float is taken as shape (1,).
        unit: Its SI unit as text, "" for a pure number.
        positive: Whether only positive numbers make sense, as for a mass.
        symbol: The CasADi symbol that stands for it, shape (k, 1). Made where not given.
        exogenous: Whether it moves.
        nonnegative: Whether negative numbers make no sense, as for a coefficient of friction.
        bounds: The range (low, high) of its values, each a number or of shape (k,), in which
            relative degrees must be the same. If None, half and twice the default, or -1 and 1
            where it is 0. Equal bounds fix the value.
        derivatives: The symbols of w', w'', ..., each of shape (k, 1), if it moves.

    Raises:
        ModelError: The value is not finite or out of its bounds, or the symbol does not fit it.
    """

    name: str
    value: FloatArray
    unit: str = ""
    positive: bool = False
    symbol: ca.SX = field(default=None)
    exogenous: bool = False
    nonnegative: bool = False
    bounds: tuple[ArrayLike, ArrayLike] | None = None
    derivatives: tuple[ca.SX, ...] = field(default=(), repr=False)

    def __post_init__(self) -> None:
        value = np.atleast_1d(numbers(f"parameter '{self.name}'", self.value))
        if value.ndim != 1:
            raise ModelError(f"parameter '{self.name}' must be one-dimensional, got {self.value!r}")
        value.setflags(write=False)
        object.__setattr__(self, "value", value)
        if self.bounds is not None and not np.all(self.low <= self.high):
            raise ModelError(
                f"parameter '{self.name}': bounds must be a lowest and a highest value, got "
                f"{self.bounds!r}"
            )
        self.check(value)
        if self.symbol is None:
            object.__setattr__(self, "symbol", ca.SX.sym(self.name, value.size))
        elif not is_symbol(self.symbol) or self.symbol.shape != (value.size, 1):
            raise ModelError(
                f"the symbol of parameter '{self.name}' must be a CasADi SX column of "
                f"{value.size} symbols, as its value has; got {self.symbol}"
            )
        if self.exogenous and not self.derivatives:
            names = [self.name + "'" * order for order in range(1, DERIVATIVES + 1)]
            rates = tuple(ca.SX.sym(name, value.size) for name in names)
            object.__setattr__(self, "derivatives", rates)

    @property
    def low(self) -> FloatArray:
        """The lowest values for which relative degrees are checked, shape (k,)."""
        least = 0.0 if self.positive or self.nonnegative else -1.0
        usual = np.where(self.value == 0.0, least, np.minimum(0.5 * self.value, 2.0 * self.value))
        return usual if self.bounds is None else self.entries(self.bounds[0])

    @property
    def high(self) -> FloatArray:
        """The highest values for which relative degrees are checked, shape (k,)."""
        usual = np.where(self.value == 0.0, 1.0, np.maximum(0.5 * self.value, 2.0 * self.value))
        return usual if self.bounds is None else self.entries(self.bounds[1])

    @property
    def signals(self) -> tuple[Signal, ...]:
        """Names and units of its entries."""
        if self.value.size == 1:
            return (Signal(self.name, self.unit),)
        return signals([f"{self.name}[{i}]" for i in range(self.value.size)], self.unit)

    @property
    def rate(self) -> ca.SX:
        """The symbols of w', shape (k, 1); structural zeros if it is constant."""
        return self.derivatives[0] if self.derivatives else ca.SX(self.value.size, 1)

    def entries(self, value: ArrayLike) -> FloatArray:
        """Returns a value of it, shape (k,); one number stands for all entries."""
        entries = np.atleast_1d(numbers(f"parameter '{self.name}'", value))
        if entries.shape not in ((1,), self.value.shape):
            raise ModelError(
                f"parameter '{self.name}' has {self.value.size} entries, got {value!r}"
            )
        return np.broadcast_to(entries, self.value.shape).copy()

    def check(self, value: FloatArray) -> None:
        """Raises ModelError if a value is not finite, has the wrong sign, or is out of bounds."""
        size, wrong = np.abs(value), ""
        if not np.all(np.isfinite(value)):
            wrong = "be finite"
        elif self.positive and not np.all(value > 0.0):
            wrong = "be positive"
        elif self.nonnegative and not np.all(value >= 0.0):
            wrong = "not be negative"
        elif np.any(size > LARGEST) or (self.positive and np.any(size < 1.0 / LARGEST)):
            wrong = f"be from {1.0 / LARGEST:g} to {LARGEST:g}, so that a double holds its products"
        elif self.bounds is not None and not np.all((self.low <= value) & (value <= self.high)):
            wrong = "stay in its bounds, from {} to {}".format(*map(brief, self.bounds))
        if wrong:
            raise ModelError(f"parameter '{self.name}' must {wrong}, got {value}")


def is_symbol(value: Any) -> bool:
    """Whether it is a CasADi SX matrix of symbols."""
    return isinstance(value, ca.SX) and value.is_valid_input()


def parameter_symbol(parameters: Sequence[Parameter]) -> ca.SX:
    """Returns the symbols of all parameters in one column, then w', w'', ... of exogenous ones."""
    rates = [rate for p in parameters if p.exogenous for rate in p.derivatives]
    return ca.vertcat(ca.SX(0, 1), *[p.symbol for p in parameters], *rates)


@dataclass(frozen=True, eq=False)
class Exogenous:
    """The exogenous parameters w of a system, with symbols for their time derivatives."""

    owner: str
    parameters: tuple[Parameter, ...]

    @property
    def moving(self) -> tuple[Parameter, ...]:
        return tuple(p for p in self.parameters if p.exogenous)

    def __bool__(self) -> bool:
        return bool(self.moving)

    @property
    def signals(self) -> tuple[Signal, ...]:
        """Names and units of the entries of w."""
        return tuple(signal for p in self.moving for signal in p.signals)

    def rate(self, expression: ca.SX) -> ca.SX:
        """Returns the part sum_j (d/dw^(j)) w^(j+1) of a time derivative, shape (k, 1)."""
        rate = ca.SX(expression.numel(), 1)
        for p in self.moving:
            levels = (p.symbol, *p.derivatives)
            if ca.depends_on(expression, levels[-1]):
                raise ModelError(
                    f"{self.owner}: more than {len(p.derivatives)} derivatives of '{p.name}' are "
                    "needed"
                )
            rate += ca.jtimes(expression, ca.vertcat(*levels[:-1]), ca.vertcat(*levels[1:]))
        return rate

    def degrees(self, *expressions: ca.SX) -> tuple[int, ...]:
        """Returns the number of derivatives of each entry of w on which expressions depend."""
        every = ca.veccat(*expressions)
        return tuple(
            max([0, *(k for k, d in enumerate(p.derivatives, 1) if ca.depends_on(every, d[i]))])
            for p in self.moving
            for i in range(p.value.size)
        )

    @cached_property
    def slices(self) -> dict[str, slice]:
        """Name of a parameter -> its place in the parameter vector."""
        ends = np.cumsum([0, *(p.value.size for p in self.parameters)]).tolist()
        return {p.name: slice(*ends[i : i + 2]) for i, p in enumerate(self.parameters)}

    @cached_property
    def rates(self) -> dict[str, slice]:
        """Name of an exogenous parameter -> the place of w', w'', ... in the parameter vector."""
        first, rates = sum(p.value.size for p in self.parameters), dict[str, slice]()
        for p in self.moving:
            rates[p.name] = slice(first, first + p.value.size * len(p.derivatives))
            first = rates[p.name].stop
        return rates

    def places(self, degrees: Sequence[int]) -> list[int]:
        """Returns the indices of w_1, w_1', ..., w_1^(d_1), w_2, ... among the parameters."""
        places, degree = list[int](), iter(degrees)
        for p in self.moving:
            start, rates, size = self.slices[p.name].start, self.rates[p.name], p.value.size
            for i in range(size):
                places += [start + i, *range(rates.start + i, rates.stop, size)[: next(degree)]]
        return places


class DerivativeLayout:
    """The indices of p signals and their derivatives in the stacked vectors of section 2.

    A chain holds mu_i derivatives of each signal, and a reference one more, or `more` of them:

        chain     = (z_1, z_1', ..., z_1^(mu_1 - 1), z_2, ...)    sum mu_i numbers
        reference = (r_1, r_1', ..., r_1^(mu_1),     r_2, ...)    sum (mu_i + 1) numbers

    The constraint chains of (4) are stacked likewise, with r_i in place of mu_i.
    """

    def __init__(self, degrees: Sequence[int], more: Sequence[int] = ()) -> None:
        self.degrees = tuple(degrees)
        self.chain_size = sum(self.degrees)
        count, orders = len(self.degrees), np.array(self.degrees, dtype=np.intp)
        further = np.array(more or [0] * count, dtype=np.intp)
        #: The number of derivatives of each r_i in a reference, mu_i without further ones.
        self.reference_degrees: tuple[int, ...] = tuple((orders + further).tolist())
        self.reference_size = sum(self.reference_degrees) + count
        #: The signals with mu_i >= 1, and those with mu_i = 0, which have no chain.
        self.dynamic, self.direct = np.flatnonzero(orders > 0), np.flatnonzero(orders == 0)
        #: Of each chain entry its signal, and the order of its derivative, shape (sum mu_i,).
        self.owners = np.repeat(np.arange(count), orders)
        #: The first chain entry of each signal, shape (p,); its highest one where mu_i >= 1.
        self.starts: Indices = np.cumsum(orders) - orders
        self.orders: Indices = np.arange(self.chain_size) - self.starts[self.owners]
        self.heads = np.flatnonzero(self.orders == 0)
        self.ends: Indices = self.heads + orders[self.dynamic] - 1
        #: r_1, ..., r_p and r_1^(mu_1), ..., r_p^(mu_p) in a reference vector, shape (p,).
        self.lowest: Indices = np.cumsum(orders + further + 1) - (orders + further + 1)
        self.highest: Indices = self.lowest + orders
        #: The target of each chain entry in a reference vector, shape (sum mu_i,).
        self.chained: Indices = self.lowest[self.owners] + self.orders

    def chain_signals(self, signals: Sequence[Signal]) -> tuple[Signal, ...]:
        """Returns names and units of the entries of a chain."""
        pairs = zip(self.owners, self.orders, strict=True)
        return tuple(signals[int(i)].derivative(int(order)) for i, order in pairs)

    def reference_signals(self, signals: Sequence[Signal]) -> tuple[Signal, ...]:
        """Returns names and units of the entries of a reference vector."""
        pairs = zip(signals, self.reference_degrees, strict=True)
        return tuple(signal.derivative(order) for signal, d in pairs for order in range(d + 1))

    def values(self, reference: ArrayLike) -> FloatArray:
        """Returns the values r_1, ..., r_p of a reference vector, shape (p,)."""
        return np.asarray(reference, dtype=float).reshape(-1)[self.lowest]

    def constant(self, values: ArrayLike) -> FloatArray:
        """Returns the reference vector of constant values of shape (p,); its derivatives are 0."""
        reference = np.zeros(self.reference_size)
        reference[self.lowest] = values
        return reference
