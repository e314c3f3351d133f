import casadi as ca
import numpy as np
import pytest
from problems import PROBLEMS, changed
from runs import some

from drake_dae.dae import DaeSystem, Derivatives, find_structure
from drake_dae.dae.derivatives import lie_derivative
from drake_dae.errors import ModelError
from drake_dae.trace.functions import TracedFunction


def motion_of(system: DaeSystem) -> Derivatives:
    chains = []
    for i, degree in enumerate(find_structure(system).constraint_degrees):
        chain = system.k[i]
        for _ in range(degree - 1):
            chain = lie_derivative(chain, system.explicit.f, system.state)
        chains.append(chain)
    return Derivatives(system, ca.vertcat(ca.SX(0, 1), *chains))


@pytest.mark.slow
@pytest.mark.parametrize("problem", some(PROBLEMS, of=3), indirect=True)
def test_derivatives_are_those_along_the_constrained_motion(problem):
    """Three orders of a function of the state, and of v, against Lie derivatives by hand's v."""
    system = problem.system
    motion = motion_of(system)
    x, u = system.state, motion.control
    structure = find_structure(system)
    rate = structure.elimination.f_star + ca.mtimes(structure.elimination.h_star, u)
    force = structure.elimination.alpha + ca.mtimes(structure.elimination.beta, u)

    function = ca.sin(x[0]) + ca.sumsqr(x) * x[-1]
    along, expected = ca.vertcat(function, motion.constraint_input), ca.vertcat(function, force)
    found = [motion.expand(along)]
    by_hand = [expected]
    for _ in range(3):
        along, expected = motion.derivative(along), lie_derivative(expected, rate, x)
        found.append(motion.expand(along))
        by_hand.append(expected)
    values = TracedFunction(
        "derivatives",
        {"x": x, "u": u, "p": system.parameter_symbol},
        {"found": ca.horzcat(*found), "by_hand": ca.horzcat(*by_hand)},
    )
    random = np.random.default_rng(0)
    for _ in range(3):
        controls = random.standard_normal(system.num_controls)
        one, two = values(problem.consistent(random), controls, system.parameter_values)
        # Third derivatives, sums of a thousand terms up to 1e6 in size.
        np.testing.assert_allclose(one, two, rtol=1e-10, atol=1e-10 * np.abs(two).max())


def with_inertia(arm: DaeSystem, **fields) -> DaeSystem:
    """The two-link arm as E x' = f + g v + h u with E = diag(1, 1, M), as a robot is given."""
    inertia = ca.inv(arm.h[2:, :])
    mass = ca.diagcat(ca.SX.eye(2), inertia)
    return changed(
        arm,
        f=ca.mtimes(mass, arm.f),
        g=ca.mtimes(mass, arm.g),
        h=ca.vertcat(ca.SX(2, 2), ca.SX.eye(2)),
        mass_matrix=mass,
        **fields,
    )


def test_a_mass_matrix_and_the_implicit_form_change_nothing():
    arm = PROBLEMS["two_link_arm"]().system
    plain = with_inertia(arm)
    rate = ca.jtimes(arm.k, arm.state, arm.f)

    def implicit(x: ca.SX, v: ca.SX) -> tuple[ca.SX, ca.SX]:
        reaction = ca.vertcat(ca.SX(2, 1), ca.jtimes(arm.k, arm.state, v, True)[:2])
        residual = ca.mtimes(plain.mass_matrix, x) - plain.f - reaction
        return residual, ca.jtimes(rate, arm.state, x)

    state = np.array([1.0, -1.3, 0.2, 0.3])
    values = [
        TracedFunction(
            "law",
            {"x": system.state},
            {"a": find_structure(system).drift, "b": find_structure(system).control_matrix},
        )(state)
        for system in (arm, plain, with_inertia(arm, implicit=implicit))
    ]
    for one, two, three in zip(*values, strict=True):
        np.testing.assert_allclose(one, three, rtol=1e-12, atol=1e-12)
        np.testing.assert_allclose(two, three, rtol=1e-12, atol=1e-12)
    wrongs = (
        lambda x, v: (implicit(x, 2 * v)[0], implicit(x, v)[1]),
        lambda x, v: (implicit(x, v)[0], 2 * implicit(x, v)[1]),
        lambda x, v: (implicit(x, v)[0], ca.SX(2, 1)),
    )
    for wrong in wrongs:
        with pytest.raises(ModelError, match="'implicit'"):
            find_structure(with_inertia(arm, implicit=wrong))


@pytest.mark.parametrize("angle", [1.0, 0.3, -1e-3, 1e-13, 0.0])
def test_the_inverse_reports_where_constraint_inputs_that_no_control_moves_are_not_determined(
    angle,
):
    """A has the columns (1, 0) and (cos a, sin a): its pivot is |sin a|. v is of the state alone,

    v_2 = -w_2 / sin a and v_1 = -w_1 - cos a v_2, and u = wanted - v_1 - 2 v_2 needs it.
    """
    x = ca.SX.sym("x", 6)  # Two that are held, a, w_1, w_2, and what u moves.
    system = DaeSystem(
        state=x,
        f=ca.vertcat(x[3], x[4], 0, 0, 0, 0),
        g=ca.vertcat(
            ca.horzcat(1, ca.cos(x[2])), ca.horzcat(0, ca.sin(x[2])), ca.SX(3, 2), ca.SX([[1, 2]])
        ),
        h=ca.vertcat(ca.SX(5, 1), 1),
        k=x[:2],
        l=x[5],
        m=ca.SX(1, 2),
        nominal_state=[0.0, 0.0, 1.0, 0.4, 0.7, 0.2],
    )
    motion = find_structure(system).derivatives
    control, pivot, _ = motion.inverse(motion.rate[5], ca.SX(3.0))
    function = ca.Function("inverse", [x], [control, pivot])
    found = [value.full().item() for value in function([0.0, 0.0, angle, 0.4, 0.7, 0.2])]
    assert found[1] == pytest.approx(abs(np.sin(angle)), rel=1e-9, abs=1e-300)
    if abs(angle) > 1e-6:
        second = -0.7 / np.sin(angle)
        first = -0.4 - np.cos(angle) * second
        assert found[0] == pytest.approx(3.0 - first - 2.0 * second, rel=1e-9)
