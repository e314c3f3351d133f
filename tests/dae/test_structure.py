"""The structure of a system: degrees, matrices, units, and the states that decide."""

import casadi as ca
import numpy as np
import pytest
from problems import PROBLEMS, changed, double_integrator, system_of
from problems.found import degrees, untidy_one, violation

from drake_dae.analysis import Finding, analyze
from drake_dae.dae import DaeSystem, find_structure
from drake_dae.errors import AssumptionError, ModelError


@pytest.mark.slow
@pytest.mark.equation(15)
def test_degrees_index_and_dimensions(problem):
    structure = problem.structure
    assert structure.constraint_degrees == problem.constraint_degrees
    assert structure.output_degrees == problem.output_degrees
    assert structure.index == problem.index
    assert structure.manifold.dimension == problem.manifold_dimension
    assert structure.zero_dynamics_dimension == problem.zero_dynamics
    assert structure.output_order == problem.output_order


def test_a_force_that_the_control_does_not_act_on_is_not_met_at_once():
    """A tangential force u on a pendulum: n* = beta is zero except for round-off, p = 1.

    So the tension m (w^2 L + ...) has degree 1, while the pendulum swings.
    """
    system = PROBLEMS["pendulum_tension"]().system
    x = system.state
    tangential = ca.vertcat(0, 0, -x[1] * untidy_one(x[0]), x[0])
    moving = changed(system, h=tangential, nominal_state=[0.4, -0.6, 0.6, 0.4])
    assert degrees(moving, spread=0.02) == ((2,), (1,))
    # At rest the power that u brings in is zero, and with it the degree undefined.
    resting = changed(moving, nominal_state=[0.48, -0.64, 0.0, 0.0])
    error = violation(resting)
    assert error.assumption == 4
    assert "'tension'" in str(error)


@pytest.mark.parametrize(
    "mass", [[[2.0, 1.0], [0.0, 3.0]], [[2.0, 0.0], [0.0, -3.0]], [[1.0, 1.0], [1.0, 1.0]]]
)
def test_mass_matrices_must_be_symmetric_and_positive_definite(mass):
    with pytest.raises(ModelError, match="mass_matrix"):
        find_structure(changed(double_integrator(), mass_matrix=ca.SX(np.array(mass))))


def test_a_column_of_b_that_is_only_round_off_is_zero():
    """As 1e-17 in place of 0 is, where a table of sines was typed in."""
    system = system_of(
        3,
        f=lambda x: [0, 0, 0],
        h=lambda x: [[ca.cos(x[2]), 1e-17], [ca.sin(x[2]), 2e-17], [0, 1]],
        l=lambda x: [x[0], x[1]],
        nominal_state=[0.0, 0.0, 0.3],
    )
    error = violation(system)
    assert error.assumption == 5
    assert "dynamic_extension" in str(error)


def nearly_singular(off, **more):
    """z' = [[1, 1], [1, 1 + off]] u: the smallest singular value is off / 8^0.5, rows scaled."""
    return DaeSystem.from_functions(
        2,
        f=lambda x: [-x[0], -x[1]],
        h=lambda x: [[1, 1], [1, 1 + off]],
        l=lambda x: [x[0], x[1]],
        **more,
    )


def test_how_near_to_singular_is_singular_is_said_and_can_be_set():
    off = 1e-7
    with pytest.raises(AssumptionError, match=r"least_margin.*1e-06"):
        find_structure(nearly_singular(off))
    report = analyze(nearly_singular(off))
    assert report.assumptions[4].finding is Finding.VIOLATED
    allowed = nearly_singular(off, least_margin=0.1 * off)
    assert find_structure(allowed).control_margin.relative == pytest.approx(off / 8**0.5, rel=0.01)
    assert analyze(allowed).assumptions[4].finding is Finding.SATISFIED
    assert f"{0.1 * off:.0e}" in str(analyze(allowed))
    with pytest.raises(AssumptionError, match="least_margin"):
        find_structure(nearly_singular(0.1, least_margin=0.3))
