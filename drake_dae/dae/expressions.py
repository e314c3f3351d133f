"""Traced expressions as fast functions of NumPy arrays."""

import re
from collections.abc import Mapping, Sequence
from math import isfinite

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from drake_dae.errors import FloatArray, ModelError

SINGULAR_PIVOT = 1e-12
"""A matrix whose `pivot` is below this counts as singular; see `Factorization`."""


class TracedFunction:
    """CasADi expressions, evaluated on preallocated NumPy arrays.

    A call goes through CasADi's buffer interface and allocates nothing.

    Args:
        name: For messages.
        inputs: Name -> symbol column, in the order of the call's arguments.
        outputs: Name -> expression; a column becomes an array of shape (k,), anything else an
            array of its own shape.
        often: Whether it is called often enough for common subexpressions to be worth removing.

    Attributes:
        num_operations: Scalar operations of one call.
    """

    def __init__(
        self,
        name: str,
        inputs: Mapping[str, ca.SX],
        outputs: Mapping[str, ca.SX],
        often: bool = True,
    ) -> None:
        self.name = name
        self.input_names = tuple(inputs)
        self.output_names = tuple(outputs)
        dense = [ca.densify(expression) for expression in outputs.values()]
        # One scalar that is finite exactly if all outputs are: testing it costs 0.1 us.
        check = sum((ca.sum1(ca.vec(e)) for e in dense if e.numel()), ca.SX(0))
        expressions = ca.cse([*dense, check]) if often else [*dense, check]
        self._function = ca.Function(
            _identifier(name), list(inputs.values()), expressions, {"cse": False}
        )
        self.num_operations = int(self._function.n_instructions())
        self._buffer, self._evaluate = self._function.buffer()
        self._inputs = tuple(np.zeros(symbol.numel()) for symbol in inputs.values())
        results = [np.zeros(e.shape, order="F") for e in expressions]
        for index, array in enumerate(self._inputs):
            self._buffer.set_arg(index, array.data)
        for index, array in enumerate(results):
            self._buffer.set_res(index, array.reshape(-1, order="F").data)
        self._check = results.pop().reshape(-1)
        self._outputs = tuple(
            array.reshape(-1, order="F") if array.shape[1] == 1 else array for array in results
        )

    def evaluate(self, *arguments: FloatArray) -> tuple[FloatArray, ...]:
        """Calls the function without allocation.

        Args:
            arguments: Arrays of the inputs' sizes, in order.

        Returns:
            The outputs. The arrays are overwritten by the next call: copy what must last.
        """
        for own, given in zip(self._inputs, arguments, strict=True):
            own[:] = given
        self._evaluate()
        return self._outputs

    @property
    def sizes(self) -> tuple[int, ...]:
        """Of the inputs."""
        return tuple(array.size for array in self._inputs)

    @property
    def is_finite(self) -> bool:
        """Whether every output of the last call was finite."""
        return isfinite(self._check[0])

    def derivative(self, output: int, inputs: Sequence[int]) -> "TracedFunction":
        """The derivatives of an output with respect to some inputs, side by side."""
        names = self.input_names
        symbols = [ca.SX.sym(name, size) for name, size in zip(names, self.sizes, strict=True)]
        value = ca.vec(self._function(*symbols)[output])
        slope = ca.jacobian(value, ca.vertcat(*[symbols[i] for i in inputs]))
        return TracedFunction(
            f"{self.output_names[output]} of {self.name}, differentiated by "
            + " and ".join(names[i] for i in inputs),
            dict(zip(names, symbols, strict=True)),
            {"slope": slope},
            often=False,
        )

    def __call__(self, *arguments: ArrayLike) -> tuple[FloatArray, ...]:
        """Calls the function and returns fresh arrays.

        Raises:
            ModelError: A wrong number of arguments, or one of a wrong size.
        """
        if len(arguments) != len(self._inputs):
            raise ModelError(
                f"{self.name} takes {len(self._inputs)} arguments "
                f"({', '.join(self.input_names)}), got {len(arguments)}"
            )
        arrays = [np.asarray(argument, dtype=float).reshape(-1) for argument in arguments]
        for label, own, given in zip(self.input_names, self._inputs, arrays, strict=True):
            if own.size != given.size:
                raise ModelError(f"{self.name}: '{label}' has size {given.size}, not {own.size}")
        return tuple(output.copy() for output in self.evaluate(*arrays))


