"""N*: residuals and projections by hand, and starts, settled with the least kinetic energy."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from problems import PROBLEMS, Problem, pendulum, system_of

from drake_dae.dae import DaeSystem, Manifold, Signal, find_constraint_structure, find_structure
from drake_dae.errors import InconsistentStateError, ModelError

CONSTRAINED = [name for name, make in PROBLEMS.items() if make().constraint_degrees]


@pytest.fixture(params=CONSTRAINED)
def problem(request) -> Problem:
    return PROBLEMS[request.param]()


def manifold_of(k, n: int = 2, **parameters: float) -> Manifold:
    """{x in R^n: k(x) = 0}."""
    system = DaeSystem.from_functions(
        n,
        f=lambda x, *p: [0] * n,
        h=lambda x, *p: np.eye(n)[:, :1],
        g=lambda x, *p: np.zeros((n, ca.vertcat(*_list(k(x, *p))).numel())),
        k=k,
        l=lambda x, *p: x[0],
        m=lambda x, *p: np.zeros((1, ca.vertcat(*_list(k(x, *p))).numel())),
        parameters=parameters,
        name="curve",
    )
    return Manifold(system, [[system.k[i]] for i in range(system.num_constraints)])


def _list(value) -> list:
    return list(value) if isinstance(value, (list, tuple)) else [value]


def circle(**parameters: float) -> Manifold:
    return manifold_of(lambda x, p: x[0] ** 2 + x[1] ** 2 - p.radius**2, **parameters)


@pytest.mark.slow
@pytest.mark.equation(4, 42)
def test_residual_and_dimension_are_those_found_by_hand(problem):
    manifold = problem.structure.manifold
    assert manifold.dimension == problem.manifold_dimension
    random = np.random.default_rng(0)
    for _ in range(3):
        state = random.standard_normal(problem.system.num_states)
        # A few operations on numbers of order 1.
        np.testing.assert_allclose(
            manifold.residual(state), problem.derivatives(state), rtol=1e-14, atol=1e-14
        )
        consistent = problem.consistent(random)
        np.testing.assert_allclose(manifold.residual(consistent), 0.0, atol=1e-14)


@pytest.mark.slow
def test_projection_reaches_the_manifold_to_round_off(problem):
    manifold = problem.structure.manifold
    random = np.random.default_rng(1)
    for size in (1e-9, 1e-6, 1e-3, 1e-1):
        start = problem.consistent(random)
        start = start + size * random.standard_normal(start.size)
        state = manifold.project(start)
        # Newton's method ends at the round-off of the residual, of numbers of order 1.
        np.testing.assert_allclose(problem.derivatives(state), 0.0, atol=5e-15)
        # The nearest state is at most as far as the one that the start was made from, up to the
        # curvature of N*.
        assert np.linalg.norm(state - start) < 3 * size * np.sqrt(start.size)


def test_projection_follows_the_parameters():
    manifold = circle(radius=2.0)
    assert np.hypot(*manifold.project([1.0, 1.0])) == pytest.approx(2.0, abs=1e-15)
    assert np.hypot(*manifold.project([1.0, 1.0], [3.0])) == pytest.approx(3.0, abs=1e-15)
    assert manifold.residual([1.0, 1.0], [3.0]) == pytest.approx([-7.0])


@pytest.mark.parametrize(
    "k",
    [
        lambda x: [x[0] - 1, x[0] - 1],
        lambda x: [x[0] - 1, 3 * (x[0] - 1) * (1 + 1e-13 * x[1])],
        lambda x: [ca.sin(x[0]) - 0.5, ca.sin(x[0]) ** 2 - 0.25],
    ],
)
def test_redundant_constraints_still_have_a_projection(k):
    """QR has no step where gradients depend on each other; least squares have."""
    manifold = manifold_of(k)
    state = manifold.project([0.3, 0.2])
    np.testing.assert_allclose(manifold.residual(state), 0.0, atol=1e-14)


def test_failures_say_what_is_left_and_why():
    with pytest.raises(InconsistentStateError, match="y0 = 1") as caught:
        manifold_of(lambda x: x[0] ** 2 + 1).project([0.3, 0.0])
    assert caught.value.residual == pytest.approx([1.0], abs=0.01)
    with pytest.raises(InconsistentStateError, match=r"y[01] = -?0\.5 "):
        manifold_of(lambda x: [x[0] - 1, x[0] - 2]).project([0.0, 0.0])
    with pytest.raises(InconsistentStateError, match="y0"):
        manifold_of(lambda x: ca.sqrt(x[0]) - 1).project([-1.0, 0.0])
    with pytest.raises(InconsistentStateError, match="y0"):
        circle(radius=1.0).project([np.nan, 0.0])
    # The gradient vanishes at the centre of the circle.
    with pytest.raises(InconsistentStateError, match="y0 = -4"):
        circle(radius=2.0).project([0.0, 0.0])


def test_a_given_start_is_settled_level_by_level():
    """A fast pendulum whose velocity is 1e-6 off: the position that was right stays as it is.

    The velocity loses its part along the rod, as it would by hand. A joint step of least norm moves
    the position by some 1e-9 instead, since the velocity is large.
    """
    # Sizes that are alike, so that no direction in space is preferred.
    system = replace(pendulum().system, state_scale=np.ones(4))
    manifold = find_structure(system).manifold
    x = manifold.project([0.6, 0.8, 120.0, -90.0])
    wrong = x + np.array([0.0, 0.0, 1e-6, 0.0])
    found = manifold.settle(wrong)
    np.testing.assert_array_equal(found[:2], wrong[:2])
    along = wrong[:2] / np.linalg.norm(wrong[:2])
    np.testing.assert_allclose(
        found[2:], wrong[2:] - along * (along @ wrong[2:]), rtol=0, atol=1e-13
    )
    assert np.abs(manifold.project(wrong)[:2] - wrong[:2]).max() > 1e-10
    assert np.max(np.abs(manifold.residual(found))) < 1e-13


@pytest.mark.parametrize("off", [0.0, 1e-15, 1e-9, 1e-6])
def test_a_state_near_a_pole_of_a_constraint_is_not_consistent(off):
    """k = 2 tan(q / 2) at half a turn: Newton's step is sin q, the residual is huge."""
    turned = find_structure(
        system_of(
            4,
            f=lambda x: [x[1], 0, x[3], 0],
            g=lambda x: [0, 1, 0, 0],
            h=lambda x: [0, 0, 0, 1],
            k=lambda x: 2 * ca.tan(x[0] / 2),
            l=lambda x: x[2],
            m=lambda x: 0,
        )
    ).manifold
    start = np.array([np.pi - off, 0.0, 0.3, 0.1])
    assert not turned.is_consistent(start)
    if off < 1e-12:
        with pytest.raises(InconsistentStateError) as caught:
            turned.project(start)
        assert np.max(np.abs(caught.value.residual)) > 1.0
    else:  # Newton's steps double, and lead away from the pole.
        np.testing.assert_allclose(turned.residual(turned.project(start)), 0.0, atol=1e-12)
    found = turned.settle(start)  # Which starts again elsewhere.
    assert abs(np.sin(found[0] / 2)) < 1e-12
    assert turned.is_consistent(found)
    np.testing.assert_allclose(turned.project([1.0, 0.2, 0.3, 0.1])[:2], 0.0, atol=1e-12)


