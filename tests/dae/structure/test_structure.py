from collections.abc import Callable

import casadi as ca
import numpy as np
import pytest
from numpy.testing import assert_allclose
from problems import (
    PROBLEMS,
    changed,
    double_integrator,
    early_control,
    hidden_normal_form,
    in_other_units,
    redundant,
    system_of,
)
from runs import some

from drake_dae.analysis.analyze import analyze
from drake_dae.dae.derivatives import Derivatives
from drake_dae.dae.structure import relative_degrees
from drake_dae.dae.structure.constrained import find_constraint_structure
from drake_dae.dae.structure.structure import examine_structure, find_structure
from drake_dae.dae.system.signals import Parameter
from drake_dae.dae.system.system import DaeSystem
from drake_dae.errors import AssumptionError, InconsistentStateError, ModelError
from drake_dae.trace.functions import TracedFunction
from drake_dae.trace.lie import lie_derivative


def degrees(system: DaeSystem, **options) -> tuple[tuple[int, ...], tuple[int, ...]]:
    structure = find_structure(system, **options)
    return structure.constraint_degrees, structure.output_degrees


def violation(system: DaeSystem, **options) -> AssumptionError:
    with pytest.raises(AssumptionError) as caught:
        find_structure(system, **options)
    return caught.value


# ---- systems that satisfy the assumptions


@pytest.mark.slow
def test_degrees_index_and_dimensions(problem):
    structure = find_structure(problem.system)
    assert structure.constraint_degrees == problem.constraint_degrees
    assert structure.output_degrees == problem.output_degrees
    assert structure.index == problem.index
    assert structure.manifold.dimension == problem.manifold_dimension
    assert structure.zero_dynamics_dimension == problem.zero_dynamics
    assert structure.output_order == problem.output_order
    assert structure.num_dynamic_outputs == sum(d > 0 for d in problem.output_degrees)


@pytest.mark.slow
def test_the_order_of_the_outputs_is_that_of_15(problem):
    """In the order found, n* has s rows of zeros first, and every row after has an entry."""
    structure = find_structure(problem.system)
    n_star = TracedFunction(
        "n*",
        {"x": problem.system.state, "p": problem.system.parameter_symbol},
        {"n": structure.elimination.n_star},
    )
    for state in structure.states:
        value = n_star(state, problem.system.parameter_values)[0]
        value = value.reshape(problem.system.num_controls, -1)[list(structure.output_order)]
        s = structure.num_dynamic_outputs
        # Entries of order 1, or zero up to round-off.
        assert np.abs(value[:s]).max(initial=0.0) < 1e-14
        assert np.abs(value[s:]).max(axis=1, initial=0.0).min(initial=1.0) > 1e-3


@pytest.mark.slow
def test_numbers_were_decided_at_consistent_states(problem):
    structure = find_structure(problem.system, count=5)
    assert structure.states.shape == (6, problem.system.num_states)
    nominal = structure.manifold.project(problem.system.nominal_state)
    np.testing.assert_array_equal(structure.states[0], nominal)
    for state in structure.states:
        # Projected to round-off of numbers of order 10.
        np.testing.assert_allclose(problem.derivatives(state), 0.0, atol=1e-14)


@pytest.mark.slow
def test_margins_are_singular_values_at_the_states(problem):
    structure = find_structure(problem.system)
    b = [np.linalg.svd(problem.known(x).control_matrix)[1][-1] for x in structure.states]
    assert structure.control_margin.singular_value == pytest.approx(min(b), rel=1e-10)
    assert 0.0 < structure.control_margin.relative <= 1.0 + 1e-12 or len(b) > 1
    if problem.constraint_degrees:
        a = [np.linalg.svd(problem.known(x).constraint_matrix)[1][-1] for x in structure.states]
        assert structure.constraint_margin.singular_value == pytest.approx(min(a), rel=1e-10)
    else:
        assert structure.constraint_margin is None


