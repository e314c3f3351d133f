"""Texts: where letters stand, where the tool presses, and what cannot be written."""

import numpy as np
import pytest

from drake_dae import PathLimits, TextReference
from drake_dae.errors import ReferenceSignalError

LIMITS = PathLimits(0.3, 4.0)


def course(path, degree=0, count=4001):
    function = path.derivatives([degree] * path.size)
    times = path.start_time + np.linspace(0.0, path.spline.duration, count)
    return np.array([function(t) for t in times]).reshape(count, path.size, degree + 1)


def test_letters_stand_where_they_shall():
    """LI, mirrored: the L is 0.06 m wide and 0.09 m high, and the I as far left of it as 0.03 m."""
    path = TextReference("Li", [0.5, 0.2], 0.09, LIMITS, along=[-1.0, 0.0], corner=1e-3, order=2)
    points = course(path)[:, :, 0]
    np.testing.assert_allclose(points[[0, -1]], [[0.5, 0.29], [0.41, 0.2]], atol=1e-15)
    np.testing.assert_allclose(points.min(axis=0), [0.41, 0.2], atol=1e-12)
    np.testing.assert_allclose(points.max(axis=0), [0.5, 0.29], atol=1e-12)
    for corner in ([0.5, 0.2], [0.44, 0.2], [0.41, 0.29]):
        assert np.linalg.norm(points - corner, axis=1).min() < 5e-4


def test_the_force_is_smaller_between_strokes():
    """TT: the bar and the stem of each, and the way between; the speed is that of the limits."""
    path = TextReference("TT", [0.0, 0.0], 0.1, LIMITS, press=[20.0, 4.0], corner=2e-3)
    found = course(path, degree=2)
    force = found[:, 2, 0]
    assert force.min() == pytest.approx(4.0)
    assert force.max() == pytest.approx(20.0)
    x, y = found[:, :2, 0].T
    bar = (np.abs(y - 0.1) < 1e-12) & (x > 0.01) & (x < 0.05)
    np.testing.assert_allclose(force[bar], 20.0, rtol=1e-12)
    assert np.linalg.norm(found[:, :2, 1], axis=1).max() <= 0.3
    assert np.linalg.norm(found[:, :2, 2], axis=1).max() <= 4.0


def test_all_letters_have_the_given_height():
    for letter in "ABCDEFGHIJKLMNOPQRSTUVWXYZ0123456789":
        path = TextReference(letter, [0.0, 0.0], 1.0, LIMITS, corner=0.01, order=2)
        points = course(path, count=401)[:, :, 0]
        assert points.min() > -1e-12
        assert points[:, 1].max() == pytest.approx(1.0, abs=0.02), letter


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"text": " "}, "text: empty, at least one letter is needed"),
        ({"text": "é"}, "text: no letter 'É'; there are ABC"),
        ({"height": 0.0}, "height must be positive, got 0"),
        ({"up": [2.0, 0.0]}, r"along and up must be two directions, got \(1\.0, 0\.0\) and"),
        ({"origin": [1.0]}, r"origin must be .* shape \(2,\)"),
        ({"press": 5.0}, r"press must be .* shape \(2,\)"),
        ({"corner": -1.0}, "corner must be positive, got -1"),
    ],
)
def test_refusals(changes, message):
    given = {"text": "A", "origin": [0.0, 0.0], "height": 0.1, "limits": LIMITS, **changes}
    with pytest.raises(ReferenceSignalError, match=message):
        TextReference(**given)
