"""Damping of the constraint by the law, on contacts that give way, against closed forms.

The plant of each test is x' = f + g F + h u with F = -k phi in place of the constraint; it is
integrated by SciPy.
"""

import numpy as np
import pytest
import scipy.integrate
import scipy.linalg
from numpy.testing import assert_allclose
from problems import PROBLEMS

from drake_dae import ConstantReference, DaeSystem, PointToPointReference, TrackingLaw, poles
from drake_dae.dae import contact_damping
from drake_dae.errors import ModelError
from drake_dae.references import stack_references

STIFFNESS, MASS = 1e4, 2.0


def block(friction=0.0):
    """A mass on a floor that slides toward positive x, z across; moved by a force along each."""
    return DaeSystem.from_functions(
        ["x", "z", "vx", "vz"],
        f=lambda s: [s[2], s[3], 0.0, -9.81],
        g=lambda s: [0.0, 0.0, -friction / MASS, 1.0 / MASS],
        h=lambda s: [[0.0, 0.0], [0.0, 0.0], [1.0 / MASS, 0.0], [0.0, 1.0 / MASS]],
        k=lambda s: s[1],
        l=lambda s: [s[0], 0.0],
        m=lambda s: [0.0, 1.0],
        name="block",
    )


def press(law, references, stiffness, start, times, order=0):
    """phi and F = -k phi^(order) of a plant that gives way, shape (len(times), 2)."""
    system = law.system
    reference = stack_references(references, law.layout.reference_degrees)
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
    c = share * contact_damping(STIFFNESS, 1.0 / MASS)
    assert contact_damping(STIFFNESS, 1.0 / MASS) == pytest.approx(2.0 * frequency)
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


def test_a_force_that_rises_within_a_period_of_the_contact_is_followed_by_its_deflection():
    """From a start without error there is none; 2 pi / sqrt(A k) is 0.09 s, the rise takes 0.05.

    The law is linear in 1 / k, so that half of k leaves the opposite of what none leaves. Friction
    is that of the wanted force and not of the push that moves the tool into the floor: that push is
    8 N at most, whose friction would move the block by a millimetre. The integrator leaves 1e-10 m.
    """
    force = PointToPointReference([10.0], [40.0], 0.1, 0.15)
    times, start = np.linspace(0.0, 0.3, 61), [0.0, -10.0 / STIFFNESS, 0.0, 0.0]
    wanted = np.array([force.derivatives([0])(t)[0] for t in times])

    def errors(stiffness):
        law = TrackingLaw(
            block(0.3), poles(-8.0), constraint_damping=poles(-50.0), contact_stiffness=stiffness
        )
        found, states = press(law, [ConstantReference(0.0), force], STIFFNESS, start, times)
        return found[:, 1] - wanted, states[:, 0]

    # The integrator leaves 1e-6 of 40 N.
    found, along = errors(STIFFNESS)
    assert_allclose(found, 0.0, atol=1e-4)
    assert_allclose(along, 0.0, atol=1e-8)
    without = errors(None)[0]
    assert np.abs(without).max() > 5.0
    assert_allclose(errors(STIFFNESS / 2.0)[0], -without, atol=1e-4)


@pytest.mark.parametrize(("problem", "match"), [("pendulum_tension", "0"), ("linear", "linear")])
def test_where_a_deflection_is_not_known_it_is_refused(problem, match):
    with pytest.raises(ModelError, match=match):
        TrackingLaw(PROBLEMS[problem]().system, poles(-3.0), contact_stiffness=1e5 * (match != "0"))


# Advice.


def sampled(frequency, damping, sample_time, delay, samples):
    """|phi| of a contact from phi = 1, its damping held and late, ten times a sample."""
    fine = scipy.linalg.expm(
        np.array([[0.0, 1.0, 0.0], [-(frequency**2), 0.0, 1.0], [0.0, 0.0, 0.0]])
        * (sample_time / 10.0)
    )
    x, waiting, largest = np.array([1.0, 0.0, 0.0]), [0.0] * delay, []
    for _ in range(samples):
        waiting.append(-damping * x[1])
        x[2], size = waiting.pop(0), 0.0
        for _ in range(10):
            x = fine @ x
            size = max(size, abs(x[0]))
        largest.append(size)
    return np.array(largest)


@pytest.mark.slow
@pytest.mark.parametrize("delay", [0, 1, 2])
@pytest.mark.parametrize("share", [0.02, 0.1, 0.4, 0.8])
def test_the_advice_brings_a_sampled_contact_to_rest_sooner_than_others(share, delay):
    """Half and twice of it are slower in the long run, or no damping is advised at all."""
    T, k = 1e-3, (share / 1e-3) ** 2
    c, samples = contact_damping(k, 1.0, T, delay), int(20 / share)
    assert 0.0 <= c <= 2.0 * np.sqrt(k) * (1.0 + 1e-12)
    left = [sampled(np.sqrt(k), f * c, T, delay, samples)[-5:].max() for f in (1.0, 0.5, 2.0)]
    if c > 0.0:
        assert left[0] < min(*left[1:], 1.0)


@pytest.mark.parametrize(
    ("numbers", "message"),
    [
        ((0.0, 1.0), "stiffness"),
        ((1e5, -1.0), "mobility"),
        ((1e5, 1.0, -1e-3), "sample_time"),
        ((1e5, 1.0, 1e-3, -1), "delay"),
    ],
)
def test_advice_needs_sensible_numbers(numbers, message):
    with pytest.raises(ModelError, match=message):
        contact_damping(*numbers)
