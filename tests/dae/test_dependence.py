"""Why A(x) has no full rank: which constraints follow from which, and what is to be done."""

import casadi as ca
import numpy as np
import pytest
from problems import system_of

from drake_dae import DaeSystem, find_structure
from drake_dae.dae import ViolationKind
from drake_dae.errors import AssumptionError


def violation(system):
    with pytest.raises(AssumptionError) as caught:
        find_structure(system)
    return caught.value.violation


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
    found = violation(
        mass_point(
            lambda q: [q[0], q[1], 3 * q[0] - q[1], 1000 * q[1]],
            size=5,
            constraint_output_signals=labels,
        )
    )
    assert found.cause is ViolationKind.REDUNDANT
    corner, again = found.combinations
    assert (corner.name, corner.others, corner.constant) == ("corner", ("floor", "wall"), True)
    np.testing.assert_allclose(corner.factors, [3.0, -1.0], rtol=1e-9)
    assert (again.name, again.others) == ("wall again", ("wall",))
    np.testing.assert_allclose(again.factors, [1000.0], rtol=1e-9)
    assert "'corner' ~ 3 floor - 1 wall; 'wall again' ~ 1000 wall" in str(found)


def test_a_singular_configuration_is_one():
    """Of (x, z, y) the gradients (-2x, 1, 0) and (2x + y, 1, x) are equal at the origin alone."""

    def k(q):
        return [q[1] - q[0] ** 2, q[1] + q[0] ** 2 + q[0] * q[2]]

    found = violation(mass_point(k))
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
    found = violation(hidden(lambda x: [x[0], factor * x[0] + x[1]]))
    assert found.cause is ViolationKind.HIDDEN_DEGREE
    (combination,) = found.combinations
    assert (combination.name, combination.others) == ("y1", ("y0",))
    np.testing.assert_allclose(combination.factors, [factor], rtol=1e-9)
    # The difference in its place.
    assert find_structure(hidden(lambda x: [x[0], x[1]])).constraint_degrees == (1, 2)
