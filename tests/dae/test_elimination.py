import casadi as ca
import numpy as np
import pytest
from problems import PROBLEMS, Problem

from drake_dae.dae import find_structure
from drake_dae.dae.derivatives import lie_derivative, lie_derivative_along
from drake_dae.trace.functions import TracedFunction


def states(problem: Problem) -> list[np.ndarray]:
    """Consistent states, and states beside N*, where (9)-(14) are defined too."""
    random = np.random.default_rng(1)
    near = problem.system.nominal_state + 0.1 * random.standard_normal(
        (3, problem.system.num_states)
    )
    return [*(problem.consistent(random) for _ in range(3)), *near]


def evaluated(problem: Problem, **expressions: ca.SX) -> TracedFunction:
    system = problem.system
    return TracedFunction("values", {"x": system.state, "p": system.parameter_symbol}, expressions)


@pytest.mark.equation(2, 13, 14, 16)
def test_a_alpha_beta_drift_and_b_are_those_found_by_hand(problem):
    structure = problem.structure
    elimination = structure.elimination
    function = evaluated(
        problem,
        constraint_matrix=elimination.constraint_matrix,
        alpha=elimination.alpha,
        beta=elimination.beta,
        drift=structure.drift,
        control_matrix=structure.control_matrix,
    )
    for state in states(problem):
        found = function(state, problem.system.parameter_values)
        for name, one, two in zip(
            problem.known(state)._fields, found, problem.known(state), strict=True
        ):
            # Closed forms of some ten operations on numbers up to 1e3.
            np.testing.assert_allclose(
                one.reshape(two.shape), two, rtol=1e-11, atol=1e-12, err_msg=name
            )


@pytest.mark.equation(3, 9, 10, 11, 12, 46, 47, 48, 49)
def test_the_rest_follows_from_the_definitions(problem):
    """(9)-(12) with alpha and beta by hand."""
    system = problem.system
    elimination = find_structure(system).elimination
    starred = evaluated(
        problem,
        f=elimination.f_star,
        h=elimination.h_star,
        l=elimination.l_star,
        n=elimination.n_star,
    )
    plain = evaluated(problem, f=system.f, g=system.g, h=system.h, l=system.l, m=system.m)
    n, m, p = system.num_states, system.num_constraints, system.num_controls
    shapes = [(n,), (n, p), (p,), (p, p)]
    for state in states(problem):
        parameters = system.parameter_values
        f, g, h, el, em = plain(state, parameters)
        alpha, beta = problem.known(state)[1:3]
        g, h, em = g.reshape(n, m), h.reshape(n, p), em.reshape(p, m)
        expected = (f + g @ alpha, h + g @ beta, el + em @ alpha, em @ beta)
        for one, two, shape in zip(starred(state, parameters), expected, shapes, strict=True):
            np.testing.assert_allclose(one.reshape(shape), two, rtol=1e-11, atol=1e-12)


def lie_derivatives(expression, field, state, order):
    """[k, L_f k, ..., L_f^order k]."""
    chain = [expression]
    for _ in range(order):
        chain.append(lie_derivative(chain[-1], field, state))
    return chain


@pytest.mark.equation(17, 18, 19, 25)
def test_constraint_inputs_keep_the_constraint(problem):
    """L_f*^k k_i = L_f^k k_i below r_i, L_f*^k k_i = 0 from r_i on, L_h* L_f*^k k_i = 0 always."""
    structure = problem.structure
    elimination, x = structure.elimination, problem.system.state
    lower, vanishing, by_control = (
        [ca.SX(0, 1)],
        [ca.SX(0, 1)],
        [ca.SX(0, problem.system.num_controls)],
    )
    for i, degree in enumerate(structure.constraint_degrees):
        plain = lie_derivatives(problem.system.k[i], problem.system.f, x, degree - 1)
        starred = lie_derivatives(problem.system.k[i], elimination.f_star, x, degree + 1)
        lower += [one - two for one, two in zip(starred[:degree], plain, strict=True)]
        vanishing += starred[degree:]
        by_control += [
            lie_derivative_along(order, elimination.h_star, x) for order in starred[: degree + 1]
        ]
    function = evaluated(
        problem,
        lower=ca.vertcat(*lower),
        vanishing=ca.vertcat(*vanishing),
        by_control=ca.vertcat(*by_control),
    )
    for state in states(problem):
        for value in function(state, problem.system.parameter_values):
            # Sums of terms up to 1e3 that cancel.
            np.testing.assert_allclose(value, 0.0, atol=1e-11)


def test_the_pivot_says_where_a_is_singular():
    problem = PROBLEMS["pendulum"]()
    function = evaluated(problem, pivot=problem.structure.elimination.pivot)
    parameters = problem.system.parameter_values
    assert function([0.4, -0.6, 0.0, 0.0], parameters)[0] == 1.0
    assert function(np.zeros(4), parameters)[0] == 0.0
