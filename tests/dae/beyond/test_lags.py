"""Lags that tell derivatives, against closed forms."""

from math import factorial

import casadi as ca
import numpy as np
import pytest
from numpy.testing import assert_allclose

from drake_dae.dae import Lags

RATE, PERIOD = 8.0, 0.01
TIMES = PERIOD * np.arange(1, 200)


def run(lags, signal):
    """r, r', ... at the samples after a signal began that is held between them."""
    state, rows = ca.DM.zeros(1, lags.degree + 1), []
    for value in signal:
        state = lags.after(state, ca.DM(value))
        rows.append(ca.horzcat(state[-1], lags.derivatives(state)).full()[0])
    return np.array(rows).T


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_constant_is_found_as_the_filter_says(degree):
    """r' = k (k t)^n / n! e^(-k t), whose integral is r, and whose derivatives are r'', ..."""
    found = run(Lags.of(RATE, PERIOD, degree), np.ones(TIMES.size))
    x = RATE * TIMES
    terms = sum(x**j / factorial(j) for j in range(degree + 1))
    assert_allclose(found[0], 1.0 - np.exp(-x) * terms, atol=1e-12)
    # r^(j + 1) = k^(j + 1) d^j/dx^j of x^n / n! e^(-x).
    density = np.polynomial.Polynomial([0.0] * degree + [1.0 / factorial(degree)])
    for j in range(1, degree + 1):
        assert_allclose(found[j], RATE**j * density(x) * np.exp(-x), atol=1e-9)
        density = density.deriv() - density
