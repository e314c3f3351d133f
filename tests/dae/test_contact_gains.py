"""The advice of gains, against the roots of the loops that it closes."""

import numpy as np
import pytest
from scipy.linalg import expm

from drake_dae import contact_gains
from drake_dae.errors import ModelError


def test_one_sample_at_a_kilohertz_gives_the_rate_of_the_docstring():
    """w = 0.05 / (3 sqrt(2) 1e-3) = 11.8 1/s by noise, and 0.15 / (3 1.5e-3) = 33 1/s without."""
    found = contact_gains(1e5, 0.03, 1e-3)
    assert found.position_pole == pytest.approx(-11.785, rel=1e-4)
    assert found.constraint_damping == pytest.approx(1.7 * 11.785, rel=1e-4)
    still = contact_gains(1e5, 0.03, 1e-3, velocity_noise=0.0)
    assert still.position_pole == pytest.approx(-100.0 / 3.0)


@pytest.mark.parametrize("sample_time", [2.5e-4, 1e-3, 4e-3])
@pytest.mark.parametrize("noise", [0.0, 1e-3])
def test_contact_that_is_sampled_late_comes_to_rest(sample_time, noise):
    """All soft contacts, and stiff ones up to a swing of half a radian in a sample.

    (phi, phi', the force's integral, what is held): phi'' = -A k phi + held, where the law of one
    sample before holds A (r - K_i int e) - c phi'; the roots of its map are inside the circle.
    """
    for frequency in (10.0, 30.0, 100.0, 0.5 / sample_time):
        mobility = 0.1
        stiffness = frequency**2 / mobility
        found = contact_gains(stiffness, mobility, sample_time, velocity_noise=noise)
        if not found.constraint_damping:
            continue
        rates = np.array([[0.0, 1.0, 0.0], [-(frequency**2), 0.0, 1.0], [0.0, 0.0, 0.0]])
        step = expm(rates * sample_time)[:2]
        loop = np.zeros((4, 4))
        loop[:2, [0, 1, 3]] = step
        loop[2] = [-stiffness * sample_time, 0.0, 1.0, 0.0]
        loop[3] = [0.0, -found.constraint_damping, -found.force_pole * mobility, 0.0]
        assert np.abs(np.linalg.eigvals(loop)).max() < 1.0, frequency


@pytest.mark.parametrize("sample_time", [2.5e-4, 1e-3, 4e-3])
def test_positions_that_are_sampled_late_come_to_rest(sample_time):
    """e'' = held, with the triple pole of one sample before; damped as the poles without it.

    A phase of 0.15 rad leaves the slowest root within a third of e^(-w T).
    """
    found = contact_gains(1e4, 0.1, sample_time, velocity_noise=0.0)
    w = -found.position_pole
    step = expm(sample_time * np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [0.0, 0.0, 0.0]]))[:2]
    loop = np.zeros((4, 4))
    loop[:2, [0, 1, 3]] = step
    loop[2] = [sample_time, 0.0, 1.0, 0.0]
    loop[3] = [-3.0 * w**2, -3.0 * w, -(w**3), 0.0]
    slowest = -np.log(np.abs(np.linalg.eigvals(loop)).max()) / sample_time
    assert slowest > w / 1.5


def test_stiff_contact_that_samples_cannot_damp_gets_no_damping():
    """At w T = 1.3 what is held is late by more than a quarter of a swing."""
    found = contact_gains((1.3e3) ** 2 / 0.03, 0.03, 1e-3)
    assert found.constraint_damping == 0.0
    assert found.force_pole < 0.0


def test_numbers_that_make_no_sense_are_refused():
    for arguments in ((-1.0, 0.1, 1e-3), (1e5, 0.0, 1e-3), (1e5, 0.1, 0.0)):
        with pytest.raises(ModelError, match="must be positive"):
            contact_gains(*arguments)
    with pytest.raises(ModelError, match="velocity_noise must be 0 or more"):
        contact_gains(1e5, 0.1, 1e-3, velocity_noise=-1.0)
