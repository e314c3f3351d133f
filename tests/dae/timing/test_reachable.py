"""The fastest motion within linear limits, against closed forms and linear programs."""

import numpy as np
import pytest
from scipy.optimize import linprog
from scipy.sparse import diags, vstack

from drake_dae.dae.timing.reachable import LinearLimits, fastest_motion
from drake_dae.dae.timing.smoothing import smoothed


def duration(points, b):
    speed = np.sqrt(b)
    return float(np.sum(2.0 * np.diff(points) / (speed[1:] + speed[:-1])))


def largest_by_program(points, lines, largest):
    """sum b as large as possible: the largest b at each point, since the maximum of two is allowed.

    The same discrete problem, by HiGHS.
    """
    count = points.size - 1
    double = 2.0 * np.diff(points)
    rows = []
    for k in range(lines.alpha.shape[1]):
        alpha = (lines.alpha[1:, k] + lines.alpha[:-1, k]) / 2.0 / double
        beta = (lines.beta[1:, k] + lines.beta[:-1, k]) / 4.0
        rows.append(diags([beta - alpha, beta + alpha], [0, 1], shape=(count, count + 1)))
    limits = [(0.0, None if not np.isfinite(most) else most) for most in largest]
    limits[0] = limits[-1] = (0.0, 0.0)
    matrix = vstack(rows).tocsr()
    found = linprog(-np.ones(count + 1), A_ub=matrix, b_ub=np.ones(matrix.shape[0]), bounds=limits)
    return found.x


def test_an_acceleration_and_a_speed_make_a_trapezoid():
    points = np.linspace(0.0, 1.0, 401)
    lines = LinearLimits(np.tile([0.5, -0.5], (401, 1)), np.zeros((401, 2)))
    found = fastest_motion(points, lines, np.full(401, 0.5))
    # |a| <= 2 and s' <= sqrt(0.5): length / speed + speed / a; a is constant in all intervals.
    wanted = 1.0 / np.sqrt(0.5) + np.sqrt(0.5) / 2.0
    assert duration(points, found.b) == pytest.approx(wanted, rel=1e-12)
    assert set(found.active[found.active >= 0]) == {0, 1}


@pytest.mark.parametrize("seed", range(5))
def test_the_result_is_that_of_a_linear_program(seed):
    random, count = np.random.default_rng(seed), 150
    points = np.concatenate([[0.0], np.cumsum(random.uniform(0.5, 1.5, count))]) / count
    shape = (count + 1, 8)
    walk = [
        random.normal(size=8) + 0.1 * np.cumsum(random.normal(size=shape), axis=0) for _ in range(2)
    ]
    # Next to a zero of alpha the largest b at one point and at the next exclude each other.
    walk[0] = np.sign(walk[0][0]) * (0.2 + np.abs(walk[0]))
    lines = LinearLimits(np.hstack([walk[0], -walk[0]]), np.hstack([walk[1], -walk[1]]))
    largest = np.where(random.uniform(size=count + 1) < 0.5, np.inf, 0.3)
    found = fastest_motion(points, lines, largest)
    wanted = largest_by_program(points, lines, largest)
    # HiGHS leaves 1e-7.
    np.testing.assert_allclose(found.b, wanted, atol=1e-6)


def test_a_smoothed_motion_has_the_ends_and_a_continuous_acceleration():
    points = (1.0 - np.cos(np.pi * np.arange(301) / 300)) / 2.0
    lines = LinearLimits(np.tile([0.5, -0.5], (301, 1)), np.zeros((301, 2)))
    found = fastest_motion(points, lines, np.full(301, np.inf))
    b, a, times = smoothed(points, found.b, found.a)
    assert b[0] == b[-1] == 0.0
    assert np.all(b[1:-1] > 0.0)
    assert np.abs(a).max() <= 2.0 + 1e-12
    # The speed is the integral of an acceleration that is straight in time.
    speed = np.concatenate([[0.0], np.cumsum((a[1:] + a[:-1]) / 2.0 * np.diff(times))])
    np.testing.assert_allclose(speed, np.sqrt(b), atol=1e-4)
    # One switch costs an interval's share of the time: 2 sqrt(1 / 2) s without.
    assert times[-1] == pytest.approx(np.sqrt(2.0), rel=1e-4)
