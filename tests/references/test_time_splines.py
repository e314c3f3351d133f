"""Splines in time: by their recursion, through points, within limits."""

import casadi as ca
import numpy as np
import pytest
from runs import both

from drake_dae import PointToPointReference, WaypointsReference
from drake_dae.references import PathLimits
from drake_dae.references.splines import UNROLLED, PiecewisePolynomials, TimeSpline
from drake_dae.trace.functions import TracedFunction


def test_a_spline_is_that_of_another_source():
    """With the same points and knots; the ends are held by repeated points."""
    random = np.random.default_rng(1)
    spline = TimeSpline(random.normal(size=(9, 2)), 0.25, 1.0, 3)
    # By the recursion of Cox and de Boor.
    held = np.pad(spline.points, ((3, 3), (0, 0)), mode="edge")

    def element(x: float, degree: int) -> float:
        if degree == 0:
            return float(0.0 <= x < 1.0)
        rising, falling = element(x, degree - 1), element(x - 1.0, degree - 1)
        return (x * rising + (degree + 1 - x) * falling) / degree

    def other(time: float, nu: int) -> np.ndarray:
        c = np.diff(held, nu, axis=0) / 0.25**nu
        x = (time - 1.0) / 0.25
        return sum(row * element(x - k + 4 - nu, 4 - nu) for k, row in enumerate(c))

    times = (1.0, 1.1, 2.3, 3.5, 3.7)
    for time, found in zip(times, spline.pieces([3, 1]).at(np.array(times)), strict=True):
        table = [other(time, nu=k) for k in range(4)]
        expected = [*(row[0] for row in table), table[0][1], table[1][1]]
        np.testing.assert_allclose(found, expected, rtol=1e-11, atol=1e-12)


@both
def test_many_polynomials_are_looked_up(compiled):
    """At breaks, beside them, between them and far away; beside a break it is the right piece.

    The sums have another order: to round-off of the largest factors, which are below 5.
    """
    random = np.random.default_rng(0)
    breaks = np.cumsum([1.0, *random.uniform(1e-3, 1.0, UNROLLED + 100)])
    factors = random.normal(size=(breaks.size - 1, 4, 3))
    factors[:, 1, 2] = 0.0
    pieces = PiecewisePolynomials(breaks, factors)
    time = ca.SX.sym("t")
    expressions = {"r": pieces.expression(time)}
    function = TracedFunction("pieces", {"time": time}, expressions, compiled=compiled)
    beside = np.nextafter(breaks, -np.inf), breaks, np.nextafter(breaks, np.inf)
    for moment in np.concatenate([*beside, random.uniform(1.0, breaks[-1], 300), [-1e6, 1e6]]):
        (found,) = function.evaluate(np.array([moment]))
        np.testing.assert_allclose(found, pieces.at(np.array([moment]))[0], rtol=0.0, atol=1e-14)
    assert function.is_machine_code == compiled
    assert function.num_operations < 100


POINTS = [[0.0, 0.0], [0.2, 0.1], [0.3, -0.1], [0.5, 0.0]]
TIMES = [0.5, 1.5, 2.0, 3.5]
LIMITS = PathLimits(0.2, 1.0, 10.0)


@pytest.mark.parametrize("order", [2, 4, 6])
def test_it_is_at_each_point_at_its_time(order):
    """And rests before the first and after the last one; round-off grows with the order."""
    path = WaypointsReference(POINTS, TIMES, start_time=1.0, order=order)
    function = path.derivatives([order] * 2)
    for time, point in zip(TIMES, POINTS, strict=True):
        found = np.reshape(function(1.0 + time), (2, -1))
        np.testing.assert_allclose(found[:, 0], point, rtol=0, atol=1e-12)
    for time, point in ((-3.0, POINTS[0]), (9.0, POINTS[-1])):
        found = np.reshape(function(time), (2, -1)).copy()
        np.testing.assert_allclose(found[:, 0], point, rtol=0, atol=1e-12)
        np.testing.assert_allclose(found[:, 1:], 0.0, atol=1e-9)


@pytest.mark.parametrize("order", [2, 3, 5])
def test_between_two_points_it_is_the_move_from_rest_to_rest(order):
    path = WaypointsReference([[1.0], [3.0]], [0.0, 2.5], order=order)
    move = PointToPointReference(1.0, 3.0, 0.0, 2.5, order)
    for time in (0.1, 1.0, 2.2):
        np.testing.assert_allclose(
            path.derivatives([order])(time), move.derivatives([order])(time), rtol=1e-9, atol=1e-9
        )


@pytest.mark.parametrize("limits", [LIMITS, PathLimits(2.0, 0.5), PathLimits(2.0, 9.0, 1.0)])
def test_limits_are_kept_and_one_is_reached(limits):
    path = WaypointsReference(POINTS, limits=limits, order=3)
    function = path.derivatives([3, 3])
    found = [
        np.reshape(function(t), (2, 4))[:, 1:].copy() for t in np.linspace(0, path.duration, 5001)
    ]
    share = np.linalg.norm(found, axis=1).max(axis=0) / limits.values
    assert np.all(share <= 1.0)
    assert share.max() > 0.99
