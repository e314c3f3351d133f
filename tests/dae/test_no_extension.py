"""Systems that no integrators help, and what is said of them."""

import casadi as ca
import numpy as np
import pytest
from problems import changed
from problems.extensions import GRAVITY, vtol

from drake_dae.dae import DaeSystem, dynamic_extension
from drake_dae.errors import AssumptionError


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
    error, count, name = violation(vtol()), "2 before thrust", "thrust"
    assert f'nominal_control={{"{name}": 1.0}}' in str(error)
    assert count in str(error)
    assert error.state[vtol().num_states] == 0.0
