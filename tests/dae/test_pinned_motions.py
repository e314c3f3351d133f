"""Pinned motions against closed forms."""

import casadi as ca
import numpy as np
import pytest
from problems import PROBLEMS, Problem, reference_at, wanted_outputs
from problems.zero_systems import GRAVITY, Array, cart_pendulum, derivatives, zero_dynamics
from runs import some
from scipy.integrate import solve_ivp

from drake_dae.dae import PinnedMotion, ZeroDynamics


def following(problem: Problem, count: int = 13) -> tuple[ZeroDynamics, Array, PinnedMotion]:
    """A problem's reference from a random start, without failure."""
    times = np.linspace(0.0, problem.horizon, count)
    dynamics = zero_dynamics(problem.system)
    start = problem.consistent(np.random.default_rng(3))
    motion = dynamics.motion(lambda t: reference_at(problem, t), times, start)
    assert motion.ending is None
    np.testing.assert_array_equal(motion.times, times)
    return dynamics, times, motion


@pytest.mark.slow
@pytest.mark.equation(36)
@pytest.mark.parametrize("problem", some(PROBLEMS, of=3, first=1), indirect=True)
def test_outputs_and_constraints_hold_on_the_whole_motion(problem):
    """By the closed forms of the problem: k and its derivatives, z = l + m (alpha + beta u)."""
    _, times, motion = following(problem)
    system = problem.system
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
    motion = zero_dynamics(system).motion(reference, times)
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
