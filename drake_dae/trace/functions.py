"""Traced expressions as fast functions of NumPy arrays, with checks of their values."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import Enum
from functools import cached_property
from hashlib import sha256
from math import isfinite
from threading import RLock, local

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from drake_dae.arguments import uncollected
from drake_dae.arrays import FloatArray, numbers
from drake_dae.errors import ModelError
from drake_dae.trace.compiled import Compiled, attempts, machine_code

# A number above this, in any unit, means that something grew without bound. Its powers cancel and
# overflow, so that pivots have no meaning.
HUGE = 1e30
# A matrix whose `pivot` is below this counts as singular; see `trace.factorization`.
SINGULAR_PIVOT = 1e-12


# Functions of more operations than this are kept, so many of them: a further run of a loop then
# takes no time to shorten its expressions, and to find their machine code.
LONG, KEPT = 2000, 16


class FailureKind(Enum):
    """The kinds of failures of a function; the enum value is a description."""

    INPUT = "an input is not finite"
    OVERFLOW = "an input is beyond all measure"
    VALUE = "the function is not finite: it left its domain, or a matrix in it is singular"
    SINGULAR = "a matrix that must be regular is singular"
    OUTSIDE = "the function does not hold there"


@dataclass(frozen=True)
class Failure:
    """The reason why the last values of a function are not valid."""

    function: str
    fault: FailureKind
    inputs: Mapping[str, tuple[int, ...]]
    singular: str = ""


def count_operations(expression: ca.SX) -> int:
    """The number of operations of an expression, without its common subexpressions."""
    symbols = ca.vertcat(ca.SX(0, 1), *ca.symvar(expression))
    return int(ca.Function("f", [symbols], [ca.cse(expression)]).n_instructions())


class TracedFunction:
    """A function of CasADi expressions on preallocated NumPy arrays, compiled or interpreted.

    Each thread has arrays of its own. A call goes through CasADi's buffer interface and allocates
    nothing; it also computes one number that says whether its values are valid, see `is_valid`.
    Only here it is decided whether a function is interpreted or compiled. CasADi's function is made
    when it is first needed: many blocks run as parts of a whole, and a report needs few.
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
    ) -> None:
        self.name, self._regular, self._often, self._compiled = name, regular, often, compiled
        self.input_names, self.output_names = tuple(inputs), tuple(outputs)
        dense = [ca.densify(expression) for expression in outputs.values()]
        # Two numbers show whether the values are valid: the first is finite exactly if all outputs
        # are, the last if also the pivot is large enough.
        finite = sum((ca.sum1(ca.vec(e)) for e in dense if e.numel()), ca.SX(0))
        checks, regularity = [finite], ca.SX(1)
        if pivot is not None:
            regularity = pivot
            checks.append(finite + ca.if_else(pivot >= SINGULAR_PIVOT, 0, np.nan))
        self._expressions, self._symbols = [*dense, regularity, *checks], list(inputs.values())
        self.sizes = tuple(symbol.numel() for symbol in self._symbols)
        self._num_inputs, self._num_outputs = len(self.sizes), len(dense)
        self._local, self._lock = local(), RLock()
        self._current: ca.Function | None = None  # What calls evaluate; None before the first.
        self._attempts: list[tuple[int, bool]] | None = None  # None before the first call.
        self._calls_left, self.is_machine_code = 0, False

    @property
    def function(self) -> ca.Function:
        """The CasADi function: outputs, pivot, and numbers that are finite if they are valid."""
        return self._made.function

    @cached_property
    @uncollected
    def _made(self) -> "_Made":
        """The function, which long ones of equal expressions have in common."""
        name = re.sub("[^A-Za-z0-9]+", "_", f"f_{self.name}")  # As CasADi accepts them.
        plain = ca.Function(name, self._symbols, self._expressions, {"cse": False})
        if not self._often:
            return _Made(plain)
        key, is_long = f"{self._compiled}", plain.n_instructions() > LONG
        if is_long:
            key += sha256(plain.serialize().encode("latin-1")).hexdigest()
            if (known := _MADE.get(key)) is not None:
                return known
        expressions = ca.cse(self._expressions)
        made = _Made(ca.Function(name, self._symbols, expressions, {"cse": False}))
        if is_long:
            if len(_MADE) >= KEPT:
                _MADE.clear()
            _MADE[key] = made
        return made

    @property
    def num_operations(self) -> int:
        """The number of scalar operations of one call."""
        return int(self.function.n_instructions())

    def _count(self) -> None:
        """Makes the function before the first call, and machine code after some more."""
        with self._lock:
            if self._attempts is None:
                self._current, self._attempts = self.function, []
                if self._often:
                    self._attempts = attempts(self._compiled, self.num_operations)
                self._calls_left = self._attempts[0][0] if self._attempts else 0
            self._calls_left -= 1
            if not self._attempts or self._calls_left > 0:
                return
            _, make = self._attempts.pop(0)
            self._calls_left = self._attempts[0][0] if self._attempts else 0
            made = self._made
            made.code = made.code or machine_code(made.function, self._compiled, make)
            if made.code is not None:
                self._attempts, self._current, self.is_machine_code = [], made.code, True

    @property
    def _arrays(self) -> "_Arrays":
        try:
            arrays: _Arrays = self._local.arrays
        except AttributeError:
            shapes = [e.shape for e in self._expressions]
            arrays = self._local.arrays = _Arrays(self.sizes, shapes, self._num_outputs)
        return arrays

    def evaluate(self, *arguments: FloatArray | float) -> tuple[FloatArray, ...]:
        """Evaluates the function without allocation."""
        if len(arguments) != self._num_inputs:
            raise TypeError(f"{self.name} takes {self.input_names}, got {len(arguments)} arguments")
        if self._attempts is None or self._attempts:
            self._count()
        try:
            arrays = self._local.arrays
        except AttributeError:
            arrays = self._arrays
        if arrays.function is not self._current:
            arrays.bind(self._current)
        # zip(..., strict=True) and [:] would take as long as the function.
        inputs, index = arrays.arguments, 0
        for argument in arguments:
            inputs[index][...] = argument
            index += 1  # noqa: SIM113 - enumerate takes longer.
        arrays.evaluate()
        return arrays.outputs

    def nowhere(self) -> tuple[FloatArray, ...]:
        """Returns new arrays of nan in the shapes of the outputs, for failed evaluations."""
        return tuple(np.full_like(output, np.nan) for output in self.outputs)

    @property
    def outputs(self) -> tuple[FloatArray, ...]:
        """The outputs of this thread's last call, which its next call overwrites."""
        return self._arrays.outputs

    @property
    def is_valid(self) -> bool:
        """Whether the last values are valid: all finite, and the matrix regular."""
        return isfinite(self._arrays.valid[0])

    @property
    def is_finite(self) -> bool:
        """Whether every output of the last call was finite."""
        return isfinite(self._arrays.finite[0])

    @property
    def pivot(self) -> float:
        """The pivot of the last evaluation; 1 without a matrix."""
        return float(self._arrays.pivot[0])

    def failure(self) -> Failure:
        """The failure of the last evaluation, if it was not valid."""
        for fault, limit in ((FailureKind.INPUT, np.inf), (FailureKind.OVERFLOW, HUGE)):
            bad = {
                name: tuple(int(i) for i in np.flatnonzero(~(np.abs(argument) < limit)))
                for name, argument in zip(self.input_names, self._arrays.arguments, strict=True)
                if not np.all(np.abs(argument) < limit)
            }
            if bad:
                return Failure(self.name, fault, bad)
        # A value may not be finite because the matrix is singular.
        is_singular = self.is_finite or self.pivot < SINGULAR_PIVOT
        fault = FailureKind.SINGULAR if is_singular else FailureKind.VALUE
        return Failure(self.name, fault, {}, self._regular)

    def __call__(self, *arguments: ArrayLike) -> tuple[FloatArray, ...]:
        """Evaluates the function and returns new arrays."""
        if len(arguments) != self._num_inputs:
            raise ModelError(
                f"{self.name} takes {self._num_inputs} arguments "
                f"({', '.join(self.input_names)}), got {len(arguments)}"
            )
        arrays = []
        for name, argument, size in zip(self.input_names, arguments, self.sizes, strict=True):
            array = numbers(what := f"{self.name}: '{name}'", argument)
            if array.size != size or (array.ndim > 1 and array.shape != (size, 1)):
                raise ModelError(f"{what} has shape {array.shape}, not {(size,)}")
            arrays.append(array.reshape(-1))
        return tuple(output.copy() for output in self.evaluate(*arrays))


@dataclass
class _Made:
    """A function, and its machine code if there is any yet."""

    function: ca.Function
    code: ca.Function | None = None


_MADE: dict[str, _Made] = {}


class _Arrays:
    """The arrays of one thread, and the call that reads and writes them."""

    def __init__(self, sizes: Sequence[int], shapes: Sequence[tuple[int, int]], count: int) -> None:
        self.arguments = tuple(np.zeros(size) for size in sizes)
        self._results = results = [np.zeros(shape, order="F") for shape in shapes]
        checks = results[count:]
        self.pivot, self.finite, self.valid = (checks[i].reshape(-1) for i in (0, 1, -1))
        self.outputs = tuple(
            array.reshape(-1, order="F") if array.shape[1] == 1 else array
            for array in results[:count]
        )
        self.function: ca.Function | None = None

    def bind(self, function: ca.Function) -> None:
        """Sets the function that `evaluate` calls; CasADi keeps the addresses of the arrays."""
        self.function = function
        self._buffer, self.evaluate = function.buffer()
        for index, array in enumerate(self.arguments):
            self._buffer.set_arg(index, array.data)
        for index, result in enumerate(self._results):
            self._buffer.set_res(index, result.reshape(-1, order="F").data)