def test_the_same_seed_gives_the_same_states():
    system = PROBLEMS["two_link_arm"]().system
    one, two, other = (find_structure(system, seed=seed).states for seed in (3, 3, 4))
    np.testing.assert_array_equal(one, two)
    assert np.abs(one[1:] - other[1:]).min() > 0.0


def test_spread_and_count():
    system = PROBLEMS["flexible_pendulum"]().system
    structure = find_structure(system, spread=[0.0, 0.0, 10.0, 0.001], count=200)
    deviation = structure.states[1:].std(axis=0)
    # 200 normal numbers: their deviation is known to 5%.
    np.testing.assert_allclose(deviation, [0.0, 0.0, 10.0, 0.001], rtol=0.25)
    assert find_structure(system, count=1).states.shape == (2, 4)
    with pytest.raises(ModelError, match="count must be a whole number from 1, got 0"):
        find_structure(system, count=0)
    with pytest.raises(ModelError, match="seed must be a whole number from 0, got -1"):
        find_structure(system, seed=-1)
    for wrong in ([0.1, 0.2], [[0.1]], np.nan):
        with pytest.raises(
            ModelError, match=r"spread must be (a number or have shape \(4,\)|finite)"
        ):
            find_structure(system, spread=wrong)


@pytest.mark.slow
@pytest.mark.parametrize("seed", some(range(30)))
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
@pytest.mark.parametrize("seed", range(5))
def test_units_do_not_matter(problem, seed):
    """Every state, input and output in its own unit, from 1e-4 to 1e4 of the original one.

    A dense mass matrix fills all zeros with round-off.
    """
    random = np.random.default_rng(seed)
    # The nearest consistent state depends on the units: start from a consistent one.
    system = changed(problem.system, nominal_state=problem.consistent(random))
    counts = (
        system.num_states,
        system.num_constraints,
        system.num_controls,
        system.num_constraints,
        system.num_controls,
    )
    factors = [10 ** random.uniform(-4, 4, count) for count in counts]
    other = in_other_units(system, *factors)
    bend = 2 + ca.sin(other.state[0] * factors[0][0])
    dense = with_mass_matrix(
        other,
        bend * (positive_definite(random, system.num_states) * np.outer(factors[0], factors[0])),
    )
    for one in (other, dense):
        structure = find_structure(one, spread=0.01 / factors[0])
        assert structure.constraint_degrees == problem.constraint_degrees
        assert structure.output_degrees == problem.output_degrees
    # The same matrix but for scaling; the equilibration is not quite unique.
    relative = find_structure(system, spread=0.01).control_margin.relative
    assert structure.control_margin.relative == pytest.approx(relative, rel=0.9)


@pytest.mark.slow
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


# ---- zeros that are not structural


def untidy_one(x: ca.SX) -> ca.SX:
    """1, but CasADi does not see it, and it is off by round-off."""
    return ca.exp(x) * ca.exp(-x)


def test_a_control_that_the_constraint_cancels_never_acts():
    """A radial force on a pendulum is taken up by the rod: h* is zero but for round-off, p = 1."""
    system = PROBLEMS["pendulum"]().system
    x = system.state
    radial = ca.vertcat(0, 0, x[0] * untidy_one(x[1]), x[1])
    error = violation(changed(system, h=radial))
    assert error.assumption == 5
    assert "output 'x'" in str(error)


