"""Zero dynamics: eigenvalues against pencils and by hand, and verdicts on stability."""

import casadi as ca
import numpy as np
import pytest
import scipy.linalg
from problems import PROBLEMS
from problems.zero_systems import GRAVITY, Array, assert_same_numbers, cart_pendulum, spring_masses
from runs import some

from drake_dae.dae import DaeSystem, Verdict, ZeroDynamics


def finite_zeros(system: DaeSystem) -> Array:
    """Invariant zeros of a linear system (1)-(3): s where its pencil in (x, v, u) loses rank."""
    x, m, p = system.state, system.num_constraints, system.num_controls

    def slope(expression: ca.SX) -> Array:
        return np.array(ca.DM(ca.jacobian(expression, x)))

    g, h, feedthrough = (np.array(ca.DM(ca.densify(e))) for e in (system.g, system.h, system.m))
    pencil = np.block(
        [
            [slope(system.f), g, h],
            [slope(system.k), np.zeros((m, m + p))],
            [slope(system.l), feedthrough, np.zeros((p, p))],
        ]
    )
    states = np.zeros_like(pencil)
    states[: x.numel(), : x.numel()] = np.eye(x.numel())
    alpha, beta = scipy.linalg.eigvals(pencil, states, homogeneous_eigvals=True)
    # The infinite ones come as beta of the size of round-off, to a power 1/6 as they are defective.
    finite = np.abs(beta) > 1e-6 * np.abs(alpha)
    return alpha[finite] / beta[finite]


def linear_system(seed: int, n: int = 7, m: int = 1, p: int = 2) -> DaeSystem:
    """Numbers without structure: r = 1, mu = 1, so n - m - p zeros."""
    random = np.random.default_rng(seed)
    x = ca.SX.sym("x", n)
    f, k, el = random.normal(size=(n, n)), random.normal(size=(m, n)), random.normal(size=(p, n))
    g, h = random.normal(size=(n, m)), random.normal(size=(n, p))
    return DaeSystem(
        state=x, f=f @ x, g=g, h=h, k=k @ x, l=el @ x, m=np.zeros((p, m)), name="linear"
    )


@pytest.mark.slow
@pytest.mark.parametrize("seed", some(range(8), of=3))
def test_eigenvalues_of_linear_systems_are_their_invariant_zeros(seed):
    system = linear_system(seed, n=7 + seed % 3, m=seed % 3)
    dynamics = ZeroDynamics(system)
    zeros = finite_zeros(system)
    assert zeros.shape == (dynamics.dimension,) == (system.num_states - 2 - seed % 3,)
    stability = dynamics.stability()
    found = stability.eigenvalues
    # The pencil's infinite zeros are defective and spoil the finite ones a little.
    assert_same_numbers(found, zeros, rtol=1e-7, atol=1e-7)
    assert np.all(np.diff(found.real) <= 0.0)
    stable = np.max(zeros.real) < 0.0
    assert stability.verdict == (Verdict.STABLE if stable else Verdict.UNSTABLE)


def test_pendulum_on_a_cart_is_not_minimum_phase():
    """Upright +- sqrt(g/L); hanging +- i sqrt(g/L), or damped."""
    rate = np.sqrt(GRAVITY / 0.7)
    upright = ZeroDynamics(cart_pendulum()).stability()
    # Rod and cart in Cartesian coordinates, ten operations.
    np.testing.assert_allclose(upright.eigenvalues, [rate, -rate], rtol=1e-10)
    assert upright.verdict is Verdict.UNSTABLE
    assert upright.reason.startswith("non-minimum phase")
    assert "3.744 1/s" in upright.reason
    assert "s = 0.3" in upright.reason

    hanging = ZeroDynamics(cart_pendulum(angle=np.pi)).stability()
    assert_same_numbers(hanging.eigenvalues, np.array([1j, -1j]) * rate, rtol=1e-10, atol=1e-10)
    assert hanging.verdict is Verdict.UNDECIDED
    assert "2 of 2" in hanging.reason

    # L a'' = -g a - d L a', found from a start beside it.
    swung = ZeroDynamics(cart_pendulum(damping=0.8, angle=2.8)).stability()
    assert_same_numbers(swung.eigenvalues, np.roots([1.0, 0.8, rate**2]), rtol=1e-10)
    assert swung.verdict is Verdict.STABLE
    np.testing.assert_allclose(swung.state[:3], [0.3, 0.3, -0.7], rtol=0, atol=1e-10)


@pytest.mark.parametrize("damping", [0.0, 1e-6, 0.1, -1e-6])
def test_a_center_is_undecided_and_the_least_damping_is_not(damping):
    """2 q2'' + d q2' + 8 q2 = 8 q1."""
    dynamics = ZeroDynamics(spring_masses(damping))
    stability = dynamics.stability([0.3, 0.2, 0.1, 0.1])
    np.testing.assert_allclose(stability.state, [0.3, 0.3, 0, 0], atol=1e-12)
    assert_same_numbers(
        stability.eigenvalues, np.roots([2.0, damping, 8.0]) + 0j, rtol=0, atol=1e-13
    )
    expected = {0.0: Verdict.UNDECIDED, -1e-6: Verdict.UNSTABLE}
    assert stability.verdict is expected.get(damping, Verdict.STABLE)


@pytest.mark.parametrize(
    ("name", "verdict"), [("linear", Verdict.STABLE), ("aircraft", Verdict.UNSTABLE)]
)
def test_the_verdict_is_that_of_the_literature(name, verdict):
    stability = ZeroDynamics(PROBLEMS[name]().system).stability()
    assert stability.verdict is verdict
    if name == "aircraft":  # e roll'' = sin roll with e = 0.5.
        expected = [-np.sqrt(2.0), np.sqrt(2.0)]
        np.testing.assert_allclose(np.sort_complex(stability.eigenvalues), expected, rtol=1e-7)
