"""References with all the derivatives that a tracking law asks for."""

from collections.abc import Callable, Sequence
from itertools import pairwise
from math import comb
from typing import Any, Protocol

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from drake_dae.arrays import FloatArray
from drake_dae.errors import NonFiniteError, ReferenceSignalError
from drake_dae.trace.functions import TracedFunction
from drake_dae.trace.smoothness import find_flaw


class ReferenceSignal(Protocol):
    """Desired values of one or several outputs over time.

    Attributes:
        size: How many outputs it covers.
    """

    @property
    def size(self) -> int: ...

    def derivatives(self, degrees: Sequence[int]) -> Callable[[float], FloatArray]:
        """Prepares r_1, r_1', ..., r_1^(mu_1), r_2, ... as a function of the time in s.

        Args:
            degrees: mu of each covered output.

        Raises:
            ReferenceSignalError: The signal is not smooth enough for these degrees.
        """


class ExpressionSignal:
    """A reference r(t) that is a CasADi expression of time; differentiated exactly.

    Args:
        function: Of a CasADi scalar t in s; returns an expression, or a list of these.

    Raises:
        ReferenceSignalError: What it returns is no such expression; at preparation, for an output
            with mu_i >= 1: a constant that is not finite, or an operation on time that is not
            smooth, such as fabs.
    """

    def __init__(self, function: Callable[[ca.SX], Any]) -> None:
        self._time = ca.SX.sym("t")
        value = function(self._time)
        items = value if isinstance(value, (list, tuple)) else [value]
        try:
            self.expression = ca.SX(ca.vertcat(*items))
        except (NotImplementedError, RuntimeError) as error:
            raise ReferenceSignalError(
                f"a reference must be an expression of the time or a list of these, got {value!r}"
            ) from error
        unknown = [s.name() for s in ca.symvar(self.expression) if not ca.is_equal(s, self._time)]
        if unknown or self.expression.shape[1] != 1:
            raise ReferenceSignalError(
                "a reference must be a column of expressions of the time alone, got shape "
                f"{self.expression.shape} with {', '.join(unknown) or 'no'} other symbols"
            )

    @property
    def size(self) -> int:
        return int(self.expression.numel())

    def derivative_expressions(self, degrees: Sequence[int], time: ca.SX) -> ca.SX:
        """r_1, r_1', ..., r_1^(mu_1), r_2, ... at a symbolic time."""
        self._check(degrees)
        rows = []
        for i, degree in enumerate(degrees):
            rows.append(self.expression[i])
            for _ in range(degree):
                rows.append(ca.jacobian(rows[-1], self._time))
        return ca.substitute(ca.vertcat(*rows), self._time, time)

    def _check(self, degrees: Sequence[int]) -> None:
        """Refuses what lacks derivatives up to the degrees."""
        for i, degree in enumerate(degrees):
            flaw = find_flaw(self.expression[i], self._time, ca.SX(0, 1))
            if degree and flaw:
                raise ReferenceSignalError(
                    f"row {i} of the reference {flaw.describe('the time')}. The law needs {degree} "
                    "derivatives of it; a move from rest to rest is point_to_point"
                )

    def derivatives(self, degrees: Sequence[int]) -> Callable[[float], FloatArray]:
        rows = self.derivative_expressions(degrees, self._time)
        return _at_time(TracedFunction("reference", {"time": self._time}, {"R": rows}))


def constant(values: ArrayLike) -> ExpressionSignal:
    """Stays at given values, shape (k,).

    Raises:
        ReferenceSignalError: They are not finite numbers.
    """
    try:
        numbers = np.atleast_1d(np.asarray(values, dtype=float))
    except (TypeError, ValueError):
        raise ReferenceSignalError(f"constant: values must be numbers, got {values!r}") from None
    return ExpressionSignal(lambda t: list(numbers))


def sinusoids(
    offset: float,
    amplitudes: ArrayLike,
    frequencies: ArrayLike,
    phases: ArrayLike = 0.0,
) -> ExpressionSignal:
    """offset + sum_i amplitude_i sin(frequency_i t + phase_i).

    Args:
        offset: In the output's unit.
        amplitudes: In the output's unit, shape (k,).
        frequencies: rad/s, shape (k,).
        phases: rad, shape (k,).

    Raises:
        ReferenceSignalError: Shapes that do not fit.
    """
    rows = _together("sinusoids", amplitudes=amplitudes, frequencies=frequencies, phases=phases)
    terms = np.array(rows).T
    return ExpressionSignal(lambda t: offset + sum(a * ca.sin(w * t + p) for a, w, p in terms))