def test_a_force_that_the_control_does_not_act_on_is_not_met_at_once():
    """A tangential force u on a pendulum: n* = beta is zero but for round-off, p = 1.

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
    assert "output 'tension' is not defined at x = [ 0.48, -0.64,  0.  ,  0.  ]" in str(error)


def test_small_numbers_are_not_zeros():
    """A control that acts through 1e-8 beside terms of order 1 does act."""
    tiny = system_of(2, f=lambda x: [x[1], x[0]], h=lambda x: [1e-8, 1], l=lambda x: x[0])
    assert degrees(tiny) == ((), (1,))
    # And through 1e-17, as a similarity transform in floating point leaves behind, it does not.
    noise = system_of(2, f=lambda x: [x[1], x[0]], h=lambda x: [1e-17, 1], l=lambda x: x[0])
    assert degrees(noise) == ((), (2,))


def test_a_transformed_linear_system_keeps_its_degree():
    """A chain of five integrators behind T F T^-1 in floating point."""
    t = np.random.default_rng(3).normal(size=(5, 5))
    inverse = np.linalg.inv(t)
    x = ca.SX.sym("x", 5)
    system = DaeSystem(
        state=x,
        f=(t @ np.eye(5, k=1) @ inverse) @ x,
        g=[],
        h=t[:, -1],
        k=[],
        l=inverse[:1] @ x,
        m=[],
    )
    assert degrees(system) == ((), (5,))


# ---- violated assumptions


def test_1_a_degree_that_is_not_defined_at_the_nominal_state():
    error = violation(
        system_of(
            3,
            f=lambda x: [0, 0, 0],
            g=lambda x: [0, x[0], 0],
            h=lambda x: [1, 0, 0],
            k=lambda x: x[1] - 1,
            l=lambda x: x[0],
            m=lambda x: 0,
        )
    )
    assert error.assumption == 1
    assert "degree of constraint 'y0' is not defined at x = [0., 1., 0.]" in str(error)
    np.testing.assert_array_equal(error.state, [0.0, 1.0, 0.0])


def test_1_a_gradient_that_vanishes_on_the_constraint():
    error = violation(
        system_of(
            2,
            f=lambda x: [0, 0],
            g=lambda x: [0, 1],
            h=lambda x: [1, 0],
            k=lambda x: x[1] ** 2,
            l=lambda x: x[0],
            m=lambda x: 0,
        )
    )
    assert error.assumption == 1
    assert "write the constraint so that its gradient does not vanish" in str(error)


def test_1_a_degree_that_is_lost_between_the_sampled_states():
    """g = x0 - 0.03 vanishes beside the nominal state: its sign changes on the way."""
    error = violation(
        system_of(
            3,
            f=lambda x: [0, 0, 0],
            g=lambda x: [0, x[0] - 0.03, 0],
            h=lambda x: [1, 0, 0],
            k=lambda x: x[1] - 1,
            l=lambda x: x[0],
            m=lambda x: 0,
        ),
        spread=0.1,
    )
    assert error.assumption == 1
    assert "constraint 'y0'" in str(error)
    # Bisection ends at neighbouring numbers.
    assert error.state[0] == pytest.approx(0.03, abs=1e-12)


@pytest.mark.parametrize(
    "k",
    [
        lambda x: [x[0], x[0]],
        lambda x: [x[0] - 1, 2 * x[0] - 2],
        lambda x: [x[0] - 1, (x[0] - 1) * (2 + ca.sin(x[2]))],
        lambda x: [ca.sin(x[0]) - 0.1, 0.99 - ca.cos(x[0]) ** 2],
        lambda x: [x[0] - 1, (x[0] - 1) * untidy_one(x[2])],
        lambda x: [x[0] - 1, (1 + 1e-9) * (x[0] - 1) + 1e-10 * (x[0] - 1) * x[2]],
    ],
)
def test_2_redundant_constraints(k):
    """Exactly, by a factor, on N* alone, by an identity, and but for round-off."""
    error = violation(redundant(k))
    assert error.assumption == 2
    assert "A(x) loses rank at x = " in str(error)
    assert "The constraints are redundant" in str(error)


def test_2_forces_that_do_not_act_independently():
    error = violation(
        redundant(
            lambda x: [x[0], x[2]],
            g=lambda x: [[0, 0], [1, 2], [0, 0], [1, 2]],
            h=lambda x: [0, 1, 0, 0],
        )
    )
    assert error.assumption == 2


def test_2_a_rank_that_is_lost_between_the_sampled_states():
    """A = [[1, 1], [1, 1 + x4 - 0.02]]: no row vanishes where it is singular."""
    error = violation(
        system_of(
            5,
            f=lambda x: [x[1], 0, x[3], 0, 0],
            g=lambda x: [[0, 0], [1, 1], [0, 0], [1, 1 + x[4] - 0.02], [0, 0]],
            h=lambda x: [0, 0, 0, 0, 1],
            k=lambda x: [x[0], x[2]],
            l=lambda x: x[4],
            m=lambda x: [[0, 0]],
        )
    )
    assert error.assumption == 2
    assert error.state[4] == pytest.approx(0.02, abs=1e-6)


def test_2_more_constraints_than_states():
    error = violation(
        system_of(
            1,
            f=lambda x: 0,
            g=lambda x: [[1, 1]],
            h=lambda x: 1,
            k=lambda x: [x[0], x[0] + 1],
            l=lambda x: x[0],
            m=lambda x: [[0, 0]],
        )
    )
    assert error.assumption == 2
    assert "m = 2 constraints are more than the states" in str(error)


@pytest.mark.parametrize(
    "k",
    [
        lambda x: x[2],  # A state that moves by itself,
        lambda x: ca.sin(x[2]) + x[3] ** 2,  # two of them,
        lambda x: x[0] ** 2 - x[0] * x[0] * untidy_one(x[2]) + x[2],  # or by a sum that cancels.
        lambda x: x[4] - 0.1,  # A state that does not move.
    ],
)
def test_2_no_force_keeps_the_constraint(k):
    error = violation(
        system_of(
            5,
            f=lambda x: [x[1], 0, x[3], -x[2], 0],
            g=lambda x: [0, 1, 0, 0, 0],
            h=lambda x: [0, 1, 0, 0, 0],
            k=k,
            l=lambda x: x[0],
            m=lambda x: 0,
        )
    )
    assert error.assumption == 2
    assert "no constraint input ever acts on constraint 'y0'" in str(error)


def test_3_a_control_that_enters_before_the_force_does():
    error = violation(early_control())
    assert error.assumption == 3
    assert "the control acts on derivative 1 of constraint 'y0', before any" in str(error)
    # At the same order it is allowed.
    assert degrees(PROBLEMS["pendulum"]().system)[0] == (2,)


def test_4_a_degree_that_is_not_defined_at_the_nominal_state():
    error = violation(double_integrator(l=lambda x: x[0] + x[1] ** 2))
    assert error.assumption == 4
    assert "output 'z0' is not defined at x = [0., 0.]" in str(error)
    assert "acts on its derivative 1 around this state" in str(error)
    # An output that is met at once nearly everywhere.
    tension = PROBLEMS["pendulum_tension"]().system
    error = violation(changed(tension, nominal_state=[0.0, -0.8, 0.0, 0.0]))
    assert error.assumption == 4
    assert "acts on its derivative 0" in str(error)


def test_4_a_degree_that_is_lost_between_the_sampled_states():
    system = double_integrator(l=lambda x: x[0] + x[1] ** 2, nominal_state=[0.0, -0.04])
    error = violation(system, spread=0.1)
    assert error.assumption == 4
    assert "output 'z0'" in str(error)
    assert error.state[1] == pytest.approx(0.0, abs=1e-12)


def test_5_outputs_that_repeat():
    """An output that repeats another, a constraint, a combination, a function of both."""
    system = PROBLEMS["gantry"]().system
    q = system.state
    one_more = [system.l[i] for i in range(4)]
    no_force = np.array([[1, 0], [0, 0], [0, 1], [0, 0]])
    for row, output in (
        (3, q[2]),
        (3, 2 * q[2] + 1),
        (3, ca.sin(q[2])),
        (3, q[2] + q[0]),
        (3, q[2] * (1 + (q[0] - 1) * q[3])),
    ):
        error = violation(changed(system, l=ca.vertcat(*one_more[:row], output), m=no_force))
        assert error.assumption == 5
        assert "the controlled outputs v1, q3, v2, q4 cannot be steered" in str(error)
    for output in (q[0], 3 * q[0] + q[1], q[0] ** 2, (q[0] - 1) * q[2], q[4], ca.SX(0), ca.SX(7)):
        error = violation(changed(system, l=ca.vertcat(*one_more[:3], output), m=no_force))
        assert error.assumption == 5
        assert "the control never acts on output 'q4'" in str(error)


@pytest.mark.parametrize(
    ("factors", "text"),
    [
        ((0, 0, 1), "'q4' ~ 1 v2"),
        ((0, 0, -2.5), "'q4' ~ -2.5 v2"),
        ((0, 3, 0), "'q4' ~ 3 q3"),
        ((3, 0, 0.5), "'q4' ~ 3 v1 + 0.5 v2"),
    ],
)
def test_5_an_output_that_follows_from_others_is_named_with_its_factors(factors, text):
    """v1 and v2 are forces of the gantry, and q3 is a position."""
    system = PROBLEMS["gantry"]().system
    rows = [system.l[i] for i in range(4)]
    last = sum((f * row for f, row in zip(factors, rows[:3], strict=True)), ca.SX(0))
    m = np.array([[1, 0], [0, 0], [0, 1], [0, 0]], dtype=float)
    m[3] = np.array(factors) @ m[:3]
    error = violation(changed(system, l=ca.vertcat(*rows[:3], last), m=m))
    (found,) = error.violation.combinations
    assert f"rows of B(x): {text}" in str(error)
    assert found.name == "q4"
    np.testing.assert_allclose(found.factors, [f for f in factors if f], rtol=1e-9)


@pytest.mark.parametrize("factor", [1.0, -3.0, 1e-3])
def test_5_an_output_that_repeats_a_constraint_is_named_with_it(factor):
    arm = PROBLEMS["two_link_arm"]().system
    (name,) = [signal.name for signal in arm.constraint_output_signals]
    error = violation(changed(arm, l=ca.vertcat(0, factor * arm.k)))
    assert f"it follows from the constraints, 'height' ~ {factor:g} {name}" in str(error)


def test_5_an_output_that_repeats_a_curved_constraint():
    arm = PROBLEMS["two_link_arm"]().system
    for output in (arm.k, arm.k + arm.k**2, ca.sin(arm.k)):
        error = violation(changed(arm, l=ca.vertcat(0, output)))
        assert error.assumption == 5
        assert "the control never acts on output 'height'" in str(error)
    error = violation(changed(arm, l=ca.vertcat(0, 0), m=[1, 2]))
    assert error.assumption == 5
    assert "B(x) of (16) is singular" in str(error)


@pytest.fixture
def derivatives_taken(monkeypatch) -> list[int]:
    """Counts the derivatives of outputs and of constraints, which grow without bound in size."""
    taken = []

    def counted(derivative: Callable) -> Callable:
        def count(*arguments):
            taken.append(1)
            return derivative(*arguments)

        return count

    monkeypatch.setattr(Derivatives, "derivative", counted(Derivatives.derivative))
    monkeypatch.setattr(relative_degrees, "lie_derivative", counted(lie_derivative))
    return taken


def beside_an_integrator(n: int, **fields) -> DaeSystem:
    """x0'' = u + v, and nonlinear states that nothing reaches; after ten derivatives of these
    CasADi takes minutes."""
    moving = [ca.sin, *[lambda x: x] * (n - 3)]
    base = {
        "f": lambda x: [
            x[1],
            0,
            *[moving[i](x[2 + (i + 1) % (n - 2)]) * x[2 + i] ** 2 for i in range(n - 2)],
        ],
        "h": lambda x: [0, 1, *[0] * (n - 2)],
        "nominal_state": [0.5] * n,
    }
    return system_of(n, **{**base, **fields})


def test_5_an_output_that_no_control_reaches(derivatives_taken):
    error = violation(beside_an_integrator(20, l=lambda x: x[5]))
    assert error.assumption == 5
    assert "no control reaches it" in str(error)
    assert len(derivatives_taken) <= 1


def test_2_a_constraint_that_no_force_reaches(derivatives_taken):
    error = violation(
        beside_an_integrator(
            20,
            g=lambda x: [0, 1, *[0] * 18],
            k=lambda x: x[5] - 0.5,
            l=lambda x: x[0],
            m=lambda x: 0,
        )
    )
    assert error.assumption == 2
    assert "none reaches it" in str(error)
    assert len(derivatives_taken) == 0


def test_5_an_output_that_repeats_the_constraint_is_found_at_once(derivatives_taken):
    """By Theorem 2.1, before its derivatives fill the state; h* is zero by cancellation alone."""
    system = beside_an_integrator(
        20,
        g=lambda x: [0, untidy_one(x[4]), *[0] * 18],
        h=lambda x: [0, untidy_one(x[3]), *[0] * 18],
        k=lambda x: x[0] * (2 + x[6]) + x[5] ** 2 - 0.75,
        l=lambda x: (x[0] * (2 + x[6]) + x[5] ** 2 - 0.75) * (1 + x[3]),
        m=lambda x: 0,
    )
    error = violation(system)
    assert error.assumption == 5
    assert "it follows from the constraints, 'z0' ~ 1.5 y0" in str(error)
    # One of the constraint, two of the output.
    assert len(derivatives_taken) <= 3


def test_2_a_constraint_whose_derivatives_repeat_is_found_at_once(derivatives_taken):
    """x2 oscillates by itself; x0 enters and cancels, so that the structure does not tell."""
    n = 20
    system = system_of(
        n,
        f=lambda x: [x[1], 0, x[3], -x[2], *[0] * (n - 4)],
        g=lambda x: [0, 1, *[0] * (n - 2)],
        h=lambda x: [0, 1, *[0] * (n - 2)],
        k=lambda x: x[2] + x[0] ** 2 - x[0] ** 2 * untidy_one(x[4]),
        l=lambda x: x[0],
        m=lambda x: 0,
    )
    error = violation(system)
    assert error.assumption == 2
    assert "no constraint input ever acts on constraint 'y0'" in str(error)
    assert len(derivatives_taken) <= 2


def test_2_redundant_constraints_that_fill_the_state():
    """Their four derivatives have no room in three states."""
    error = violation(
        system_of(
            3,
            f=lambda x: [x[1], 0, 0],
            g=lambda x: [[0, 0], [1, 1], [0, 1]],
            h=lambda x: [0, 0, 1],
            k=lambda x: [x[0], x[0]],
            l=lambda x: x[2],
            m=lambda x: [[0, 0]],
        )
    )
    assert error.assumption == 2
    assert "repeat each other or fill the state" in str(error)


def test_5_a_b_that_is_singular_between_the_sampled_states():
    """x' = (u1 + u2, u1 + (1 + x2 - 0.02) u2, 0.1 u1 ...): no row vanishes."""
    error = violation(
        system_of(
            3,
            f=lambda x: [0, 0, 0],
            h=lambda x: [[1, 1, 0], [1, 1 + x[2] - 0.02, 0], [0, 0, 1]],
            l=lambda x: x,
        )
    )
    assert error.assumption == 5
    assert error.state[2] == pytest.approx(0.02, abs=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 15, 40, 46])
