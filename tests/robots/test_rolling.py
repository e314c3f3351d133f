"""Wheels against MultibodyPlant, and against equations worked out by hand."""

from functools import cache

import casadi as ca
import numpy as np
from pydrake.math import RigidTransform
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import (
    FixedOffsetFrame,
    PlanarJoint,
    RevoluteJoint,
    SpatialInertia,
    UnitInertia,
)
from test_contract_of_constraints import robot

from drake_dae import PointCoordinates, RobotModel, RobotPlant, RollingWheel, find_structure
from drake_dae.trace.functions import TracedFunction

# A robot with two driven wheels, on a planar joint: two wheels roll, one of them holds the side.

CHASSIS, AHEAD, YAW = 8.0, 0.12, 0.3  # kg, m from the axle to the centre of mass, kg m^2 about it
WHEEL, RADIUS, TRACK = 0.7, 0.1, 0.25  # kg, m, m from the middle to a wheel
SPIN, ACROSS = 0.004, 0.002  # kg m^2 of a wheel about its axle, and across it


def inertia(mass, centre, diagonal):
    """With a diagonal rotational inertia about the centre of mass."""
    unit = UnitInertia(*(value / mass for value in diagonal))
    return SpatialInertia(mass, centre, unit.ShiftFromCenterOfMass(np.array(centre)))


@cache
def cart():
    plant = MultibodyPlant(0.0)
    chassis = plant.AddRigidBody("chassis", inertia(CHASSIS, [AHEAD, 0, 0.1], (0.2, 0.3, YAW)))
    ground = plant.world_frame()
    level = plant.AddFrame(FixedOffsetFrame("level", ground, RigidTransform([0, 0, RADIUS])))
    plant.AddJoint(PlanarJoint("base", level, chassis.body_frame(), [0, 0, 0]))
    for name, side in (("left", 1.0), ("right", -1.0)):
        wheel = plant.AddRigidBody(name, inertia(WHEEL, [0, 0, 0], (ACROSS, SPIN, ACROSS)))
        place = RigidTransform([0.0, side * TRACK, 0.0])
        hub = plant.AddFrame(FixedOffsetFrame(f"{name}_hub", chassis.body_frame(), place))
        joint = RevoluteJoint(f"{name}_axle", hub, wheel.body_frame(), [0, 1, 0])
        plant.AddJointActuator(f"{name}_motor", plant.AddJoint(joint))
    plant.Finalize()
    wheels = [
        RollingWheel("left", RADIUS, name="left"),
        RollingWheel("right", RADIUS, holds_side=False, name="right"),
    ]
    ahead = PointCoordinates("chassis", "xy", (0.3, 0.0, 0.0))
    model = RobotModel.from_multibody(plant, wheels, [ahead], name="cart", forces=[])
    return model, find_structure(model.dae)


def rolling_state(x, y, heading, speed, turn):
    """(q, v) of the cart in motion without slip."""
    spins = [(speed - TRACK * turn) / RADIUS, (speed + TRACK * turn) / RADIUS]
    rates = [speed * np.cos(heading), speed * np.sin(heading), turn]
    return np.array([x, y, heading, 0.4, -0.9, *rates, *spins])


