"""Polynomials that continue the references of the phase before and decay to zero."""

from collections.abc import Sequence
from functools import cache
from math import factorial
from typing import Any

import numpy as np

from drake_dae.arrays import FloatArray

SMOOTH = 2
"""The least number of continuous derivatives of a fade, even if a law needs fewer."""


def fade(offset: Any, degrees: Sequence[int], over: Any) -> list[list[Any]]:
    """Polynomials that begin with given values and derivatives, and end at rest at zero.

    For each output i with offsets d_0, ..., d_mu the one of degree 2 n + 1, n = max(mu, SMOOTH),

        p^(k)(0) = d_k (0 for k > mu),    p^(k)(over) = 0,    k = 0, ..., n.

    Args:
        offset: d, output-major as a reference, shape (sum (mu_i + 1),), of numbers or expressions.
        degrees: mu_1, ..., mu_p.
        over: Its duration, in s, a number or an expression.

    Returns:
        Factors of 1, x, x^2, ... with x = t / over, one row for each entry of the reference.
    """
    width = 2 * max(SMOOTH, *degrees) + 2
    rows, first = [], 0
    for mu in degrees:
        n = max(mu, SMOOTH)
        factors: list[Any] = [0.0] * width
        for k in range(mu + 1):
            start = offset[first + k] * over**k
            factors[: 2 * n + 2] = [
                factor + start * part
                for factor, part in zip(factors[: 2 * n + 2], _basis(n)[k].tolist(), strict=True)
            ]
        for k in range(mu + 1):
            rows.append([factor / over**k for factor in factors])
            factors = [factors[j] * j for j in range(1, width)] + [0.0]
        first += mu + 1
    return rows


@cache
def _basis(n: int) -> FloatArray:
    """Polynomials whose k-th derivative is 1 at 0, and all others up to n are 0 at 0 and at 1.

    Returns:
        Row k has the factors of 1, x, ..., x^(2 n + 1), shape (n + 1, 2 n + 2).
    """
    powers = np.arange(2 * n + 2)
    # Row j: the j-th derivatives of the powers at 1.
    at_end = np.array(
        [[float(np.prod(powers[p] - np.arange(j))) for p in powers] for j in range(n + 1)]
    )
    factors = np.zeros((n + 1, 2 * n + 2))
    for k in range(n + 1):
        factors[k, k] = 1.0 / factorial(k)
    remaining = at_end[:, : n + 1] @ factors[:, : n + 1].T
    factors[:, n + 1 :] = -np.linalg.solve(at_end[:, n + 1 :], remaining).T
    return factors