def test_5_a_singular_b_hidden_in_a_random_system(seed):
    """In place of a second output of degree mu >= 1, a function of the first one and of k."""
    while True:
        hidden = hidden_normal_form(seed)
        system, mu = hidden.system, hidden.output_degrees
        of_state = [i for i in range(len(mu)) if mu[i] and not system.m[i, :].nnz()]
        if len(of_state) >= 2 and hidden.constraint_degrees:
            break
        seed += 100
    first, second = of_state[:2]
    outputs = [system.l[i] for i in range(system.num_controls)]
    outputs[second] = outputs[first] * (1 + 0.3 * outputs[first]) + system.k[0]
    assert violation(changed(system, l=ca.vertcat(*outputs))).assumption == 5


@pytest.mark.slow
def test_examine_structure_finds_the_same(problem):
    structure, violation = examine_structure(problem.system)
    assert violation is None
    assert structure.output_degrees == problem.output_degrees


def test_the_structure_of_a_singular_b_is_complete():
    """A unicycle whose position is the output: the rate of its heading acts on neither."""
    unicycle = system_of(
        3,
        f=lambda x: [0, 0, 0],
        h=lambda x: [[ca.cos(x[2]), 0], [ca.sin(x[2]), 0], [0, 1]],
        l=lambda x: x[:2],
        nominal_state=[0.0, 0.0, 0.7],
    )
    structure, violation = examine_structure(unicycle)
    assert violation.assumption == 5
    assert structure.output_degrees == (1, 1)
    b = TracedFunction("B", {"x": unicycle.state}, {"b": structure.control_matrix})([0, 0, 0.7])[0]
    np.testing.assert_allclose(b, [[np.cos(0.7), 0.0], [np.sin(0.7), 0.0]], rtol=1e-15)
    margin = structure.control_margin
    assert margin.is_singular
    assert margin.vanishing_row is None
    np.testing.assert_array_equal(margin.state, violation.state)
    with pytest.raises(AssumptionError, match=r"B\(x\) of \(16\) is singular") as caught:
        find_structure(unicycle)
    assert str(caught.value) == str(violation)
    assert caught.value.violation.names == tuple(signal.name for signal in unicycle.output_signals)


