"""The contract of a reference, and all references as one function of time."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from itertools import pairwise

import casadi as ca
import numpy as np

from drake_dae.arguments import checked
from drake_dae.arrays import FloatArray
from drake_dae.errors import NonFiniteError, ReferenceSignalError
from drake_dae.trace.expressions import find_flaw
from drake_dae.trace.functions import TracedFunction


@checked(ReferenceSignalError)
class Reference(ABC):
    """Desired values r(t) of one or several outputs, with their time derivatives.

    A member has `size`, and `expression` or, if it is none, `derivatives`.

    1. `size`, at least 1, is the number of its outputs. It never changes.
    2. `derivatives` takes one degree mu_i >= 0 per output, and returns a function of the time in s
       with the values r_1, r_1', ..., r_1^(mu_1), r_2, ...: output-major, shape
       (sum (mu_i + 1),).
    3. Each value is the exact time derivative of the one before it. All except the last of an
       output are continuous.
    4. A value depends only on time, not on the other degrees or on other calls, and is an array of
       its own.
    5. `derivatives` and `expression` refuse an output that is not smooth enough for its degree,
       with the row and a remedy. The function refuses a time without a value.
    6. `expression` has the same values at a symbolic time, so that all references are traced as
       one function; None if there is no such expression.
    7. A reference with a file reads it when it is used. `remark` describes approximations of the
       file's data.
    """

    @property
    @abstractmethod
    def size(self) -> int:
        """The number of its outputs."""

    def derivatives(self, degrees: Sequence[int]) -> Callable[[float], FloatArray]:
        """Returns the function t -> (r_1, r_1', ..., r_1^(mu_1), r_2, ...), with t in s.

        Args:
            degrees: The degree mu of each output.

        Raises:
            ReferenceSignalError: The reference is not smooth enough for these degrees.
        """
        time = ca.SX.sym("t")
        rows = self.expression(degrees, time)
        assert rows is not None, f"{type(self).__name__} has neither expression nor derivatives"
        value = function_of_time(time, rows)
        return lambda time: value(time).copy()

    def expression(self, degrees: Sequence[int], time: ca.SX) -> ca.SX | None:
        """Returns the values at a symbolic time, shape (sum (mu_i + 1), 1), or None.

        Raises:
            ReferenceSignalError: The reference is not smooth enough for these degrees.
        """
        return None

    @property
    def repeats(self) -> float | None:
        """Its period in s; 0 if it is constant, None if it has none or none is known."""
        return None

    @property
    def remark(self) -> str:
        """A text on approximations of its data; empty if there are none."""
        return ""


class FormulaReference(Reference):
    """A reference r(t) that CasADi differentiates."""

    @abstractmethod
    def rows(self, time: ca.SX) -> ca.SX:
        """Returns r(t), shape (size, 1)."""

    def expression(self, degrees: Sequence[int], time: ca.SX) -> ca.SX:
        self.check_smoothness(degrees)
        values = []
        for row, degree in zip(ca.vertsplit(self.rows(time)), degrees, strict=True):
            values.append(row)
            for _ in range(degree):
                values.append(ca.jacobian(values[-1], time))
        return ca.vertcat(*values)

    def check_smoothness(self, degrees: Sequence[int]) -> None:
        """Raises ReferenceSignalError if a row has no derivatives up to its degree."""
        time = ca.SX.sym("t")
        rows = self.rows(time)
        others = [symbol for symbol in ca.symvar(rows) if not ca.is_equal(symbol, time)]
        for i, degree in enumerate(degrees):
            flaw = find_flaw(rows[i], time, ca.vertcat(ca.SX(0, 1), *others), "the time")
            if degree and flaw:
                raise ReferenceSignalError(
                    f"row {i} of the reference {flaw}. The law needs {degree} "
                    "derivatives of it; a move from rest to rest is a PointToPointReference"
                )


def check_order(order: int, least: int, most: int) -> None:
    """Raises ReferenceSignalError if `order` is out of range."""
    if not least <= order <= most:
        raise ReferenceSignalError(f"order must be from {least} to {most}, got {order}")


def check_continuity(reference: Reference, order: int, degrees: Sequence[int]) -> None:
    """Raises ReferenceSignalError if a degree exceeds the number of continuous derivatives."""
    if max(degrees) > order:
        raise ReferenceSignalError(
            f"this {type(reference).__name__} has {order} continuous derivatives, the law "
            f"needs {max(degrees)}: pass order={max(degrees)} or more"
        )


def common_period(periods: Sequence[float | None]) -> float | None:
    """Returns the period in s of signals together; 0 if all are constant, None without one."""
    moving = np.array([period for period in periods if period], dtype=float)
    if None in periods or not moving.size:
        return None if None in periods else 0.0
    for count in range(1, 13):
        turns = count * moving.max() / moving
        if np.all(np.abs(turns - np.round(turns)) <= 1e-9 * turns):
            return float(count * moving.max())
    return None


def with_degrees(
    references: Sequence[Reference], degrees: Sequence[int]
) -> list[tuple[Reference, Sequence[int]]]:
    """Returns each reference with the degrees of its outputs."""
    ends = np.cumsum([0, *[reference.size for reference in references]])
    return list(zip(references, [degrees[a:b] for a, b in pairwise(ends)], strict=True))


def stack_references(
    references: Sequence[Reference], degrees: Sequence[int]
) -> Callable[[float], FloatArray]:
    """Combines references to one function of the time in s; expressions are traced together."""
    parts = with_degrees(references, degrees)
    time = ca.SX.sym("t")
    rows = [reference.expression(part, time) for reference, part in parts]
    if all(row is not None for row in rows):
        return function_of_time(time, ca.vertcat(*rows))
    functions = [reference.derivatives(part) for reference, part in parts]

    def evaluate(time: float) -> FloatArray:
        value = np.concatenate([function(time) for function in functions])
        if not np.isfinite(value).all():
            raise not_finite(time, value)
        return value

    return evaluate


def function_of_time(time: ca.SX, rows: ca.SX) -> Callable[[float], FloatArray]:
    """Returns an expression of time as a function, which reuses its array."""
    function = TracedFunction("reference", {"time": time}, {"R": rows})

    def evaluate(time: float) -> FloatArray:
        (value,) = function.evaluate(time)
        if not function.is_valid:
            raise not_finite(time, value)
        return value

    return evaluate


def not_finite(time: float, value: FloatArray) -> NonFiniteError:
    """Returns the error of a reference that is not finite at a time in s."""
    return NonFiniteError(f"the reference is not finite at t = {time:g} s", time, value)
