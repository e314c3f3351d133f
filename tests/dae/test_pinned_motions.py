"""Pinned motions against closed forms, and how far they go: reach, singularity, growth, domain."""

import casadi as ca
import numpy as np
import pytest
from problems import PROBLEMS, reference_at, wanted_outputs
from problems.zero_systems import GRAVITY, Array, cart_pendulum, derivatives, free_arm, internal
from runs import some
from scipy.integrate import solve_ivp

from drake_dae.dae import DaeSystem, EndCause, ZeroDynamics
from drake_dae.errors import NonFiniteError


@pytest.mark.slow
@pytest.mark.equation(36)
@pytest.mark.parametrize("problem", some(PROBLEMS, of=3, first=1), indirect=True)
def test_outputs_and_constraints_hold_on_the_whole_motion(problem):
    """By the closed forms of the problem: k and its derivatives, z = l + m (alpha + beta u)."""
    system, times = problem.system, np.linspace(0.0, problem.horizon, 13)
    start = problem.consistent(np.random.default_rng(3))
    motion = ZeroDynamics(system).motion(lambda t: reference_at(problem, t), times, start)
    assert motion.ending is None
    np.testing.assert_array_equal(motion.times, times)
    numbers = ca.Function(
        "lm", [system.state, system.parameter_symbol], [ca.densify(system.l), ca.densify(system.m)]
    )
    for i, x in enumerate(motion.states):
        # Round-off of numbers of order 10.
        np.testing.assert_allclose(problem.derivatives(x), 0.0, atol=1e-13)
        known = problem.known(x)
        force = known.alpha + known.beta @ motion.controls[i]
        np.testing.assert_allclose(motion.constraint_inputs[i], force, rtol=1e-10, atol=1e-10)
        el, em = (np.array(e) for e in numbers(x, system.parameter_values))
        # The promise of 1e-9; Newton's method leaves 1e-12 of a state.
        wanted = wanted_outputs(problem, times[[i]])[0]
        np.testing.assert_allclose(el[:, 0] + em @ force, wanted, rtol=0, atol=1e-9)


@pytest.mark.parametrize("angle", [0.0, 0.4])
@pytest.mark.equation(35)
def test_the_internal_motion_of_a_pendulum_on_a_moved_cart(angle):
    """Against L a'' = g sin a - s'' cos a, written and integrated in the angle."""
    system = cart_pendulum(angle=angle)
    reference = derivatives(lambda t: [0.3 * ca.cos(2.0 * t)], (2,))
    times = np.linspace(0.0, 2.0, 21)
    motion = ZeroDynamics(system).motion(reference, times)
    assert motion.ending is None

    def angle_rate(t, a):
        pushed = GRAVITY * np.sin(a[0]) - reference(t)[2] * np.cos(a[0])
        return [a[1], pushed / 0.7]

    expected = solve_ivp(
        angle_rate, (0, 2), [angle, 0.0], "DOP853", times, rtol=1e-11, atol=1e-12
    ).y
    found = np.arctan2(motion.states[:, 1] - motion.states[:, 0], motion.states[:, 2])
    # Errors of 1e-9 a step grow by exp(sqrt(g/L) 2 s) = 1800 before it falls over.
    np.testing.assert_allclose(np.exp(1j * found), np.exp(1j * expected[0]), rtol=0, atol=2e-5)
    np.testing.assert_allclose(motion.states[:, 0], 0.3 * np.cos(2.0 * times), atol=1e-11)


def test_a_reference_out_of_reach_ends_the_motion_where_the_arm_is_straight():
    """Radially from 1.2 m at 0.3 m/s: the arm of 1.8 m is straight after 2 s."""
    dynamics = ZeroDynamics(free_arm())
    direction = np.array([0.6, 0.8])
    times = np.linspace(0.0, 3.0, 31)
    reference = derivatives(lambda t: [(1.2 + 0.3 * t) * d for d in direction], (2, 2))
    motion = dynamics.motion(reference, times)
    assert (motion.ending.cause, motion.ending.matrix) == (EndCause.OUT_OF_REACH, "B")
    # A step below a millionth of the grid's ends the search: twice that is not tried any more.
    assert motion.ending.time == pytest.approx(2.0, abs=2e-6 * 0.1)
    np.testing.assert_allclose(motion.times, times[times < 2.0 - 1e-9])
    # B is the Jacobian of the tip: its determinant is l1 l2 sin q2, its size that of its entries.
    elbow = np.arccos((np.square(1.2 + 0.3 * motion.times) - 1.0 - 0.64) / 1.6)
    np.testing.assert_allclose(motion.states[:, 1], elbow, rtol=1e-9)
    jacobians = [tip_jacobian(q) for q in motion.states]
    singular = np.linalg.svd(jacobians, compute_uv=False)
    np.testing.assert_allclose(motion.control_margins, singular[:, -1], rtol=1e-9)
    assert np.all(np.diff(motion.control_margins[-5:]) < 0.0)


