"""CasADi functions that are called on arrays, without conversions."""

import casadi as ca
import numpy as np

from drake_dae.arrays import FloatArray


class BufferedFunction:
    """A CasADi function with buffers for its inputs and outputs.

    A matrix of CasADi with k columns is an array of shape (k, n).

    Args:
        function: The function; its inputs and outputs are dense.

    Attributes:
        results: Its outputs, overwritten by each call, shapes (n,) or (k, n).
    """

    def __init__(self, function: ca.Function) -> None:
        def array(shape: tuple[int, int]) -> FloatArray:
            return np.zeros(shape[::-1] if shape[1] > 1 else shape[0])

        self._arrays = [array(function.size_in(i)) for i in range(function.n_in())]
        self.results = [array(function.size_out(i)) for i in range(function.n_out())]
        self._buffer, self._evaluate = function.buffer()
        for index, values in enumerate(self._arrays):
            self._buffer.set_arg(index, values.reshape(-1).data)
        for index, values in enumerate(self.results):
            self._buffer.set_res(index, values.reshape(-1).data)

    def __call__(self, *arguments: FloatArray | float) -> list[FloatArray]:
        """Returns the outputs, in `results`."""
        for array, values in zip(self._arrays, arguments, strict=True):
            array[...] = values
        self._evaluate()
        return self.results
