"""What keeps its energy: a pendulum in Cartesian coordinates, and a four-bar linkage."""

from functools import cache

import numpy as np
import pytest
import scipy.integrate
from arms import fixed_step
from numpy.testing import assert_allclose
from problems.mechanisms import hanging_pendulum
from pydrake.math import RigidTransform
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import FixedOffsetFrame, RevoluteJoint, SpatialInertia, UnitInertia
from scipy.special import ellipj, ellipk

from drake_dae import CoincidentPoints, DaePlant, RobotModel, RobotPlant, simulate

GRAVITY = 9.81


def swing(angle, time):
    """The angle and its rate of a pendulum of 1 m that is let go at an angle, by sn and cn."""
    k, fast = np.sin(angle / 2), np.sqrt(GRAVITY)
    sn, cn, _, _ = ellipj(ellipk(k**2) + fast * time, k**2)
    return 2 * np.arcsin(k * sn), 2 * k * fast * cn


@pytest.mark.slow
def test_a_pendulum_swings_as_elliptic_functions_do():
    """From 2 rad, where it is no longer harmonic; Hairer and Wanner, 1996, VII.1: index 3.

    The multiplier of x^2 + y^2 = 1 is half of what pulls: 2 v = -(3 cos a - 2 cos a_0) g. RK5 at
    2 ms keeps the energy, of size 10 J, to 1e-10 J over 10 s.
    """
    plant = DaePlant(hanging_pendulum(h=None, l=None, m=None))
    context = plant.CreateDefaultContext()
    start = 2.0
    plant.set_state(context, [np.sin(start), -np.cos(start), 0.0, 0.0])
    energies = []
    for second in range(1, 11):
        config = fixed_step(2e-3)
        config.start_time = context.get_time()
        simulate(plant, context, 1.0, config)
        x, y, vx, vy = plant.state(context)
        energies.append((vx**2 + vy**2) / 2 + GRAVITY * y)
        angle, rate = swing(start, float(second))
        wanted = [np.sin(angle), -np.cos(angle), rate * np.cos(angle), rate * np.sin(angle)]
        assert_allclose([x, y, vx, vy], wanted, atol=1e-9)
        force = plant.GetOutputPort("constraint_force").Eval(context)
        pull = GRAVITY * (3 * np.cos(angle) - 2 * np.cos(start))
        assert_allclose(force, [-pull / 2], atol=1e-8)
    assert_allclose(energies, -GRAVITY * np.cos(start), atol=1e-10)


GROUND, CRANK, COUPLER, ROCKER = 0.4, 0.12, 0.35, 0.3
"""In m: shortest and longest together are less than the others, so the crank turns round."""

MASSES = {CRANK: 0.5, COUPLER: 0.8, ROCKER: 0.7}


@cache
def four_bar():
    """Thin rods in the vertical x-z plane, on pivots at the origin and at (0.4, 0); no actuator."""
    plant = MultibodyPlant(0.0)
    parent, place = plant.world_frame(), [0.0, 0.0, 0.0]
    for name, length in (("crank", CRANK), ("coupler", COUPLER), ("rocker", ROCKER)):
        if name == "rocker":
            parent, place = plant.world_frame(), [GROUND, 0.0, 0.0]
        unit = UnitInertia.ThinRod(length, [1.0, 0.0, 0.0])
        centre = np.array([length / 2, 0.0, 0.0])
        inertia = SpatialInertia(MASSES[length], centre, unit.ShiftFromCenterOfMass(centre))
        body = plant.AddRigidBody(name, inertia)
        hinge = plant.AddFrame(FixedOffsetFrame(f"{name}_hinge", parent, RigidTransform(place)))
        plant.AddJoint(RevoluteJoint(f"{name}_joint", hinge, body.body_frame(), [0.0, -1.0, 0.0]))
        parent, place = body.body_frame(), [length, 0.0, 0.0]
    plant.Finalize()
    pin = CoincidentPoints("coupler", (COUPLER, 0, 0), "rocker", (ROCKER, 0, 0), "xz")
    return RobotModel.from_multibody(plant, [pin], [], [1.0, 0.0, 1.5], "four-bar", forces=[])


