"""Which assumption of the paper a system violates, and where."""

from collections.abc import Callable

import casadi as ca
import numpy as np
import pytest
from problems import (
    PROBLEMS,
    changed,
    double_integrator,
    early_control,
    redundant,
    system_of,
)
from problems.found import degrees, untidy_one, violation

from drake_dae.dae import DaeSystem, Derivatives, ViolationKind, find_structure, relative_degrees
from drake_dae.dae.derivatives import lie_derivative
from drake_dae.dae.structure import examine_structure
from drake_dae.errors import AssumptionError
from drake_dae.trace.functions import TracedFunction


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
    assert error.violation.cause is ViolationKind.COUNT


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
    for row, output in (
        (3, q[2]),
        (3, 2 * q[2] + 1),
        (3, ca.sin(q[2])),
        (3, q[2] + q[0]),
        (3, q[2] * (1 + (q[0] - 1) * q[3])),
    ):
        error = violation(changed(system, l=ca.vertcat(*one_more[:row], output), m=no_force))
        assert error.assumption == 5
        assert error.violation.names == ("v1", "q3", "v2", "q4")
    for output in (q[0], 3 * q[0] + q[1], q[0] ** 2, (q[0] - 1) * q[2], q[4], ca.SX(0), ca.SX(7)):
        error = violation(changed(system, l=ca.vertcat(*one_more[:3], output), m=no_force))
        assert error.assumption == 5
        assert error.violation.names == ("q4",)


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
    assert text in str(error)
    assert found.name == "q4"
    np.testing.assert_allclose(found.factors, [f for f in factors if f], rtol=1e-9)


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


@pytest.mark.parametrize("residual", [0.0, 1e-10])
def test_5_an_output_that_repeats_the_constraint_is_found_at_once(residual, derivatives_taken):
    """By Theorem 2.1, before its derivatives fill the state; h* is zero by cancellation alone.

    What a state leaves of the constraint stands alone in the column of x3.
    """
    system = beside_an_integrator(
        20,
        g=lambda x: [0, untidy_one(x[4]), *[0] * 18],
        h=lambda x: [0, untidy_one(x[3]), *[0] * 18],
        k=lambda x: x[0] * (2 + x[6]) + x[5] ** 2 - 0.75,
        l=lambda x: (x[0] * (2 + x[6]) + x[5] ** 2 - 0.75 + residual) * (1 + x[3]),
        m=lambda x: 0,
    )
    error = violation(system)
    assert error.assumption == 5
    assert "'z0' ~ 1.5 y0" in str(error)
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
    assert error.violation.cause is ViolationKind.NO_FORCE
    assert len(derivatives_taken) <= 2


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
    with pytest.raises(AssumptionError, match=r"B\(x\)") as caught:
        find_structure(unicycle)
    assert caught.value.violation.names == tuple(signal.name for signal in unicycle.output_signals)
