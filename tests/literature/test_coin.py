"""A thin disk rolls on level ground and leans: r = 2 for its height, r = (1, 1) for rolling.

The classic of Appell and Korteweg; Neimark and Fufaev, Dynamics of Nonholonomic Systems, 1972.
"""

from dataclasses import dataclass
from functools import cache

import casadi as ca
import numpy as np
import pytest
import scipy.integrate
from arms import fixed_step
from numpy.testing import assert_allclose
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import PrismaticJoint, RevoluteJoint, SpatialInertia, UnitInertia

from drake_dae import RobotModel, RobotPlant, RollingWheel, Signal, simulate
from drake_dae.robots import Application, Constraint

MASS, RADIUS, GRAVITY = 0.4, 0.25, 9.81
ACROSS, ABOUT = MASS * RADIUS**2 / 4, MASS * RADIUS**2 / 2
WHOLE = ABOUT + MASS * RADIUS**2


@dataclass(frozen=True)
class RimOnGround(Constraint):
    """The lowest point of a disk's rim stays at z = 0: 0 = z - radius sqrt(1 - axle_z^2)."""

    frame: str
    name: str = "rim"

    @property
    def force_signals(self):
        return (Signal(f"{self.name}.force", "N"),)

    @property
    def residual_signals(self):
        return (Signal(f"{self.name}.height", "m"),)

    def residual(self, frames):
        axle = frames.rotation(self.frame)[:, 1]
        return frames.position(self.frame)[2] - RADIUS * ca.sqrt(axle[0] ** 2 + axle[1] ** 2)

    def applications(self, kinematics):
        axle, up = kinematics.rotation(self.frame)[:, 1], ca.SX([0.0, 0.0, 1.0])
        along = ca.cross(axle, up)
        steep = ca.cross(along / ca.norm_2(along), axle)
        point = kinematics.position(self.frame) - RADIUS * steep
        return (Application(point, up, ca.SX(3, 1), self.frame),)


@cache
def coin():
    """Three shifts of its centre, and yaw, lean and spin about the axle y; no actuator."""
    plant = MultibodyPlant(0.0)
    unit, parent = np.eye(3), plant.world_frame()
    light = SpatialInertia.Zero()
    disk = SpatialInertia(
        MASS, np.zeros(3), UnitInertia(ACROSS / MASS, ABOUT / MASS, ACROSS / MASS)
    )
    joints = [(name, PrismaticJoint, unit[i]) for i, name in enumerate("xyz")]
    turns = (("yaw", 2), ("lean", 0), ("spin", 1))
    joints += [(name, RevoluteJoint, unit[i]) for name, i in turns]
    for name, kind, axis in joints:
        body = plant.AddRigidBody(f"{name}_body", disk if name == "spin" else light)
        plant.AddJoint(kind(name, parent, body.body_frame(), axis))
        parent = body.body_frame()
    plant.Finalize()
    wheel = RollingWheel("spin_body", RADIUS)
    nominal = [0.0, 0.0, RADIUS, 0.0, 0.0, 0.0]
    return RobotModel.from_multibody(
        plant, [RimOnGround("spin_body"), wheel], [], nominal, "coin", forces=[]
    )


def rolling(yaw, lean, spin, rates):
    """(q, v) at the origin from the angular velocity along heading, axle and up the disk.

    The centre moves with radius (w_2, -w_1) along heading and axle.
    """
    first, second, third = rates
    heading, side = np.array([np.cos(yaw), np.sin(yaw)]), np.array([-np.sin(yaw), np.cos(yaw)])
    moving = RADIUS * (second * heading - first * np.cos(lean) * side)
    falling = -RADIUS * first * np.sin(lean)
    turning = third / np.cos(lean), first, second - third * np.tan(lean)
    return np.array([0, 0, RADIUS * np.cos(lean), yaw, lean, spin, *moving, falling, *turning])


