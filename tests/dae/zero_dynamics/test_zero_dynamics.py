"""Zero dynamics: eigenvalues against pencils and closed loops, and verdicts on stability."""

import casadi as ca
import numpy as np
import pytest
import scipy.linalg
from arms import touching
from problems import (
    PROBLEMS,
    in_other_units,
)
from problems.zero_systems import (
    GRAVITY,
    NON_MINIMUM_PHASE,
    Array,
    aircraft,
    assert_same_numbers,
    cart_pendulum,
    quadruple_tank,
    spring_masses,
    zero_dynamics,
)
from runs import some

from drake_dae.dae.system.system import DaeSystem
from drake_dae.dae.tracking.gains import poles
from drake_dae.dae.tracking.tracking import TrackingLaw
from drake_dae.dae.zero_dynamics.stability import Verdict
from drake_dae.robots.actuation.flexible_joints import FlexibleJoints


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
    dynamics = zero_dynamics(system)
    zeros = finite_zeros(system)
    assert zeros.shape == (dynamics.dimension,) == (system.num_states - 2 - seed % 3,)
    found = dynamics.eigenvalues(np.zeros(system.num_states))
    # The pencil's infinite zeros are defective and spoil the finite ones a little.
    assert_same_numbers(found, zeros, rtol=1e-7, atol=1e-7)
    assert np.all(np.diff(found.real) <= 0.0)
    stability = dynamics.stability()
    stable = np.max(zeros.real) < 0.0
    assert stability.verdict == (Verdict.STABLE if stable else Verdict.UNSTABLE)


def test_zeros_with_feedthrough():
    """z2 = L2 x + M2 v is met at once: r = (1, 1), mu = (1, 0)."""
    problem = PROBLEMS["linear"]()
    dynamics = zero_dynamics(problem.system)
    found = dynamics.eigenvalues(np.zeros(6))
    assert_same_numbers(found, finite_zeros(problem.system), rtol=1e-8)
    # Anywhere the outputs put it, too: the linear system at rest with outputs (0.3, -0.2).
    rest = dynamics.equilibrium([0.3, -0.2])
    np.testing.assert_allclose(problem.derivatives(rest), 0.0, atol=1e-12)
    assert_same_numbers(dynamics.eigenvalues(rest), found, rtol=1e-8)


@pytest.mark.slow
@pytest.mark.parametrize(("name", "size"), [("two_link", 2), ("seven_joint", 7)])
def test_damped_flexible_joints_leave_their_deflections(name, size):
    """K d + D d' = tau: the eigenvalues of -D^-1 K, whatever links and motors do."""
    random = np.random.default_rng(1)

    def positive(scale: float) -> Array:
        root = np.eye(size) + 0.2 * random.normal(size=(size, size))
        return scale * root @ root.T

    stiffness, damping = positive(8000.0), positive(20.0)
    model = touching(name, [FlexibleJoints(stiffness, np.eye(size), damping)])
    dynamics = zero_dynamics(model.dae)
    assert dynamics.dimension == size
    stability = dynamics.stability()
    assert stability.verdict is Verdict.STABLE
    assert "minimum phase" in stability.reason
    expected = np.linalg.eigvals(-np.linalg.solve(damping, stiffness))
    # A state of 28 numbers, and forces that are differences of large ones.
    assert_same_numbers(stability.eigenvalues, expected + 0j, rtol=1e-8)
    rate, still = np.split(stability.state.reshape(4, size), 2)[0][1], stability.state[-size:]
    np.testing.assert_allclose([rate, still], 0.0, atol=1e-10)


def test_pendulum_on_a_cart_is_not_minimum_phase():
    """Upright +- sqrt(g/L); hanging +- i sqrt(g/L), or damped."""
    rate = np.sqrt(GRAVITY / 0.7)
    upright = zero_dynamics(cart_pendulum()).stability()
    # Rod and cart in Cartesian coordinates, ten operations.
    np.testing.assert_allclose(upright.eigenvalues, [rate, -rate], rtol=1e-10)
    assert upright.verdict is Verdict.UNSTABLE
    assert upright.reason.startswith("non-minimum phase")
    assert "3.744 1/s" in upright.reason
    assert "s = 0.3" in upright.reason

    hanging = zero_dynamics(cart_pendulum(angle=np.pi)).stability()
    assert_same_numbers(hanging.eigenvalues, np.array([1j, -1j]) * rate, rtol=1e-10, atol=1e-10)
    assert hanging.verdict is Verdict.UNDECIDED
    assert "2 of 2" in hanging.reason

    # L a'' = -g a - d L a', found from a start beside it.
    swung = zero_dynamics(cart_pendulum(damping=0.8, angle=2.8)).stability()
    assert_same_numbers(swung.eigenvalues, np.roots([1.0, 0.8, rate**2]), rtol=1e-10)
    assert swung.verdict is Verdict.STABLE
    np.testing.assert_allclose(swung.state[:3], [0.3, 0.3, -0.7], rtol=0, atol=1e-10)


@pytest.mark.slow
@pytest.mark.parametrize("epsilon", [0.01, 0.25, 4.0])
def test_the_aircraft_is_not_minimum_phase(epsilon):
    """eps a'' = sin a (Hauser, Sastry and Meyer, 1992, section 3)."""
    rate = 1 / np.sqrt(epsilon)
    stability = zero_dynamics(aircraft()).stability(parameters=[epsilon])
    np.testing.assert_allclose(stability.eigenvalues, [rate, -rate], rtol=1e-12)
    assert stability.verdict is Verdict.UNSTABLE
    # Upside down it is a center.
    down = zero_dynamics(aircraft()).stability([0, 0, 3.0, 0, 0, 0], [epsilon])
    np.testing.assert_allclose(down.state[2], np.pi, rtol=1e-10)
    assert down.verdict is Verdict.UNDECIDED


