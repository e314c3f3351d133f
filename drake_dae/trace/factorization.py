"""Matrices of expressions, factored once for many right sides, and equations in blocks."""

from collections.abc import Callable

import casadi as ca
import numpy as np

from drake_dae.arrays import Booleans


def nonzeros(pattern: ca.Sparsity) -> Booleans:
    """Returns which entries of a matrix are structurally nonzero."""
    result = np.zeros(pattern.shape, dtype=bool)
    result[pattern.get_triplet()] = True
    return result


class Factorization:
    """A factorization A = Q R of a regular matrix, for many right sides, without pivoting.

    A right side is orthogonalized along with the columns of A (modified Gram-Schmidt), so that the
    error grows with the condition of A and not, as by Q^T B, with its square.
    """

    def __init__(self, matrix: ca.SX) -> None:
        size = matrix.shape[1]
        self._triangle, self.pivot = ca.SX(size, size), ca.SX(1)
        self._directions: list[ca.SX] = []
        if matrix.shape == (1, 1):
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
        """Returns X of A X = B, shape (n, k), with the structurally zero columns of B."""
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

    def shortest(self, right: ca.SX) -> ca.SX:
        """Returns the shortest x of A^T x = b, shape (l, 1), for b of shape (n, 1): x = Q R^-T b.

        Summed so that directions which are not quite orthogonal do no harm (Bjorck, Numerical
        Methods for Least Squares Problems, 1996, section 2.4.5).
        """
        result = ca.SX(self._directions[0].numel(), 1)
        lengths = ca.solve(self._triangle.T, ca.densify(right))
        for k, direction in reversed(list(enumerate(self._directions))):
            result += direction * (lengths[k] - ca.dot(direction, result))
        return result


def nearest_solution(
    matrix: ca.SX, right: ca.SX, metric: ca.SX, goal: ca.SX
) -> tuple[ca.SX, ca.SX]:
    """Returns the u with B u = b next to u_0, for which (u - u_0)^T W (u - u_0) is least:

        u = u_0 + W^-1 B^T (B W^-1 B^T)^-1 (b - B u_0).

    With W = R^T R it is u_0 + R^-1 x for the shortest x of (B R^-1) x = b - B u_0, so that nothing
    is squared.
    """
    root = ca.chol(metric)
    factors = Factorization(ca.solve(root.T, ca.densify(matrix.T)))
    shortest = factors.shortest(right - ca.mtimes(matrix, goal))
    return goal + ca.solve(root, shortest), factors.pivot


class PositiveDefiniteFactorization:
    """A factorization A = L D L^T of a symmetric positive definite matrix, for many right sides."""

    def __init__(self, matrix: ca.SX) -> None:
        self._identity = ca.is_equal(matrix, ca.SX.eye(matrix.shape[0]))
        self.pivot = ca.SX(1)
        self.lengths = [ca.SX(1)] * matrix.shape[0]
        if self._identity:
            return
        self._diagonal, upper, _ = ca.ldl(matrix, False)
        self._lower = upper.T + ca.SX.eye(matrix.shape[0])
        self.lengths = [ca.sqrt(square) for square in ca.vertsplit(ca.SX(self._diagonal))]
        for i in range(matrix.shape[0]):
            square = self._diagonal[i] / matrix[i, i]
            self.pivot = ca.fmin(self.pivot, ca.if_else(matrix[i, i] > 0, square, 0))

    def solve(self, right: ca.SX) -> ca.SX:
        """X of A X = B, shape (n, k), with the structurally zero columns of B."""
        return self.backward(self.forward(right))

    def forward(self, right: ca.SX) -> ca.SX:
        """Y = L^-1 B, shape (n, k)."""
        return right if self._identity else _by_columns(self._lower, right)

    def backward(self, half: ca.SX) -> ca.SX:
        """X = L^-T D^-1 Y, shape (n, k)."""
        return half if self._identity else _by_columns(self._lower.T, self.scaled(half))

    def scaled(self, half: ca.SX) -> ca.SX:
        """D^-1 Y, shape (n, k); the product Y_1^T D^-1 Y_2 is B_1^T A^-1 B_2."""
        return half if self._identity else half / ca.repmat(self._diagonal, 1, half.shape[1])


def _by_columns(triangle: ca.SX, right: ca.SX) -> ca.SX:
    """The solution with a triangular matrix, of the columns that are not structurally zero."""
    result = ca.SX(*right.shape)
    for j in range(right.shape[1]):
        if right[:, j].nnz():
            result[:, j] = ca.solve(triangle, right[:, j])
    return ca.sparsify(result)


def block_stages(pattern: ca.Sparsity) -> list[list[tuple[list[int], list[int]]]]:
    """Returns rows and columns of diagonal blocks, in stages: each needs those of earlier ones."""
    count, rows, columns, row_starts, column_starts, _, _ = pattern.btf()
    used = nonzeros(pattern)
    stages: list[list[tuple[list[int], list[int]]]] = []
    stage_of = np.full(pattern.size2(), -1)
    for k in range(count):
        own_rows = rows[row_starts[k] : row_starts[k + 1]]
        block = columns[column_starts[k] : column_starts[k + 1]]
        stage = int(stage_of[used[own_rows].any(axis=0)].max()) + 1
        stage_of[block] = stage
        if stage == len(stages):
            stages.append([])
        stages[stage].append((own_rows, block))
    return stages


def saddle_point_solver(
    inertia: PositiveDefiniteFactorization, g: ca.SX, gradient: ca.SX
) -> tuple[Callable[[ca.SX, ca.SX], ca.SX], ca.SX, ca.SX]:
    """Returns a solver of [[E, -g], [c, 0]] (w, v) = -(balance, rate), by factors of E."""
    half = inertia.forward(g)
    coupling: Factorization | PositiveDefiniteFactorization
    if gradient is g:  # A = g^T E^-1 g, as J M^-1 J^T
        other = ca.sparsify(inertia.scaled(half))
        matrix = ca.sparsify(ca.tril2symm(ca.tril(ca.mtimes(other.T, half))))
        coupling = PositiveDefiniteFactorization(matrix)
    else:
        other = ca.sparsify(inertia.scaled(inertia.forward(gradient)))
        matrix = ca.sparsify(ca.mtimes(other.T, half))
        coupling = Factorization(matrix)

    def solve(balance: ca.SX, rate: ca.SX) -> ca.SX:
        free = inertia.forward(-balance)
        v = coupling.solve(-rate - ca.mtimes(other.T, free))
        return ca.vertcat(inertia.backward(free + ca.mtimes(half, v)), v)

    return solve, matrix, coupling.pivot
