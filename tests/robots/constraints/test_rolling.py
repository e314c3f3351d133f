"""Blades, wheels and balls against MultibodyPlant, and against equations worked out by hand."""

from functools import cache

import casadi as ca
import numpy as np
import pytest
import scipy.integrate
from arms import fixed_step
from pydrake.math import RigidTransform
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import (
    BallRpyJoint,
    FixedOffsetFrame,
    PlanarJoint,
    PrismaticJoint,
    RevoluteJoint,
    SpatialInertia,
    UnitInertia,
)
from test_contract_of_constraints import robot

from drake_dae import (
    Ellipsoid,
    Plane,
    PointCoordinates,
    RobotModel,
    RobotPlant,
    RollingWheel,
    SinusoidReference,
    Sphere,
    TrackingLaw,
    find_structure,
    make_closed_loop,
    poles,
    simulate,
)
from drake_dae.errors import InconsistentStateError, ModelError
from drake_dae.robots import Blade, RollingBall
from drake_dae.trace.functions import TracedFunction

GRAVITY = 9.81


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


def test_a_cart_tracks_with_a_point_ahead_of_its_axle():
    """e(t) of double poles at -3; RK5 at 4 ms leaves 1e-9. The wheels do not slip."""
    model, structure = cart()
    law = TrackingLaw(model.dae, poles(-3.0), structure=structure)
    wanted = [SinusoidReference(0.2, 0.5, 0.8), SinusoidReference(0.0, 0.4, 1.1)]
    loop = make_closed_loop(RobotPlant(model, structure=structure), law, wanted)
    context = loop.diagram.CreateDefaultContext()
    own = loop.plant.GetMyMutableContextFromRoot(context)
    start = rolling_state(-0.1, 0.05, 0.7, 0.3, 0.2)
    loop.plant.set_state(own, start)
    simulate(loop.diagram, context, 1.5, fixed_step(4e-3))
    record = loop.record(context)
    predicted = loop.predicted_error(record)
    np.testing.assert_allclose(record["tracking_error"], predicted, atol=1e-8)
    assert np.abs(record["tracking_error"][0]).min() > 0.01
    for state in record["state"][::40]:
        speed = (state[8] + state[9]) / 2 * RADIUS
        along = [speed * np.cos(state[2]), speed * np.sin(state[2])]
        np.testing.assert_allclose(state[5:7], along, atol=1e-9)