def crank():
    """Two bodies of 1 and 100 kg on a line, of which one pulls the other by a gear of 2.

    Least kinetic energy would keep the heavy one.
    """
    x, v = ca.SX.sym("x", 2), ca.SX.sym("v", 2)
    system = DaeSystem(
        name="gear",
        state=ca.vertcat(x, v),
        f=ca.vertcat(v, 0, 0),
        g=ca.vertcat(0, 0, 1, -0.02),
        h=ca.SX(4, 0),
        k=x[0] - 2 * x[1] + 0.1 * ca.sin(x[0]),
        l=ca.SX(0, 1),
        m=ca.SX(0, 1),
        state_signals=[Signal(name, "m") for name in ("x", "y", "x_v", "y_v")],
        nominal_state=np.zeros(4),
    )
    return find_constraint_structure(system).manifold


def test_a_velocity_that_is_given_is_kept_and_the_others_follow():
    """x' - 2 y' + 0.1 cos(x) x' = 0 at x = 0.3, y = (0.3 + 0.1 sin 0.3) / 2."""
    manifold = crank()
    y = (0.3 + 0.1 * np.sin(0.3)) / 2.0
    found = manifold.settle([0.3, y, 5.24, 0.0])
    np.testing.assert_allclose(found, [0.3, y, 5.24, 5.24 * (1 + 0.1 * np.cos(0.3)) / 2])


