"""A system without its redundant constraints has the same motion."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from arms import arm
from problems import redundant, system_of
from problems.tables import TABLE, plate

from drake_dae import DaePlant, drop_constraints, find_structure, share_forces
from drake_dae.dae.samples import draw
from drake_dae.dae.structure import examine_constraints
from drake_dae.errors import AssumptionError, ModelError


@pytest.mark.parametrize("names", [None, ["leg3"], ["leg0"]])
def test_a_table_with_four_legs_stands_on_three(names):
    """Whichever leg goes, the sum of forces and torques is that of the load, by NumPy alone."""
    with pytest.raises(AssumptionError):
        find_structure(plate(TABLE))
    system = drop_constraints(plate(TABLE), names)
    gone = (names or ["leg3"])[0]
    stay = [i for i in range(4) if f"leg{i}" != gone]
    assert [s.name for s in system.constraint_output_signals] == [f"leg{i}" for i in stay]
    plant = DaePlant(system)
    context = plant.CreateDefaultContext()
    plant.GetInputPort("control").FixValue(context, [0.0])
    force = plant.GetOutputPort("constraint_force").Eval(context)
    jacobian = np.array([[1.0, *TABLE[i]] for i in stay])
    np.testing.assert_allclose(jacobian.T @ force, [9.81 * 4.0, -0.3, 0.2], rtol=1e-12)
    rates = plant.EvalTimeDerivatives(context).CopyToVector()
    np.testing.assert_allclose(rates, 0.0, atol=1e-12)


def test_a_robot_keeps_its_shorter_form():
    """A row twice, then once: the same derivatives as the robot's own, to round-off."""
    own = arm("two_link").model.dae

    def implicit(rate, force):
        rest, constraint_rate = own.implicit(rate, force[0] + 2 * force[1])
        return rest, ca.vertcat(constraint_rate, 2 * constraint_rate)

    names = ["wall", "again"]
    twice = replace(
        own,
        g=ca.horzcat(own.g, 2 * own.g),
        k=ca.vertcat(own.k, 2 * own.k),
        m=ca.SX(2, 2),
        l=ca.vertcat(own.l[0], own.state[1]),
        constraint_input_signals=names,
        constraint_output_signals=names,
        implicit=implicit,
    )
    once = drop_constraints(twice)
    assert once.implicit is not None
    values = []
    for system in (once, replace(once, implicit=None)):
        values.append(rate_of(system)(own.nominal_state, [3.0, -2.0], own.parameter_values)[0])
    np.testing.assert_allclose(values[0], values[1], rtol=1e-9, atol=1e-9)


def rate_of(system):
    """x' as a function of state, control and parameters, by what the constraints alone decide."""
    found, _ = examine_constraints(system, draw(system, None, 3, 0))
    derivatives = found.derivatives
    control = {"control": derivatives.control}
    rate = derivatives.expand(derivatives.rate)
    return system.trace("rate", {"rate": rate}, control)


def test_what_cannot_go_is_refused():
    with pytest.raises(ModelError, match=r"'leg4'.*'leg"):
        drop_constraints(plate(TABLE), ["leg4"])
    with pytest.raises(ModelError, match="'leg0', 'leg1'"):
        drop_constraints(plate(TABLE), ["leg0", "leg1"])
    # v_2 pushes z'' beside x''.
    with pytest.raises(ModelError, match="'y1'"):
        drop_constraints(redundant(lambda x: [x[0], x[0]]))
    with pytest.raises(ModelError, match="'y1'"):
        drop_constraints(
            system_of(
                2,
                f=lambda x: [0, 0],
                g=lambda x: [[1, 1], [0, 0]],
                h=lambda x: [0, 1],
                k=lambda x: [x[0], 2 * x[0]],
                l=lambda x: [0],
                m=lambda x: [[0, 1]],
            )
        )