def test_a_vanishing_row_of_b():
    """B = [[x1]] around x1 = 0.02: the sign changes on the way to the states beyond."""
    system = system_of(
        2,
        f=lambda x: [0, 0],
        h=lambda x: [[x[1], 0], [0, 1]],
        l=lambda x: x,
        nominal_state=[0.0, 0.02],
    )
    structure, violation = examine_structure(system, spread=0.1)
    assert violation.assumption == 4
    assert structure.control_margin.vanishing_row == 0
    assert structure.control_margin.state[1] == pytest.approx(0.0, abs=1e-12)


# ---- states and functions that are not there


@pytest.mark.parametrize("k", [lambda x: x[1] ** 2 + 1, lambda x: ca.exp(x[1]) + 0.5])
def test_a_constraint_that_cannot_be_met(k):
    with pytest.raises(InconsistentStateError, match="test: no consistent state found near"):
        find_structure(
            system_of(
                2,
                f=lambda x: [0, 0],
                g=lambda x: [0, 1],
                h=lambda x: [1, 0],
                k=k,
                l=lambda x: x[0],
                m=lambda x: 0,
            )
        )


def test_constraints_that_contradict_each_other():
    with pytest.raises(InconsistentStateError, match="constraints contradict each other"):
        find_structure(redundant(lambda x: [x[0] - 1, x[0] - 2]))


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"f": lambda x: [ca.sqrt(x[0] - 1), 0]}, "f of .* not finite"),
        ({"h": lambda x: [0, 1 / x[0]]}, "h of .* not finite"),
        ({"f": lambda x: [x[1], ca.log(x[0])], "l": lambda x: 1 / x[1]}, "f, l of .* not finite"),
        # Finite, but with an infinite derivative.
        ({"l": lambda x: ca.sqrt(x[0])}, "is not finite at the consistent state"),
    ],
)
def test_functions_that_are_not_finite_at_the_nominal_state(fields, message):
    with pytest.raises(ModelError, match=message):
        find_structure(double_integrator(**fields))


