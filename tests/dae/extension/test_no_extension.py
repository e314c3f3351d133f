"""Systems that no integrators help, and what is said of them."""

import casadi as ca
import numpy as np
import pytest
from arms import touching
from problems import (
    changed,
)
from problems.extensions import (
    GRAVITY,
    crane,
    evaluated,
    unicycle,
    vtol,
)

from drake_dae.dae.extension.dynamic_extension import dynamic_extension
from drake_dae.dae.extension.extension import extend
from drake_dae.dae.structure.structure import find_structure
from drake_dae.dae.system.system import DaeSystem
from drake_dae.errors import AssumptionError, ModelError


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
    "outputs",
    [
        lambda x: [x[0], 2 * x[0] + 1],
        lambda x: [x[0], ca.sin(x[0])],
        lambda x: [x[0], x[1]],
        lambda x: [x[1], x[0] + x[1]],
        lambda x: [x[0], x[0] * x[1] + x[1]],
    ],
)
def test_outputs_that_depend_on_each_other(outputs):
    """One is a function of the other, of its derivative, or of both."""
    error = violation(pair(outputs))
    assert error.assumption == 5
    assert "a, b" in str(error)


def test_outputs_that_depend_on_each_other_through_the_motion():
    """b' = a + b, found when the chains meet."""
    system = DaeSystem.from_functions(
        5,
        f=lambda x: [x[1], 0, x[0] + x[2], x[4], 0],
        h=lambda x: [[0, 0], [1, 0], [0, 0], [0, 0], [0, 1]],
        l=lambda x: [x[0], x[2]],
    )
    error = violation(system)
    assert error.assumption == 5


def test_outputs_that_depend_on_each_other_are_found_before_integrators_are_added():
    """Beside states that are free, which could feed some rounds."""
    system = DaeSystem.from_functions(
        8,
        f=lambda x: [x[1], ca.sin(x[0]), x[3], x[0], x[5], x[6], x[7], -x[4]],
        h=lambda x: [[0, 0], [1, 0], [0, 0], [0, 1], *[[0, 1]] * 4],
        l=lambda x: [x[0], ca.exp(x[0])],
    )
    assert "not right-invertible" in str(violation(system, max_integrators=0))


def test_an_output_that_repeats_the_constraint():
    def rope(x: ca.SX) -> ca.SX:
        return (x[2] - x[0]) ** 2 + x[3] ** 2 - x[1] ** 2

    error = violation(crane(l=lambda x: [x[2], x[2] + rope(x)]))
    assert error.assumption == 5
    assert "X, Y" in str(error)
    error = violation(crane(l=lambda x: [x[2], rope(x)]))
    assert error.assumption == 5
    assert "'Y'" in str(error)


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


@pytest.mark.parametrize(("make", "count"), [(unicycle, "1 before v"), (vtol, "2 before thrust")])
def test_at_rest_another_nominal_control_is_asked_for(make, count):
    error = violation(make())
    name = count.split()[-1]
    assert f'nominal_control={{"{name}": 1.0}}' in str(error)
    assert count in str(error)
    assert error.state[make().num_states] == 0.0


def test_more_integrators_than_allowed():
    hovering = {"nominal_control": {"thrust": GRAVITY}}
    assert dynamic_extension(vtol(), max_integrators=2, **hovering).integrators == {"thrust": 2}
    error = violation(vtol(), max_integrators=1, **hovering)
    assert error.assumption == 5
    assert "max_integrators = 1" in str(error)


def test_a_constraint_that_binds_the_control_forever():
    """No constraint input ever acts on x0' = u, whatever stands before u."""
    system = DaeSystem.from_functions(
        2,
        f=lambda x: [0, 0],
        g=lambda x: [0, 1],
        h=lambda x: [1, 0],
        k=lambda x: x[0],
        l=lambda x: x[1],
        m=lambda x: 0,
    )
    error = violation(system)
    assert error.assumption == 2
    assert "'y0'" in str(error)


def test_a_rank_that_changes_from_state_to_state():
    """B = [[1, 0, 0], [1, 0, 0], [1, x3^60, 0]] has rank 2 or, to the eye, 1 around x3 = 1."""
    system = DaeSystem.from_functions(
        4,
        f=lambda x: [0, 0, 0, 0],
        h=lambda x: [[1, 0, 0], [1, 0, 0], [1, x[3] ** 60, 0], [0, 0, 1]],
        l=lambda x: x[:3],
        nominal_state=[0, 0, 0, 1],
    )
    error = violation(system, spread=0.1)
    assert "2 to 1" in str(error)
    assert 0.5 < error.state[3] < 1.0


def test_a_spread_of_a_wrong_shape_is_refused():
    with pytest.raises(ModelError, match="spread"):
        dynamic_extension(unicycle(), spread=[0.1, 0.2])


def test_a_robot_keeps_its_mass_matrix():
    """Torques that are set by their rates: force and height of the arm have one degree more.

    And B(x) is the same: what the torque did to z^(mu), its rate does to z^(mu + 1).
    """
    arm = touching("two_link").dae
    names = [signal.name for signal in arm.control_signals]
    plain, slow = find_structure(arm), find_structure(extend(arm, names))
    assert slow.constraint_degrees == plain.constraint_degrees
    assert slow.output_degrees == tuple(degree + 1 for degree in plain.output_degrees)
    for state in slow.states:
        one = evaluated(arm, state[:4], b=plain.control_matrix)[0]
        two = evaluated(slow.system, state, b=slow.control_matrix)[0]
        # A hundred operations on numbers of order 1.
        np.testing.assert_allclose(one, two, rtol=1e-11, atol=1e-12)
