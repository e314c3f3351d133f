"""Smooth curves through points: where they are when, how smooth, and how fast."""

import numpy as np
import pytest

from drake_dae import PointToPointReference, WaypointsReference
from drake_dae.references import PathLimits

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
