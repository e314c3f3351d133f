"""Given states at which a system is analyzed, and the way downhill between random ones."""

import casadi as ca
import numpy as np
import pytest
from problems import PROBLEMS

from drake_dae.analysis import analyze
from drake_dae.dae import DaeSystem, Manifold
from drake_dae.dae.samples import Samples


def test_given_states():
    problem = PROBLEMS["pendulum"]()
    random = np.random.default_rng(0)
    states = np.array([problem.consistent(random) for _ in range(4)])
    analysis = analyze(problem.system, states=states)
    np.testing.assert_allclose(analysis.states, states, atol=1e-12)
    # These alone, nothing between them.
    least = min(problem.known(x).control_matrix.item() for x in states)
    assert analysis.assumptions[4].margin.singular_value == pytest.approx(least, rel=1e-10)
    assert analysis.where == "4 consistent states as given"


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
