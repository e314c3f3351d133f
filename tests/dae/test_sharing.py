"""Forces of redundant constraints by least squares: one split of many, and one motion."""

from dataclasses import replace
from functools import cache

import casadi as ca
import numpy as np
import pytest
from numpy.testing import assert_allclose
from problems import system_of
from problems.tables import TABLE, plate
from pydrake.math import RigidTransform
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import (
    FixedOffsetFrame,
    JacobianWrtVariable,
    RevoluteJoint,
    SpatialInertia,
    UnitInertia,
)

from drake_dae import (
    CoincidentPoints,
    DaeSystem,
    RobotModel,
    RobotPlant,
    drop_constraints,
    share_forces,
)
from drake_dae.errors import ModelError


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


CRANK, PLACES = 0.5, (0.0, 0.4, 1.0)
"""Length of three parallel cranks, and where their pivots stand; the platform's pins likewise."""


@cache
def platform():
    """A platform on three parallel cranks in the x-z plane: two pins too many rows by one."""
    plant = MultibodyPlant(0.0)
    down = [0.0, -1.0, 0.0]

    def rod(name, mass, length):
        unit = UnitInertia.ThinRod(length, [1.0, 0.0, 0.0])
        centre = np.array([length / 2, 0.0, 0.0])
        inertia = SpatialInertia(mass, centre, unit.ShiftFromCenterOfMass(centre))
        return plant.AddRigidBody(name, inertia)

    for i, place in enumerate(PLACES):
        pivot = FixedOffsetFrame(f"pivot{i}", plant.world_frame(), RigidTransform([place, 0, 0]))
        body = rod(f"crank{i}", 0.5 + 0.1 * i, CRANK)
        plant.AddJoint(RevoluteJoint(f"joint{i}", plant.AddFrame(pivot), body.body_frame(), down))
    tip = plant.AddFrame(
        FixedOffsetFrame("tip", plant.GetFrameByName("crank0"), RigidTransform([CRANK, 0.0, 0.0]))
    )
    table = rod("table", 3.0, PLACES[-1])
    plant.AddJoint(RevoluteJoint("table", tip, table.body_frame(), down))
    plant.Finalize()
    return plant


def pins():
    return [
        CoincidentPoints("table", (place, 0, 0), f"crank{i}", (CRANK, 0, 0), "xz", f"pin{i}")
        for i, place in enumerate(PLACES[1:], start=1)
    ]


PARALLEL = np.array([1.0, -1.0, 1.0, 1.0])
"""Rates of the first crank, the table on it, and the other cranks."""


@cache
def cranks(compliant=False):
    compliances = {"pin1.fx": 4.0} if compliant else {}
    return RobotModel.from_multibody(
        platform(), pins(), [], 0.8 * PARALLEL, "cranks", forces=[], compliances=compliances
    )


def by_hand(q, v, compliances):
    """All forces of the pins: M, H and J of MultibodyPlant, then NumPy's least squares."""
    plant = platform()
    context = plant.CreateDefaultContext()
    plant.SetPositions(context, q)
    plant.SetVelocities(context, v)
    rows, bias = [], []
    for pin in pins():
        for frame, point, sign in (
            (pin.frame_b, pin.point_b, 1.0),
            (pin.frame_a, pin.point_a, -1.0),
        ):
            arguments = (
                context,
                JacobianWrtVariable.kV,
                plant.GetFrameByName(frame),
                np.array(point, dtype=float),
                plant.world_frame(),
                plant.world_frame(),
            )
            rows.append(sign * plant.CalcJacobianTranslationalVelocity(*arguments)[[0, 2]])
            bias.append(sign * plant.CalcBiasTranslationalAcceleration(*arguments)[[0, 2], 0])
    jacobian = np.vstack([rows[0] + rows[1], rows[2] + rows[3]])
    drift = np.concatenate([bias[0] + bias[1], bias[2] + bias[3]])
    mass = plant.CalcMassMatrix(context)
    force = plant.CalcGravityGeneralizedForces(context) - plant.CalcBiasTerm(context)
    free = np.linalg.solve(mass, force)
    scale = np.sqrt(compliances)
    matrix = jacobian @ np.linalg.solve(mass, jacobian.T) / scale
    return np.linalg.lstsq(matrix, -(jacobian @ free + drift), rcond=1e-10)[0] / scale


@pytest.mark.parametrize("compliant", [False, True])
def test_forces_of_a_robot_are_those_of_least_squares(compliant):
    """At random states of the motion, to 1e-10 of forces of 30 N, J by MultibodyPlant."""
    model = cranks(compliant)
    plant = RobotPlant(model)
    context = plant.CreateDefaultContext()
    random = np.random.default_rng(2)
    assert [s.name for s in model.dae.force_signals] == [
        f"pin{i}.f{axis}" for i in (1, 2) for axis in "xz"
    ]
    assert model.dae.num_constraints == 3
    for _ in range(8):
        angle, rate = random.uniform(0.3, 2.8), random.uniform(-4.0, 4.0)
        q, v = angle * PARALLEL, rate * PARALLEL
        plant.set_state(context, [*q, *v])
        found = plant.GetOutputPort("constraint_force").Eval(context)
        wanted = by_hand(q, v, [4.0 if compliant else 1.0, 1.0, 1.0, 1.0])
        assert_allclose(found, wanted, atol=1e-10 * np.abs(wanted).max())
        # The wrenches are those of all pins.
        wrenches = plant.GetOutputPort("constraint_wrenches").Eval(context).reshape(-1, 6)
        on_cranks = {
            s.name.split(".")[0]: w[[3, 5]]
            for s, w in zip(plant.wrench_signals[::6], wrenches, strict=True)
            if "crank" in s.name
        }
        assert_allclose(np.concatenate([on_cranks["pin1"], on_cranks["pin2"]]), found, rtol=1e-12)
