"""Shortest solutions against fractions, and sines of angles against NumPy's projections."""

from fractions import Fraction

import casadi as ca
import numpy as np
import pytest
from numpy.testing import assert_allclose

from drake_dae.trace.factorization import Factorization


@pytest.mark.parametrize("small", [1.0, 1e-3, 1e-5, 1e-7])
def test_shortest_solution_of_rows_that_are_nearly_parallel(small):
    """A^T x = b for Lauchli's A, which has ones above a diagonal D, by fractions: x = A y.

    (1 1^T + D^2) y = b, as Sherman and Morrison solve it. Directions are orthogonal to 1e-16 over
    small alone. The error is that of the condition, with room, and A^T x = b holds to round-off.
    """
    diagonal = small * np.array([1.0, 2.0, -1.0])
    A = np.vstack([np.ones(3), np.diag(diagonal)])
    b = np.array([1.0, 1.0 + small, 1.0 - 3.0 * small])
    weights = [1 / Fraction(d) ** 2 for d in diagonal]
    known = [w * Fraction(value) for w, value in zip(weights, b, strict=True)]
    shared = sum(known) / (1 + sum(weights))
    y = [own - w * shared for own, w in zip(known, weights, strict=True)]
    x = np.array(
        [float(sum(y)), *(float(Fraction(d) * v) for d, v in zip(diagonal, y, strict=True))]
    )
    matrix = ca.SX.sym("A", 4, 3)
    function = ca.Function("shortest", [matrix], [Factorization(matrix).shortest(ca.SX(b))])
    found = function(A).full()[:, 0]
    assert_allclose(found, x, rtol=0.0, atol=1e-15 / small * np.abs(x).max())
    assert_allclose(A.T @ found, b, rtol=0.0, atol=1e-14 * np.abs(x).max())
