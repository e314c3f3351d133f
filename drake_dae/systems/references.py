"""References with all the derivatives that a tracking law asks for."""

from collections.abc import Callable, Sequence
from functools import cached_property
from itertools import pairwise
from math import comb
from typing import Any, Protocol

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike
from pydrake.systems.framework import BasicVector, Context
from pydrake.trajectories import PiecewisePolynomial, Trajectory

from drake_dae.dae.expressions import TracedFunction
from drake_dae.dae.smoothness import flaw
from drake_dae.errors import FloatArray, NonFiniteError, ReferenceSignalError
from drake_dae.systems.autodiff import DifferentiableSystem, Formula


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
            message = flaw(self.expression[i], self._time, ca.SX(0, 1), "the time")
            if degree and message:
                raise ReferenceSignalError(
                    f"row {i} of the reference {message}. The law needs {degree} derivatives of "
                    "it; a move from rest to rest is point_to_point"
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


class TrajectorySignal:
    """A Drake Trajectory, shape (k, 1), with the derivatives that it provides itself.

    Args:
        trajectory: Any column-valued Trajectory.

    Raises:
        ReferenceSignalError: At preparation: no derivatives, or, for a PiecewisePolynomial, a
            derivative below the highest one that jumps at a break. During a simulation: a time
            outside the trajectory, which Drake would silently clip.
    """

    def __init__(self, trajectory: Trajectory) -> None:
        if trajectory.cols() != 1:
            raise ReferenceSignalError(
                f"a reference Trajectory must be a column, this one is {trajectory.rows()} x "
                f"{trajectory.cols()}"
            )
        self.trajectory = trajectory

    @property
    def size(self) -> int:
        return int(self.trajectory.rows())

    def derivatives(self, degrees: Sequence[int]) -> Callable[[float], FloatArray]:
        highest = max(degrees)
        path = self.trajectory
        if highest and not path.has_derivative():
            raise ReferenceSignalError(
                f"{type(path).__name__} has no derivatives, the law needs {highest}"
            )
        if isinstance(path, PiecewisePolynomial):
            self._check_breaks(path, degrees)
        first, last = path.start_time(), path.end_time()
        slack = 1e-9 * max(1.0, abs(last))

        def evaluate(time: float) -> FloatArray:
            if not first - slack <= time <= last + slack:
                raise ReferenceSignalError(
                    f"the reference Trajectory covers {first:g} to {last:g} s and was asked for "
                    f"t = {time:g} s; extend it over the whole simulation"
                )
            table = [path.value(time)] + [
                path.EvalDerivative(time, k) for k in range(1, highest + 1)
            ]
            return np.array(
                [table[k][i, 0] for i, degree in enumerate(degrees) for k in range(degree + 1)]
            )

        return evaluate

    @staticmethod
    def _check_breaks(path: PiecewisePolynomial, degrees: Sequence[int]) -> None:
        breaks = path.get_segment_times()[1:-1]
        for order in range(max(degrees)):
            derivative = path.derivative(order) if order else path
            for index, time in enumerate(breaks):
                left = derivative.getPolynomialMatrix(index)
                right = derivative.getPolynomialMatrix(index + 1)
                width = time - path.get_segment_times()[index]
                for i, degree in enumerate(degrees):
                    before, after = (
                        left[i, 0].EvaluateUnivariate(width),
                        right[i, 0].EvaluateUnivariate(0.0),
                    )
                    if order < degree and abs(before - after) > 1e-6 * (1.0 + abs(before)):
                        raise ReferenceSignalError(
                            f"derivative {order} of row {i} of the reference Trajectory jumps by "
                            f"{after - before:.3g} at t = {time:g} s, but the law needs a "
                            f"reference with {degree} derivatives; use a smoother trajectory"
                        )


class ReferenceGenerator(DifferentiableSystem):
    """References of all outputs, stacked, with their derivatives.

    Output port:
        reference: R(t) of (28): r_1, r_1', ..., r_1^(mu_1), r_2, ..., output-major, shape
            (sum (mu_i + 1),).

    Args:
        signals: One below the other; together they cover all outputs.
        degrees: mu_1, ..., mu_p, as `TrackingLaw.degrees`.

    Converts to AutoDiffXd. A time that has derivatives itself asks each signal for one more.

    Raises:
        ReferenceSignalError: Signals that cover too few or too many outputs, or that are not
            smooth enough.
        NonFiniteError: During a simulation.
    """

    def __init__(self, signals: Sequence[ReferenceSignal], degrees: Sequence[int]) -> None:
        super().__init__()
        self.set_name("reference")
        for index, signal in enumerate(signals):
            if not (hasattr(signal, "size") and hasattr(signal, "derivatives")):
                raise ReferenceSignalError(
                    f"references[{index}] must be a signal such as constant(0.3), got {signal!r}"
                )
        covered = sum(signal.size for signal in signals)
        if covered != len(degrees):
            raise ReferenceSignalError(
                f"the references cover {covered} outputs, the law has {len(degrees)}"
            )
        self._signals, self._degrees = tuple(signals), tuple(degrees)
        self._evaluate = _stack(signals, degrees)
        self.DeclareVectorOutputPort(
            "reference",
            sum(degree + 1 for degree in degrees),
            self._calc_reference,
            {self.time_ticket()},
        )

    def reference(self, time: float) -> FloatArray:
        """R(t) at a time in s, shape (sum (mu_i + 1),)."""
        return self._evaluate(time).copy()

    def _calc_reference(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector(self._evaluate(context.get_time()))

    def _formulas(self) -> dict[str, Formula]:
        return {"reference": _ReferenceFormula(self._signals, self._degrees)}


class _ReferenceFormula:
    """R(t); its derivative by the time needs one more derivative of each signal."""

    sources = ("time",)

    def __init__(self, signals: Sequence[ReferenceSignal], degrees: Sequence[int]) -> None:
        self._evaluate = _stack(signals, degrees)
        self._signals, self._degrees = signals, degrees

    def value(self, time: float, *arguments: FloatArray) -> FloatArray:
        return self._evaluate(time).copy()

    @cached_property
    def _higher(self) -> Callable[[float], FloatArray]:
        return _stack(self._signals, [degree + 1 for degree in self._degrees])

    def slope(self, moving: tuple[int, ...], time: float, *arguments: FloatArray) -> FloatArray:
        ends = np.cumsum([degree + 2 for degree in self._degrees])
        parts = [part[1:] for part in np.split(self._higher(time), ends[:-1])]
        return np.concatenate(parts)[:, None]


def _stack(
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