def tip_jacobian(q: Array) -> Array:
    s1, c1, s12, c12 = np.sin(q[0]), np.cos(q[0]), np.sin(q[0] + q[1]), np.cos(q[0] + q[1])
    return np.array([[-s1 - 0.8 * s12, -0.8 * s12], [c1 + 0.8 * c12, 0.8 * c12]])


def test_the_guess_decides_which_solution_is_followed():
    dynamics = ZeroDynamics(free_arm())
    reference = derivatives(lambda t: [1.2 + 0.3 * ca.sin(t), 0.5 * ca.cos(t)], (2, 2))
    times = np.linspace(0.0, 6.0, 25)
    up, down = (
        dynamics.motion(reference, times, [0.3, elbow, 0.0, 0.0]).states for elbow in (1.0, -1.0)
    )
    assert up.shape == down.shape == (25, 4)
    assert np.all(up[:, 1] > 0.1)
    # Mirrored at the line to the tip.
    np.testing.assert_allclose(down[:, 1], -up[:, 1], rtol=1e-9)
    # A coarse grid makes more steps between its times, not other jumps.
    coarse = dynamics.motion(reference, times[::12], [0.3, 1.0, 0.0, 0.0]).states
    np.testing.assert_allclose(coarse, up[::12], rtol=1e-9, atol=1e-9)


@pytest.mark.slow
def test_unstable_zero_dynamics_end_the_motion_in_growth():
    """s' = s: exp(t) is 1e8 at t = 18.4; s' = s^2 is infinite at t = 1."""
    still = derivatives(lambda t: [0], (1,))
    times = np.linspace(0.0, 30.0, 31)
    slow = ZeroDynamics(internal(lambda s, z: s)).motion(still, times)
    assert slow.ending.cause is EndCause.UNBOUNDED
    assert slow.times[-1] == pytest.approx(np.floor(8.0 * np.log(10.0)))
    # 1e-8 a step, 500 steps.
    np.testing.assert_allclose(slow.states[:, 1], np.exp(slow.times), rtol=5e-6)
    fast = ZeroDynamics(internal(lambda s, z: s**2)).motion(still, np.linspace(0.0, 2.0, 21))
    assert fast.ending.cause is EndCause.UNBOUNDED
    assert fast.ending.time == pytest.approx(1.0, abs=1e-5)
    np.testing.assert_allclose(fast.states[:, 1], 1 / (1 - fast.times), rtol=1e-6)


def test_motions_end_where_domain_and_reference_do():
    tank = DaeSystem.from_functions(
        ["h"],
        f=lambda x: -ca.sqrt(x[0]),
        h=lambda x: 1,
        l=lambda x: x[0],
        nominal_state=[1.0],
        name="tank",
    )
    dynamics, times = ZeroDynamics(tank), np.linspace(0.0, 2.0, 21)
    motion = dynamics.motion(derivatives(lambda t: [1 - 1.003 * t], (1,)), times)
    assert motion.ending.cause is EndCause.NO_WAY_ON
    assert motion.ending.time == pytest.approx(1 / 1.003, abs=1e-6)
    assert motion.times.size == 10

    def short(t: float) -> Array:
        return np.array([1.0, 0.0]) if t <= 1.0 else np.array([np.nan, 0.0])

    motion = dynamics.motion(short, times)
    assert motion.ending.cause is EndCause.REFERENCE_NOT_FINITE
    assert motion.times[-1] == 1.0

    def raising(t: float) -> Array:
        if t > 1.0:
            raise NonFiniteError("reference: over", t, [0.0])
        return np.array([1.0, 0.0])

    assert str(dynamics.motion(raising, times).ending) == "reference: over"
