"""The structure of systems that satisfy the assumptions: degrees, matrices, units."""

import casadi as ca
import numpy as np
import pytest
from problems import PROBLEMS, changed, hidden_normal_form
from problems.found import degrees, untidy_one, violation
from runs import some

from drake_dae.dae import DaeSystem, find_structure
from drake_dae.trace.functions import TracedFunction


@pytest.mark.slow
def test_degrees_index_and_dimensions(problem):
    structure = problem.structure
    assert structure.constraint_degrees == problem.constraint_degrees
    assert structure.output_degrees == problem.output_degrees
    assert structure.index == problem.index
    assert structure.manifold.dimension == problem.manifold_dimension
    assert structure.zero_dynamics_dimension == problem.zero_dynamics
    assert structure.output_order == problem.output_order


@pytest.mark.slow
@pytest.mark.equation(15)
def test_the_order_of_the_outputs_is_that_of_15(problem):
    """In the order found, n* has s rows of zeros first, and every row after has an entry."""
    structure = problem.structure
    n_star = TracedFunction(
        "n*",
        {"x": problem.system.state, "p": problem.system.parameter_symbol},
        {"n": structure.elimination.n_star},
    )
    for state in structure.states:
        value = n_star(state, problem.system.parameter_values)[0]
        value = value.reshape(problem.system.num_controls, -1)[list(structure.output_order)]
        s = sum(degree > 0 for degree in problem.output_degrees)
        # Entries of order 1, or zero up to round-off.
        assert np.abs(value[:s]).max(initial=0.0) < 1e-14
        assert np.abs(value[s:]).max(axis=1, initial=0.0).min(initial=1.0) > 1e-3


@pytest.mark.slow
@pytest.mark.parametrize("seed", some(range(6), of=6))
def test_hidden_normal_forms_are_found(seed):
    """Systems of random degrees behind a diffeomorphism, a feedback, mixed inputs and orders."""
    hidden = hidden_normal_form(seed)
    structure = find_structure(hidden.system)
    assert structure.constraint_degrees == hidden.constraint_degrees
    assert structure.output_degrees == hidden.output_degrees
    assert structure.zero_dynamics_dimension == hidden.zero_dynamics


def positive_definite(random: np.random.Generator, size: int) -> np.ndarray:
    """With a condition of about 10."""
    root = random.normal(size=(size, size))
    return root @ root.T / size + np.eye(size)


def with_mass_matrix(system: DaeSystem, mass: ca.SX) -> DaeSystem:
    """E x' = E f + E g v + E h u: the same system as x' = f + g v + h u."""
    return changed(
        system,
        f=ca.mtimes(mass, system.f),
        g=ca.mtimes(mass, system.g),
        h=ca.mtimes(mass, system.h),
        mass_matrix=mass,
    )


@pytest.mark.slow
@pytest.mark.parametrize("problem", some(PROBLEMS, of=3, first=1), indirect=True)
def test_a_mass_matrix_changes_nothing(problem):
    """(1) multiplied by a positive definite E(x) has the same A, alpha, beta, a, B and degrees."""
    system, random = problem.system, np.random.default_rng(0)
    mass = positive_definite(random, system.num_states)
    other = with_mass_matrix(system, (2 + ca.sin(system.state[0])) * mass)
    structure = find_structure(other)
    assert structure.constraint_degrees == problem.constraint_degrees
    assert structure.output_degrees == problem.output_degrees
    elimination = structure.elimination
    function = TracedFunction(
        "values",
        {"x": system.state, "p": system.parameter_symbol},
        {
            "constraint_matrix": elimination.constraint_matrix,
            "alpha": elimination.alpha,
            "beta": elimination.beta,
            "drift": structure.drift,
            "control_matrix": structure.control_matrix,
        },
    )
    for _ in range(3):
        state = problem.consistent(random)
        found = function(state, system.parameter_values)
        for name, one, two in zip(
            problem.known(state)._fields, found, problem.known(state), strict=True
        ):
            # The solution with E of condition 10 costs a digit, four derivatives of it another two.
            np.testing.assert_allclose(
                one.reshape(two.shape), two, rtol=1e-10, atol=1e-10, err_msg=name
            )


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
