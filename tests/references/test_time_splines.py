"""B-splines in time: against SciPy's, along edges, at corners, within limits."""

import casadi as ca
import numpy as np
import pytest
from runs import both
from scipy.interpolate import BSpline

from drake_dae.references.splines import UNROLLED, PiecewisePolynomials, TimeSpline, basis_pieces
from drake_dae.trace.functions import TracedFunction


@pytest.mark.parametrize("degree", [1, 2, 5, 8])
def test_pieces_are_those_of_another_source(degree):
    x = np.linspace(0.0, 1.0, 7)
    found = np.vander(x, degree + 1, increasing=True) @ basis_pieces(degree)
    element = BSpline.basis_element(np.arange(degree + 2))
    expected = np.column_stack([element(x + degree - k) for k in range(degree + 1)])
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-14)


def test_a_spline_is_that_of_another_source():
    """With the same points and knots; the ends are held by repeated points."""
    random = np.random.default_rng(1)
    spline = TimeSpline(random.normal(size=(9, 2)), 0.25, 1.0, 3)
    held = np.pad(spline.points, ((3, 3), (0, 0)), mode="edge")
    knots = 1.0 + 0.25 * np.arange(-4, len(held) + 1)
    other = BSpline(knots, held, 4)
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
