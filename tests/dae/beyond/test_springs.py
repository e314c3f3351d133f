"""The loop around springs: its poles and its bound, against two masses by other routes."""

import casadi as ca
import numpy as np
import pytest
from numpy.testing import assert_allclose

from drake_dae import DaeSystem, SpringLoop, TrackingLaw, poles, spring_loop
from drake_dae.dae.beyond.spring_bound import spring_error_bound, spring_loop_radius, stable_scales
from drake_dae.errors import ModelError

M, B, K, POLE = 2.0, 0.8, 3000.0, 12.0


def link() -> DaeSystem:
    """M q'' = tau."""
    x, none = ca.SX.sym("x", 2), ca.SX(0, 1)
    return DaeSystem(
        x,
        ca.vertcat(x[1], 0.0),
        ca.SX(2, 0),
        ca.vertcat(0, 1),
        none,
        x[0],
        ca.SX(1, 0),
        mass_matrix=ca.diag(ca.SX([1.0, M])),
    )


def amplitude(loop: SpringLoop, frequency: float, delay: float) -> float:
    """|q - r| of r = sin(W t) in the steady state, of the continuous loop in closed form.

    The equations of the two masses, the rigid law, and the loop with a_d = tau_d / M, the slope of
    tau_d by a lag of 1 / (2 w), and controls that act late; all are linear in the complex
    amplitudes of (q, q_2, tau_d, u).
    """
    s, w, zeta = 1j * frequency, loop.rate, loop.damping
    slope = s * 2.0 * w / (s + 2.0 * w)
    law = s**2 + 2.0 * POLE * s + POLE**2
    late = np.exp(-s * delay)
    inner = B / K * np.array([w**2, 2.0 * zeta * w])
    torque = np.array([-K, K, 0.0, 0.0])
    rows = np.array(
        [
            [M * s**2 + K, -K, 0.0, 0.0],
            [-K, B * s**2 + K, 0.0, -late],
            [M * (law - s**2), 0.0, 1.0, 0.0],  # tau_d = M (r'' - 2 p e' - p^2 e).
            [0.0, 0.0, 0.0, 1.0],
        ],
        dtype=complex,
    )
    rows[3] -= torque * (1.0 - inner[0] - inner[1] * s)
    rows[3, 2] -= B / M + inner[0] + inner[1] * slope
    q = np.linalg.solve(rows, np.array([0.0, 0.0, M * law, 0.0]))[0]
    return float(abs(q - 1.0))


@pytest.mark.parametrize(("rate", "delay"), [(60.0, 0.0), (120.0, 0.0), (60.0, 2e-3)])
def test_the_bound_is_above_the_closed_form_and_close_to_it(rate, delay):
    """For motions at 1 to 3 rad/s, where what is neglected is a few per cent; the overshoot of the
    loop, the integral of |g| and the sum of two phases leave a factor of three."""
    law, loop = TrackingLaw(link(), poles(-POLE)), SpringLoop(rate)
    for frequency in (1.0, 3.0):
        times = np.linspace(0.0, 12.0 / frequency, 2001)
        r = np.sin(frequency * times)
        states = np.transpose([r, frequency * np.cos(frequency * times)])
        torques = -M * frequency**2 * r[:, None]
        period = 1e-6
        bound = spring_error_bound(
            law, times, states, torques, [K], [B], loop, period, delay - period / 2 * bool(delay)
        )
        exact = amplitude(loop, frequency, delay)
        assert exact < bound[0] < 3.0 * exact


def sample(memory: np.ndarray, loop: SpringLoop, period: float, scale: float) -> np.ndarray:
    """(q, q', q_2, q_2', f_o, controls on their way) a sample later.

    Two masses, stepped in 200 parts.
    """
    q, dq, shaft, rate, f, *on_the_way = memory
    w, zeta, gain = loop.rate, loop.damping, -np.expm1(-loop.motor_rate * period)
    torque = K * (shaft - q)
    u = torque - B * (w**2 * (shaft - q) + 2.0 * zeta * w * (rate - dq)) + f
    acted, *on_the_way = [*on_the_way, u]
    state, h = np.array([q, dq, shaft, rate]), period / 200

    def change(x: np.ndarray) -> np.ndarray:
        spring = scale * K * (x[2] - x[0])
        return np.array([x[1], spring / M, x[3], (acted - spring) / B])

    for _ in range(200):
        state = state + h * change(state + h / 2.0 * change(state))
    # What is seen at the next sample, and used there only after the control.
    now = K * (state[2] - state[0])
    lost = acted - (now + torque) / 2.0 - B * (state[3] - rate) / period
    return np.array([*state, f + gain * (lost - f), *on_the_way])


@pytest.mark.parametrize(
    ("rate", "delay", "scale"),
    [(60.0, 1, 1.0), (300.0, 1, 1.0), (420.0, 1, 1.0), (90.0, 2, 2.0), (90.0, 0, 0.5)],
)
def test_the_poles_are_those_of_a_stepped_loop(rate, delay, scale):
    """Those of its map over a sample, except for the two of free motion, which are 1.

    The parts of steps leave 1e-5. The observer sees a sample where the loop uses it at once here:
    as in the block, the control of a sample has the estimate of the one before.
    """
    loop = SpringLoop(rate, 0.7, 0.5 * rate)
    found = spring_loop_radius([K], [B], [[1.0 / M]], loop, 1e-3, delay, scale)
    columns = [sample(column, loop, 1e-3, scale) for column in np.eye(5 + delay)]
    sizes = np.abs(np.linalg.eigvals(np.transpose(columns)))
    free = np.argsort(np.abs(sizes - 1.0))[:2]
    assert_allclose(sizes[free], 1.0, atol=1e-5)
    assert_allclose(np.delete(sizes, free).max(), found, atol=2e-5)


def test_the_recommended_loop_is_stable_with_a_margin():
    """For springs at least half and twice as stiff, whatever the ratio of link and shaft."""
    for period, delay in ((1e-3, 1), (5e-4, 0), (2e-3, 2)):
        loop = spring_loop(period, delay)
        assert_allclose(2.0 * loop.damping * loop.rate * (delay + 0.5) * period, 0.2)
        for mass in (0.3 * B, B, 10.0 * B):
            found = stable_scales([K], [B], [np.array([[1.0 / mass]])], loop, period, delay)
            swing = np.sqrt(K * (1.0 / mass + 1.0 / B)) * (delay + 0.5) * period
            if swing < 0.6:
                assert found is not None
                assert found[0] <= 0.5
                assert found[1] >= 2.0 or swing > 0.3


def test_numbers_that_make_no_sense_are_refused():
    with pytest.raises(ModelError, match="same number of rows"):
        spring_error_bound(
            TrackingLaw(link(), poles(-POLE)), [0.0, 1.0], [[0, 0]], [[0]], [K], [B],
            SpringLoop(50.0), 1e-3,
        )  # fmt: skip
    with pytest.raises(ModelError, match="period must be positive"):
        spring_loop(0.0, 1)