def _identifier(name: str) -> str:
    """A name that CasADi takes: no other characters, no two underscores in a row."""
    return re.sub("[^A-Za-z0-9]+", "_", f"f_{name}")


class Factorization:
    """A regular matrix A = Q R, factored once for many right sides; needs no pivoting.

    A right side is orthogonalized along with the columns of A (modified Gram-Schmidt), so that the
    error grows with the condition of A and not, as by Q^T B, with its square.

    Args:
        matrix: A, shape (n, n), regular where the expressions are evaluated.

    Attributes:
        pivot: The smallest sine of the angle between a column of A and the span of the columns
            before it: 0 exactly where A is singular, 1 where it is orthogonal.
    """

    def __init__(self, matrix: ca.SX) -> None:
        size = matrix.shape[0]
        self._triangle = ca.SX(size, size)
        self._directions: list[ca.SX] = []
        self.pivot = ca.SX(1)
        if size == 1:
            # Exact, and without a square root.
            self._directions, self._triangle = [ca.SX(1)], matrix
            self.pivot = ca.fabs(ca.sign(matrix))
            return
        basis = [ca.densify(matrix[:, j]) for j in range(size)]
        for i in range(size):
            length, whole = ca.norm_2(basis[i]), ca.norm_2(matrix[:, i])
            # A column of zeros makes 0 / 0, which fmin would pass over.
            self.pivot = ca.fmin(self.pivot, ca.if_else(whole > 0, length / whole, 0))
            direction = basis[i] / length
            self._triangle[i, i] = length
            for j in range(i + 1, size):
                self._triangle[i, j] = ca.dot(direction, basis[j])
                basis[j] -= self._triangle[i, j] * direction
            self._directions.append(direction)

    def solve(self, right: ca.SX) -> ca.SX:
        """X of A X = B, shape (n, k); columns of B that are structurally zero stay so."""
        result = ca.SX(*right.shape)
        chosen = [j for j in range(right.shape[1]) if right[:, j].nnz()]
        if not (chosen and self._directions):
            return result
        rest, coordinates = ca.densify(right[:, chosen]), []
        for direction in self._directions:
            coordinates.append(ca.mtimes(direction.T, rest))
            rest -= ca.mtimes(direction, coordinates[-1])
        result[:, chosen] = ca.solve(self._triangle, ca.vertcat(*coordinates))
        return result


class PositiveDefiniteFactorization:
    """A symmetric positive definite matrix A = L D L^T, factored once for many right sides.

    Args:
        matrix: A, shape (n, n); its structural zeros are used.

    Attributes:
        pivot: A holds the products of some vectors; the smallest squared sine of the angle between
            one of them and the span of those before it: 0 exactly where A is singular.
    """

    def __init__(self, matrix: ca.SX) -> None:
        self._identity = ca.is_equal(matrix, ca.SX.eye(matrix.shape[0]))
        self.pivot = ca.SX(1)
        if self._identity:
            return
        self._diagonal, upper, _ = ca.ldl(matrix, False)
        self._lower = upper.T + ca.SX.eye(matrix.shape[0])
        for i in range(matrix.shape[0]):
            square = self._diagonal[i] / matrix[i, i]
            self.pivot = ca.fmin(self.pivot, ca.if_else(matrix[i, i] > 0, square, 0))

    def solve(self, right: ca.SX) -> ca.SX:
        """X of A X = B, shape (n, k); columns of B that are structurally zero stay so."""
        return self.backward(self.forward(right))

    def forward(self, right: ca.SX) -> ca.SX:
        """Y = L^-1 B, shape (n, k)."""
        return right if self._identity else _by_columns(self._lower, right)

    def backward(self, half: ca.SX) -> ca.SX:
        """X = L^-T D^-1 Y, shape (n, k)."""
        return half if self._identity else _by_columns(self._lower.T, self.scaled(half))

    def scaled(self, half: ca.SX) -> ca.SX:
        """D^-1 Y, shape (n, k), so that the product Y_1^T D^-1 Y_2 is B_1^T A^-1 B_2."""
        return half if self._identity else half / ca.repmat(self._diagonal, 1, half.shape[1])


def _by_columns(triangle: ca.SX, right: ca.SX) -> ca.SX:
    """The solution with a triangular matrix, of the columns that are not structurally zero."""
    result = ca.SX(*right.shape)
    for j in range(right.shape[1]):
        if right[:, j].nnz():
            result[:, j] = ca.solve(triangle, right[:, j])
    return ca.sparsify(result)