def test_a_constraint_that_is_not_finite_at_the_nominal_state():
    with pytest.raises(InconsistentStateError, match="y0 is not finite at the given state"):
        find_structure(redundant(lambda x: [ca.sqrt(x[0] - 1) - 1, x[2]]), spread=0.0)


def test_samples_outside_the_domain_are_left_out():
    """A tank x' = u - sqrt(x) near empty: about a third of the states drawn are below zero."""
    tank = system_of(1, f=lambda x: -ca.sqrt(x), h=lambda x: 1, l=lambda x: x, nominal_state=[0.05])
    structure = find_structure(tank, spread=0.1)
    assert structure.output_degrees == (1,)
    assert 1 < len(structure.states) < 13
    assert structure.states.min() > 0.0


def test_branches_of_the_manifold_are_no_singularity():
    """x0^2 = 1 from around 0 ends at both 1 and -1, where A has opposite signs, with no way."""
    structure = find_structure(
        system_of(
            2,
            f=lambda x: [0, 0],
            g=lambda x: [1, 0],
            h=lambda x: [0, 1],
            k=lambda x: x[0] ** 2 - 1,
            l=lambda x: x[1],
            m=lambda x: 0,
        )
    )
    assert {-1.0, 1.0} == set(structure.states[:, 0])
    assert structure.constraint_degrees == (1,)


