"""What analysis finds of systems: properties, violated assumptions, singular states."""

import re

import casadi as ca
import numpy as np
import pytest
from problems import (
    PROBLEMS,
    system_of,
)
from problems.found import NO, OPEN, YES, findings
from runs import some

from drake_dae.analysis.analyze import analyze
from drake_dae.analysis.report import Finding
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
@pytest.mark.parametrize("problem", some(PROBLEMS, of=3, first=2), indirect=True)
def test_margins_belong_to_their_states(problem):
    """The state of a margin is consistent, and A or B is as near to singular there as said."""
    analysis = analyze(problem.system, count=12)
    for margin in (analysis.assumptions[1].margin, analysis.assumptions[4].margin):
        if margin is not None:
            # Projected to round-off of numbers of order 10.
            np.testing.assert_allclose(problem.derivatives(margin.state), 0.0, atol=1e-13)
    b = analysis.assumptions[4].margin
    found = np.linalg.svd(problem.known(b.state).control_matrix)[1][-1]
    assert b.singular_value <= found * (1 + 1e-10)


@pytest.mark.slow
@pytest.mark.parametrize("problem", some(PROBLEMS, of=3, first=1), indirect=True)
def test_the_gradients_of_all_chains(problem):
    """Theorem 2.1, from the chains that find_structure returns, by NumPy's rank."""
    analysis = analyze(problem.system, count=3)
    structure, system = problem.structure, problem.system
    chains = [e for chain in structure.output_chains for e in chain]
    rows = ca.vertcat(structure.manifold.residual_expression, *chains)
    if not rows.numel():
        assert analysis.independence is None
        return
    symbols = [system.state, system.parameter_symbol]
    gradient = ca.Function("gradient", symbols, [ca.densify(ca.jacobian(rows, system.state))])
    values = [gradient(x, system.parameter_values).full() for x in analysis.states]
    assert all(np.linalg.matrix_rank(value) == rows.numel() for value in values)
    least = min(np.linalg.svd(value)[1][-1] for value in values)
    assert analysis.independence.singular_value == pytest.approx(least, rel=1e-9)


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


def test_zero_dynamics_that_are_undecided_are_none():
    """A pendulum held by its tension swings for ever."""
    analysis = analyze(PROBLEMS["pendulum_tension"]().system)
    assert analysis.problems == ()
    assert analysis.zero_dynamics_finding is Finding.UNDECIDED
    assert re.search(r"eigenvalues 0 ± 3\.8\d+i 1/s", str(analysis))


@pytest.mark.slow
def test_1_a_degree_that_is_not_defined():
    fields = {
        "f": lambda x: [0, 0, 0],
        "h": lambda x: [1, 0, 0],
        "k": lambda x: x[1] - 1,
        "l": lambda x: x[0],
        "m": lambda x: 0,
    }
    analysis = analyze(system_of(3, g=lambda x: [0, x[0], 0], **fields))
    assert findings(analysis) == [NO, OPEN, OPEN, OPEN, OPEN]
    assert (analysis.constraint_degrees, analysis.index, analysis.structure) == (None, None, None)
    (problem,) = analysis.problems
    assert problem.startswith("Assumption (1): ")
    assert "index ?, N* of dimension ?, zero dynamics of dimension ?" in str(analysis)
    # Beside the nominal state only, and without a change of sign.
    beside = system_of(3, g=lambda x: [0, (x[0] - 0.03) ** 2, 0], state_scale=np.ones(3), **fields)
    find_structure(beside)
    analysis = analyze(beside)
    assert findings(analysis) == [NO, OPEN, YES, YES, YES]
    assert analysis.assumptions[0].margin.state[0] == pytest.approx(0.03, abs=1e-3)
    assert analysis.constraint_degrees == (1,)
    assert analysis.structure is not None


def nearly_singular(gap: float) -> DaeSystem:
    """B = [[1, 1], [1, 1 + gap + (x2 - 0.3)^2]], whose determinant does not change its sign."""
    return system_of(
        3,
        f=lambda x: [0, 0, 0],
        h=lambda x: [[1, 1], [1, 1 + gap + (x[2] - 0.3) ** 2], [0, 0]],
        l=lambda x: x[:2],
    )