def test_a_start_that_slips_is_refused_and_mended():
    """The level is that of velocities: positions are free, and the nearest motion has no slip."""
    model, structure = cart()
    block = RobotPlant(model, structure=structure)
    context = block.CreateDefaultContext()
    block.GetInputPort("control").FixValue(context, [0.0, 0.0])
    slipping = rolling_state(3.0, -2.0, 0.5, 1.0, 0.3)
    slipping[5:7] += [0.2, 0.3]
    block.set_state(context, slipping)
    with pytest.raises(InconsistentStateError, match=r"left\.side_speed"):
        simulate(block, context, 0.1, fixed_step())
    mended = block.set_consistent_state(context, slipping)
    heading, rates = mended[2], mended[5:]
    assert -np.sin(heading) * rates[0] + np.cos(heading) * rates[1] == pytest.approx(0, abs=1e-12)
    simulate(block, context, 0.1, fixed_step())


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
    blade = Blade("tip", tuple(axle), tuple(center))
    bowl = Sphere((0.1, 0.2, -0.3), 2.0, inside=True)
    ball = RollingBall("tip", bowl, radius, tuple(center))
    kinematics = links.kinematics()
    rates = [kinematics.value(c.rate(kinematics)) for c in (wheel, blade, ball)]
    parameters = [*links.parameters, *wheel.parameters, *ball.parameters]
    function = TracedFunction(
        "rates",
        {"q": links.q, "v": links.v, "p": ca.vertcat(*[p.symbol for p in parameters])},
        {name: rate for name, rate in zip(("wheel", "blade", "ball"), rates, strict=True)},
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
        np.testing.assert_allclose(found[1], [own @ velocity(middle)], atol=1e-12)
        inward = np.array(bowl.center) - middle
        inward /= np.linalg.norm(inward)
        slip = velocity(middle - radius * inward)
        first = np.array([1.0, 0.0, 0.0]) - inward[0] * inward
        first /= np.linalg.norm(first)
        expected = [inward @ slip, first @ slip, np.cross(inward, first) @ slip]
        np.testing.assert_allclose(found[2], expected, atol=1e-12)


# A ball, carried by a gantry without mass whose motors push its center.

BALL, SIZE = 1.3, 0.2


def rolling(surface, **options):
    """A solid ball of 2/5 m r^2."""
    plant = MultibodyPlant(0.0)
    light, parent = SpatialInertia.Zero(), plant.world_frame()
    for name, axis in (("x", [1, 0, 0]), ("y", [0, 1, 0]), ("z", [0, 0, 1])):
        body = plant.AddRigidBody(f"slide_{name}", light)
        joint = plant.AddJoint(PrismaticJoint(name, parent, body.body_frame(), axis))
        plant.AddJointActuator(f"push_{name}", joint)
        parent = body.body_frame()
    ball = plant.AddRigidBody("ball", SpatialInertia.SolidSphereWithMass(BALL, SIZE))
    plant.AddJoint(BallRpyJoint("turn", parent, ball.body_frame()))
    plant.Finalize()
    contact = RollingBall("ball", surface, SIZE, **options)
    x, y, z = surface.position
    return RobotModel.from_multibody(
        plant,
        [contact],
        [PointCoordinates("ball", "xy")],
        [x, y, z + SIZE, 0.0, 0.0, 0.0],
        forces=["ball.force"],
    )


def run(model, structure, state, duration, step=1e-3):
    block = RobotPlant(model, structure=structure)
    context = block.CreateDefaultContext()
    block.GetInputPort("control").FixValue(context, np.zeros(3))
    block.set_state(context, state)
    simulate(block, context, duration, fixed_step(step))
    return block.state(context), block.GetOutputPort("constraint_force").Eval(context)


def test_a_ball_swings_in_a_bowl_as_a_slow_pendulum():
    """a'' = -5 g / (7 (R - r)) sin a, against SciPy: RK5 at 1 ms leaves 1e-11."""
    wide, duration, angle = 1.5, 1.2, 0.7
    middle = np.array([0.3, -0.2, 2.0])
    model = rolling(Sphere(tuple(middle), wide, inside=True))
    arm = wide - SIZE
    place = middle + arm * np.array([0.0, np.sin(angle), -np.cos(angle)])
    state, force = run(model, find_structure(model.dae), [*place, *np.zeros(9)], duration)
    angle, rate = scipy.integrate.solve_ivp(
        lambda t, y: [y[1], -5 * GRAVITY / (7 * arm) * np.sin(y[0])],
        (0.0, duration),
        [angle, 0.0],
        method="DOP853",
        rtol=1e-13,
        atol=1e-13,
    ).y[:, -1]
    place = middle + arm * np.array([0.0, np.sin(angle), -np.cos(angle)])
    np.testing.assert_allclose(state[:3], place, atol=1e-10)
    pressed = BALL * (arm * rate**2 + GRAVITY * np.cos(angle))
    assert force[0] == pytest.approx(pressed, rel=1e-9)


def test_a_spinning_ball_keeps_its_energy_in_a_bowl():
    """Rolling friction takes no power, in three dimensions with spin; RK5 leaves 1e-10."""
    middle = np.array([0.0, 0.0, 1.5])
    model = rolling(Sphere(tuple(middle), 1.5, inside=True))
    structure, plant = find_structure(model.dae), model.links.plant
    place = middle + 1.3 * np.array([0.28, 0.0, -0.96])
    guess = [*place, 0.1, 0.2, 0.3, 0.0, 0.8, 0.0, 0.5, -0.4, 1.0]
    start = structure.manifold.project(guess)
    state, _ = run(model, structure, start, 0.8)
    energies = []
    for x in (start, state):
        context = plant.CreateDefaultContext()
        plant.SetPositionsAndVelocities(context, x)
        energies.append(plant.EvalKineticEnergy(context) + plant.EvalPotentialEnergy(context))
    assert energies[1] == pytest.approx(energies[0], abs=1e-9)
    assert np.linalg.norm(state[:3] - start[:3]) > 0.3


def test_a_pushed_ball_tracks_with_its_normal_force():
    """e(t) of double poles at -4, and the force at once."""
    model = rolling(Sphere((0.0, 0.0, -2.0), 2.0))
    structure = find_structure(model.dae)
    law = TrackingLaw(model.dae, poles(-4.0), structure=structure)
    wanted = [SinusoidReference(0.1, 0.2, 1.0), SinusoidReference(0.0, 0.2, 1.5)]
    wanted.append(SinusoidReference(30.0, 5.0, 2.0))
    loop = make_closed_loop(RobotPlant(model, structure=structure), law, wanted)
    context = loop.diagram.CreateDefaultContext()
    own = loop.plant.GetMyMutableContextFromRoot(context)
    q = model.configuration([0.15, 0.05], [0.1, 0.0, 0.2, 0.0, 0.0, 0.0])
    loop.plant.set_consistent_state(own, model.rest_state(q, [30.0]))
    simulate(loop.diagram, context, 1.0, fixed_step(4e-3))
    record = loop.record(context)
    predicted = loop.predicted_error(record)
    np.testing.assert_allclose(record["tracking_error"], predicted, atol=1e-8)
    apart = np.linalg.norm(record["state"][:, :3] - [0.0, 0.0, -2.0], axis=1)
    np.testing.assert_allclose(apart, 2.0 + SIZE, atol=1e-9)


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: Blade("a", (0, 0, 0)), "axis"),
        (lambda: RollingWheel("a", 0.0), r"'wheel\.radius'"),
        (lambda: RollingBall("a", Plane((0, 0, 0), (0, 0, 1)), -1.0), r"'ball\.radius'"),
        (
            lambda: RollingBall("a", Ellipsoid((0, 0, 0), (1, 2, 3)), 0.1),
            "Ellipsoid",
        ),
    ],
)
def test_what_makes_no_sense_is_refused(make, words):
    with pytest.raises(ModelError, match=words):
        make()