def knee(angle):
    """Where crank and coupler, and coupler and rocker meet, as complex numbers x, z of analysis."""
    b = CRANK * np.array([np.cos(angle), np.sin(angle)])
    to_pivot = np.array([GROUND, 0.0]) - b
    square = to_pivot @ to_pivot
    share = (COUPLER**2 - ROCKER**2 + square) / (2 * square)
    beside = np.sqrt(COUPLER**2 / square - share**2)
    return b, b + share * to_pivot + beside * np.array([-to_pivot[1], to_pivot[0]])


def reduced(angle):
    """J and V of the energy J a'^2 / 2 + V, and the rates of coupler and rocker for a' = 1."""
    b, c = knee(angle)
    arm, swung = c - b, c - np.array([GROUND, 0.0])
    drive = np.array([-b[1], b[0]])
    first, second = np.array([-arm[1], arm[0]]), np.array([-swung[1], swung[0]])
    # drive + first coupler' = second rocker'.
    det = first[0] * second[1] - first[1] * second[0]
    coupler = -(drive[0] * second[1] - drive[1] * second[0]) / det
    rocker = -(drive[0] * first[1] - drive[1] * first[0]) / det
    middle = drive + first * coupler / 2
    inertia = MASSES[CRANK] * CRANK**2 / 3 + MASSES[ROCKER] * ROCKER**2 / 3 * rocker**2
    inertia += MASSES[COUPLER] * (middle @ middle + COUPLER**2 / 12 * coupler**2)
    height = MASSES[CRANK] * b[1] / 2 + MASSES[COUPLER] * (b + c)[1] / 2 + MASSES[ROCKER] * c[1] / 2
    return inertia, GRAVITY * height, coupler, rocker


def by_the_crank_alone(time, start):
    """a'' = -(J' a'^2 / 2 + V') / J by DOP853; J' and V' by steps along the imaginary axis."""

    def motion(t, y):
        inertia, energy, _, _ = reduced(y[0] + 1e-30j)
        bend, slope = inertia.imag / 1e-30, energy.imag / 1e-30
        return y[1], -(bend * y[1] ** 2 / 2 + slope) / inertia.real

    options = {"method": "DOP853", "rtol": 1e-13, "atol": 1e-13}
    return scipy.integrate.solve_ivp(motion, (0.0, time), start, **options).y[:, -1]


def of_the_crank(angle, rate):
    """(q, v) of crank, coupler relative to it, and rocker."""
    b, c = knee(angle)
    _, _, coupler, rocker = reduced(angle)
    arm, swung = c - b, c - np.array([GROUND, 0.0])
    turned, tilt = np.arctan2(arm[1], arm[0]), np.arctan2(swung[1], swung[0])
    return np.array([angle, turned - angle, tilt, rate, (coupler - 1) * rate, rocker * rate])


@pytest.mark.slow
def test_a_four_bar_keeps_its_energy_and_turns_as_its_crank_alone():
    """Over 10 s and some turns, by Lagrange's equation in one angle; energies by MultibodyPlant.

    RK5 at 1 ms keeps an energy of 3 J to 1e-10 J.
    """
    model = four_bar()
    block = RobotPlant(model)
    assert block.structure.constraint_degrees == (2, 2)
    context, start = block.CreateDefaultContext(), (1.0, 6.0)
    block.set_state(context, of_the_crank(*start))
    plant, energies = model.links.plant, []
    own = plant.CreateDefaultContext()

    def watch(current):
        plant.SetPositionsAndVelocities(own, block.state(current))
        energies.append(plant.EvalKineticEnergy(own) + plant.EvalPotentialEnergy(own))

    simulate(block, context, 10.0, fixed_step(1e-3), after_step=watch)
    angle, rate = by_the_crank_alone(10.0, start)
    state, wanted = block.state(context), of_the_crank(angle, rate)
    wanted[1] += 2 * np.pi * np.round((state[1] - wanted[1]) / (2 * np.pi))
    assert_allclose(state, wanted, atol=1e-8)
    inertia, potential, _, _ = reduced(start[0])
    assert_allclose(energies, inertia * start[1] ** 2 / 2 + potential, atol=1e-10)
    assert angle - start[0] > 4 * np.pi
