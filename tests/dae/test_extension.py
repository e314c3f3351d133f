"""Integrators before controls, asked for and found: degrees, motions and controls."""

import casadi as ca
import numpy as np
import pytest
from problems import changed, hidden_normal_form
from problems.extensions import REGULAR, evaluated, extension_of
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


def behind_integrators(system: DaeSystem, count: int) -> DaeSystem:
    """A system with E = 1 whose first controls are states, with new controls as rates."""
    n, held = system.num_states, ca.SX.sym("held", count)
    h = ca.SX(n + count, system.num_controls)
    h[:n, count:], h[n:, :count] = system.h[:, count:], ca.SX.eye(count)
    return changed(
        system,
        state=ca.vertcat(system.state, held),
        f=ca.vertcat(system.f + ca.mtimes(system.h[:, :count], held), ca.SX(count, 1)),
        g=ca.vertcat(system.g, ca.SX(count, system.num_constraints)),
        h=h,
        mass_matrix=None,
        state_signals=(),
        nominal_state=np.pad(system.nominal_state, (0, count)),
    )


@pytest.mark.slow
@pytest.mark.parametrize("seed", some(range(8), of=4))
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
    system = behind_integrators(hidden.system, count)
    # The controls in another basis: each moves all.
    system = changed(system, h=ca.mtimes(system.h, np.eye(p) + 0.4 * random.normal(size=(p, p))))
    extension = dynamic_extension(system)
    assert extension.structure.constraint_degrees == hidden.constraint_degrees
    assert extension.structure.output_degrees == tuple(d + 1 for d in hidden.output_degrees)
    assert sum(extension.integrators.values()) == p - count
    assert extension.structure.zero_dynamics_dimension == hidden.zero_dynamics