def four_bar(seed):
    """A planar four-bar in an oblique plane, closed by a spatial joint: five rows, of which the
    point takes two and the axis none. In the world's axes the others are round-off."""
    turn = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))[0]
    turn *= np.linalg.det(turn)
    normal = turn[:, 2]
    cross = np.cross(normal, np.eye(3)).T

    def bar(length, angle):
        return ca.mtimes(ca.DM(turn), length * ca.vertcat(ca.cos(angle), ca.sin(angle), 0))

    def closure(x):
        gap = bar(0.4, x[0]) + bar(0.9, x[0] + x[1]) - bar(1.0, 0) - bar(0.7, x[2])
        angle = x[0] + x[1]
        rotation = ca.SX.eye(3) + ca.sin(angle) * cross + (1 - ca.cos(angle)) * (cross @ cross)
        axis = ca.mtimes(rotation, ca.DM(normal))
        return ca.vertcat(gap, *[ca.dot(axis, ca.DM(turn[:, i])) for i in (0, 1)])

    q = ca.SX.sym("q", 3)
    jacobian = ca.Function("J", [q], [ca.jacobian(closure(q), q)])
    return system_of(
        6,
        f=lambda x: [x[3], x[4], x[5], 0, 0, 0],
        g=lambda x: ca.vertcat(ca.SX(3, 5), jacobian(x[:3]).T),
        h=lambda x: [0, 0, 0, 1, 0, 0],
        k=closure,
        l=lambda x: [x[0]],
        m=lambda x: np.zeros((1, 5)),
        nominal_state=[1.0, -0.6, 1.3, 0, 0, 0],
    )


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("without", [drop_constraints, share_forces])
def test_rows_of_round_off_are_redundant(seed, without):
    """Scaled to length one a row of 1e-17 counted as any other."""
    found = find_structure(without(four_bar(seed)))
    assert found.constraint_degrees == (2, 2)
    assert found.zero_dynamics_dimension == 0


@pytest.mark.parametrize("without", [drop_constraints, share_forces])
def test_a_column_of_round_off_keeps_no_constraint(without):
    """The legs act on the seventh state by 1e-17, as where M^-1 J^T cancels."""
    table = plate(TABLE)
    noise = np.zeros((7, 4))
    noise[6] = 1e-17 * np.array([1.0, -2.0, 3.0, 1.0])
    noisy = replace(table, g=table.g + noise)
    assert find_structure(without(noisy)).constraint_degrees == (2, 2, 2)


def test_a_constraint_that_is_needed_does_not_pass_for_round_off():
    """The fourth leg stands 1e-6 m beside the third, which is no round-off."""
    with pytest.raises(ModelError, match="'leg0'"):
        drop_constraints(plate([*TABLE[:2], (-1.0, -1.0), (-1.0, -1.0 + 1e-6)]), ["leg0"])


@pytest.mark.parametrize(
    "nominal", [[1e-16, 0, 0, 0, 0], [0, 0, 1e-16, 0, 0], [0, 3e-17, 0, 0, -1e-16]]
)
def test_a_nominal_state_of_round_off_is_zero(nominal):
    """A point in a corner of two curved walls: random states go away from it."""
    turn = np.linalg.qr(np.random.default_rng(1).normal(size=(2, 2)))[0]

    def walls(x):
        along = ca.mtimes(ca.DM(turn), x[:2])
        return along + 0.5 * along**2

    q = ca.SX.sym("q", 2)
    jacobian = ca.Function("J", [q], [ca.jacobian(walls(q), q)])
    system = system_of(
        5,
        f=lambda x: [x[2], x[3], 0, -9.81, 0],
        g=lambda x: ca.vertcat(ca.SX(2, 2), jacobian(x[:2]).T, ca.SX(1, 2)),
        h=lambda x: [0, 0, 0, 0, 1],
        k=walls,
        l=lambda x: [x[4]],
        m=lambda x: np.zeros((1, 2)),
        nominal_state=nominal,
    )
    assert find_structure(system).constraint_degrees == (2, 2)
    assert np.all(system.spread_around(system.nominal_state) >= 0.1 * system.scale)
