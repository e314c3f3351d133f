"""References with all the derivatives that a tracking law asks for."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from math import comb
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from drake_dae.arguments import checked, result_of
from drake_dae.arrays import FloatArray
from drake_dae.errors import NonFiniteError, ReferenceSignalError
from drake_dae.trace.functions import TracedFunction
from drake_dae.trace.smoothness import find_flaw


@checked(ReferenceSignalError)
class Reference(ABC):
    """Desired values r(t) of one or several outputs, with their time derivatives.

    1. `size`, at least 1, is the number of outputs that it covers. It never changes.
    2. `derivatives` takes one degree mu_i >= 0 per output, and returns a function of the time in s
       with the values r_1, r_1', ..., r_1^(mu_1), r_2, ...: output-major, shape
       (sum (mu_i + 1),).
    3. Each value is the exact time derivative of the one before it. All but the last of an output
       are continuous: the law integrates them.
    4. A value depends on the time alone: not on the other degrees, nor on earlier calls.
    5. An output that is not smooth enough for its degree is refused by `derivatives`, with the row
       and a remedy, and never later. A time at which there is no value is refused by the function.
    6. A reference that is an expression of time says so in `expression`, so that all of them are
       traced as one function; the values are the same either way.
    """

    @property
    @abstractmethod
    def size(self) -> int:
        """The number of outputs that it covers."""

    @abstractmethod
    def derivatives(self, degrees: Sequence[int]) -> Callable[[float], FloatArray]:
        """Prepares r_1, r_1', ..., r_1^(mu_1), r_2, ... as a function of the time in s.

        Args:
            degrees: The degree mu of each covered output.

        Raises:
            ReferenceSignalError: The reference is not smooth enough for these degrees.
        """

    def expression(self, degrees: Sequence[int], time: ca.SX) -> ca.SX | None:
        """The values at a symbolic time, shape (sum (mu_i + 1), 1); None if they are no expression.

        Raises:
            ReferenceSignalError: The reference is not smooth enough for these degrees.
        """
        return None


@checked(ReferenceSignalError)
class _Expression(Reference):
    """A reference that is a CasADi expression of time; differentiated exactly."""

    @abstractmethod
    def _rows(self, time: ca.SX) -> ca.SX:
        """r(t), shape (size, 1)."""

    def _check(self, degrees: Sequence[int]) -> None:
        """Refuses what lacks derivatives up to the degrees."""
        time = ca.SX.sym("t")
        rows = self._rows(time)
        for i, degree in enumerate(degrees):
            flaw = find_flaw(rows[i], time, ca.SX(0, 1))
            if degree and flaw:
                raise ReferenceSignalError(
                    f"row {i} of the reference {flaw.describe('the time')}. The law needs {degree} "
                    "derivatives of it; a move from rest to rest is a PointToPointReference"
                )

    def expression(self, degrees: Sequence[int], time: ca.SX) -> ca.SX:
        self._check(degrees)
        values = []
        for row, degree in zip(ca.vertsplit(self._rows(time)), degrees, strict=True):
            values.append(row)
            for _ in range(degree):
                values.append(ca.jacobian(values[-1], time))
        return ca.vertcat(*values)

    def derivatives(self, degrees: Sequence[int]) -> Callable[[float], FloatArray]:
        time = ca.SX.sym("t")
        return _at_time(time, self.expression(degrees, time))


@checked(ReferenceSignalError)
@dataclass(frozen=True)
class ConstantReference(_Expression):
    """A reference that stays at given values.

    Attributes:
        values: The values in the outputs' units, shape (k,), or one number.

    Raises:
        ReferenceSignalError: The values are not finite numbers, or there are none.
    """

    values: ArrayLike

    def __post_init__(self) -> None:
        _settle(self, "values")

    @property
    def size(self) -> int:
        return np.size(self.values)

    def _rows(self, time: ca.SX) -> ca.SX:
        return ca.SX(ca.DM(self.values))


@checked(ReferenceSignalError)
@dataclass(frozen=True)
class SinusoidReference(_Expression):
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

    def __post_init__(self) -> None:
        _settle(self, "amplitudes", "frequencies", "phases")

    @property
    def size(self) -> int:
        return 1

    def _rows(self, time: ca.SX) -> ca.SX:
        terms = np.transpose([self.amplitudes, self.frequencies, self.phases])
        return ca.SX(self.offset + sum(a * ca.sin(w * time + p) for a, w, p in terms))


@checked(ReferenceSignalError)
@dataclass(frozen=True)
class PointToPointReference(_Expression):
    """A smooth move from rest at `start` to rest at `end`, held before and after.

    It is the polynomial of degree 2 order + 1 whose derivatives 1, ..., order vanish at both ends:
    order 2 is the quintic.

    Attributes:
        start: The values before, in the outputs' units, shape (k,), or one number for all.
        end: The values after, in the outputs' units, likewise.
        start_time: When the move begins, in s.
        end_time: When the move ends, in s.
        order: How many derivatives are continuous, from 0 to 30; at least mu of the outputs.

    Raises:
        ReferenceSignalError: A number is not finite, or shapes or times do not fit.
    """

    start: ArrayLike
    end: ArrayLike
    start_time: float
    end_time: float
    order: int = 2

    def __post_init__(self) -> None:
        _settle(self, "start", "end")
        if not self.end_time > self.start_time:
            raise ReferenceSignalError(
                f"end_time {self.end_time} must be after start_time {self.start_time}"
            )
        if not 0 <= self.order <= 30:
            raise ReferenceSignalError(f"order must be from 0 to 30, got {self.order}")

    @property
    def size(self) -> int:
        return np.size(self.start)

    def _rows(self, time: ca.SX) -> ca.SX:
        s = (time - self.start_time) / (self.end_time - self.start_time)
        # Positive terms alone, so that nothing cancels.
        fraction = s ** (self.order + 1) * sum(
            comb(self.order + k, k) * (1 - s) ** k for k in range(self.order + 1)
        )
        blend = ca.if_else(s <= 0, 0, ca.if_else(s >= 1, 1, fraction))
        first, last = np.asarray(self.start), np.asarray(self.end)
        return ca.vertcat(*[a + (b - a) * blend for a, b in zip(first, last, strict=True)])

    def _check(self, degrees: Sequence[int]) -> None:
        if max(degrees) > self.order:
            raise ReferenceSignalError(
                f"this PointToPointReference has {self.order} continuous derivatives, the law "
                f"needs {max(degrees)}: pass order={max(degrees)} or more"
            )


@checked(ReferenceSignalError)
@dataclass(frozen=True, eq=False)
class ExpressionReference(_Expression):
    """A reference that is any CasADi expression of time.

    Attributes:
        function: Takes the time in s, a CasADi scalar; returns an expression, or a list of these.

    Raises:
        ReferenceSignalError: The function returns no such expression; or, when `derivatives` is
            called with mu_i >= 1, the expression has a constant that is not finite, or an
            operation on time that is not smooth, such as fabs.
    """

    function: Callable[[ca.SX], Any]

    def __post_init__(self) -> None:
        time = ca.SX.sym("t")
        rows = self._rows(time)
        unknown = [s.name() for s in ca.symvar(rows) if not ca.is_equal(s, time)]
        if unknown or rows.shape[1] != 1:
            raise ReferenceSignalError(
                "a reference must be a column of expressions of the time alone, got shape "
                f"{rows.shape} with {', '.join(unknown) or 'no'} other symbols"
            )

    @property
    def size(self) -> int:
        return int(self._rows(ca.SX.sym("t")).numel())

    def _rows(self, time: ca.SX) -> ca.SX:
        value = result_of("function", self.function, time, error=ReferenceSignalError)
        try:
            return ca.SX(ca.vertcat(*(value if isinstance(value, (list, tuple)) else [value])))
        except (NotImplementedError, RuntimeError) as error:
            raise ReferenceSignalError(
                f"a reference must be an expression of the time or a list of these, got {value!r}"
            ) from error


def _settle(reference: Reference, *names: str) -> None:
    """Makes fields tuples of the same length; a single number serves all.

    Raises:
        ReferenceSignalError: They are no finite numbers, empty, or do not fit each other.
    """
    listed = ", ".join(names)
    given = {name: getattr(reference, name) for name in names}
    try:
        arrays = {name: np.asarray(value, dtype=float) for name, value in given.items()}
    except (TypeError, ValueError):
        shown = next(iter(given.values())) if len(given) == 1 else given
        raise ReferenceSignalError(f"{listed}: must be numbers, got {shown!r}") from None
    for name, array in arrays.items():
        if not array.size:
            raise ReferenceSignalError(f"{name}: empty, at least one number is needed")
        if array.ndim > 1 or not np.isfinite(array).all():
            raise ReferenceSignalError(
                f"{name} must be finite numbers, shape (k,), got {given[name]!r}"
            )
    lengths = {name: array.size for name, array in arrays.items() if array.ndim}
    if len(set(lengths.values())) > 1:
        found = ", ".join(f"{name} has {length}" for name, length in lengths.items())
        raise ReferenceSignalError(
            f"{listed} need as many entries as each other, or one number for all: {found}"
        )
    length = next(iter(lengths.values()), 1)
    for name, array in arrays.items():
        values = tuple(float(value) for value in np.broadcast_to(array, length))
        object.__setattr__(reference, name, values)


def stack_references(
    references: Sequence[Reference], degrees: Sequence[int]
) -> Callable[[float], FloatArray]:
    """All references as one function of the time in s; expressions are traced together.

    Args:
        references: The references, in the order of the outputs.
        degrees: The degrees mu_1, ..., mu_p of all outputs.

    Raises:
        ReferenceSignalError: A reference is not smooth enough.
    """
    ends = np.cumsum([0, *[reference.size for reference in references]])
    parts = list(zip(references, [degrees[a:b] for a, b in pairwise(ends)], strict=True))
    time = ca.SX.sym("t")
    rows = [reference.expression(part, time) for reference, part in parts]
    if all(row is not None for row in rows):
        return _at_time(time, ca.vertcat(*rows))
    functions = [reference.derivatives(part) for reference, part in parts]

    def evaluate(time: float) -> FloatArray:
        value = np.concatenate([function(time) for function in functions])
        if not np.isfinite(value).all():
            raise _not_finite(time, value)
        return value

    return evaluate


def _at_time(time: ca.SX, rows: ca.SX) -> Callable[[float], FloatArray]:
    """An expression of the time alone as a function that is called with a float."""
    function = TracedFunction("reference", {"time": time}, {"R": rows})
    (moment,), (value,) = function.arguments, function.outputs

    def evaluate(time: float) -> FloatArray:
        moment[0] = time
        if not function.run():
            raise _not_finite(time, value)
        return value

    return evaluate


def _not_finite(time: float, value: FloatArray) -> NonFiniteError:
    return NonFiniteError(f"the reference is not finite at t = {time:g} s", time, value)
