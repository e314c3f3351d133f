"""A CasADi function at many moments at once: each of its operations on arrays of NumPy's.

CasADi's own `map` interprets every operation for each moment, this once for hundreds of them.
"""

from collections.abc import Callable
from typing import Any

import casadi as ca
import numpy as np

from drake_dae.arrays import FloatArray
from drake_dae.running.rollout.stepping.called import BufferedFunction

BLOCK = 512
"""So many moments are computed together: what they need in between stays near the processor."""

FEW = 96
"""For fewer moments than this CasADi's interpreter is as fast."""


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
"""What NumPy does for an operation of CasADi's; a function with another one is mapped."""


class VectorizedFunction:
    """A function at many moments.

    Args:
        function: A function of expressions (SX), whose inputs and outputs are dense columns.
    """

    def __init__(self, function: ca.Function) -> None:
        self._function = function
        codes = [function.instruction_id(i) for i in range(function.n_instructions())]
        known = {*UFUNCS, ca.OP_CONST, ca.OP_INPUT, ca.OP_OUTPUT}
        self._steps: list[tuple[Callable[..., Any], tuple[Any, ...]]] = []
        sizes = [
            [function.numel_in(i) for i in range(function.n_in())],
            [function.numel_out(i) for i in range(function.n_out())],
        ]
        self._given, self._found = ([np.zeros((k, BLOCK)) for k in each] for each in sizes)
        self._one = BufferedFunction(function)
        if known.issuperset(codes):
            self._steps = self._program(codes)

    def _program(self, codes: list[int]) -> list[tuple[Callable[..., Any], tuple[Any, ...]]]:
        """What is called in turn, each with its arrays; constants and inputs are not copied."""
        function, work = self._function, np.zeros((self._function.sz_w(), BLOCK))
        places: dict[int, FloatArray] = {}
        steps: list[tuple[Callable[..., Any], tuple[Any, ...]]] = []
        for i, code in enumerate(codes):
            given, found = function.instruction_input(i), function.instruction_output(i)
            if code == ca.OP_CONST:
                places[found[0]] = np.array([function.instruction_constant(i)])
            elif code == ca.OP_INPUT:
                places[found[0]] = self._given[given[0]][given[1]]
            elif code == ca.OP_OUTPUT:
                steps.append((np.copyto, (self._found[found[0]][found[1]], places[given[0]])))
            else:
                operands = [places[j] for j in given]
                places[found[0]] = work[found[0]]
                steps.append((UFUNCS[code], (*operands, work[found[0]])))
        return steps

    def __call__(self, *arguments: FloatArray) -> list[FloatArray]:
        """The outputs, one row for each moment.

        Args:
            arguments: One row for each moment, shape (k, n), or one for all, shape (n,).
        """
        count = max(len(each) for each in arguments if each.ndim == 2)
        if count < FEW or not self._steps:
            rows = [np.broadcast_to(each, (count, each.shape[-1])) for each in arguments]
            found = [np.empty((count, each.size)) for each in self._one.results]
            for i in range(count):
                for column, value in zip(found, self._one(*(row[i] for row in rows)), strict=True):
                    column[i] = value
            return found
        parts = [self._block(arguments, i, min(i + BLOCK, count)) for i in range(0, count, BLOCK)]
        return [np.concatenate(values) for values in zip(*parts, strict=True)]

    def _block(self, arguments: tuple[FloatArray, ...], first: int, last: int) -> list[FloatArray]:
        number = last - first
        for array, given in zip(self._given, arguments, strict=True):
            array[:, :number] = given[first:last].T if given.ndim == 2 else given[:, None]
        with np.errstate(all="ignore"):
            for function, arrays in self._steps:
                function(*arrays)
        return [array[:, :number].T.copy() for array in self._found]
