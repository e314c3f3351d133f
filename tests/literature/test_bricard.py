"""Bricard's mechanism: five rods and six hinges, whose loop has two equations too many and moves.

Bricard, Mémoire sur la théorie de l'octaèdre articulé, 1897; IFToMM, Library of Computational
Benchmark Problems; González, Dopico, Lugrís, Cuadrado, A Benchmarking System for MBS Simulation
Software, Multibody System Dynamics 16, 2006: rods of 1 m and 1 kg along edges of a cube, which
fall. Spatial mechanisms with six bodies and six hinges have no freedom as a rule: this one has, by
its measures alone.
"""

from functools import cache
from itertools import pairwise

import casadi as ca
import numpy as np
import pytest
import scipy.integrate
from arms import error_controlled
from numpy.testing import assert_allclose
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import (
    FixedOffsetFrame,
    JacobianWrtVariable,
    RevoluteJoint,
    SpatialInertia,
    UnitInertia,
)

from drake_dae import CoincidentPoints, RobotModel, RobotPlant, simulate

GRAVITY, BEARING = 9.81, 0.1
START = np.full(5, np.pi / 2)
TWISTS = (1.0, -1.0, 1.0, -1.0, 1.0, -1.0)
"""Quarter turns about a rod from the hinge at its start to that at its end."""


@cache
def bricard():
    """The rods in a row from the world; the last hinge runs in two bearings, 0.2 m apart.

    Each bearing is a ball joint with three equations, so there are six for the five that a hinge
    takes, of which in this mechanism four are independent.
    """
    plant = MultibodyPlant(0.0)
    unit, centre = UnitInertia.ThinRod(1.0, [1.0, 0.0, 0.0]), np.array([0.5, 0.0, 0.0])
    inertia = SpatialInertia(1.0, centre, unit.ShiftFromCenterOfMass(centre))
    parent, pose = plant.world_frame(), RigidTransform()
    for i in range(5):
        rod = plant.AddRigidBody(f"rod{i}", inertia)
        hinge = plant.AddFrame(FixedOffsetFrame(f"hinge{i}", parent, pose))
        plant.AddJoint(RevoluteJoint(f"joint{i}", hinge, rod.body_frame(), [0.0, 0.0, 1.0]))
        parent = rod.body_frame()
        pose = RigidTransform(turned(TWISTS[i]), [1.0, 0.0, 0.0])
    plant.AddFrame(FixedOffsetFrame("end", parent, pose))
    ground = RigidTransform(turned(-TWISTS[5]), [-1.0, 0.0, 0.0])
    plant.AddFrame(FixedOffsetFrame("ground", plant.world_frame(), ground))
    plant.Finalize()
    bearings = [
        CoincidentPoints("ground", (0, 0, z), "end", (0, 0, z), "xyz", name)
        for name, z in (("upper", BEARING), ("lower", -BEARING))
    ]
    model = RobotModel.from_multibody(
        plant, bearings, [], START, "bricard", forces=[], compliances={}
    )
    return model, RobotPlant(model)


def turned(quarters):
    return RotationMatrix.MakeXRotation(quarters * np.pi / 2)


@cache
def on_paper():
    """The motion with one freedom: where the hinges are, by their angles a, b, a, b, a, b.

    The loop closes where (1 + cos a) (1 + cos b) = 1 (Chen and You, Proc. R. Soc. A 461, 2005, for
    a twist of 90 degrees). Along that curve, da = F_b du, db = -F_a du, a thin rod from P to Q has
    the energy m (P'.P' + P'.Q' + Q'.Q') / 6, so the mechanism I(a, b) u'^2 / 2 + V(a, b).
    """
    angles, rate = ca.SX.sym("angles", 2), ca.SX.sym("u'")
    place, turn, places = ca.SX(3, 1), ca.SX.eye(3), [ca.SX(3, 1)]
    for i, twist in enumerate(TWISTS):
        c, s = ca.cos(angles[i % 2]), ca.sin(angles[i % 2])
        about_hinge = ca.blockcat([[c, -s, 0], [s, c, 0], [0, 0, 1]])
        turn = ca.mtimes(turn, about_hinge)
        place += turn[:, 0]
        turn = ca.mtimes(turn, ca.DM([[1, 0, 0], [0, 0, -twist], [0, twist, 0]]))
        places.append(place)
    closed = (1 + ca.cos(angles[0])) * (1 + ca.cos(angles[1])) - 1
    slope = ca.gradient(closed, angles)
    way = ca.vertcat(slope[1], -slope[0])
    inertia, height = 0, 0
    for start, end in pairwise(places[:6]):
        p, q = ca.jtimes(start, angles, way), ca.jtimes(end, angles, way)
        inertia += (ca.dot(p, p) + ca.dot(p, q) + ca.dot(q, q)) / 3
        height += (start[2] + end[2]) / 2
    gravity = GRAVITY * height
    pull = ca.jtimes(inertia, angles, way) * rate**2 / 2 + ca.jtimes(gravity, angles, way)
    second = -pull / inertia
    acceleration = way * second + ca.jtimes(way, angles, way) * rate**2
    motion = ca.vertcat(way * rate, second)
    energy = inertia * rate**2 / 2 + gravity
    loop = ca.vertcat(places[6], ca.vec(turn - ca.DM.eye(3)))
    outputs = [motion, acceleration, energy, loop]
    return ca.Function("bricard", [angles, rate], outputs)


