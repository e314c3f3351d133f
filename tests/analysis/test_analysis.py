"""What analysis finds of systems: properties, violated assumptions, singular states."""

import re

import casadi as ca
import numpy as np
import pytest
from problems import PROBLEMS, system_of
from problems.found import NO, YES, findings
from runs import some

from drake_dae.analysis import analyze
from drake_dae.dae import DaeSystem, Verdict, find_structure


@pytest.mark.slow
@pytest.mark.parametrize("problem", some(PROBLEMS, of=3), indirect=True)
def test_what_is_known_of_the_problems(problem):
    analysis = analyze(problem.system, count=12)
    assert findings(analysis) == [YES] * 5
    assert analysis.constraint_degrees == problem.constraint_degrees
    assert analysis.output_degrees == problem.output_degrees
    assert analysis.output_order == problem.output_order
    assert analysis.index == problem.index
    assert analysis.manifold_dimension == problem.manifold_dimension
    assert analysis.zero_dynamics_dimension == problem.zero_dynamics
    assert analysis.structure.output_degrees == problem.output_degrees
    # Found by going downhill from the sampled states, so at most what these have.
    a, b = (analysis.assumptions[i].margin for i in (1, 4))
    sampled = [problem.known(x) for x in analysis.states]
    least = min(np.linalg.svd(k.control_matrix)[1][-1] for k in sampled)
    assert 0.0 < b.singular_value <= least * (1 + 1e-10)
    if problem.constraint_degrees:
        least = min(np.linalg.svd(k.constraint_matrix)[1][-1] for k in sampled)
        assert 0.0 < a.singular_value <= least * (1 + 1e-10)
    else:
        assert a is None


@pytest.mark.slow
@pytest.mark.parametrize("problem", some(PROBLEMS, of=3, first=1), indirect=True)
def test_the_gradients_of_all_chains(problem):
    """Theorem 2.1, from the chains that find_structure returns, by NumPy's rank."""
    structure, system = problem.structure, problem.system
    chains = [e for chain in structure.output_chains for e in chain]
    rows = ca.vertcat(structure.manifold.residual_expression, *chains)
    symbols = [system.state, system.parameter_symbol]
    gradient = ca.Function("gradient", symbols, [ca.densify(ca.jacobian(rows, system.state))])
    values = [gradient(x, system.parameter_values).full() for x in structure.states]
    assert all(np.linalg.matrix_rank(value) == rows.numel() for value in values if value.size)


def test_zero_dynamics_that_are_unstable_are_a_problem():
    """x0' = x1 + u, x1' = 2 x1 + u, z = x0: u = -x1 pins z, and x1' = x1 runs away."""
    analysis = analyze(
        system_of(2, f=lambda x: [x[1], 2 * x[1]], h=lambda x: [1, 1], l=lambda x: x[0])
    )
    assert analysis.zero_dynamics.verdict is Verdict.UNSTABLE
    np.testing.assert_allclose(analysis.zero_dynamics.eigenvalues, [1.0], rtol=1e-9)
    (problem,) = analysis.problems
    assert "2.2" in problem
    assert re.search(r"2\.2  zero dynamics are stable +violated", str(analysis))
    assert "eigenvalues 1 1/s" in str(analysis)


def nearly_singular(gap: float, **more) -> DaeSystem:
    """B = [[1, 1], [1, 1 + gap + (x2 - 0.3)^2]], whose determinant does not change its sign."""
    return system_of(
        3,
        f=lambda x: [0, 0, 0],
        h=lambda x: [[1, 1], [1, 1 + gap + (x[2] - 0.3) ** 2], [0, 0]],
        l=lambda x: x[:2],
        **more,
    )


@pytest.mark.slow
def test_a_singular_b_without_a_change_of_sign():
    system = nearly_singular(0.0, state_scale=[1.0, 1.0, 10.0])
    find_structure(system, spread=1.0)  # Does not find it.
    analysis = analyze(system)
    assert findings(analysis) == [YES, YES, YES, YES, NO]
    margin = analysis.assumptions[4].margin
    # Singular is what is below 1e-6, and the determinant (x2 - 0.3)^2.
    assert margin.state[2] == pytest.approx(0.3, abs=2e-3)
    assert analysis.structure is not None
    # States near the nominal one, where it is not.
    near = nearly_singular(0.0, nominal_state=[0.0, 0.0, 0.9])
    assert findings(analyze(near)) == [YES] * 5


def test_the_least_margin_between_states():
    """Where there is no zero, the least is approached: at x2 = 0.3, inside a box of 1 around 0."""
    analysis = analyze(nearly_singular(0.05, state_scale=[1.0, 1.0, 10.0]), count=20)
    margin = analysis.assumptions[4].margin
    least = np.linalg.svd([[1, 1], [1, 1.05]])[1][-1]
    # Flat at the least: 5% of the width away from it costs 1% of the 0.05 there.
    assert margin.singular_value == pytest.approx(least, rel=0.01)
    assert margin.state[2] == pytest.approx(0.3, abs=0.05)
