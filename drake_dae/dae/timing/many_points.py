"""A function of columns at many points at once."""

import casadi as ca
import numpy as np

from drake_dae.arrays import FloatArray
from drake_dae.trace.compiled import Compiled, machine_code

BLOCK = 128
"""The number of points of a call."""


class ManyPoints:
    """A CasADi function that is evaluated at many points without conversions of matrices.

    Args:
        function: The function, with dense inputs and outputs.
        compiled: Whether it becomes machine code: True, False, or "auto", from the cache alone.
    """

    def __init__(self, function: ca.Function, compiled: Compiled = False) -> None:
        self._shapes = [function.sparsity_out(i).shape for i in range(function.n_out())]
        if compiled:
            function = machine_code(function, compiled, compiled is True) or function
        self._buffer, self._evaluate = function.map(BLOCK).buffer()
        self._arguments = [np.zeros((BLOCK, function.nnz_in(i))) for i in range(function.n_in())]
        self._results = [np.zeros((BLOCK, rows * columns)) for rows, columns in self._shapes]
        for index, array in enumerate(self._arguments):
            self._buffer.set_arg(index, array.reshape(-1).data)
        for index, array in enumerate(self._results):
            self._buffer.set_res(index, array.reshape(-1).data)

    def __call__(self, *arguments: FloatArray) -> list[FloatArray]:
        """Evaluates the function at all points.

        Args:
            arguments: One for each input: a row for each point, shape (k, size), or one row for
                all, shape (size,); the first has k rows.

        Returns:
            For each result an array of shape (k, size), or (k, rows, columns) of a matrix.
        """
        count = len(arguments[0])
        results = [np.empty((count, part.shape[1])) for part in self._results]
        for first in range(0, count, BLOCK):
            last = min(first + BLOCK, count)
            for column, argument in zip(self._arguments, arguments, strict=True):
                column[: last - first] = argument[first:last] if argument.ndim == 2 else argument
            self._evaluate()
            for result, part in zip(results, self._results, strict=True):
                result[first:last] = part[: last - first]
        return [
            array if columns == 1 else array.reshape(count, columns, rows).transpose(0, 2, 1)
            for array, (rows, columns) in zip(results, self._shapes, strict=True)
        ]
