"""Traced expressions as fast functions of NumPy arrays, with checks of their values."""

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from enum import Enum
from functools import cached_property
from math import isfinite
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from drake_dae.arrays import FloatArray, numbers
from drake_dae.errors import ModelError
from drake_dae.trace.compiled import CompilationAttempt, Compiled, attempts, machine_code

HUGE = 1e30
"""A number above this, in any unit, means that something grew without bound. Its powers cancel and
overflow, so that pivots have no meaning."""

SINGULAR_PIVOT = 1e-12
"""A matrix whose `pivot` is below this counts as singular; see `trace.factorization`."""


class FailureKind(Enum):
    """The kinds of failures of a function; the enum value is a description."""

    INPUT = "an input is not finite"
    OVERFLOW = "an input is beyond all measure"
    VALUE = "the function is not finite: it left its domain, or a matrix in it is singular"
    SINGULAR = "a matrix that must be regular is singular"
    OUTSIDE = "the function does not hold there"


@dataclass(frozen=True)
class Failure:
    """The reason why the last values of a function are not valid.

    Attributes:
        function: The function's name.
        fault: The kind of failure.
        inputs: Name of an input -> its entries that are not finite, or beyond `HUGE`; empty unless
            `fault` is INPUT or OVERFLOW.
        singular: The matrix that must be regular, which is singular if `fault` is SINGULAR; or why
            the function does not hold, if it is OUTSIDE.
    """

    function: str
    fault: FailureKind
    inputs: Mapping[str, tuple[int, ...]]
    singular: str = ""


def count_operations(expression: ca.SX) -> int:
    """The number of operations of an expression, without its common subexpressions."""
    symbols = ca.vertcat(ca.SX(0, 1), *ca.symvar(expression))
    return int(ca.Function("f", [symbols], [ca.cse(expression)]).n_instructions())