def test_a_cart_moves_as_the_unicycle_of_the_textbook():
    """With V along the heading and w the turn, from Lagrange's equations by hand:

    (m + 2 J/r^2) V' - M d w^2 = (tau_l + tau_r) / r,
    (I + 2 J b^2/r^2) w' + M d V w = b (tau_r - tau_l) / r.

    Each wheel: r T = tau - J spin'. The side force is m V w + M d w'. Round-off with room.
    """
    model, structure = cart()
    assert structure.constraint_degrees == (1, 1, 1)
    assert structure.output_degrees == (2, 2)
    names = [signal.name for signal in model.dae.constraint_input_signals]
    assert names == ["left.traction", "left.side_force", "right.traction"]
    block = RobotPlant(model, structure=structure)
    context = block.CreateDefaultContext()
    mass = CHASSIS + 2 * WHEEL
    about = YAW + CHASSIS * AHEAD**2 + 2 * (WHEEL * TRACK**2 + ACROSS)
    random = np.random.default_rng(0)
    for _ in range(4):
        x, y, heading, speed, turn = random.uniform(-1.5, 1.5, 5)
        left, right = random.uniform(-3.0, 3.0, 2)
        block.set_state(context, rolling_state(x, y, heading, speed, turn))
        block.GetInputPort("control").FixValue(context, [left, right])
        faster = (left + right) / RADIUS + CHASSIS * AHEAD * turn**2
        faster /= mass + 2 * SPIN / RADIUS**2
        turned = TRACK * (right - left) / RADIUS - CHASSIS * AHEAD * speed * turn
        turned /= about + 2 * SPIN * TRACK**2 / RADIUS**2
        spins = np.array([faster - TRACK * turned, faster + TRACK * turned]) / RADIUS
        along, across = [np.cos(heading), np.sin(heading)], [-np.sin(heading), np.cos(heading)]
        place = faster * np.array(along) + speed * turn * np.array(across)
        rate = block.EvalTimeDerivatives(context).CopyToVector()[5:]
        np.testing.assert_allclose(rate, [*place, turned, *spins], rtol=1e-11, atol=1e-11)
        traction = (np.array([left, right]) - SPIN * spins) / RADIUS
        side = mass * speed * turn + CHASSIS * AHEAD * turned
        force = block.GetOutputPort("constraint_force").Eval(context)
        np.testing.assert_allclose(force, [traction[0], side, traction[1]], rtol=1e-10, atol=1e-10)
        # The ground pushes each wheel where it touches: at its center the traction turns it back.
        wrenches = block.GetOutputPort("constraint_wrenches").Eval(context).reshape(-1, 6)
        frames = [signal.name for signal in block.wrench_signals[::6]]
        assert frames == [
            f"{name}.{frame}.mx" for name in ("left", "right") for frame in (name, "world")
        ]
        push = traction[1] * np.array([*along, 0.0])
        np.testing.assert_allclose(wrenches[2][3:], push, atol=1e-10)
        turn_back = np.cross([0.0, 0.0, -RADIUS], push)
        np.testing.assert_allclose(wrenches[2][:3], turn_back, atol=1e-10)
        np.testing.assert_allclose(wrenches[3][3:], -push, atol=1e-10)


# Rates, by the velocities of body points that Drake computes.


def test_rates_are_velocities_of_the_points_that_touch():
    """Anywhere, also off the constraint; the lowest point of the rim is found by search."""
    links, random = robot(), np.random.default_rng(3)
    plant = links.plant
    axle, up, center, radius = (
        np.array([0.1, 1.0, 0.2]),
        np.array([0.1, -0.2, 0.9]),
        [0.2, 0, 1],
        0.3,
    )
    up = up / np.linalg.norm(up)
    wheel = RollingWheel("tip", radius, tuple(axle), tuple(center), tuple(up))
    kinematics = links.kinematics()
    rate = kinematics.value(wheel.rate(kinematics))
    parameters = [*links.parameters, *wheel.parameters]
    function = TracedFunction(
        "rates",
        {"q": links.q, "v": links.v, "p": ca.vertcat(*[p.symbol for p in parameters])},
        {"rate": rate},
    )
    values = np.concatenate([p.value for p in parameters])
    context = plant.CreateDefaultContext()
    tip = plant.GetFrameByName("tip")
    for _ in range(4):
        q, v = random.uniform(-1.0, 1.0, (2, 8))
        plant.SetPositions(context, q)
        plant.SetVelocities(context, v)
        pose = tip.CalcPoseInWorld(context)
        moving = tip.CalcSpatialVelocityInWorld(context)

        def velocity(point, pose=pose, moving=moving):
            lever = point - pose.translation()
            return moving.translational() + np.cross(moving.rotational(), lever)

        middle = pose @ np.array(center)
        own = pose.rotation() @ (axle / np.linalg.norm(axle))
        across = np.linalg.svd(own[None])[2][1:]  # Two directions of the wheel's plane.
        lowest = -across.T @ (across @ up)
        contact = middle + radius * lowest / np.linalg.norm(lowest)
        heading = np.cross(own, up) / np.linalg.norm(np.cross(own, up))
        found = function(q, v, values)
        slip = velocity(contact)
        expected = [heading @ slip, np.cross(up, heading) @ slip]
        np.testing.assert_allclose(found[0], expected, atol=1e-12)