@pytest.mark.slow
def test_a_singular_b_without_a_change_of_sign():
    system = nearly_singular(0.0)
    find_structure(system, spread=1.0)  # Does not find it.
    analysis = analyze(system, region={"x2": (-1.0, 1.0)})
    assert findings(analysis) == [YES, YES, YES, YES, NO]
    margin = analysis.assumptions[4].margin
    # Singular is what is below 1e-6, and the determinant (x2 - 0.3)^2.
    assert margin.state[2] == pytest.approx(0.3, abs=2e-3)
    assert analysis.structure is not None
    # A region that does not hold it.
    assert findings(analyze(system, region={"x2": (0.35, 1.0)})) == [YES] * 5


def test_the_least_margin_in_a_region():
    """Where there is no zero, the least is approached: at x2 = 0.3, and at the edge of a box."""
    for low, best in ((-1.0, 0.3), (0.5, 0.5)):
        analysis = analyze(nearly_singular(0.05), region={"x2": (low, 1.0)}, count=20)
        margin = analysis.assumptions[4].margin
        least = np.linalg.svd([[1, 1], [1, 1.05 + (best - 0.3) ** 2]])[1][-1]
        # Flat at the least: 5% of the width away from it costs 1% of the 0.05 there.
        assert margin.singular_value == pytest.approx(least, rel=0.01)
        assert margin.state[2] == pytest.approx(best, abs=0.05)


@pytest.mark.slow
def test_a_singularity_of_two_dimensions_less():
    """det B = (x2 - 0.3)^2 + (x2 + x3)^2 vanishes at one point of a plane."""
    system = system_of(
        4,
        f=lambda x: [0, 0, 0, 0],
        h=lambda x: [[1, 1], [1, 1 + (x[2] - 0.3) ** 2 + (x[3] + x[2]) ** 2], [0, 0], [0, 0]],
        l=lambda x: x[:2],
    )
    analysis = analyze(system, region={"x2": (-1.0, 1.0), "x3": (-1.0, 1.0)})
    assert findings(analysis)[4] is NO
    np.testing.assert_allclose(analysis.assumptions[4].margin.state[2:], [0.3, -0.3], atol=2e-3)


def stretching() -> DaeSystem:
    """Two massless links of 1 m with unit inertias at their joints, the tip on a rail at (s, 0)."""
    q, v = ca.SX.sym("q", 3), ca.SX.sym("v", 3)
    phi = ca.vertcat(ca.cos(q[0]) + ca.cos(q[0] + q[1]) - q[2], ca.sin(q[0]) + ca.sin(q[0] + q[1]))
    jacobian = ca.jacobian(phi, q)
    return DaeSystem(
        state=ca.vertcat(q, v),
        f=ca.vertcat(v, ca.SX.zeros(3)),
        g=ca.vertcat(ca.SX(3, 2), jacobian.T),
        h=ca.vertcat(ca.SX(3, 1), ca.SX([0, 0, 1])),
        k=phi,
        l=q[2],
        m=ca.SX(1, 2),
        nominal_state=[0.9, -1.8, 1.2, 0.0, 0.0, 0.0],
        name="stretching arm",
    )


@pytest.mark.slow
def test_an_arm_that_stretches_out():
    """On N* x1 = -2 x0 and s = 2 cos x0, so s is stationary at x0 = 0 and B vanishes there."""
    analysis = analyze(stretching(), region={"x1": (-2.5, 0.5)})
    assert findings(analysis)[:3] == [YES] * 3
    assert NO in findings(analysis)
    violated = next(a for a in analysis.assumptions if a.finding is NO)
    np.testing.assert_allclose(violated.margin.state[:3], [0.0, 0.0, 2.0], atol=2e-3)
    assert findings(analyze(stretching(), region={"x1": (-2.5, -1.0)})) == [YES] * 5


def test_a_matrix_that_is_constant_on_the_manifold():
    """c1 + c2 = 1 is kept by v, which acts by -(c1 + c2)."""
    analysis = analyze(
        system_of(
            3,
            f=lambda x: [1 - x[0] * x[2], x[0] * x[2], -x[2]],
            g=lambda x: [-x[0], -x[1], 0],
            h=lambda x: [0, 0, 1],
            k=lambda x: [x[0] + x[1] - 1],
            l=lambda x: [x[2]],
            m=lambda x: [[0]],
            nominal_state=[0.6, 0.4, 1.0],
        )
    )
    assert "A(x) is the same at all examined states." in str(analysis)
    assert "B(x) is the same at all states." in str(analysis)
