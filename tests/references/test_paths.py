"""Lines and circles: where they go, how fast, and that they rest at both ends."""

from math import factorial

import numpy as np
import pytest

from drake_dae import CircleReference, LineReference
from drake_dae.errors import ReferenceSignalError
from drake_dae.references import PathLimits

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
        (lambda: CircleReference([0, 0], 1.0, 2.0).travel, "limits"),
        (
            lambda: LineReference([1.0], [2.0], LIMITS, order=3).derivatives([4]),
            r"LineReference.*order=4",
        ),
    ],
)
def test_refusals(make, message):
    with pytest.raises(ReferenceSignalError, match=message):
        make()
