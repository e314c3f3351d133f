"""B-splines in time: against SciPy's, along edges, at corners, within limits."""

import casadi as ca
import numpy as np
from runs import both

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
