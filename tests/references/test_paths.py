"""Lines, circles and splines: where they go, how fast and how smooth, and their ends at rest."""

from math import factorial

import casadi as ca
import numpy as np
import pytest
from runs import both

from drake_dae import CircleReference, LineReference, PointToPointReference, WaypointsReference
from drake_dae.errors import ReferenceSignalError
from drake_dae.references import PathLimits
from drake_dae.references.splines import UNROLLED, PiecewisePolynomials, uniform_spline
from drake_dae.trace.functions import TracedFunction

LIMITS = PathLimits(0.2, 1.0, 8.0)

MEMBERS = {
    "long line": LineReference([0.1, 0.2], [0.7, -0.6], LIMITS, 0.3),
    "short line": LineReference([0.0], [0.004], LIMITS, 0.3),
    "steep line": LineReference([0.0], [0.1], PathLimits(0.2, 1.0), 0.3, order=2),
    "smooth line": LineReference([0.0], [0.1], LIMITS, 0.3, order=7),
    "turns": CircleReference([0.5, 0.1], 0.1, limits=LIMITS, turns=-1.5, phase=0.4, start_time=0.3),
    "tight turn": CircleReference([0.5, 0.1], 0.01, limits=LIMITS, start_time=0.3, order=6),
}


@pytest.fixture(params=MEMBERS)
def path(request):
    return MEMBERS[request.param]


def course(path, count=3001):
    """r, r', r'', r''' at times of the whole motion, shape (count, size, 4)."""
    degree = min(3, path.order)
    function = path.derivatives([degree] * path.size)
    times = path.start_time + np.linspace(0.0, path.travel.duration, count)
    return np.array([np.reshape(function(t), (path.size, -1)).copy() for t in times])


def test_limits_are_kept_and_one_is_reached(path):
    """The sampled peak of the binding one is off by less than 1 %: of the steps, and of curves."""
    peaks = np.linalg.norm(course(path), axis=1).max(axis=0)[1:]
    share = peaks / np.array(path.limits.values)[: peaks.size]
    assert np.all(share <= 1.0 + 1e-9)
    assert share.max() > 0.99


def test_it_rests_at_both_ends(path):
    """Just inside of them the last derivative enters with the slope that the next one has there.

    With m = order - 1 that is speed / ramp^order (2 m + 1)! / m!; round-off adds 1e-9.
    """
    function = path.derivatives([path.order] * path.size)
    begin, end = path.start_time, path.start_time + path.travel.duration
    for inside, outside, far in (
        (begin + 1e-9, begin - 1e-9, -7.0),
        (end - 1e-9, end + 1e-9, 99.0),
    ):
        within, out, away = (
            np.array(function(t)).reshape(path.size, -1) for t in (inside, outside, far)
        )
        np.testing.assert_allclose(out, away, rtol=0, atol=1e-12)
        assert not out[:, 1:].any()
        np.testing.assert_allclose(within[:, 0], out[:, 0], rtol=0, atol=1e-12)
        m, travel = path.order - 1, path.travel
        slope = travel.speed / travel.ramp**path.order * factorial(2 * m + 1) / factorial(m)
        assert np.abs(within[:, 1:]).max() < 1.01e-9 * slope + 1e-9


def test_a_line_takes_as_long_as_by_hand():
    """Order 2: the speed goes as 3 x^2 - 2 x^3, with peaks of 3/2 and 6 for its derivatives."""
    path = LineReference([0.0, 0.0], [0.3, 0.4], PathLimits(0.2, 1.0, 5.0), order=2)
    ramp = max(1.5 * 0.2 / 1.0, np.sqrt(6 * 0.2 / 5.0))
    assert path.travel.duration == pytest.approx(0.5 / 0.2 + ramp, rel=1e-14)
    middle = path.derivatives([0, 0])(path.travel.duration / 2)
    np.testing.assert_allclose(middle, [0.15, 0.2], atol=1e-15)
    quarter = path.derivatives([1, 1])(ramp / 2)
    np.testing.assert_allclose(quarter[1::2], [0.06, 0.08], atol=1e-15)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: PathLimits(0.0, 1.0), r"speed.*0"),
        (lambda: PathLimits(1.0, 1.0, -1.0), r"jerk.*-1"),
        (lambda: LineReference([1.0, 2.0], [1.0, 2.0], LIMITS), r"start.*end"),
        (lambda: LineReference([1.0, 2.0], [1.0], LIMITS), r"start.*2.*end.*1"),
        (lambda: LineReference([1.0], [2.0], LIMITS, order=1), r"order.*1"),
        (lambda: CircleReference([0, 0], 1.0), "period"),
        (lambda: CircleReference([0, 0, 0], 1.0, 2.0), r"center.*\(2,\)"),
        (lambda: CircleReference([0, 0], -1.0, 2.0), r"radius.*-1"),
        (lambda: CircleReference([0, 0], 1.0, 0.0), "period"),
        (
            lambda: LineReference([1.0], [2.0], LIMITS, order=3).derivatives([4]),
            r"LineReference.*order=4",
        ),
    ],
)
def test_refusals(make, message):
    with pytest.raises(ReferenceSignalError, match=message):
        make()


def test_a_spline_is_that_of_another_source():
    """With the same points and knots; the ends are held by repeated points."""
    random = np.random.default_rng(1)
    points = random.normal(size=(9, 2))
    # By the recursion of Cox and de Boor.
    held = np.pad(points, ((3, 3), (0, 0)), mode="edge")

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
    values = uniform_spline(points, 0.25, 1.0, 3, [3, 1]).at(np.array(times))
    for time, found in zip(times, values, strict=True):
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
CURVE = PathLimits(0.2, 1.0, 10.0)


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


@pytest.mark.parametrize("limits", [CURVE, PathLimits(2.0, 0.5), PathLimits(2.0, 9.0, 1.0)])
def test_limits_of_a_curve_are_kept_and_one_is_reached(limits):
    path = WaypointsReference(POINTS, limits=limits, order=3)
    function = path.derivatives([3, 3])
    found = [
        np.reshape(function(t), (2, 4))[:, 1:].copy() for t in np.linspace(0, path.duration, 5001)
    ]
    share = np.linalg.norm(found, axis=1).max(axis=0) / limits.values
    assert np.all(share <= 1.0)
    assert share.max() > 0.99