def test_states_that_are_fixed_keep_their_values_or_it_says_so():
    manifold = crank()
    found = manifold.settle([0.3, 0.0, 0.0, 1.0], fixed=["x", "y_v"])
    y = (0.3 + 0.1 * np.sin(0.3)) / 2.0
    np.testing.assert_allclose(found, [0.3, y, 2.0 / (1 + 0.1 * np.cos(0.3)), 1.0])
    with pytest.raises(InconsistentStateError, match="x, y"):
        manifold.settle([0.3, 0.0, 0.0, 0.0], fixed=["x", "y"])
    with pytest.raises(ModelError, match="'z'"):
        manifold.settle([0.3, 0.0, 0.0, 0.0], fixed=["z"])


def rod_between_masses(masses=(1.0, 1e4), lengths=(1.0, 1.0)) -> Manifold:
    """Two bodies in the plane at a fixed distance; lengths are the units of their coordinates."""
    x = ca.SX.sym("x", 8)
    q, v = x[:4], x[4:]
    first, second = lengths[0] * q[:2], lengths[1] * q[2:]
    k = ca.sumsqr(first - second) - 1.0
    units = np.repeat(lengths, 2)
    inertia = np.diag(np.repeat(masses, 2) * units**2)
    system = DaeSystem(
        state=x,
        mass_matrix=ca.diagcat(ca.SX.eye(4), ca.SX(inertia)),
        f=ca.vertcat(v, ca.SX(4, 1)),
        g=ca.vertcat(ca.SX(4, 1), ca.jacobian(k, q).T),
        h=ca.SX(8, 0),
        k=k,
        l=ca.SX(0, 1),
        m=ca.SX(0, 1),
        nominal_state=np.array([0.0, 0.0, 0.6, 0.8, 1.0, 2.0, 1.0, 2.0]) / np.tile(units, 2),
    )
    return find_constraint_structure(system).manifold


@pytest.mark.parametrize("lengths", [(1.0, 1.0), (1e-6, 1e2)])
def test_what_is_heavy_stays_in_any_units(lengths):
    """A rod that is too long by 2e-6 m: of it the body of 1 kg moves 1e4 times as far."""
    manifold = rod_between_masses(lengths=lengths)
    units = np.tile(np.repeat(lengths, 2), 2)
    along = np.array([0.6, 0.8])
    start = np.array(
        [0.0, 0.0, *((1.0 + 2e-6) * along), 1.0, 2.0, *(np.array([1, 2]) + 3e-6 * along)]
    )
    found = units * manifold.settle(start / units)
    share = 1e4 / (1.0 + 1e4)
    moved = np.array([*(2e-6 * share * along), *(-2e-6 * (1.0 - share) * along)])
    np.testing.assert_allclose(found[:4] - start[:4], moved, rtol=0, atol=1e-11)
    turned = np.array([*(3e-6 * share * along), *(-3e-6 * (1.0 - share) * along)])
    np.testing.assert_allclose(found[4:] - start[4:], turned, rtol=0, atol=1e-11)
    assert manifold.is_consistent(found / units)
    np.testing.assert_allclose(manifold.residual(found / units), 0.0, atol=1e-14)
