"""What the docstring of `FlexibleJoints` says of late laws, and of tools that friction holds."""

import casadi as ca
import numpy as np
import pytest
import scipy.linalg
from numpy.testing import assert_allclose

from drake_dae import DaeSystem, TrackingLaw, poles

LINKS, ROTORS, SPRINGS = np.array([2.0, 0.3]), np.array([0.5, 0.7]), np.array([900.0, 500.0])


def sprung(links, rotors, springs, outputs) -> DaeSystem:
    """M q'' = K (p - q), M_2 p'' = u - K (p - q), z = C q."""
    n = len(links)
    x, none = ca.SX.sym("x", 4 * n), ca.SX(0, 1)
    q, v, p, rate = ca.vertsplit(x, n)
    force = ca.DM(springs) * (p - q)
    return DaeSystem(
        x,
        ca.vertcat(v, force / ca.DM(links), rate, -force / ca.DM(rotors)),
        ca.SX(4 * n, 0),
        ca.vertcat(ca.SX(3 * n, n), ca.diag(1 / ca.DM(rotors))),
        none,
        ca.mtimes(ca.DM(outputs), q),
        ca.SX(n, 0),
    )


def late(system, law, period, delay):
    """The largest pole of x_(k+1) = exp(A T) x_k + Gamma(T - c) G x_(k-n) + ... of a late law.

    Its control acts from t_k + d on, d = n T + c, until that of the next sample does.
    """
    n, zeros = system.num_states, np.zeros(5)
    rate = ca.Function("f", [system.state], [system.f]).jacobian()
    A = rate(np.zeros(n), np.zeros(n)).full()
    h = ca.DM(ca.evalf(system.h)).full()
    G = h @ np.array([law.control(x, zeros) for x in np.eye(n)]).T
    whole, rest = int(delay // period), delay % period

    def held(length):
        both = scipy.linalg.expm(length * np.block([[A, G], [np.zeros((n, 2 * n))]]))
        return both[:n, :n], both[:n, n:]

    first, second = held(rest), held(period - rest)
    matrix = np.eye((whole + 2) * n, k=-n)
    matrix[:n] = 0.0
    matrix[:n, :n] = second[0] @ first[0]
    matrix[:n, whole * n : (whole + 1) * n] += second[1]
    matrix[:n, (whole + 1) * n :] += second[0] @ first[1]
    return np.abs(np.linalg.eigvals(matrix)).max()


@pytest.mark.parametrize("ratio", [1.0, 10.0])
def test_late_law_behind_a_spring_needs_fast_poles(ratio):
    """2 (W + w) (W^2 + 3 W w + w^2) > W_0^2 tau W w, to 8 per cent where W_0 tau = 0.1."""
    M, J, K = 2.0, 0.5, 4000.0
    system = sprung([M], [J], [K], [[1.0]])
    squared, period, delay = K * (1 / M + 1 / J), 5e-4, 7.5e-4
    tau = delay + period / 2.0
    least = squared * tau * ratio / (2.0 * (ratio + 1.0) * (ratio**2 + 3.0 * ratio + 1.0))

    def radius(w):
        law = TrackingLaw(system, poles([-w, -w, -ratio * w, -ratio * w]))
        return late(system, law, period, delay)

    assert radius(1.08 * least) < 1.0 < radius(0.92 * least)


def test_tool_that_sticks_has_the_acceleration_of_its_model():
    """a'' + K_4 a' + (K_3 - kappa) a = 0 is among the modes where q_1 + q_2 is held.

    Held, that is with the force f that makes P q'' = 0 for P = (1, 1), of which the law knows
    nothing; K_3 is below kappa with the slow poles, and above with the fast ones.
    """
    P = np.array([[1.0, 1.0]])
    system = sprung(LINKS, ROTORS, SPRINGS, [[1.0, 1.0], [1.0, -1.0]])
    M, K, Z, one = np.diag(LINKS), np.diag(SPRINGS), np.zeros((2, 2)), np.eye(2)
    mobility = P @ np.linalg.solve(M, P.T)
    kappa = (P @ np.linalg.solve(M, K @ np.linalg.solve(M, P.T)) / mobility).item()
    held = one - np.linalg.solve(M, P.T) @ P / mobility
    pull, turn = held @ np.linalg.solve(M, K), K / ROTORS[:, None]
    free = np.block([[Z, one, Z, Z], [-pull, Z, pull, Z], [Z, Z, Z, one], [turn, Z, -turn, Z]])
    push = np.vstack([Z, Z, Z, np.diag(1 / ROTORS)])
    for pole, is_stable in ((-5.0, False), (-30.0, True)):
        law = TrackingLaw(system, poles(pole))
        still = law.control(np.zeros(8), np.zeros(10))
        feedback = np.array([law.control(x, np.zeros(10)) - still for x in np.eye(8)]).T
        modes = np.linalg.eigvals(free + push @ feedback)
        wanted = np.roots([1.0, -4.0 * pole, 6.0 * pole**2 - kappa])
        assert_allclose([np.abs(modes - one).min() for one in wanted], 0.0, atol=1e-6)
        assert (wanted.real.max() < 0.0) == is_stable
