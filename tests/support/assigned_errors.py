"""Errors as gains assign them: gains that couple outputs, the new input v(t), closed forms."""

from math import comb, factorial

import numpy as np


def coupled(degree, size, random):
    """Lambda_1, ..., Lambda_mu with poles from -3 to -5 that belong to mixtures of the errors."""
    mix = np.eye(size) + 0.2 * random.standard_normal((size, size))
    rows = np.array([np.poly(p)[:0:-1] for p in -random.uniform(3.0, 5.0, (size, degree))])
    return [mix @ np.diag(column) @ np.linalg.inv(mix) for column in rows.T]


def new_input(reference, gains, outputs):
    """v(t) of (70), (71), (80), (81) from z, z', ...: r^(mu) - sum Lambda_k+1 (z^(k) - r^(k))."""
    r = reference.reshape(-1, len(gains) + 1).T
    return r[-1] - sum(g @ (z - r[k]) for k, (g, z) in enumerate(zip(gains, outputs, strict=True)))


def closed_form(pole, start, times):
    """e(t) of (s - pole)^mu e = 0 from e(0), e'(0), ...: exp(pole t) times a polynomial.

    The polynomial is w = e exp(-pole t), whose derivatives at 0 follow from Leibniz's rule.
    """
    w = [
        sum(comb(k, j) * (-pole) ** (k - j) * start[j] for j in range(k + 1))
        for k in range(len(start))
    ]
    return np.exp(pole * times) * sum(c * times**k / factorial(k) for k, c in enumerate(w))
