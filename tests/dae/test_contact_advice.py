"""Gains as an optimum: what they have to bear, and what is refused."""

from dataclasses import replace

import pytest

from drake_dae.dae import SensedContact, SensorNoise, advised_gains
from drake_dae.dae.one_direction import DirectionGains, sampled_loop
from drake_dae.errors import GainError, ModelError

T, ROUGHNESS = 1e-3, 1.0


def situation(resolution, stiffness, mobility, delay, bandwidth=0.0):
    """An arm whose noise is that of angles, filtered as differences or by an estimator."""
    noise = SensorNoise(resolution, force=0.3, velocity_bandwidth=bandwidth)
    return SensedContact(
        T, delay, stiffness, mobility, 0.3, 0.7, 0.7, 5.0, noise, estimates=not bandwidth
    )


# In each of them faster gains were smooth enough; margins of masses or stiffness forbid them.
SITUATIONS = [
    (1e-4, 1e5, 0.03, 1),
    (5e-4, 1e5, 0.3, 2),
    (3e-6, 1e6, 0.03, 1, 300.0),
    (1e-4, 1e5, 0.3, 1, 300.0),
]


@pytest.mark.parametrize("numbers", SITUATIONS)
def test_gains_bear_other_masses_and_stiffnesses(numbers):
    found = advised_gains(given := situation(*numbers), ROUGHNESS)
    own, fast = found.gains, found.state_rate
    quiet = SensorNoise(velocity_bandwidth=given.noise.velocity_bandwidth)
    lowest, middle, highest = own.position_gains(3)
    free = DirectionGains((lowest, middle, highest), 0.0, own.observer_rate, fast)
    for mass in (0.5, 1.0, 2.0):
        loop = sampled_loop(free, quiet, T, given.delay, mass_error=mass)
        assert loop.radius < 1.0 - 0.05 * T * highest / 3.0
    contact = DirectionGains(
        (0.0, 0.0, own.constraint_damping), own.force_gain, own.observer_force_rate, fast
    )
    for mass in (2.0 / 3.0, 1.0, 1.5):
        for share in (0.1, 0.5, 1.0, 2.0):
            pressed = given.mobility, share * given.stiffness, mass
            assert sampled_loop(contact, quiet, T, given.delay, *pressed).radius < 1.0
    assert found.roughness <= ROUGHNESS


@pytest.mark.parametrize("numbers", SITUATIONS)
def test_errors_and_roughness_are_those_of_the_gains(numbers):
    """Of the two directions, by loops that other tests compare with runs."""
    found = advised_gains(given := situation(*numbers), ROUGHNESS)
    own, fast = found.gains, found.state_rate
    free = DirectionGains(tuple(own.position_gains(3)), 0.0, own.observer_rate, fast)
    of_point = SensorNoise(0.7 * numbers[0], 0.0, 0.3, given.noise.velocity_bandwidth)
    error, _ = sampled_loop(free, of_point, T, given.delay).deviations()
    _, jump = sampled_loop(free, given.noise, T, given.delay).deviations()
    contact = DirectionGains(
        (0.0, 0.0, own.constraint_damping), own.force_gain, own.observer_force_rate, fast
    )
    pressed = T, given.delay, given.mobility, given.stiffness
    force, push = sampled_loop(contact, of_point, *pressed).deviations()
    assert found.free.by_noise == pytest.approx(error)
    assert found.contact.by_noise == pytest.approx(force)
    parts = (5.0 * jump) ** 2 + (0.7 / given.mobility * push) ** 2
    assert found.roughness == pytest.approx(parts**0.5)
    assert found.free.error > error
    assert found.contact.error > force


def test_noise_is_met_by_equal_poles_and_a_slow_estimator():
    """Butterworth's poles need one of 133 1/s, where twice the mass is unknown, with 0.12 mm."""
    noise, quiet = SensorNoise(5e-5, 1e-2, 3.0), SensorNoise(3e-6, 0.0, 0.05)
    given = SensedContact(T, 1, 1e5, 0.03, 0.59, 0.98, 0.29, 8.0, noise, estimates=True)
    found = advised_gains(given, 1.0)
    assert found.gains.position_damping == pytest.approx(1.0)
    p = found.gains.position_rate
    assert found.gains.position_gains(3) == pytest.approx([p**3, 3.0 * p**2, 3.0 * p])
    assert found.gains.position_gains(2) == pytest.approx([p**2, 2.0 * p])
    assert found.free.error < 7.0e-5
    exact = advised_gains(replace(given, noise=quiet), 1.0)
    assert exact.gains.position_damping == pytest.approx(0.5)
    assert exact.gains.position_rate == pytest.approx(50.0)


def test_equal_poles_are_not_so_slow_that_friction_keeps_a_mode():
    """Samples of 4 ms and a light tool: some at 6 1/s have 4 % less error, without friction."""
    noise = SensorNoise(2e-5, 5e-3, 0.3)
    given = SensedContact(4e-3, 1, 6e4, 0.42, 2.65, 0.54, 0.38, 0.59, noise, estimates=True)
    found = advised_gains(given, 0.24).gains
    assert found.position_damping == pytest.approx(0.5)
    assert found.position_rate == pytest.approx(7.5, rel=0.01)


@pytest.mark.slow
def test_within_a_bound_of_an_error_the_smoothest_gains_are_taken():
    """Each bound alone leaves the other error as small as the roughness allows."""
    given = situation(1e-5, 1e5, 0.03, 1)
    best = advised_gains(given, 1.0)
    near = advised_gains(given, 1.0, position_error=4.0 * best.free.error)
    assert best.free.error < near.free.error <= 4.0 * best.free.error
    assert near.gains.position_rate < 0.9 * best.gains.position_rate
    assert near.contact.error == pytest.approx(best.contact.error, rel=0.1)
    soft = advised_gains(given, 1.0, force_error=1.5 * best.contact.error)
    assert best.contact.error < soft.contact.error <= 1.5 * best.contact.error
    both = advised_gains(
        given, 1.0, position_error=4.0 * best.free.error, force_error=1.5 * best.contact.error
    )
    assert both.roughness <= near.roughness


@pytest.mark.slow
def test_an_error_that_no_gains_keep_is_refused_with_what_forbids_it():
    """An error, of good sensors or by the noise of bad ones, or the allowed roughness."""
    good, bad = situation(1e-6, 1e5, 0.03, 1), situation(1e-3, 1e5, 0.03, 1)
    least = advised_gains(bad, 1e3).free.error
    with pytest.raises(GainError, match=r"1e-06 m"):
        advised_gains(good, 1.0, position_error=1e-6)
    with pytest.raises(GainError, match="noise"):
        advised_gains(bad, 1e3, position_error=0.5 * least)
    with pytest.raises(GainError, match=r"0\.0001 N"):
        advised_gains(good, 1.0, force_error=1e-4)
    with pytest.raises(GainError, match=r"0\.2"):
        advised_gains(bad, 0.2, position_error=1.1 * least)
    with pytest.raises(ModelError, match="position_error"):
        advised_gains(good, 1.0, position_error=0.0)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"delay": -1}, "delay.*-1"),
        ({"noise": SensorNoise(force=-0.1)}, "force.*-0.1"),
        ({"noise": SensorNoise(position=float("nan"))}, "position.*nan"),
    ],
)
def test_a_negative_delay_or_noise_is_refused(change, message):
    with pytest.raises(ModelError, match=message):
        replace(situation(1e-4, 1e5, 0.03, 1), **change)
