"""Filters of samples, against closed forms, poles and a recursion."""

from math import factorial

import casadi as ca
import numpy as np
import pytest
from numpy.testing import assert_allclose

from drake_dae.dae.disturbance import Lags, filter_gain, transition

T = 1e-4


@pytest.mark.parametrize(("fast", "slow"), [(50.0, 5.0), (50.0, 50.0), (20.0, 200.0)])
def test_poles_are_those_of_the_docstring(fast, slow):
    """The stable roots of s^6 + w^4 s^2 - w^4 k_o^2 = 0; samples move them by some w T."""
    gain = filter_gain(fast, slow, T)
    closed = (np.eye(3) - gain @ np.eye(3)[:1]) @ transition(T)
    poles = np.sort_complex(np.log(np.linalg.eigvals(closed)) / T)
    roots = np.roots([1.0, 0.0, 0.0, 0.0, fast**4, 0.0, -(fast**4) * slow**2])
    wanted = np.sort_complex(roots[roots.real < 0.0])
    assert_allclose(poles, wanted, rtol=20.0 * fast * T)


@pytest.mark.slow
@pytest.mark.parametrize("ratio", [None, 30.0])
def test_gain_is_where_riccatis_recursion_ends(ratio):
    """From no knowledge at all, 20,000 samples; round-off of the recursion is about 1e-10."""
    fast, slow, period = 40.0, 10.0, 1e-3
    found = filter_gain(fast, slow, period, ratio)
    shown = np.eye(3)[: 1 if ratio is None else 2]
    error = np.diag([1.0, ratio**2] if ratio else [1.0])
    noise = np.diag([0.0, fast**4, fast**4 * slow**2]) * period**2
    step, spread = transition(period), 1e8 * np.eye(3)
    for _ in range(20_000):
        before = step @ spread @ step.T + noise
        gain = before @ shown.T @ np.linalg.inv(shown @ before @ shown.T + error)
        spread = (np.eye(3) - gain @ shown) @ before
    assert_allclose(found, gain, rtol=1e-6)


RATE, PERIOD = 8.0, 0.01
TIMES = PERIOD * np.arange(1, 200)


def run(lags, degree, signal):
    """r, r', ... at the samples after a signal began that is held between them."""
    state, rows = ca.DM.zeros(1, degree + 1), []
    for value in signal:
        state = lags.after(state, ca.DM(value))
        rows.append(ca.horzcat(state[-1], lags.derivatives(state)).full()[0])
    return np.array(rows).T


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_constant_is_found_as_the_filter_says(degree):
    """r' = k (k t)^n / n! e^(-k t), whose integral is r, and whose derivatives are r'', ..."""
    found = run(Lags.of(RATE, PERIOD, degree), degree, np.ones(TIMES.size))
    x = RATE * TIMES
    terms = sum(x**j / factorial(j) for j in range(degree + 1))
    assert_allclose(found[0], 1.0 - np.exp(-x) * terms, atol=1e-12)
    # r^(j + 1) = k^(j + 1) d^j/dx^j of x^n / n! e^(-x).
    density = np.polynomial.Polynomial([0.0] * degree + [1.0 / factorial(degree)])
    for j in range(1, degree + 1):
        assert_allclose(found[j], RATE**j * density(x) * np.exp(-x), atol=1e-9)
        density = density.deriv() - density
