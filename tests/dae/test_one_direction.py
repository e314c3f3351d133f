"""The sampled loop of one direction, against loops that are stepped and closed forms."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from runs import some
from scipy.integrate import solve_ivp

from drake_dae.dae import SensorNoise
from drake_dae.dae.disturbance import filter_gain, transition
from drake_dae.dae.one_direction import DirectionGains, sampled_loop

T = 1e-3
FREE = DirectionGains((15.0**3, 2.0 * 15.0**2, 30.0), 0.0, 20.0)
PRESSING = DirectionGains((0.0, 0.0, 23.0), 9.0, 10.0)
CONTACT = {"delay": 1, "mobility": 0.03, "stiffness": 1e5}
NOISE = SensorNoise(1e-5, 1e-3, 0.3)


def stepped(rates, noise, steps, push=0.0, *, delay, mobility=1.0, stiffness=0.0, mass_error=1.0):
    """Error and asked acceleration of the loop of the docstring, sample by sample."""
    random = np.random.default_rng(0)
    x, sigma, held = np.zeros(2), 0.0, [0.0] * delay
    stiff = mobility * stiffness
    r, last, acted, predicted = 0.0, 0.0, 0.0, np.zeros(3)
    w, filtered = (mass_error * stiff) ** 0.5, None
    if rates.state_rate:
        filtered = filter_gain(rates.state_rate, rates.observer_rate, T)
    errors, wanted = np.zeros(steps), np.zeros(steps)
    draws = random.normal(size=(steps, 3))
    for k in range(steps):
        position, velocity = x + draws[k, :2] * [noise.position, noise.velocity]
        force = -stiffness * x[0] + noise.force * draws[k, 2]
        if filtered is None:
            error, rate, d = position, velocity, r
        else:
            error, rate, d = known = predicted + filtered[:, 0] * (position - predicted[0])
        if stiff:
            a = -rates.gains[2] * rate - rates.force_gain * sigma - d
            sigma -= T * mobility * force
        else:
            a = -np.dot(rates.gains, [sigma, error, rate]) - d
            sigma += T * error
        errors[k], wanted[k] = (-stiffness * x[0] if stiff else x[0]), a
        held.append(a)
        acts = held.pop(0)
        middle = (mass_error * acts + push) / w**2 if w else 0.0
        before = x
        if w:
            c, s = np.cos(w * T), np.sin(w * T)
            away = x[0] - middle
            x = np.array([middle + c * away + s / w * x[1], -w * s * away + c * x[1]])
        else:
            total = mass_error * acts + push
            x = np.array([x[0] + T * x[1] + T**2 / 2.0 * total, x[1] + T * total])
        mean = 0.0
        if stiff:
            mean = -stiff * (before[0] + x[0]) / 2.0
            mean += mobility * noise.force * draws[k, 2]
        if filtered is None:
            gain = 1.0 - np.exp(-rates.observer_rate * T)
            r += gain * ((velocity - last) / T - acted - r)
            last, acted = velocity, acts + mean
        else:
            predicted = transition(T) @ known + (acts + mean) * np.array([T**2 / 2.0, T, 0.0])
    return errors, wanted


CASES = [
    ({"delay": 1}, FREE),
    ({"delay": 2, "mass_error": 1.3}, replace(FREE, state_rate=100.0)),
    (CONTACT, PRESSING),
    ({**CONTACT, "mass_error": 0.8}, replace(PRESSING, state_rate=100.0)),
]


@pytest.mark.slow
@pytest.mark.parametrize(("direction", "rates"), some(CASES, of=4))
def test_deviations_are_those_of_a_loop_with_noise(direction, rates):
    """100 s, in which errors are correlated for some 0.2 s: 500 of them tell 3 per cent."""
    noise = replace(NOISE, velocity=0.0) if rates.state_rate else NOISE
    errors, wanted = stepped(rates, noise, 100_000, **direction)
    deviations = sampled_loop(rates, noise, T, **direction).deviations()
    assert np.std(errors[2000:]) == pytest.approx(deviations[0], rel=0.15)
    assert np.sqrt(np.mean(np.diff(wanted[2000:]) ** 2)) == pytest.approx(deviations[1], rel=0.03)


@pytest.mark.parametrize(("gains", "state_rate"), [(FREE.gains, 100.0), ((8e3, 1.2e3, 60.0), 60.0)])
def test_noise_of_fast_samples_leaves_the_variance_of_the_docstring(gains, state_rate):
    """By quadrature, with the poles of `filter_gain`; the mean delay of 0.05 ms is neglected."""
    period, slow = 1e-4, 20.0
    roots = np.roots([1.0, 0.0, 0.0, 0.0, state_rate**4, 0.0, -((state_rate**2 * slow) ** 2)])
    D = np.real(np.poly(roots[roots.real < 0.0]))
    s = 1j * np.linspace(-2e4, 2e4, 400_001)
    shown = np.polymul([gains[1], gains[0]], D[1:])
    filtered = [D[3] + gains[2] * D[2], gains[2] * D[3], 0.0, 0.0]
    through = np.polyval(np.polyadd(filtered, shown), s)
    response = through / np.polyval(np.polymul([1.0, *gains[::-1]], D), s)
    variance = period * np.trapezoid(np.abs(response) ** 2, s.imag) / (2.0 * np.pi)
    rates = DirectionGains(gains, 0.0, slow, state_rate)
    loop = sampled_loop(rates, SensorNoise(1e-5), period, 0)
    assert loop.deviations()[0] == pytest.approx(1e-5 * variance**0.5, rel=0.02)


@pytest.mark.parametrize(("direction", "rates"), CASES)
def test_error_after_a_step_of_the_disturbance_is_that_of_a_loop(direction, rates):
    """Both are sums over the same samples, to round-off of sums of 5,000 numbers."""
    errors, _ = stepped(rates, SensorNoise(), 5000, 1.0, **direction)
    found = sampled_loop(rates, SensorNoise(), T, **direction).after_step()
    assert found == pytest.approx(np.linalg.norm(errors), rel=1e-6)


def test_motion_within_a_sample_is_that_of_the_contact():
    """phi'' = m (a - A k phi) for one sample without a control, to the integrator's 1e-12."""
    loop = sampled_loop(PRESSING, SensorNoise(), T, **CONTACT, mass_error=0.7)
    w2 = 0.7 * 0.03 * 1e5
    run = solve_ivp(lambda t, x: [x[1], -w2 * x[0]], (0.0, T), [1.0, 3.0], rtol=1e-12, atol=1e-14)
    start = np.zeros(len(loop.step))
    start[:2] = 1.0, 3.0 * T  # In units of the period.
    assert_allclose(loop.step[:2] @ start, run.y[:, -1] * [1.0, T], rtol=1e-10)