def _together(owner: str, **given: ArrayLike) -> list[FloatArray]:
    """Numbers of the same length; a single number serves all."""
    try:
        arrays = {key: np.asarray(value, dtype=float) for key, value in given.items()}
    except (TypeError, ValueError):
        raise ReferenceSignalError(f"{owner}: {', '.join(given)} must be numbers") from None
    lengths = {key: array.shape for key, array in arrays.items() if array.ndim}
    if len(set(lengths.values())) > 1 or any(len(shape) > 1 for shape in lengths.values()):
        found = ", ".join(f"{key} {shape}" for key, shape in lengths.items())
        raise ReferenceSignalError(
            f"{owner}: {', '.join(given)} must be numbers or have the same length, got {found}"
        )
    shape = next(iter(lengths.values()), (1,))
    return [np.broadcast_to(array, shape) for array in arrays.values()]


class _Move(ExpressionSignal):
    """A move from rest to rest that knows how smooth it is."""

    def __init__(self, function: Callable[[ca.SX], Any], order: int) -> None:
        super().__init__(function)
        self._order = order

    def _check(self, degrees: Sequence[int]) -> None:
        if max(degrees) > self._order:
            raise ReferenceSignalError(
                f"point_to_point has {self._order} continuous derivatives, the law needs "
                f"{max(degrees)}: pass order={max(degrees)} or more"
            )


def point_to_point(
    start: ArrayLike, end: ArrayLike, start_time: float, end_time: float, order: int = 2
) -> ExpressionSignal:
    """A smooth move from rest at `start` to rest at `end`, held before and after.

    The polynomial of degree 2 order + 1 whose derivatives 1, ..., order vanish at both ends:
    order 2 is the quintic.

    Args:
        start: shape (k,).
        end: shape (k,).
        start_time: s.
        end_time: s.
        order: How many derivatives are continuous; at least mu of the outputs.

    Raises:
        ReferenceSignalError: Shapes or times that do not fit.
    """
    first, last = _together("point_to_point", start=start, end=end)
    if not end_time > start_time:
        raise ReferenceSignalError(f"end_time {end_time} must be after start_time {start_time}")
    if not 0 <= order <= 30:
        raise ReferenceSignalError(f"order must be from 0 to 30, got {order}")

    def function(t: ca.SX) -> list[ca.SX]:
        s = (t - start_time) / (end_time - start_time)
        # Positive terms alone, so that nothing cancels.
        fraction = s ** (order + 1) * sum(
            comb(order + k, k) * (1 - s) ** k for k in range(order + 1)
        )
        blend = ca.if_else(s <= 0, 0, ca.if_else(s >= 1, 1, fraction))
        return [a + (b - a) * blend for a, b in zip(first, last, strict=True)]

    return _Move(function, order)


def stack_references(
    signals: Sequence[ReferenceSignal], degrees: Sequence[int]
) -> Callable[[float], FloatArray]:
    """All signals as one function; expressions are traced together."""
    ends = np.cumsum([0, *[signal.size for signal in signals]])
    parts = [list(degrees[a:b]) for a, b in pairwise(ends)]
    if all(isinstance(signal, ExpressionSignal) for signal in signals):
        time = ca.SX.sym("t")
        rows = [
            signal.derivative_expressions(part, time)
            for signal, part in zip(signals, parts, strict=True)
            if isinstance(signal, ExpressionSignal)
        ]
        return _at_time(TracedFunction("reference", {"time": time}, {"R": ca.vertcat(*rows)}))
    functions = [s.derivatives(part) for s, part in zip(signals, parts, strict=True)]

    def evaluate(time: float) -> FloatArray:
        value = np.concatenate([function(time) for function in functions])
        if not np.isfinite(value).all():
            raise _not_finite(time, value)
        return value

    return evaluate


def _not_finite(time: float, value: FloatArray) -> NonFiniteError:
    return NonFiniteError(f"the reference is not finite at t = {time:g} s", time, value)


def _at_time(function: TracedFunction) -> Callable[[float], FloatArray]:
    """A traced function of the time alone, called with a float."""
    moment = np.zeros(1)

    def evaluate(time: float) -> FloatArray:
        moment[0] = time
        value = function.evaluate(moment)[0]
        if not function.is_finite:
            raise _not_finite(time, value)
        return value

    return evaluate
