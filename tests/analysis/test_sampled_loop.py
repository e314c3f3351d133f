"""A sampled loop over one sample: against matrix exponentials, sums over samples, and rollouts."""

import casadi as ca
import numpy as np
import pytest
from numpy.testing import assert_allclose
from runs import scenario
from scipy.linalg import expm

from drake_dae import build_scenario, rollout
from drake_dae.analysis.sampled_loop import SampledLoop
from drake_dae.blocks import Block
from drake_dae.blocks.block import Held
from drake_dae.blocks.compose import compose
from drake_dae.errors import ModelError
from drake_dae.running import start_values

T, MASS, STIFFNESS, GAINS, NOISE = 2e-3, 0.5, 200.0, (30.0, 4.0), 1e-4


def spring(period: float = T) -> Block:
    """m x'' = -k x + u, with u held and computed from x with noise, and what one sample is late."""
    x, u, late, n = (ca.SX.sym(name, size) for name, size in zip("xuln", (2, 1, 1, 1), strict=True))
    force = (u - STIFFNESS * x[0]) / MASS
    now = -GAINS[0] * (x[0] + NOISE * n) - GAINS[1] * x[1]
    held = {
        "acting": Held(u, late, np.zeros(1), period),
        "computed": Held(late, now, np.zeros(1), T, is_unrestricted=True),
    }
    return Block("spring", {"n": n}, {"x": x[0], "u": u}, x, ca.vertcat(x[1], force), held)


def closed_form() -> tuple[np.ndarray, np.ndarray]:
    """A and B of (x, x', acting, computed): the updates, and then a sample of motion."""
    swing = np.zeros((4, 4))
    swing[0, 1], swing[1, 0], swing[1, 2] = 1.0, -STIFFNESS / MASS, 1.0 / MASS
    update = np.eye(4)
    update[2:] = [[0.0, 0.0, 0.0, 1.0], [-GAINS[0], -GAINS[1], 0.0, 0.0]]
    motion = expm(T * swing)
    return motion @ update, motion @ [[0.0], [0.0], [0.0], [-GAINS[0] * NOISE]]


def linear():
    return SampledLoop(spring(), ["x", "u"]).linear(0.0, np.zeros(4), np.zeros(0))


def test_one_mass_on_a_spring_has_the_matrices_of_the_exponential():
    """To 1e-6 of the largest entry: Runge-Kutta's method in a quarter of a millisecond."""
    A, B = closed_form()
    found = linear()
    assert_allclose(found.A, A, atol=1e-6 * np.abs(A).max())
    assert_allclose(found.B, B, atol=1e-6 * np.abs(B).max())
    eigenvalues = np.linalg.eigvals(A).astype(complex)
    poles = np.log(eigenvalues[np.abs(eigenvalues) > 1e-9]) / T
    assert found.decay == pytest.approx(-poles.real.max(), rel=1e-4)
    pair = poles[np.argmax(poles.real)]
    assert found.damping == pytest.approx(-pair.real / abs(pair), rel=1e-3)


def test_deviations_by_noise_and_by_a_push_are_sums_over_samples():
    """Two seconds are 2^10 samples; sums of the closed form are equal to 1e-5."""
    (A, B), found = closed_form(), linear()
    push, C = np.array([1e-3, 0.1, 0.0, 0.0]), np.eye(4)[:1]
    spread, x, squares, power = np.zeros((4, 4)), np.zeros(4), 0.0, np.eye(4)
    for _ in range(1024):
        spread += power @ B @ B.T @ power.T
        squares += (C @ x).item() ** 2
        power, x = A @ power, A @ x + push
    assert found.by_noise("x").item() == pytest.approx((C @ spread @ C.T).item() ** 0.5, rel=1e-4)
    assert found.after_push("x", push).item() == pytest.approx((squares / 1024) ** 0.5, rel=1e-4)
    change = np.eye(4)[2] @ A - np.eye(4)[2]
    rough = (change @ spread @ change + (np.eye(4)[2] @ B).item() ** 2) ** 0.5
    assert found.change_by_noise("u").item() == pytest.approx(rough, rel=1e-4)


def test_the_worst_mode_is_that_of_the_spring():
    """Its states take part in it, and the computed value hardly does."""
    shares = linear().participation(0.1)
    assert shares[:2].min() > 10.0 * shares[3]


def test_a_period_that_is_no_fraction_is_refused():
    with pytest.raises(ModelError, match=r"0\.0015"):
        SampledLoop(spring(0.75 * T), ["x"])


@pytest.mark.slow
def test_a_loop_on_contact_answers_as_its_rollouts_do():
    """Ten samples after one joint is turned by 1e-7 rad: 1e-3 of the change, to second order."""
    plant = "plant=!CompliantContact {time_step: 1.0e-3, stiffness: 1.0e5, friction: 0.3}"
    gains = "law.gains=!Coefficients {outputs: {tool.z: [3375, 450, 30], wall.force: [9]}}"
    more = "law.integral=[tool.z, wall.force]", "sensors.force={sample_period: 1.0e-3}"
    sampling = "sampling={period: 1.0e-3, delay: 1.0e-3}"
    loop, context = build_scenario(scenario("two_link_wall", plant, gains, sampling, *more))
    block = compose(loop.diagram, context=context).block
    sampled = SampledLoop(block, ["controlled_output"])
    p, time, x = block.default("parameters"), 0.0, sampled.start[:, None]
    x = sampled.begun(0.0, x, p[:, None])
    for k in range(50):
        x = sampled.after(k * 1e-3, x, p[:, None])
    time, place = 50e-3, sampled.places[next(iter(block.held))]
    found, change = sampled.linear(time, x[:, 0], p), np.zeros(sampled.size)
    change[place] = 1e-7
    expected = found.rows["controlled_output"] @ np.linalg.matrix_power(found.A, 10) @ change

    start, values = start_values(loop, context)
    times = 1e-3 * np.arange(61)
    (before,) = rollout(loop, start, values, times, compiled=False)
    run = before.record["controlled_output"]
    assert_allclose(
        sampled.shown(time, x, p[:, None])["controlled_output"][:, 0], run[50], rtol=1e-9
    )
    moved = x.copy()
    moved[place] += 1e-7
    for k in range(50, 60):
        moved = sampled.after(k * 1e-3, moved, p[:, None])
    after = sampled.shown(0.06, moved, p[:, None])["controlled_output"][:, 0]
    assert_allclose(after - run[60], expected, rtol=1e-2, atol=1e-3 * np.abs(expected).max())