def test_infinite_matrices_are_no_singularity():
    """B = 1/(x0 - 0.02) changes its sign through infinity."""
    with pytest.raises(ModelError, match="not finite"):
        find_structure(system_of(1, f=lambda x: 0, h=lambda x: 1 / x, l=lambda x: x))
    structure = find_structure(
        system_of(1, f=lambda x: 0, h=lambda x: 1 / (x - 0.02), l=lambda x: x)
    )
    assert structure.output_degrees == (1,)


def test_a_law_needs_as_many_outputs_as_controls():
    with pytest.raises(ModelError, match="no control input, so there is nothing to steer"):
        find_structure(system_of(1, f=lambda x: 0))
    for outputs, l in ((0, None), (2, lambda x: x[:2])):  # noqa: E741
        system = system_of(3, f=lambda x: 0 * x, h=lambda x: [1, 0, 0], l=l)
        with pytest.raises(ModelError, match=f"{outputs} controlled outputs and 1 controls; the"):
            find_structure(system)


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
        "control alone": {"h": h, "l": ca.SX(0, 1), "m": ca.SX(0, 1)},
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
    assert (
        analysis.assumptions[3].reason == "there is no control input, so there is nothing to steer"
    )
    assert analysis.constraint_structure.constraint_degrees == (2,)
    assert not analysis.problems


