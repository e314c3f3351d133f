"""Integrators before controls, asked for and found: degrees, motions and controls."""

import casadi as ca
import numpy as np
import pytest
from problems import changed
from problems.extensions import GRAVITY, REGULAR, evaluated, extension_of, vtol
from runs import some

from drake_dae.dae import DaeSystem, dynamic_extension, find_structure
from drake_dae.errors import AssumptionError


@pytest.mark.slow
@pytest.mark.parametrize("name", some(REGULAR))
def test_degrees_are_those_of_the_literature(name):
    """Unicycle: Isidori 1995, 5.4; the others are flat by their outputs (Fliess et al. 1995).

    All of them have trivial zero dynamics after it: n + integrators = sum r_i + sum mu_i.
    """
    make, _, integrators, degrees = REGULAR[name]
    with pytest.raises(AssumptionError):
        find_structure(make())
    extension = extension_of(name)
    assert extension.integrators == integrators
    assert extension.structure.output_degrees == degrees
    assert extension.structure.zero_dynamics_dimension == 0
    assert extension.structure.system is extension.system
    assert extension.system.num_states == make().num_states + sum(integrators.values())


@pytest.mark.slow
@pytest.mark.parametrize("name", some(REGULAR))
def test_the_extension_moves_the_original_states_as_the_original_does(name):
    """f_e + h_e w, in the rows of x, is f + h u with the u that `original_control` recovers."""
    extension, random = extension_of(name), np.random.default_rng(0)
    original, extended = extension.original, extension.system
    n = original.num_states
    for _ in range(5):
        state = extended.nominal_state + 0.3 * random.standard_normal(extended.num_states)
        w = random.standard_normal(extended.num_controls)
        u = extension.original_control(state, w)
        f, h, g = evaluated(original, state[:n], f=original.f, h=original.h, g=original.g)
        fe, he, ge = evaluated(extended, state, f=extended.f, h=extended.h, g=extended.g)
        # A few operations on numbers of order 10.
        np.testing.assert_allclose((fe[:, 0] + he @ w)[:n], f[:, 0] + h @ u, rtol=0, atol=1e-13)
        np.testing.assert_array_equal(ge[:n], g)
        np.testing.assert_array_equal(ge[n:], 0.0)


def test_mixed_controls_by_hand():
    """left* = left + right is 4 v: both wheels share its integral, and left = left* - right."""
    extension = extension_of("wheels")
    assert [s.name for s in extension.system.state_signals] == ["x", "y", "heading", "left*"]
    assert [s.name for s in extension.system.control_signals] == ["left*'", "right"]
    # Also where one coordinate alone does not tell the mixture.
    for heading in (0.0, np.pi / 2, 0.7, -2.0):
        u = extension.original_control([1.0, 2.0, heading, 3.0], [7.0, 0.5])
        np.testing.assert_allclose(u, [2.5, 0.5], rtol=1e-15)
    assert extension.system.nominal_state[3] == pytest.approx(3.0, rel=1e-15)


# Systems that no integrators help, and what is said of them.


def violation(system: DaeSystem, **options) -> AssumptionError:
    with pytest.raises(AssumptionError) as caught:
        dynamic_extension(system, **options)
    return caught.value


def pair(outputs) -> DaeSystem:
    """Two nonlinear double integrators."""
    return DaeSystem.from_functions(
        4,
        f=lambda x: [x[1], ca.sin(x[0]), x[3], x[0] * x[1]],
        h=lambda x: [[0, 0], [1, 0], [0, 0], [0, 1]],
        l=outputs,
        output_signals=["a", "b"],
        name="pair",
    )


@pytest.mark.parametrize(
    "outputs", [lambda x: [x[0], ca.sin(x[0])], lambda x: [x[0], x[0] * x[1] + x[1]]]
)
def test_outputs_that_depend_on_each_other(outputs):
    """One is a function of the other, of its derivative, or of both."""
    error = violation(pair(outputs))
    assert error.assumption == 5
    assert "a, b" in str(error)


def test_isolated_singularities_are_not_mended():
    """Ball and beam (Hauser, Sastry and Kokotovic 1992): 2 x1 x4 u in x1''' vanishes at rest."""
    system = DaeSystem.from_functions(
        ["ball", "ball'", "beam", "beam'"],
        f=lambda x: [x[1], 0.7143 * (x[0] * x[3] ** 2 - GRAVITY * ca.sin(x[2])), x[3], 0],
        h=lambda x: [0, 0, 0, 1],
        l=lambda x: x[0],
        name="ball and beam",
    )
    error = violation(system)
    assert error.assumption == 4
    np.testing.assert_array_equal(error.state, np.zeros(4))
    assert dynamic_extension(changed(system, nominal_state=[1, 0, 0, 1])).integrators == {}


def test_at_rest_another_nominal_control_is_asked_for():
    error = violation(vtol())
    assert "nominal_control" in str(error)
    assert "2 before thrust" in str(error)
    assert error.state[vtol().num_states] == 0.0
