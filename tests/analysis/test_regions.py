"""The way downhill between the random states at which a system is analyzed."""

import casadi as ca
import numpy as np
import pytest

from drake_dae.dae import DaeSystem, Manifold
from drake_dae.dae.samples import Samples


def circle() -> Manifold:
    x = ca.SX.sym("x", 2)
    system = DaeSystem(
        state=x, f=[0, 0], g=[1, 0], h=[0, 1], k=ca.sumsqr(x) - 1, l=x[1], m=[0], name="circle"
    )
    return Manifold(system, [[system.k]])


def test_downhill_along_the_manifold():
    """|x - (0.6, 0.8)|, on the unit circle, from the other side: to the zero, or to the edge."""
    goal = np.array([0.6, 0.8])

    def distance(state):
        offset = state - goal
        size = float(np.linalg.norm(offset))
        return size, offset / size if size else offset

    start = np.array([-0.8, 0.6])
    for high, end in ((2.0, goal), (0.28, np.array([0.28, 0.96]))):
        samples = Samples(circle(), start[None])
        samples.states = np.array([[-2.0, -2.0], [high, 2.0]])  # Which span the box.
        found = samples.descend(distance, start)
        assert np.linalg.norm(found) == pytest.approx(1.0, abs=1e-12)
        np.testing.assert_allclose(found, end, atol=1e-5)
