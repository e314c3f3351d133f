"""The structure of a system: degrees, matrices, units, and the states that decide."""

import casadi as ca
import numpy as np
import pytest
from numpy.testing import assert_allclose
from problems import PROBLEMS, changed, double_integrator, hidden_normal_form, system_of
from problems.found import degrees, untidy_one, violation
from runs import some

from drake_dae.analysis import Finding, analyze
from drake_dae.dae import DaeSystem, find_constraint_structure, find_structure
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


@pytest.mark.slow
@pytest.mark.parametrize("seed", some(range(6), of=6))
def test_hidden_normal_forms_are_found(seed):
    """Systems of random degrees behind a diffeomorphism, a feedback, mixed inputs and orders."""
    hidden = hidden_normal_form(seed)
    structure = find_structure(hidden.system)
    assert structure.constraint_degrees == hidden.constraint_degrees
    assert structure.output_degrees == hidden.output_degrees
    assert structure.zero_dynamics_dimension == hidden.zero_dynamics


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


def test_constraints_alone_decide_how_a_system_moves():
    """The same degrees, A(x) and rate as with outputs; B(x) may be singular, or not square."""
    x = ca.SX.sym("x", 4)
    pendulum = {
        "state": x,
        "f": ca.vertcat(x[2], x[3], 0, -9.81),
        "g": ca.vertcat(0, 0, x[0], x[1]),
        "k": (ca.sumsqr(x[:2]) - 1) / 2,
        "nominal_state": [1.0, 0.0, 0.0, 0.0],
    }
    h = ca.vertcat(0, 0, -x[1], x[0])
    whole = find_structure(DaeSystem(**pendulum, h=h, l=x[0] * x[3] - x[1] * x[2], m=[0]))
    others = {
        "nothing": {"h": ca.SX(4, 0), "l": ca.SX(0, 1), "m": ca.SX(0, 1)},
        "the constraint as an output": {"h": h, "l": ca.sumsqr(x[:2]), "m": [0]},
        "two outputs": {"h": h, "l": x[:2], "m": [[0], [1]]},
    }
    state = whole.manifold.project([0.6, 0.8, 0.4, -0.3])
    for name, fields in others.items():
        found = find_constraint_structure(DaeSystem(**pendulum, **fields))
        assert (found.constraint_degrees, found.index) == ((2,), 3), name
        elimination = found.elimination
        values = found.system.trace("values", {"f": elimination.f_star, "v": elimination.alpha})
        expected = whole.system.trace(
            "values", {"f": whole.elimination.f_star, "v": whole.elimination.alpha}
        )
        for one, other in zip(values(state, []), expected(state, []), strict=True):
            assert_allclose(one, other, atol=1e-14)  # The same operations.
    analysis = analyze(DaeSystem(**pendulum, **others["nothing"]))
    assert [str(a.finding) for a in analysis.assumptions] == ["satisfied"] * 3 + [
        "not examined"
    ] * 2
    assert analysis.constraint_structure.constraint_degrees == (2,)
    assert not analysis.problems


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
