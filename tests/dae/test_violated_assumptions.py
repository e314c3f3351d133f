"""Which assumption of the paper a system violates, where, and which rows depend on which."""

import casadi as ca
import numpy as np
import pytest
from problems import PROBLEMS, changed, double_integrator, early_control, redundant, system_of
from problems.found import degrees, untidy_one, violation

from drake_dae import DaeSystem, find_structure
from drake_dae.dae import ViolationKind


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
    assert error.violation.cause is ViolationKind.CONSTRAINT_DEGREE
    np.testing.assert_array_equal(error.state, [0.0, 1.0, 0.0])


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
    """Exactly, by a factor, on N* alone, by an identity, and except for round-off."""
    error = violation(redundant(k))
    assert error.assumption == 2
    assert error.violation.cause is ViolationKind.REDUNDANT


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
    assert error.violation.cause is ViolationKind.NO_FORCE


def test_3_a_control_that_enters_before_the_force_does():
    error = violation(early_control())
    assert error.assumption == 3
    assert (error.violation.names, error.violation.order) == (("y0",), 1)
    # At the same order it is allowed.
    assert degrees(PROBLEMS["pendulum"]().system)[0] == (2,)


def test_4_a_degree_that_is_not_defined_at_the_nominal_state():
    error = violation(double_integrator(l=lambda x: x[0] + x[1] ** 2))
    assert error.assumption == 4
    assert (error.violation.names, error.violation.order) == (("z0",), 1)
    # An output that is met at once nearly everywhere.
    tension = PROBLEMS["pendulum_tension"]().system
    error = violation(changed(tension, nominal_state=[0.0, -0.8, 0.0, 0.0]))
    assert (error.assumption, error.violation.order) == (4, 0)


@pytest.mark.slow
def test_5_outputs_that_repeat():
    """An output that repeats another, a constraint, a combination, a function of both."""
    system = PROBLEMS["gantry"]().system
    q = system.state
    one_more = [system.l[i] for i in range(4)]
    no_force = np.array([[1, 0], [0, 0], [0, 1], [0, 0]])
    for row, output in ((3, 2 * q[2] + 1), (3, ca.sin(q[2])), (3, q[2] * (1 + (q[0] - 1) * q[3]))):
        error = violation(changed(system, l=ca.vertcat(*one_more[:row], output), m=no_force))
        assert error.assumption == 5
        assert error.violation.names == ("v1", "q3", "v2", "q4")
    for output in (3 * q[0] + q[1], (q[0] - 1) * q[2], q[4], ca.SX(7)):
        error = violation(changed(system, l=ca.vertcat(*one_more[:3], output), m=no_force))
        assert error.assumption == 5
        assert error.violation.names == ("q4",)


def dependence(system):
    return violation(system).violation


def mass_point(k, nominal=None, size=3, **fields):
    """q'' = J^T v + u in some dimensions, J = dk/dq, with the constraints k(q)."""
    q = ca.SX.sym("q", size)
    rows = k(q)
    jacobian = ca.jacobian(ca.vertcat(*rows), q)
    force = ca.Function("force", [q], [jacobian.T])
    return DaeSystem.from_functions(
        2 * size,
        f=lambda x: ca.vertcat(x[size:], ca.SX(size, 1)),
        g=lambda x: ca.vertcat(ca.SX(size, len(rows)), force(x[:size])),
        h=lambda x: ca.vertcat(ca.SX(2 * size - 1, 1), 1),
        k=lambda x: k(x[:size]),
        l=lambda x: [x[size - 1]],
        m=lambda x: ca.SX(1, len(rows)),
        nominal_state=nominal,
        name="point",
        **fields,
    )


def test_the_rows_that_follow_are_named_with_their_factors():
    """k_3 = 3 k_1 - k_2, and k_4 = k_2 in other units."""
    labels = ("floor", "wall", "corner", "wall again")
    found = dependence(
        mass_point(
            lambda q: [q[0], q[1], 3 * q[0] - q[1], 1000 * q[1]],
            size=5,
            constraint_output_signals=labels,
        )
    )
    assert found.cause is ViolationKind.REDUNDANT
    corner, again = found.combinations
    assert (corner.name, corner.others) == ("corner", ("floor", "wall"))
    np.testing.assert_allclose(corner.factors, [3.0, -1.0], rtol=1e-9)
    assert (again.name, again.others) == ("wall again", ("wall",))
    np.testing.assert_allclose(again.factors, [1000.0], rtol=1e-9)
    assert "'corner' ~ 3 floor - 1 wall; 'wall again' ~ 1000 wall" in str(found)


def test_a_singular_configuration_is_one():
    """Of (x, z, y) the gradients (-2x, 1, 0) and (2x + y, 1, x) are equal at the origin alone."""

    def k(q):
        return [q[1] - q[0] ** 2, q[1] + q[0] ** 2 + q[0] * q[2]]

    found = dependence(mass_point(k))
    assert found.cause is ViolationKind.SINGULAR_CONFIGURATION
    assert found.combinations[0].name == "y1"
    np.testing.assert_allclose(found.combinations[0].factors, [1.0], rtol=1e-9)
    # Around it nothing is wrong: on the branch x = 0 the gradients are (0, 1, 0) and (y, 1, 0).
    beside = mass_point(k, nominal=[0.0, 0.0, 1.0, 0.0, 0.0, 0.0])
    assert find_structure(beside, spread=0.01).constraint_degrees == (2, 2)


def hidden(k):
    """a' = v_1, b' = c, c' = v_2, d' = u."""
    return system_of(
        4,
        f=lambda x: [0, x[2], 0, 0],
        g=lambda x: [[1, 0], [0, 0], [0, 1], [0, 0]],
        h=lambda x: [0, 0, 0, 1],
        k=k,
        l=lambda x: [x[3]],
        m=lambda x: [[0, 0]],
    )


@pytest.mark.parametrize("factor", [-2.0, 1e4])
def test_a_regular_difference_is_not_called_redundant(factor):
    """k = (a, factor a + b) has A = [1, 0; factor, 0]; b alone has degree 2, and A is regular."""
    found = dependence(hidden(lambda x: [x[0], factor * x[0] + x[1]]))
    assert found.cause is ViolationKind.HIDDEN_DEGREE
    (combination,) = found.combinations
    assert (combination.name, combination.others) == ("y1", ("y0",))
    np.testing.assert_allclose(combination.factors, [factor], rtol=1e-9)
    # The difference in its place.
    assert find_structure(hidden(lambda x: [x[0], x[1]])).constraint_degrees == (1, 2)
