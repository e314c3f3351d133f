"""Integrators before controls, asked for and found: degrees, motions and controls."""

import casadi as ca
import numpy as np
import pytest
from problems import (
    changed,
    early_control,
    hidden_normal_form,
)
from problems.extensions import (
    REGULAR,
    evaluated,
    extension_of,
    unicycle,
)
from runs import some

from drake_dae.dae import dynamic_extension, extend, find_structure
from drake_dae.errors import AssumptionError


def test_an_integrator_is_a_state_and_its_rate_the_control():
    system = extend(unicycle(), ["v"], {"v": 0.7})
    assert [s.name for s in system.state_signals] == ["x", "y", "heading", "v"]
    assert system.state_signals[3].unit == "m/s"
    assert [s.name for s in system.control_signals] == ["v'", "w"]
    np.testing.assert_array_equal(system.nominal_state, [0.0, 0.0, 0.0, 0.7])
    f, h = evaluated(system, [1.0, 2.0, 0.3, 0.9], f=system.f, h=system.h)
    np.testing.assert_allclose(f[:, 0], [0.9 * np.cos(0.3), 0.9 * np.sin(0.3), 0, 0], rtol=1e-15)
    np.testing.assert_array_equal(h, [[0, 0], [0, 0], [0, 1], [1, 0]])


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


@pytest.mark.slow
@pytest.mark.parametrize("seed", some(range(12), of=4))
def test_hidden_integrators_are_found(seed):
    """Integrators before some controls of a random system, behind a feedback, want the others too.

    B(x) is regular and dense without them, so that all outputs then have one degree more.
    """
    random = np.random.default_rng(seed)
    while True:
        hidden = hidden_normal_form(int(random.integers(1000)))
        small = hidden.system.num_states <= 5 and max(hidden.output_degrees) <= 2
        if hidden.system.num_controls >= 2 and small:  # Larger ones take seconds.
            break
    p = hidden.system.num_controls
    count = int(random.integers(1, p))
    system = extend(hidden.system, [f"u{i}" for i in range(count)])
    # The controls in another basis: each moves all.
    system = changed(system, h=ca.mtimes(system.h, np.eye(p) + 0.4 * random.normal(size=(p, p))))
    extension = dynamic_extension(system)
    assert extension.structure.constraint_degrees == hidden.constraint_degrees
    assert extension.structure.output_degrees == tuple(d + 1 for d in hidden.output_degrees)
    assert sum(extension.integrators.values()) == p - count
    assert extension.structure.zero_dynamics_dimension == hidden.zero_dynamics


def test_a_constraint_that_a_control_meets_too_early_gets_integrators():
    """x0' = x1 + u, x1' = v violates Assumption (3): u acts on k', v on k''. As a state u may."""
    system = early_control()
    with pytest.raises(AssumptionError) as caught:
        find_structure(system)
    assert caught.value.assumption == 3
    structure = find_structure(extend(system, ["u0"]))
    assert (structure.constraint_degrees, structure.output_degrees) == ((2,), (2,))
    # x1 + u = 0 binds u: N* is {x0 = 0, x1 = -u}.
    for state in structure.states:
        np.testing.assert_allclose([state[0], state[1] + state[3]], 0.0, atol=1e-15)
