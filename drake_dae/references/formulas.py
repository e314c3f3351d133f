"""References that are expressions of time: constants, sinusoids, moves, and any other."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import comb
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from drake_dae.arguments import checked
from drake_dae.errors import ReferenceSignalError
from drake_dae.references.reference import (
    FormulaReference,
    Reference,
    check_continuity,
    check_order,
    common_period,
)
from drake_dae.trace.expressions import result_of


@checked(ReferenceSignalError)
@dataclass(frozen=True)
class ConstantReference(FormulaReference):
    """A reference with constant values.

    Attributes:
        values: The values in the outputs' units, shape (k,), or one number.

    Raises:
        ReferenceSignalError: The values are not finite numbers, or there are none.
    """

    values: ArrayLike

    def __post_init__(self) -> None:
        as_columns(self, "values")

    @property
    def size(self) -> int:
        return np.size(self.values)

    @property
    def repeats(self) -> float:
        return 0.0

    def rows(self, time: ca.SX) -> ca.SX:
        return ca.SX(ca.DM(self.values))


@checked(ReferenceSignalError)
@dataclass(frozen=True)
class SinusoidReference(FormulaReference):
    """The sum r(t) = offset + sum_i amplitude_i sin(frequency_i t + phase_i), for one output.

    Attributes:
        offset: The mean, in the output's unit.
        amplitudes: The amplitudes in the output's unit, shape (k,), or one number for all.
        frequencies: The frequencies in rad/s, likewise.
        phases: The phases at t = 0 in rad, likewise.

    Raises:
        ReferenceSignalError: A number is not finite, or shapes do not fit.
    """

    offset: float
    amplitudes: ArrayLike
    frequencies: ArrayLike
    phases: ArrayLike = 0.0

    size = 1

    def __post_init__(self) -> None:
        as_columns(self, "amplitudes", "frequencies", "phases")

    @property
    def repeats(self) -> float | None:
        return common_period([abs(2.0 * np.pi / w) for w in np.ravel(self.frequencies) if w])

    def rows(self, time: ca.SX) -> ca.SX:
        terms = np.transpose([self.amplitudes, self.frequencies, self.phases])
        return ca.SX(self.offset + sum(a * ca.sin(w * time + p) for a, w, p in terms))


@checked(ReferenceSignalError)
@dataclass(frozen=True)
class PointToPointReference(FormulaReference):
    """A smooth move from rest at `start` to rest at `end`; constant before and after.

    It is the polynomial of degree 2 order + 1 whose derivatives 1, ..., order vanish at both ends:
    order 2 is the quintic.

    Attributes:
        start: The values before, in the outputs' units, shape (k,), or one number for all.
        end: The values after, in the outputs' units, likewise.
        start_time: The start of the move, in s.
        end_time: The end of the move, in s.
        order: The number of continuous derivatives, from 0 to 30; at least mu of the outputs.

    Raises:
        ReferenceSignalError: A number is not finite, or shapes or times do not fit.
    """

    start: ArrayLike
    end: ArrayLike
    start_time: float
    end_time: float
    order: int = 2

    def __post_init__(self) -> None:
        as_columns(self, "start", "end")
        check_order(self.order, 0, 30)
        if not self.end_time > self.start_time:
            raise ReferenceSignalError(
                f"end_time {self.end_time} must be after start_time {self.start_time}"
            )

    @property
    def size(self) -> int:
        return np.size(self.start)

    def rows(self, time: ca.SX) -> ca.SX:
        s = (time - self.start_time) / (self.end_time - self.start_time)
        # Positive terms alone, so that nothing cancels.
        fraction = s ** (self.order + 1) * sum(
            comb(self.order + k, k) * (1 - s) ** k for k in range(self.order + 1)
        )
        blend = ca.if_else(s <= 0, 0, ca.if_else(s >= 1, 1, fraction))
        first, last = np.asarray(self.start), np.asarray(self.end)
        return ca.vertcat(*[a + (b - a) * blend for a, b in zip(first, last, strict=True)])

    def check_smoothness(self, degrees: Sequence[int]) -> None:
        check_continuity(self, self.order, degrees)


@checked(ReferenceSignalError)
@dataclass(frozen=True, eq=False)
class ExpressionReference(FormulaReference):
    """A reference that is any CasADi expression of time.

    Attributes:
        function: Takes the time in s, a CasADi scalar; returns an expression, or a list of these.

    Raises:
        ReferenceSignalError: The function returns no such expression; or, when `derivatives` is
            called with mu_i >= 1, the expression has a constant that is not finite, or an operation
            on time that is not smooth, such as fabs.
    """

    function: Callable[..., Any]

    def __post_init__(self) -> None:
        time = ca.SX.sym("t")
        rows = self.rows(time)
        unknown = [s.name() for s in ca.symvar(rows) if s.element_hash() != time.element_hash()]
        if unknown or rows.shape[1] != 1:
            raise ReferenceSignalError(
                "a reference must be a column of expressions of only the time, got shape "
                f"{rows.shape} with {', '.join(unknown) or 'no'} other symbols"
            )

    @property
    def size(self) -> int:
        return int(self.rows(ca.SX.sym("t")).numel())

    def rows(self, time: ca.SX) -> ca.SX:
        value = result_of("function", self.function, time, error=ReferenceSignalError)
        try:
            return ca.SX(ca.vertcat(*(value if isinstance(value, (list, tuple)) else [value])))
        except (NotImplementedError, RuntimeError) as error:
            raise ReferenceSignalError(
                f"a reference must be an expression of the time or a list of these, got {value!r}"
            ) from error


def as_columns(reference: Reference, *names: str) -> None:
    """Converts fields to tuples of the same length; a single number is repeated."""
    arrays = {name: np.asarray(getattr(reference, name), dtype=float) for name in names}
    for name, array in arrays.items():
        if array.ndim > 1 or not array.size:
            raise ReferenceSignalError(
                f"{name} must be one number or more, shape (k,), got {getattr(reference, name)!r}"
            )
    lengths = {name: array.size for name, array in arrays.items() if array.ndim}
    if len(set(lengths.values())) > 1:
        counts = ", ".join(f"{name} has {length}" for name, length in lengths.items())
        raise ReferenceSignalError(
            f"{', '.join(names)} need as many entries, or one number for all: {counts}"
        )
    length = next(iter(lengths.values()), 1)
    for name, array in arrays.items():
        object.__setattr__(reference, name, tuple(np.broadcast_to(array, length).tolist()))
