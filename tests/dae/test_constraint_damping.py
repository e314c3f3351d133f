"""Damping of the constraint by the law, on contacts that give way, against closed forms.

The plant of each test is x' = f + g F + h u with F = -k phi in place of the constraint; it is
integrated by SciPy.
"""

import numpy as np
import pytest
import scipy.integrate
import scipy.linalg
from arms import touching
from numpy.testing import assert_allclose
from runs import some

from drake_dae import (
    ConstantReference,
    DaeSystem,
    DcMotors,
    FlexibleJoints,
    SinusoidReference,
    TrackingLaw,
    build_scenario,
    find_structure,
    load_scenario,
    poles,
    simulate,
)
from drake_dae.references import stack_references
from drake_dae.scenario.shipped import find_scenario

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


@pytest.mark.slow
@pytest.mark.parametrize(
    ("stage", "degree"),
    [(DcMotors(0.5, 0.01, 1.0, 100.0), 1), (FlexibleJoints(8000.0, inertia=1.0), 2)],
)
@pytest.mark.parametrize("ratio", [3.0, 5.0])
def test_behind_motors_and_springs_a_fast_force_damps_it_too(stage, degree, ratio):
    """From 20 N off rest, with poles of the force at -3 w or -5 w and c = w, it comes to rest.

    Behind motors phi'' = -w^2 phi - a, a' = -p (a - A lambda_d - c phi'), in closed form; the arm
    moves a little. Springs have frequencies of their own near w, so that the end is looked at.
    """
    model = touching("two_link", [stage])
    structure = find_structure(model.dae)
    assert structure.output_degrees == (degree + 2, degree)
    q = model.configuration([0.3], [1.2, -1.6])
    state = model.rest_state(q, [20.0])
    A = structure.constraint_matrix(state)[0, 0]
    w = np.sqrt(A * STIFFNESS)
    gains, times = poles({"wall.force": -ratio * w, "*": -8.0}), np.linspace(0.0, 15.0 / w, 76)
    wanted = [ConstantReference(0.3), ConstantReference(20.0)]
    forces = []
    for damping in (poles(-w), None):
        law = TrackingLaw(model.dae, gains, structure=structure, constraint_damping=damping)
        found, _ = press(law, wanted, STIFFNESS, state, times)
        forces.append(found[:, 1])
    assert abs(forces[0][-1] - 20.0) < 1.0
    assert np.abs(forces[1][-20:] - 20.0).max() > 5.0
    if degree == 1:
        p = ratio * w
        swing = np.array([[0.0, 1.0, 0.0], [-(w**2), 0.0, -1.0], [0.0, p * w, -p]])
        start = np.array([20.0 / STIFFNESS, 0.0, 0.0])
        off = [STIFFNESS * (scipy.linalg.expm(swing * t) @ start)[0] for t in times]
        assert_allclose(forces[0], 20.0 - np.array(off), atol=0.5)


@pytest.mark.parametrize(
    "name",
    some(
        [
            "two_link_wall",
            pytest.param("seven_joint_wall", marks=pytest.mark.slow),
            pytest.param("two_link_flexible", marks=pytest.mark.slow),
            pytest.param("two_link_hydraulics", marks=pytest.mark.slow),
            pytest.param("seven_joint_moving_plate", marks=pytest.mark.slow),
            pytest.param("cart_wall", marks=pytest.mark.slow),
        ]
    ),
)
def test_on_an_ideal_plant_nothing_changes_but_round_off(name):
    """The plant stays on N* to 1e-15 at each step, which c = 100 / s makes 1e-12 of what it gets.

    Inside of a step the stages leave N* by the integrator's error. So steps are short.
    """
    records = []
    for settings in ([], ["law.constraint_damping={all: [-100.0]}"]):
        scenario = load_scenario(
            find_scenario(name),
            [
                "duration=0.2",
                "integrator={integration_scheme: runge_kutta5, max_step_size: 1e-3, "
                "use_error_control: false}",
                *settings,
            ],
        )
        loop, context = build_scenario(scenario)
        simulate(loop.diagram, context, 0.2, scenario.integrator)
        records.append(loop.record(context))
    for signal in ("controlled_output", "control", "state"):
        one, other = (record[signal] for record in records)
        scale = np.abs(one).max(axis=0) + 1e-3 * np.abs(one).max()
        assert np.abs((one - other) / scale).max() < 1e-9


# Advice.