@pytest.mark.parametrize("damping", [0.0, 1e-6, 0.1, -1e-6])
def test_a_center_is_undecided_and_the_least_damping_is_not(damping):
    """2 q2'' + d q2' + 8 q2 = 8 q1."""
    dynamics = zero_dynamics(spring_masses(damping))
    stability = dynamics.stability([0.3, 0.2, 0.1, 0.1])
    np.testing.assert_allclose(stability.state, [0.3, 0.3, 0, 0], atol=1e-12)
    assert_same_numbers(
        stability.eigenvalues, np.roots([2.0, damping, 8.0]) + 0j, rtol=0, atol=1e-13
    )
    expected = {0.0: Verdict.UNDECIDED, -1e-6: Verdict.UNSTABLE}
    assert stability.verdict is expected.get(damping, Verdict.STABLE)


def test_slow_modes_beside_fast_ones_are_decided():
    """s1' = -1e5 s1, s2' = -1e-3 s2, coupled: eigenvalues eight orders apart."""
    system = DaeSystem.from_functions(
        3,
        f=lambda x: [0, -1e5 * x[1] + 3e4 * x[2], -1e-3 * x[2]],
        h=lambda x: [1, 2, 3],
        l=lambda x: x[0],
    )
    # z = x0, u = 0 at rest; u also moves x1, x2: x1' ... with u = r' = 0.
    stability = zero_dynamics(system).stability()
    np.testing.assert_allclose(stability.eigenvalues, [-1e-3, -1e5], rtol=1e-9)
    assert stability.verdict is Verdict.STABLE


def test_a_defective_zero_is_undecided():
    """s1' = s2, s2' = s3, s3' = 0 in turned coordinates: round-off alone moves it by 1e-5."""
    turn = np.linalg.qr(np.random.default_rng(2).normal(size=(4, 4)))[0]
    shift = np.zeros((4, 4))
    shift[1, 2] = shift[2, 3] = 1.0
    system = DaeSystem.from_functions(
        4,
        f=lambda x: turn @ shift @ turn.T @ x,
        h=lambda x: turn[:, 0],
        l=lambda x: ca.mtimes(turn[:, :1].T, x),
    )
    stability = zero_dynamics(system).stability()
    assert stability.verdict is Verdict.UNDECIDED
    np.testing.assert_allclose(stability.eigenvalues, 0.0, atol=1e-4)


@pytest.mark.slow
def test_eigenvalues_do_not_depend_on_units():
    system = cart_pendulum(0.3)
    random = np.random.default_rng(0)
    scales = [10.0 ** random.uniform(-3, 3, size) for size in (6, 1, 1, 1, 1)]
    found = zero_dynamics(in_other_units(system, *scales)).stability()
    expected = zero_dynamics(system).stability()
    np.testing.assert_allclose(found.eigenvalues, expected.eigenvalues, rtol=1e-8)
    assert found.verdict is expected.verdict is Verdict.UNSTABLE


@pytest.mark.slow
@pytest.mark.parametrize(
    ("system", "chosen"),
    [
        (cart_pendulum(0.5), [-2.0, -3.0]),
        (cart_pendulum(0.5, np.pi), [-2.0, -3.0]),
        (aircraft(), [-2.0, -3.5]),
        (quadruple_tank(**NON_MINIMUM_PHASE), [-0.7]),
    ],
)
def test_the_closed_loop_has_the_poles_the_zero_dynamics_and_the_constraints(system, chosen):
    """The spectrum of f* + h* u(x) in all of R^n, with u of the law (28).

    It is that on N* - roots of (32) and zero dynamics - and, across N*, where L_f*^(r_i) k_i = 0,
    r_i zeros for each constraint.
    """
    dynamics = zero_dynamics(system)
    structure, degrees = dynamics.structure, dynamics.structure.output_degrees
    law = TrackingLaw(system, poles(chosen), structure=structure)
    rest = dynamics.stability()
    elimination = structure.elimination
    fields = ca.Function(
        "fields",
        [system.state, system.parameter_symbol],
        [ca.densify(elimination.f_star), ca.densify(elimination.h_star)],
    )
    held = [chain[0] for chain in structure.output_chains]
    outputs = ca.Function("outputs", [system.state], [ca.vertcat(*held)])
    values = np.array(outputs(rest.state))[:, 0]
    reference = np.concatenate(
        [[value, *np.zeros(degree)] for value, degree in zip(values, degrees, strict=True)]
    )

    def rate(x: Array) -> Array:
        f, h = (np.array(e) for e in fields(x, system.parameter_values))
        return f[:, 0] + h @ law.control(x, reference)

    step = 1e-4
    slope = np.array(
        [
            8 * (rate(rest.state + step * e) - rate(rest.state - step * e))
            - (rate(rest.state + 2 * step * e) - rate(rest.state - 2 * step * e))
            for e in np.eye(system.num_states)
        ]
    ).T / (12 * step)
    expected = np.concatenate(
        [
            np.repeat(chosen, len(degrees)),
            rest.eigenvalues,
            np.zeros(sum(structure.constraint_degrees)),
        ]
    )
    # Characteristic polynomials, as multiple roots are sensitive; differences are good to 1e-10.
    np.testing.assert_allclose(np.poly(slope), np.poly(expected).real, rtol=1e-6, atol=1e-7)
