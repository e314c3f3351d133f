"""CasADi functions that are called on arrays, without conversions."""

from threading import local

import casadi as ca
import numpy as np

from drake_dae.arrays import FloatArray


class BufferedFunction:
    """A CasADi function with buffers for its inputs and outputs, own ones for each thread.

    A matrix of CasADi with k columns is an array of shape (k, n).

    Args:
        function: The function; its inputs and outputs are dense.
    """

    def __init__(self, function: ca.Function) -> None:
        self._function, self._local = function, local()

    @property
    def results(self) -> list[FloatArray]:
        """The outputs in this thread, overwritten by each call, shapes (n,) or (k, n)."""
        if not hasattr(self._local, "results"):
            self._bind()
        results: list[FloatArray] = self._local.results
        return results

    def _bind(self) -> None:
        def array(shape: tuple[int, int]) -> FloatArray:
            return np.zeros(shape[::-1] if shape[1] > 1 else shape[0])

        function, mine = self._function, self._local
        mine.arrays = [array(function.size_in(i)) for i in range(function.n_in())]
        mine.results = [array(function.size_out(i)) for i in range(function.n_out())]
        mine.buffer, mine.evaluate = function.buffer()
        for index, values in enumerate(mine.arrays):
            mine.buffer.set_arg(index, values.reshape(-1).data)
        for index, values in enumerate(mine.results):
            mine.buffer.set_res(index, values.reshape(-1).data)

    def __call__(self, *arguments: FloatArray | float) -> list[FloatArray]:
        """Returns the outputs, in `results`."""
        mine = self._local
        try:
            arrays = mine.arrays
        except AttributeError:
            self._bind()
            arrays = mine.arrays
        for array, values in zip(arrays, arguments, strict=True):
            array[...] = values
        mine.evaluate()
        results: list[FloatArray] = mine.results
        return results
