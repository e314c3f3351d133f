"""Lags that tell derivatives, against closed forms."""

from math import factorial

import casadi as ca
import numpy as np
import pytest
from numpy.testing import assert_allclose

from drake_dae.dae.beyond.lags import Lags

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


def test_ramp_is_followed_late_with_its_slope():
    """(n + 1) / k, and half a sample, by which a signal that is held is late.

    The saw of what is held leaves up to k^2 T / 8 of the slope in r''.
    """
    found = run(Lags.of(RATE, PERIOD, 2), 3.0 * (TIMES - PERIOD))
    late = 3.0 / RATE + PERIOD / 2.0
    assert_allclose(found[0][-1], 3.0 * (TIMES[-1] - late), rtol=1e-3)
    assert_allclose(found[1:, -1], [3.0, 0.0], atol=3.0 * RATE**2 * PERIOD / 8.0)
    assert found[1, -1] == pytest.approx(3.0, rel=1e-4)


def test_derivatives_stay_where_all_lags_change_alike():
    lags = Lags.of(RATE, PERIOD, 2)
    state = ca.DM([[1.0, 2.0, 4.0]])
    assert_allclose(lags.derivatives(state), lags.derivatives(state - 0.7), atol=1e-12)
    assert_allclose(lags.derivatives(state)[0], RATE * (state[1] - state[2]))