def by_one_freedom(duration):
    """q, v and v' after a while, from rest in the cube: DOP853 at 1e-13 in a step."""

    def motion(time, y):
        return np.array(on_paper()(y[:2], y[2])[0])[:, 0]

    start = [np.pi / 2, np.pi / 2, 0.0]
    found = scipy.integrate.solve_ivp(
        motion, (0.0, duration), start, method="DOP853", rtol=1e-13, atol=1e-13
    ).y[:, -1]
    rates, acceleration, energy, loop = map(np.array, on_paper()(found[:2], found[2]))
    assert_allclose(loop, 0.0, atol=1e-10)
    assert_allclose(energy, float(on_paper()(start[:2], 0.0)[2]), atol=1e-10)
    which = [0, 1, 0, 1, 0]
    return found[which], rates[which, 0], acceleration[which, 0]


def forces_by_hand(q, v, acceleration):
    """The least forces of both bearings that make the mechanism move so: M, H, J by Drake."""
    plant = bricard()[0].links.plant
    context = plant.CreateDefaultContext()
    plant.SetPositions(context, q)
    plant.SetVelocities(context, v)
    needed = plant.CalcMassMatrix(context) @ acceleration + plant.CalcBiasTerm(context)
    needed -= plant.CalcGravityGeneralizedForces(context)
    points = np.array([[0.0, 0.0, BEARING], [0.0, 0.0, -BEARING]]).T
    world, end = plant.world_frame(), plant.GetFrameByName("end")
    jacobian = plant.CalcJacobianTranslationalVelocity(
        context, JacobianWrtVariable.kV, end, points, world, world
    )
    assert np.linalg.matrix_rank(jacobian, 1e-8) == 4
    found, *_ = np.linalg.lstsq(jacobian.T, needed, rcond=1e-8)
    assert_allclose(jacobian.T @ found, needed, atol=1e-8)
    return found


def check(duration, accuracy, angles, forces):
    """Runs the mechanism, and compares angles, and forces of some 100 N, with the other way."""
    _, plant = bricard()
    context = plant.CreateDefaultContext()
    plant.set_consistent_state(context, [*START, *np.zeros(5)])
    simulate(plant, context, duration, error_controlled(accuracy))
    q, v, acceleration = by_one_freedom(duration)
    state = plant.state(context)
    assert_allclose(state[:5], q, atol=angles)
    assert_allclose(state[5:], v, atol=10 * angles)
    found = plant.GetOutputPort("constraint_force").Eval(context)
    wanted = forces_by_hand(q, v, acceleration)
    assert_allclose(found, wanted, atol=forces * np.abs(wanted).max())
    # That all rows hold, those that were left out too.
    sharing = plant.dae.sharing
    assert len(sharing.left_out_signals) == 2
    gaps = plant.dae.trace("left out", {"gaps": sharing.left_out})
    assert_allclose(gaps(state, plant.dae.parameter_values)[0], 0.0, atol=1e-12)


def test_it_falls_with_one_freedom_though_its_loop_has_equations_to_spare():
    """Half a second; RK5 at 1e-10 in a step is right to 1e-10 rad, forces to 1e-8 of them."""
    assert bricard()[1].structure.manifold.dimension == 2
    check(0.5, 1e-10, 1e-10, 1e-8)


@pytest.mark.slow
def test_two_periods_end_where_one_freedom_says():
    """10 s as in the benchmark: angles to 1e-8 rad, forces to 1e-6 of them."""
    check(10.0, 1e-11, 1e-8, 1e-6)
