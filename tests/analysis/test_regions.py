"""Regions and given states at which a system is analyzed."""

import casadi as ca
import numpy as np
import pytest
from problems import (
    PROBLEMS,
)
from problems.found import NO, findings

from drake_dae.analysis import analyze
from drake_dae.dae import DaeSystem, Manifold, Region


def test_a_region_bounds_all_states():
    """The pendulum with y in [-0.5, -0.2]: x follows from the rod, the velocities are free."""
    system = PROBLEMS["pendulum"]().system
    analysis = analyze(system, region={"y": (-0.5, -0.2), "x": (0.0, 1.0)})
    x, y = analysis.states[:, 0], analysis.states[:, 1]
    assert len(y) > 40
    np.testing.assert_array_less(np.abs(y + 0.35), 0.15 + 1e-6)
    assert np.ptp(y) > 0.2
    np.testing.assert_allclose(x, np.sqrt(0.64 - y**2), rtol=1e-5)
    # B = y^2 / (m L^2) is least at the upper edge.
    margin = analysis.assumptions[4].margin
    assert margin.singular_value == pytest.approx(0.04 / (2.0 * 0.64), rel=1e-4)
    assert analysis.where.endswith("with y in [-0.5, -0.2], x in [0, 1]")


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


def test_a_region_is_covered_whatever_the_constraints_move():
    """A point on a circle: B = -y vanishes at (-1, 0) and (1, 0)."""
    circle = DaeSystem.from_functions(
        ["x", "y"],
        f=lambda s: [0, 0],
        g=lambda s: [2 * s[0], 2 * s[1]],
        h=lambda s: [-s[1], s[0]],
        k=lambda s: [s[0] ** 2 + s[1] ** 2 - 1],
        l=lambda s: [s[0]],
        m=lambda s: [[0]],
        nominal_state=[0.6, 0.8],
    )
    analysis = analyze(circle, region={"x": (-1.1, 1.1)})
    assert np.ptp(analysis.states[:, 0]) > 1.8
    assert NO in findings(analysis)


def circle() -> Manifold:
    x = ca.SX.sym("x", 2)
    system = DaeSystem(
        state=x,
        f=[0, 0],
        g=[1, 0],
        h=[0, 1],
        k=ca.sumsqr(x) - 1,
        l=x[1],
        m=[0],
        name="circle",
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
        region = Region(np.array([-2.0, -2.0]), np.array([high, 2.0]))
        found = region.descend(circle(), distance, start)
        assert np.linalg.norm(found) == pytest.approx(1.0, abs=1e-12)
        np.testing.assert_allclose(found, end, atol=1e-5)
