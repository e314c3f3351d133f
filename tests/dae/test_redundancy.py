"""Redundant constraints: what may go, and one split of many by least squares."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from numpy.testing import assert_allclose
from problems import redundant, system_of
from problems.made_up import TABLE, plate
from scipy.spatial.transform import Rotation

from drake_dae import DaePlant, DaeSystem, drop_constraints, find_structure, share_forces
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


@pytest.mark.parametrize("turn", [[0.3, -0.7, 0.4], [1.1, 0.2, -0.5]])
def test_a_planar_linkage_in_an_oblique_plane(turn):
    """A four-bar closed by a pin in space: its rows across the plane hold round-off alone."""
    q, v = ca.SX.sym("q", 3), ca.SX.sym("v", 3)
    angles = ca.vertcat(q[0], q[0] + q[1], q[0] + q[1] + q[2])
    lengths = ca.DM([0.3, 0.8, 0.5])
    axes = ca.SX(Rotation.from_rotvec(turn).as_matrix())
    tip = ca.vertcat(ca.dot(lengths, ca.cos(angles)) - 0.7, ca.dot(lengths, ca.sin(angles)), 0)
    rod = ca.vertcat(ca.cos(angles[2]), ca.sin(angles[2]), 0)
    k = ca.vertcat(ca.mtimes(axes, tip), ca.dot(ca.mtimes(axes, rod), axes[:, 2]))
    system = DaeSystem(
        state=ca.vertcat(q, v),
        f=ca.vertcat(v, ca.SX(3, 1)),
        g=ca.vertcat(ca.SX(3, 4), ca.jacobian(k, q).T),
        h=ca.SX(6, 0),
        k=k,
        l=ca.SX(0, 1),
        m=ca.SX(0, 4),
        nominal_state=[1.2, -0.9, -1.9, 0.0, 0.0, 0.0],
    )
    assert drop_constraints(system).num_constraints == 2


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


def test_what_is_not_determined_is_no_output():
    """Not the force of one leg, but the sum of all; one that shares with no other is, too."""
    legs = [f"v{i}" for i in range(4)]
    sharing = share_forces(plate(TABLE)).sharing
    assert sharing.undetermined == tuple(legs)
    assert [s.name for s in sharing.left_out_signals] == ["leg3"]

    def with_output(row):
        return share_forces(replace(plate(TABLE), m=ca.SX(np.array([row])), l=ca.SX(1, 1)))

    with pytest.raises(ModelError, match="z0"):
        with_output([1.0, 0.0, 0.0, 0.0])
    assert_allclose(np.array(ca.DM(with_output([1.0] * 4).m)), [[1.0, 1.0, 1.0]])
    # Beside two that share, one with a direction of its own.
    apart = system_of(
        3,
        f=lambda x: [0, 0, 0],
        g=lambda x: [[1, 0, 2], [0, 1, 0], [0, 0, 0]],
        h=lambda x: [0, 0, 1],
        k=lambda x: [x[0], x[1], 2 * x[0]],
        l=lambda x: [0],
        m=lambda x: [[0, 1, 0]],
    )
    assert share_forces(apart).sharing.undetermined == ("v0", "v2")


def test_constraints_that_move_apart_are_not_redundant():
    """Two walls at one place, of which one moves: there is no state that keeps both."""

    def walls(moving):
        return DaeSystem.from_functions(
            ["x", "v"],
            f=lambda x, p: [x[1], 0],
            g=lambda x, p: [[0, 0], [1, 1]],
            k=lambda x, p: [x[0] - p.wall, x[0] - (p.wall if moving == "both" else p.other)],
            parameters={"wall": 0.0, "other": 0.0},
            exogenous=["wall"],
        )

    with pytest.raises(ModelError, match="'wall'"):
        share_forces(walls("one"))
    with pytest.raises(ModelError, match="'wall'"):
        drop_constraints(walls("one"))
    assert share_forces(walls("both")).num_constraints == 1


@pytest.mark.parametrize("compliances", [{}, {"v0": 4.0, "v2": 0.3}])
def test_forces_are_those_of_weighted_least_squares(compliances):
    """The load of a plate on four legs, by NumPy: columns over the roots of the compliances."""
    plant = DaePlant(share_forces(plate(TABLE), compliances=compliances))
    context = plant.CreateDefaultContext()
    plant.GetInputPort("control").FixValue(context, [0.0])
    found = plant.GetOutputPort("constraint_force").Eval(context)
    scale = np.sqrt([compliances.get(f"v{i}", 1.0) for i in range(4)])
    balance = np.array([[1.0, *corner] for corner in TABLE]).T
    wanted = np.linalg.lstsq(balance / scale, [9.81 * 4.0, -0.3, 0.2])[0] / scale
    assert_allclose(found, wanted, rtol=1e-12)


def test_a_split_that_depends_on_the_state():
    """A rod held by c = 0 and by (2 + x) c = 0: of v = g y - |v|^2 they bear 1 : 2 + x."""
    system = DaeSystem.from_functions(
        ["x", "y", "vx", "vy"],
        f=lambda s: [s[2], s[3], 0.0, -9.81],
        g=lambda s: [[0, 0], [0, 0], [s[0], (2 + s[0]) * s[0]], [s[1], (2 + s[0]) * s[1]]],
        k=lambda s: [c := (s[0] ** 2 + s[1] ** 2 - 1) / 2, (2 + s[0]) * c],
        nominal_state=[0.6, -0.8, 0.0, 0.0],
    )
    plant = DaePlant(share_forces(system))
    context = plant.CreateDefaultContext()
    for angle, speed in ((0.3, 1.2), (-1.1, 0.5), (2.4, -2.0)):
        x, y = np.sin(angle), -np.cos(angle)
        plant.set_state(context, [x, y, -speed * y, speed * x])
        ratio = np.array([1.0, 2.0 + x])
        wanted = (9.81 * y - speed**2) * ratio / (ratio @ ratio)
        found = plant.GetOutputPort("constraint_force").Eval(context)
        assert_allclose(found, wanted, rtol=1e-11)