def test_parameters_take_part_with_their_defaults():
    """The same expressions with other numbers: where the gain is 0 the control never acts."""
    gain = Parameter("gain", 2.0)
    fields = {
        "h": lambda x: ca.vertcat(0, gain.symbol),
        "parameters": None,
    }
    x = ca.SX.sym("x", 2)
    for value, degree in ((2.0, 2), (0.0, None)):
        system = DaeSystem(
            state=x,
            f=ca.vertcat(x[1], 0),
            g=[],
            h=fields["h"](x),
            k=[],
            l=x[0],
            m=[],
            parameters=(Parameter("gain", value, symbol=gain.symbol),),
        )
        if degree:
            assert degrees(system) == ((), (degree,))
        else:
            assert violation(system).assumption == 5


@pytest.mark.parametrize(
    "mass", [[[2.0, 1.0], [0.0, 3.0]], [[2.0, 0.0], [0.0, -3.0]], [[1.0, 1.0], [1.0, 1.0]]]
)
def test_mass_matrices_must_be_symmetric_and_positive_definite(mass):
    with pytest.raises(ModelError, match="mass_matrix is not symmetric and positive"):
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


def test_b_keeps_what_is_zero_at_the_default_parameters_alone():
    coupling = Parameter("c", 0.0)
    x = ca.SX.sym("x", 2)
    system = DaeSystem(
        state=x,
        f=-x,
        g=[],
        h=[[1, coupling.symbol], [0, 1]],
        k=[],
        l=[x[0], x[1]],
        m=[],
        parameters=(coupling,),
    )
    function = TracedFunction(
        "B", {"x": x, "c": coupling.symbol}, {"B": find_structure(system).control_matrix}
    )
    np.testing.assert_array_equal(function([0.1, 0.2], [0.5])[0], [[1.0, 0.5], [0.0, 1.0]])
