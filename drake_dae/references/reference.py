"""The contract of a reference, and all references as one function of time."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from itertools import pairwise

import casadi as ca
import numpy as np

from drake_dae.arguments import checked
from drake_dae.arrays import FloatArray, brief
from drake_dae.errors import NonFiniteError, ReferenceSignalError
from drake_dae.trace.expressions import find_flaw
from drake_dae.trace.functions import TracedFunction


@checked(ReferenceSignalError)
class Reference(ABC):
    """Desired values r(t) of one or several outputs, with their time derivatives.

    1. `size`, at least 1, is the number of its outputs. It never changes.
    2. `expression` takes one degree mu_i >= 0 per output and a symbolic time in s, and returns the
       values r_1, r_1', ..., r_1^(mu_1), r_2, ...: output-major, shape (sum (mu_i + 1), 1).
    3. Each value is the exact time derivative of the one before it. All except the last of an
       output are continuous.
    4. A value depends only on time, not on the other degrees or on other calls.
    5. `expression` refuses an output that is not smooth enough for its degree, with the row and a
       remedy; a time without a value is NonFiniteError in a run.
    6. `derivatives` has the same values at times in s, each an array of its own.
    7. A reference with a file reads it when it is used.
    """

    @property
    @abstractmethod
    def size(self) -> int:
        """The number of its outputs."""

    @abstractmethod
    def expression(self, degrees: Sequence[int], time: ca.SX) -> ca.SX:
        """Returns the values at a symbolic time, shape (sum (mu_i + 1), 1).

        Raises:
            ReferenceSignalError: The reference is not smooth enough for these degrees.
        """

    def derivatives(self, degrees: Sequence[int]) -> Callable[[float], FloatArray]:
        """Returns the function t -> (r_1, r_1', ..., r_1^(mu_1), r_2, ...), with t in s."""
        return stack_references([self], degrees)

    @property
    def repeats(self) -> float | None:
        """Its period in s; 0 if it is constant, None if it has none or none is known."""
        return None


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
                    f"row {i} of the reference {flaw}. The law needs {degree} derivatives of it; a "
                    "move from rest to rest is a PointToPointReference"
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


def expression_of(reference: Reference, degrees: Sequence[int], time: ca.SX) -> ca.SX:
    """Returns the expression of a reference, of the right shape."""
    rows, wanted = reference.expression(degrees, time), (sum(degrees) + len(degrees), 1)
    if getattr(rows, "shape", None) != wanted:
        raise ReferenceSignalError(
            f"the expression of a {type(reference).__name__} must have shape {wanted}, all values "
            f"for the degrees {list(degrees)}; it returns {brief(rows)}"
        )
    return rows


def stacked_expression(
    references: Sequence[Reference], degrees: Sequence[int], time: ca.SX
) -> ca.SX:
    """Returns R(t) of references at a symbolic time, shape (sum (mu_i + 1), 1)."""
    ends = np.cumsum([0, *(reference.size for reference in references)])
    rows = [
        expression_of(reference, degrees[first:last], time)
        for reference, (first, last) in zip(references, pairwise(ends), strict=True)
    ]
    return ca.vertcat(ca.SX(0, 1), *rows)


def stack_references(
    references: Sequence[Reference], degrees: Sequence[int]
) -> Callable[[float], FloatArray]:
    """Returns R(t) of references as one function of the time in s."""
    time = ca.SX.sym("t")
    rows = stacked_expression(references, degrees, time)
    function = TracedFunction("reference", {"time": time}, {"R": rows})

    def evaluate(time: float) -> FloatArray:
        (value,) = function.evaluate(time)
        if not function.is_valid:
            raise NonFiniteError(f"the reference is not finite at t = {time:g} s", time, value)
        return value.copy()

    return evaluate
