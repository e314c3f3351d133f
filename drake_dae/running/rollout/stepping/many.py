"""CasADi functions of many arguments at once, by operations of NumPy on arrays.

CasADi's `map` interprets each operation for each argument; NumPy does it once for hundreds.
"""

from collections.abc import Callable
from threading import Lock
from typing import Any

import casadi as ca
import numpy as np

from drake_dae.arrays import FloatArray
from drake_dae.compiler.called import BufferedFunction

BLOCK = 512
"""The number of moments computed together: intermediate results then fit the cache."""

FEW = 96
"""For fewer moments, CasADi's interpreter is as fast."""


def _if_else_zero(condition: FloatArray, value: FloatArray, out: FloatArray) -> None:
    np.copyto(out, np.where(condition != 0.0, value, 0.0))


UFUNCS: dict[int, Callable[..., Any]] = {
    ca.OP_ASSIGN: np.positive,
    ca.OP_NEG: np.negative,
    ca.OP_EXP: np.exp,
    ca.OP_LOG: np.log,
    ca.OP_SQRT: np.sqrt,
    ca.OP_SQ: np.square,
    ca.OP_TWICE: lambda value, out: np.add(value, value, out),
    ca.OP_SIN: np.sin,
    ca.OP_COS: np.cos,
    ca.OP_TAN: np.tan,
    ca.OP_ASIN: np.arcsin,
    ca.OP_ACOS: np.arccos,
    ca.OP_ATAN: np.arctan,
    ca.OP_SINH: np.sinh,
    ca.OP_COSH: np.cosh,
    ca.OP_TANH: np.tanh,
    ca.OP_FABS: np.fabs,
    ca.OP_FLOOR: np.floor,
    ca.OP_CEIL: np.ceil,
    ca.OP_SIGN: np.sign,
    ca.OP_INV: np.reciprocal,
    ca.OP_NOT: lambda value, out: np.equal(value, 0.0, out),
    ca.OP_ADD: np.add,
    ca.OP_SUB: np.subtract,
    ca.OP_MUL: np.multiply,
    ca.OP_DIV: np.divide,
    ca.OP_POW: np.power,
    ca.OP_CONSTPOW: np.power,
    ca.OP_LT: np.less,
    ca.OP_LE: np.less_equal,
    ca.OP_EQ: np.equal,
    ca.OP_NE: np.not_equal,
    ca.OP_AND: np.logical_and,
    ca.OP_OR: np.logical_or,
    ca.OP_FMIN: np.fmin,
    ca.OP_FMAX: np.fmax,
    ca.OP_ATAN2: np.arctan2,
    ca.OP_COPYSIGN: np.copysign,
    ca.OP_IF_ELSE_ZERO: _if_else_zero,
}
"""Operation of CasADi -> that of NumPy; a function with another one is interpreted."""


class VectorizedFunction:
    """A function at many moments.

    Args:
        function: A function of expressions (SX), whose inputs and outputs are dense columns.
    """

    def __init__(self, function: ca.Function) -> None:
        self._function = function
        codes = [function.instruction_id(i) for i in range(function.n_instructions())]
        supported = {*UFUNCS, ca.OP_CONST, ca.OP_INPUT, ca.OP_OUTPUT}
        self._steps: list[tuple[Callable[..., Any], tuple[Any, ...]]] = []
        sizes = [
            [function.numel_in(i) for i in range(function.n_in())],
            [function.numel_out(i) for i in range(function.n_out())],
        ]
        self._inputs, self._outputs = ([np.zeros((k, BLOCK)) for k in each] for each in sizes)
        self._one, self._lock = BufferedFunction(function), Lock()
        if supported.issuperset(codes):
            self._steps = self._program(codes)

    def _program(self, codes: list[int]) -> list[tuple[Callable[..., Any], tuple[Any, ...]]]:
        """Returns NumPy functions to call in turn, with their arrays; inputs are not copied."""
        function, work = self._function, np.zeros((self._function.sz_w(), BLOCK))
        places: dict[int, FloatArray] = {}
        steps: list[tuple[Callable[..., Any], tuple[Any, ...]]] = []
        for i, code in enumerate(codes):
            operands, result = function.instruction_input(i), function.instruction_output(i)
            if code == ca.OP_CONST:
                places[result[0]] = np.array([function.instruction_constant(i)])
            elif code == ca.OP_INPUT:
                places[result[0]] = self._inputs[operands[0]][operands[1]]
            elif code == ca.OP_OUTPUT:
                steps.append(
                    (np.copyto, (self._outputs[result[0]][result[1]], places[operands[0]]))
                )
            else:
                inputs = [places[j] for j in operands]
                places[result[0]] = work[result[0]]
                steps.append((UFUNCS[code], (*inputs, work[result[0]])))
        return steps

    def __call__(self, *arguments: FloatArray) -> list[FloatArray]:
        """Returns the outputs, with one row for each moment.

        Args:
            arguments: Arrays with a row for each moment, shape (k, n), or for all, shape (n,).
        """
        count = max(len(each) for each in arguments if each.ndim == 2)
        if count < FEW or not self._steps:
            rows = [np.broadcast_to(each, (count, each.shape[-1])) for each in arguments]
            results = [np.empty((count, each.size)) for each in self._one.results]
            for i in range(count):
                for column, value in zip(
                    results, self._one(*(row[i] for row in rows)), strict=True
                ):
                    column[i] = value
            return results
        with self._lock:  # All threads share the arrays of a block.
            parts = [
                self._block(arguments, i, min(i + BLOCK, count)) for i in range(0, count, BLOCK)
            ]
        return [np.concatenate(values) for values in zip(*parts, strict=True)]

    def _block(self, arguments: tuple[FloatArray, ...], first: int, last: int) -> list[FloatArray]:
        number = last - first
        for array, values in zip(self._inputs, arguments, strict=True):
            array[:, :number] = values[first:last].T if values.ndim == 2 else values[:, None]
        with np.errstate(all="ignore"):
            for function, arrays in self._steps:
                function(*arrays)
        return [array[:, :number].T.copy() for array in self._outputs]
