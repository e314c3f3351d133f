"""Damping of the constraint by the law, on contacts that give way, against closed forms.

The plant of each test is x' = f + g F + h u with F = -k phi in place of the constraint; it is
integrated by SciPy.
"""

import numpy as np
import pytest
import scipy.integrate
import scipy.linalg
from numpy.testing import assert_allclose

from drake_dae import (
    ConstantReference,
    DaeSystem,
    SinusoidReference,
    TrackingLaw,
    poles,
)
from drake_dae.references import stack_references

STIFFNESS, MASS = 1e4, 2.0


def block():
    """A mass above a floor: x' along it and z across, moved by a force along each."""
    return DaeSystem.from_functions(
        ["x", "z", "vx", "vz"],
        f=lambda s: [s[2], s[3], 0.0, -9.81],
        g=lambda s: [0.0, 0.0, 0.0, 1.0 / MASS],
        h=lambda s: [[0.0, 0.0], [0.0, 0.0], [1.0 / MASS, 0.0], [0.0, 1.0 / MASS]],
        k=lambda s: s[1],
        l=lambda s: [s[0], 0.0],
        m=lambda s: [0.0, 1.0],
        name="block",
    )


def press(law, references, stiffness, start, times, order=0):
    """phi and F = -k phi^(order) of a plant that gives way, shape (len(times), 2)."""
    system = law.system
    reference = stack_references(references, law.degrees)
    residual, place = law.structure.manifold, order

    def rate(t, x):
        values = dict(zip(system.fields.output_names, system.fields(x, p), strict=True))
        force = -stiffness * residual.residual(x)[place]
        g, h = (values[key].reshape(x.size, -1) for key in "gh")
        return values["f"] + g @ [force] + h @ law.control(x, reference(t))

    p = system.parameter_values
    found = scipy.integrate.solve_ivp(
        rate, times[[0, -1]], start, "DOP853", t_eval=times, rtol=1e-9, atol=1e-11
    )
    assert found.success
    phi = np.array([residual.residual(x)[0] for x in found.y.T])
    return np.column_stack([phi, -stiffness * phi]), found.y.T


@pytest.mark.slow
@pytest.mark.parametrize("share", [0.0, 0.2, 0.7, 1.0, 3.0])
def test_a_contact_that_gives_way_is_damped_as_chosen(share):
    """phi'' + c phi' + A k phi = -A lambda_d from phi = phi' = 0, for c of several times 2 w.

    In closed form by the exponential of a matrix; the integrator leaves 1e-6 of 20 N.
    """
    frequency = np.sqrt(STIFFNESS / MASS)
    c = share * 2.0 * frequency
    law = TrackingLaw(block(), poles(-8.0), constraint_damping=poles(-c) if c else None)
    times = np.linspace(0.0, 0.2, 101)
    wanted = [ConstantReference(0.0), ConstantReference(20.0)]
    (found, _) = press(law, wanted, STIFFNESS, np.zeros(4), times)
    swing = np.array([[0.0, 1.0], [-(frequency**2), -c]])
    rest = np.array([-20.0 / STIFFNESS, 0.0])
    expected = [rest - scipy.linalg.expm(swing * t) @ rest for t in times]
    assert_allclose(found[:, 1], -STIFFNESS * np.array(expected)[:, 0], atol=2e-5)
    if share:
        assert abs(found[-1, 1] - 20.0) < 20.0 * np.exp(
            -0.2 * frequency * min(share, 1 / share) / 2
        )


def test_a_force_that_changes_is_followed_with_the_error_derived():
    """F - lambda_d = -(F'' + c F') / (A k), of amplitude c w 5 / (A k) except for w^2 / (A k)."""
    c, speed = 2.0 * np.sqrt(STIFFNESS / MASS), 3.0
    law = TrackingLaw(block(), poles(-8.0), constraint_damping=poles(-c))
    times = np.linspace(0.0, 3.0, 601)
    wanted = [ConstantReference(0.0), SinusoidReference(20.0, 5.0, speed)]
    found, _ = press(law, wanted, STIFFNESS, np.zeros(4), times)
    late = times > 0.5
    error = (found[:, 1] - 20.0 - 5.0 * np.sin(speed * times))[late]
    about = -c * 5.0 * speed * np.cos(speed * times[late]) / (STIFFNESS / MASS)
    assert np.abs(about).max() == pytest.approx(0.42, abs=0.01)
    assert np.abs(error - about).max() < 0.08 * np.abs(about).max()
    # Exactly, once the start is forgotten: the same as a transfer function.
    gain = (STIFFNESS / MASS) / (STIFFNESS / MASS + 1j * speed * c - speed**2) - 1.0
    exact = 5.0 * np.imag(gain * np.exp(1j * speed * times[late]))
    assert_allclose(error, exact, atol=2e-5)


# Advice.