class TracedFunction:
    """A compiled or interpreted function of CasADi expressions on preallocated NumPy arrays.

    A call goes through CasADi's buffer interface and allocates nothing. It also computes one number
    that says whether its values are valid, see `is_valid`. Only here it is decided whether a
    function is interpreted or compiled, by the choice `compiled` of the caller. CasADi's function
    is made when it is first needed: many blocks run as parts of a whole, and a report needs few.

    Args:
        name: The name of the function in messages.
        inputs: Name -> symbol column, in the order of the call's arguments.
        outputs: Name -> expression; a column becomes an array of shape (k,), anything else an
            array of its own shape.
        pivot: A scalar that is 0 where a matrix that must be regular is singular, such as
            `Factorization.pivot`; None if there is no such matrix.
        regular: The name of that matrix in messages.
        often: Whether it is called so often that removing common subexpressions and compiling pay.
        lean: Whether common subexpressions have been removed already.
        compiled: Whether a function that is called often becomes machine code; see
            `trace.compiled`.
        doubt: A scalar that is negative where the values are not valid though the pivot is large
            enough; the caller may have other values there, see `is_regular`.
        outside: Why values are not valid where the doubt is negative, for messages; if it is empty
            the matrix is called singular there.

    Attributes:
        arguments: The arrays that a call reads, for `run`.
        outputs: The arrays that a call writes.
        is_machine_code: Whether calls currently run machine code.
    """

    def __init__(
        self,
        name: str,
        inputs: Mapping[str, ca.SX],
        outputs: Mapping[str, ca.SX],
        pivot: ca.SX | None = None,
        regular: str = "a matrix",
        often: bool = True,
        compiled: Compiled = False,
        doubt: ca.SX | None = None,
        lean: bool = False,
        outside: str = "",
    ) -> None:
        self.name = name
        self._regular, self._outside = regular, outside
        self.input_names = tuple(inputs)
        self.output_names = tuple(outputs)
        dense = [ca.densify(expression) for expression in outputs.values()]
        # Two numbers show whether the values are valid: the first is finite exactly if all outputs
        # are, the last if also the pivot is large enough and the doubt is not negative.
        finite = sum((ca.sum1(ca.vec(e)) for e in dense if e.numel()), ca.SX(0))
        checks, regularity = [finite], ca.SX(1)
        if pivot is not None:
            regularity = pivot
            checks.append(finite + ca.if_else(pivot >= SINGULAR_PIVOT, 0, np.nan))
        if doubt is not None:
            checks.append(checks[-1] + ca.if_else(doubt >= 0, 0, np.nan))
        expressions = [*dense, regularity, *checks]
        self._expressions, self._symbols = expressions, list(inputs.values())
        self._often, self._lean = often, lean
        self.arguments = tuple(np.zeros(symbol.numel()) for symbol in self._symbols)
        self._num_inputs = len(self.arguments)
        self._results = results = [np.zeros(e.shape, order="F") for e in expressions]
        results, checks = results[: len(dense)], results[len(dense) :]
        self._pivot, self._finite, self._valid = (checks[i].reshape(-1) for i in (0, 1, -1))
        self.outputs = tuple(
            array.reshape(-1, order="F") if array.shape[1] == 1 else array for array in results
        )
        self._compiled = compiled
        self._attempts: list[CompilationAttempt] | None = None  # None before the first call.
        self._calls_left = 0
        self.is_machine_code = False

    @cached_property
    def function(self) -> ca.Function:
        """The CasADi function: outputs, pivot, and a number that is finite if all outputs are.

        With a pivot, a last number is finite if the pivot is large enough as well.
        """
        expressions = self._expressions
        if self._often and not self._lean:
            expressions = ca.cse(expressions)
        return ca.Function(_identifier(self.name), self._symbols, expressions, {"cse": False})

    @property
    def num_operations(self) -> int:
        """The number of scalar operations of one call."""
        return int(self.function.n_instructions())

    def _begin(self) -> None:
        """Makes and binds the function, before the first call."""
        self._attempts = attempts(self._compiled, self.num_operations) if self._often else []
        self._calls_left = self._attempts[0].calls if self._attempts else 0
        self._bind(self.function)

    def _bind(self, function: ca.Function) -> None:
        """Binds the function that calls evaluate to the arrays."""
        self.is_machine_code = function is not self.function
        self._buffer, self._evaluate = function.buffer()
        for index, array in enumerate(self.arguments):
            self._buffer.set_arg(index, array.data)
        for index, array in enumerate(self._results):
            self._buffer.set_res(index, array.reshape(-1, order="F").data)
        if not self._calls_left:
            vars(self)["run"] = _run(self._evaluate, self._valid)

    def _seek(self) -> None:
        """Tries to get machine code, after the number of calls of the next attempt."""
        assert self._attempts  # There are calls left.
        attempt = self._attempts.pop(0)
        code = machine_code(self.function, self._compiled, attempt.make)
        if code is None and self._attempts:
            self._calls_left = self._attempts[0].calls
        else:
            self._bind(code or self.function)

    def evaluate(self, *arguments: FloatArray) -> tuple[FloatArray, ...]:
        """Evaluates the function without allocation.

        Args:
            arguments: Arrays of the sizes of the inputs, in their order.

        Returns:
            The outputs. The arrays are overwritten by the next call; copy values to keep them.

        Raises:
            TypeError: The number of arguments is wrong.
        """
        if len(arguments) != self._num_inputs:
            raise TypeError(f"{self.name} takes {self.input_names}, got {len(arguments)} arguments")
        # zip(..., strict=True) and [:] would take as long as the function.
        inputs, index = self.arguments, 0
        for argument in arguments:
            inputs[index][...] = argument
            index += 1  # noqa: SIM113 - enumerate takes longer.
        self.run()
        return self.outputs

    def run(self) -> bool:
        """Evaluates the function at its `arguments`; returns whether its `outputs` are valid.

        This is the fastest call, for callers that write the arguments in place. It is replaced by
        `_run` when there are no more attempts to compile.
        """
        if self._attempts is None:
            self._begin()
            return self.run()
        self._calls_left -= 1
        if not self._calls_left:
            self._seek()
        self._evaluate()
        return isfinite(self._valid[0])

    def nowhere(self) -> tuple[FloatArray, ...]:
        """Returns new arrays of nan in the shapes of the outputs, for failed evaluations."""
        return tuple(np.full_like(output, np.nan) for output in self.outputs)

    @property
    def sizes(self) -> tuple[int, ...]:
        """The number of entries of each input."""
        return tuple(array.size for array in self.arguments)

    @property
    def is_valid(self) -> bool:
        """Whether the last values are valid: all finite, and the matrix regular."""
        return isfinite(self._valid[0])

    @property
    def is_finite(self) -> bool:
        """Whether every output of the last call was finite."""
        return isfinite(self._finite[0])

    @property
    def is_regular(self) -> bool:
        """Whether the last values are finite and the matrix is regular; ignores the doubt."""
        return self.is_finite and bool(self._pivot[0] >= SINGULAR_PIVOT)

    @property
    def pivot(self) -> float:
        """The pivot of the last evaluation; 1 without a matrix."""
        return float(self._pivot[0])

    def failure(self) -> Failure:
        """Returns the failure of the last evaluation, if it was not valid."""
        for fault, limit in ((FailureKind.INPUT, np.inf), (FailureKind.OVERFLOW, HUGE)):
            bad = {
                name: tuple(int(i) for i in np.flatnonzero(~(np.abs(argument) < limit)))
                for name, argument in zip(self.input_names, self.arguments, strict=True)
                if not np.all(np.abs(argument) < limit)
            }
            if bad:
                return Failure(self.name, fault, bad)
        # A value may not be finite because the matrix is singular.
        if self.is_regular and self._outside:
            return Failure(self.name, FailureKind.OUTSIDE, {}, self._outside)
        is_singular = self.is_finite or self._pivot[0] < SINGULAR_PIVOT
        fault = FailureKind.SINGULAR if is_singular else FailureKind.VALUE
        return Failure(self.name, fault, {}, self._regular)

    def derivative(self, output: int, inputs: Sequence[int]) -> "TracedFunction":
        """Returns the function of the derivatives of an output by some inputs, side by side."""
        names = self.input_names
        symbols = [ca.SX.sym(name, size) for name, size in zip(names, self.sizes, strict=True)]
        value = ca.vec(self.function(*symbols)[output])
        slope = ca.jacobian(value, ca.vertcat(*[symbols[i] for i in inputs]))
        return TracedFunction(
            f"{self.output_names[output]} of {self.name}, differentiated by "
            + " and ".join(names[i] for i in inputs),
            dict(zip(names, symbols, strict=True)),
            {"slope": slope},
            often=False,
        )

    def __call__(self, *arguments: ArrayLike) -> tuple[FloatArray, ...]:
        """Evaluates the function and returns new arrays.

        Raises:
            ModelError: The number of arguments is wrong, or one has a wrong shape or is not
                numeric.
        """
        if len(arguments) == self._num_inputs and all(map(_fits, arguments, self.arguments)):
            return tuple(output.copy() for output in self.evaluate(*arguments))  # type: ignore
        if len(arguments) != len(self.arguments):
            raise ModelError(
                f"{self.name} takes {len(self.arguments)} arguments "
                f"({', '.join(self.input_names)}), got {len(arguments)}"
            )
        arrays = [
            numbers(f"{self.name}: '{label}'", argument)
            for label, argument in zip(self.input_names, arguments, strict=True)
        ]
        for label, buffer, array in zip(self.input_names, self.arguments, arrays, strict=True):
            size = buffer.size
            if array.size != size:
                raise ModelError(f"{self.name}: '{label}' has size {array.size}, not {size}")
            if array.ndim > 1 and array.shape != (size, 1):
                raise ModelError(f"{self.name}: '{label}' has shape {array.shape}, not {(size,)}")
        values = self.evaluate(*(array.reshape(-1) for array in arrays))
        return tuple(output.copy() for output in values)


def _fits(argument: Any, buffer: FloatArray) -> bool:
    """Whether an argument is an array of the shape and type of an input buffer, as most are."""
    is_array = type(argument) is np.ndarray
    return is_array and argument.dtype is buffer.dtype and argument.shape == buffer.shape


def _run(evaluate: Callable[[], None], valid: FloatArray) -> Callable[[], bool]:
    """Returns a call without attribute lookups."""

    def run() -> bool:
        evaluate()
        return isfinite(valid[0])

    return run


def _identifier(name: str) -> str:
    """Returns a name that CasADi accepts: letters, digits and single underscores."""
    return re.sub("[^A-Za-z0-9]+", "_", f"f_{name}")
