"""Linear equations in blocks: one after the other along their structure, and of saddle points."""

from collections.abc import Callable

import casadi as ca
import numpy as np

from drake_dae.trace.factorization import (
    Factorization,
    Factors,
    PositiveDefiniteFactorization,
    nonzeros,
)


def block_stages(pattern: ca.Sparsity) -> list[list[tuple[list[int], list[int]]]]:
    """Returns rows and columns of the diagonal blocks of a square matrix, in stages.

    A block needs what blocks of earlier stages solve for, and nothing else.
    """
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
    inertia: Factors, g: ca.SX, gradient: ca.SX
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
