"""More controls than outputs: the control next to a free one in a metric."""

import casadi as ca
import numpy as np
import pytest
from numpy.testing import assert_allclose

from drake_dae import DaeSystem, Parameter, TrackingLaw, poles
from drake_dae.trace.factorization import nearest_solution

BY_U = np.array([[1.0, 0.4, -0.7, 0.2], [0.3, -1.1, 0.5, 0.9], [0.2, 0.6, 1.3, -0.8]])
ROOT = np.array(
    [[1.2, 0.0, 0.0, 0.0], [0.3, 0.9, 0.0, 0.0], [-0.2, 0.1, 1.4, 0.0], [0.5, 0.0, 0.2, 1.1]]
)
METRIC = ROOT @ ROOT.T


def sled(**choice) -> DaeSystem:
    """Three masses, four thrusters that move all of them; the third is held on x2 = sin x0.

    With p = (x0, x1, x2) and v = p': p' = v, v' = d(p, v) + G(p)^T lambda + H(p) u, where
    G = (-cos x0, 0, 1); the outputs are x0 and lambda.
    """
    x = ca.SX.sym("x", 6)
    p, v = x[:3], x[3:]
    gradient = ca.vertcat(-ca.cos(p[0]), 0.0, 1.0)
    by_control = ca.SX(BY_U) * (1.0 + 0.1 * p[1])
    drift = ca.vertcat(-ca.sin(p[1]), -p[1] - 0.5 * v[1], -9.81)
    free = Parameter("free", np.zeros(4), "N")
    metric = ca.SX(METRIC) + 0.3 * ca.diag(ca.vertcat(p[0] ** 2, 0.0, 0.0, p[1] ** 2))
    options = {"control_metric": metric, "free_control": free.symbol, **choice}
    return DaeSystem(
        state=x,
        f=ca.vertcat(v, drift),
        g=ca.vertcat(ca.SX(3, 1), gradient),
        h=ca.vertcat(ca.SX(3, 4), by_control),
        k=p[2] - ca.sin(p[0]),
        l=ca.vertcat(p[0], 0.0),
        m=ca.vertcat(0.0, 1.0),
        parameters=(free,),
        name="sled",
        **options,
    )


def by_hand(x, wanted):
    """a, B and W of the sled by NumPy: lambda and x0'' for no control, and for a unit of each."""
    p, v = x[:3], x[3:]
    gradient = np.array([-np.cos(p[0]), 0.0, 1.0])
    columns = BY_U * (1.0 + 0.1 * p[1])
    drift = np.array([-np.sin(p[1]), -p[1] - 0.5 * v[1], -9.81])
    bend = np.sin(p[0]) * v[0] ** 2
    size = gradient @ gradient
    force, by_force = -(gradient @ drift + bend) / size, -(gradient @ columns) / size
    a = np.array([drift[0] + gradient[0] * force, force])
    B = np.vstack([columns[0] + gradient[0] * by_force, by_force])
    W = METRIC + 0.3 * np.diag([p[0] ** 2, 0.0, 0.0, p[1] ** 2])
    inverse = np.linalg.solve(W, B.T) @ np.linalg.inv(B @ np.linalg.solve(W, B.T))
    return inverse @ (wanted - a), np.eye(4) - inverse @ B, W


@pytest.fixture(scope="module")
def law() -> TrackingLaw:
    return TrackingLaw(sled(), poles(-3.0))


def consistent(law, random):
    return law.structure.manifold.project(random.uniform(-1.0, 1.0, 6))


def test_the_nearest_solution_is_that_of_numpy():
    """By the normal equations in NumPy, of matrices with conditions up to 100: 1e-12."""
    random = np.random.default_rng(0)
    for p, size in ((1, 2), (2, 2), (3, 7)):
        B, b = random.standard_normal((p, size)), random.standard_normal(p)
        root, goal = random.standard_normal((size, size)), random.standard_normal(size)
        W = root @ root.T + 0.1 * np.eye(size)
        found, pivot = nearest_solution(*map(ca.SX, (B, b, W, goal)))
        weak = np.linalg.solve(W, B.T)
        expected = goal + weak @ np.linalg.solve(B @ weak, b - B @ goal)
        assert_allclose(ca.DM(found).full().ravel(), expected, rtol=1e-11, atol=1e-11)
        assert 0.0 < float(pivot) <= 1.0
    B[2] = B[0] - B[1]
    assert float(nearest_solution(*map(ca.SX, (B, b, W, goal)))[1]) < 1e-14


def test_the_law_is_the_weighted_right_inverse(law):
    """Against NumPy by hand, with a metric that depends on the state, to round-off."""
    random = np.random.default_rng(1)
    assert law.structure.output_degrees == (2, 0)
    assert law.structure.control_matrix.shape == (2, 4)
    for _ in range(5):
        x, R, free = consistent(law, random), random.uniform(-1, 1, 4), random.uniform(-5, 5, 4)
        ubar = [R[2] - 6.0 * (x[3] - R[1]) - 9.0 * (x[0] - R[0]), R[3]]
        least, onto_null, _ = by_hand(x, np.array(ubar))
        assert_allclose(law.control(x, R), least, rtol=1e-11, atol=1e-11)
        expected = least + onto_null @ free
        assert_allclose(law.control(x, R, parameters=free), expected, rtol=1e-11, atol=1e-11)