def by_euler(time, start):
    """(yaw, lean, spin, w_1, w_2, w_3, x, y) by Euler's equations about the contact, with DOP853.

    In axes of heading, axle and up the disk, which turn with W = (w_1, w_3 tan lean, w_3):
    (A + m r^2) w_1' = (C + m r^2) w_2 w_3 - A w_3^2 tan lean + m g r sin lean,
    (C + m r^2) w_2' = -m r^2 w_1 w_3,    A w_3' = A w_1 w_3 tan lean - C w_1 w_2.
    """

    def motion(t, y):
        yaw, lean, _, first, second, third = y[:6]
        fall = WHOLE * second * third - ACROSS * third**2 * np.tan(lean)
        fall += MASS * GRAVITY * RADIUS * np.sin(lean)
        heading, side = np.array([np.cos(yaw), np.sin(yaw)]), np.array([-np.sin(yaw), np.cos(yaw)])
        moving = RADIUS * (second * heading - first * np.cos(lean) * side)
        return [
            *(third / np.cos(lean), first, second - third * np.tan(lean)),
            fall / (ACROSS + MASS * RADIUS**2),
            -MASS * RADIUS**2 * first * third / WHOLE,
            first * third * np.tan(lean) - ABOUT / ACROSS * first * second,
            *moving,
        ]

    options = {"method": "DOP853", "rtol": 1e-13, "atol": 1e-13}
    return scipy.integrate.solve_ivp(motion, (0.0, time), [*start, 0.0, 0.0], **options).y[:, -1]


def run(state, duration, watch=None):
    block = RobotPlant(coin())
    assert block.structure.constraint_degrees == (2, 1, 1)
    context = block.CreateDefaultContext()
    block.set_state(context, state)
    simulate(block, context, duration, fixed_step(2e-3), after_step=watch and watch(block))
    return block.state(context), block.GetOutputPort("constraint_force").Eval(context)


def test_it_turns_evenly_on_a_circle():
    """Leaning by 0.35, w_2 w_3 (C + m r^2) = A w_3^2 tan lean - m g r sin lean, to the right.

    Its centre goes round with r w_2 / yaw'; the ground bears the weight and pulls it inward.
    """
    lean, third = 0.35, -1.2
    second = ACROSS * third**2 * np.tan(lean) - MASS * GRAVITY * RADIUS * np.sin(lean)
    second /= WHOLE * third
    turn, duration = third / np.cos(lean), 1.5
    state, force = run(rolling(0.0, lean, 0.0, (0.0, second, third)), duration)
    radius, yaw = RADIUS * second / turn, turn * duration
    wanted = rolling(yaw, lean, (second - third * np.tan(lean)) * duration, (0.0, second, third))
    wanted[:2] = radius * np.array([np.sin(yaw), 1 - np.cos(yaw)])
    assert_allclose(state, wanted, atol=1e-10)
    assert_allclose(force, [MASS * GRAVITY, 0.0, MASS * RADIUS * second * turn], atol=1e-10)


@pytest.mark.slow
def test_it_wobbles_as_by_euler_and_keeps_its_energy():
    """Over 10 s; both leave 1e-11, and RK5 at 2 ms keeps an energy of 1.6 J to 1e-10 J."""
    start = (0.2, 0.25, 0.0, 0.4, 6.0, -1.0)
    plant, energies = coin().links.plant, []
    own = plant.CreateDefaultContext()

    def watch(block):
        def look(context):
            plant.SetPositionsAndVelocities(own, block.state(context))
            energies.append(plant.EvalKineticEnergy(own) + plant.EvalPotentialEnergy(own))

        return look

    state, _ = run(rolling(*start[:3], start[3:]), 10.0, watch)
    found = by_euler(10.0, start)
    wanted = rolling(*found[:3], found[3:6])
    wanted[:2] = found[6:]
    assert_allclose(state, wanted, atol=1e-9)
    assert_allclose(energies, energies[0], atol=1e-10)
