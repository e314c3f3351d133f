"""The rules of `Links` and `Kinematics`, on links of every kind.

Frames are compared with the plain expressions of their poses, differentiated through the joints.
The numbers are of order 1 to 100, so that 1e-10 is round-off with room.
"""

from functools import cache

import casadi as ca
import numpy as np
import pytest
from arms import parse
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import (
    FixedOffsetFrame,
    PrismaticJoint,
    RevoluteJoint,
    RpyFloatingJoint,
    ScrewJoint,
    SpatialInertia,
    UniversalJoint,
)

from drake_dae import LinkExpressions
from drake_dae.errors import ModelError
from drake_dae.robots import MultibodyExpressions, Reaction
from drake_dae.trace.functions import TracedFunction

CLOSE = {"rtol": 1e-10, "atol": 1e-10}


def turned(angle):
    c, s = ca.cos(angle), ca.sin(angle)
    return ca.vertcat(ca.horzcat(c, -s, 0), ca.horzcat(s, c, 0), ca.horzcat(0, 0, 1))


def tilted(angle):
    c, s = ca.cos(angle), ca.sin(angle)
    return ca.vertcat(ca.horzcat(1, 0, 0), ca.horzcat(0, c, -s), ca.horzcat(0, s, c))


def textbook_arm():
    """The tool turns about the second link, so that its angular velocity has all components."""
    q, v = ca.SX.sym("q", 2), ca.SX.sym("v", 2)
    c, s = ca.cos(q[1]), ca.sin(q[1])
    mass = ca.vertcat(ca.horzcat(12 + 6 * c, 2 + 3 * c), ca.horzcat(2 + 3 * c, 2))
    bias = ca.vertcat(-3 * s * (2 * v[0] * v[1] + v[1] ** 2), 3 * s * v[0] ** 2)
    far = ca.vertcat(ca.cos(q[0]) + ca.cos(q[0] + q[1]), ca.sin(q[0]) + ca.sin(q[0] + q[1]), 0)
    return LinkExpressions(q, v, mass, bias, frames={"tool": (turned(q[0]) @ tilted(q[1]), far)})


def sled():
    """Velocities are those along its own axes: N is a rotation."""
    q, v = ca.SX.sym("q", 3), ca.SX.sym("v", 3)
    bias = ca.vertcat(-2.0 * v[1] * v[2], 2.0 * v[0] * v[2], 0.0)
    pose = (turned(q[2]), ca.vertcat(q[0], q[1], 0.5))
    mass = ca.diag(ca.SX([2.0, 2.0, 0.3]))
    return LinkExpressions(q, v, mass, bias, frames={"tool": pose}, velocity_map=turned(q[2]))


def floating():
    """A free body with an arm: N is not the identity."""
    plant = MultibodyPlant(0.0)
    inertia = SpatialInertia.SolidBoxWithMass(2.0, 0.3, 0.5, 0.7)
    base, link = plant.AddRigidBody("base", inertia), plant.AddRigidBody("link", inertia)
    plant.AddJoint(RpyFloatingJoint("free", plant.world_frame(), base.body_frame()))
    hinge = RevoluteJoint("hinge", base.body_frame(), link.body_frame(), [0.6, 0.0, 0.8])
    plant.AddJointActuator("motor", plant.AddJoint(hinge))
    pose = RigidTransform(RollPitchYaw(0.3, -0.7, 1.1), [0.5, 0.2, 0.9])
    plant.AddFrame(FixedOffsetFrame("tool", link.body_frame(), pose))
    plant.Finalize()
    return MultibodyExpressions(plant)


def chain():
    """A screw, a slide, a hinge whose parent is the outer body, and a joint with two positions."""
    plant = MultibodyPlant(0.0)
    inertia = SpatialInertia.SolidBoxWithMass(2.0, 0.3, 0.5, 0.7)
    world = plant.world_frame()
    a, b, c, d = (plant.AddRigidBody(name, inertia).body_frame() for name in "abcd")
    pose = RigidTransform(RollPitchYaw(0.3, -0.7, 1.1), [0.5, 0.2, 0.9])
    off = plant.AddFrame(FixedOffsetFrame("off", a, pose))
    plant.AddJoint(ScrewJoint("screw", world, a, [0.6, 0.0, 0.8], 0.3, 0.0))
    plant.AddJoint(PrismaticJoint("slide", off, b, [0.48, 0.6, 0.64]))
    plant.AddJoint(RevoluteJoint("hinge", c, b, [0.0, 0.6, 0.8]))
    plant.AddJoint(UniversalJoint("cross", c, d))
    plant.AddFrame(FixedOffsetFrame("tool", d, pose))
    plant.Finalize()
    return MultibodyExpressions(plant)


MAKERS = {
    "textbook arm": textbook_arm,
    "sled": sled,
    "floating": floating,
    "chain": chain,
    "two_link": lambda: MultibodyExpressions(parse("two_link_arm")),
    "seven_joint": lambda: MultibodyExpressions(parse("seven_joint_arm")),
}


@cache
def made(name):
    return MAKERS[name]()


@pytest.fixture(params=MAKERS)
def links(request):
    return made(request.param)


def numbers(links, extra, outputs, seed=0):
    """Values of expressions at a random state, with random numbers for further symbols."""
    random = np.random.default_rng(seed)
    parameters = ca.vertcat(ca.SX(0, 1), *[p.symbol for p in links.parameters])
    inputs = {"q": links.q, "v": links.v, **extra}
    values = [random.uniform(-1.0, 1.0, symbol.numel()) for symbol in inputs.values()]
    values.append(np.concatenate([np.zeros(0), *[p.value for p in links.parameters]]))
    function = TracedFunction("rules", {**inputs, "parameters": parameters}, outputs)
    return function(*values), values


def test_sizes_and_names(links):
    nq, nv, nu = links.q.numel(), links.v.numel(), len(links.actuator_signals)
    assert links.velocity_map.shape == (nq, nv)
    assert links.mass_matrix.shape == (nv, nv)
    assert links.bias.shape == (nv, 1)
    assert links.actuation_matrix.shape == (nv, nu)
    for limits, size in ((links.position_limits, nq), (links.velocity_limits, nv)):
        assert [end.shape for end in limits] == [(size,), (size,)]
    for row in (links.effort_limits, links.reflected_inertia, links.gear_ratios):
        assert row.shape == (nu,)
    assert links.default_positions.shape == (nq,)
    names = [s.name for s in (*links.position_signals, *links.velocity_signals)]
    assert len(set(names)) == len(names) == nq + nv
    assert links.landmarks().shape[0] == 3


def test_mass_matrix_is_one(links):
    (mass,), _ = numbers(links, {}, {"M": links.mass_matrix})
    mass = np.atleast_2d(mass)
    np.testing.assert_allclose(mass, mass.T, **CLOSE)
    assert np.linalg.eigvalsh(mass)[0] > 0.0


def test_frames(links):
    point = np.array([0.3, -0.2, 0.5])
    (rotation, origin, there, still), _ = numbers(
        links,
        {},
        {
            "R": links.rotation("tool"),
            "p": links.position("tool"),
            "there": links.position("tool", point),
            "still": links.position("world", point),
        },
    )
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-14)
    assert np.linalg.det(rotation) > 0.0
    np.testing.assert_allclose(there, origin + rotation @ point, **CLOSE)
    np.testing.assert_array_equal(still, point)
    np.testing.assert_array_equal(ca.DM(links.rotation("world")), np.eye(3))
    with pytest.raises(ModelError, match=r"'tol'.*tool"):
        links.position("tol")


@pytest.mark.parametrize("frame", ["tool", "world"])
def test_frames_move_as_their_poses_do(links, frame):
    """Velocities and accelerations against the poses of rule 3, differentiated twice."""
    point = (0.3, -0.2, 0.5)
    kinematics = links.kinematics()
    moving = ca.vertcat(links.q, links.v)
    rate = ca.vertcat(links.velocity_map @ links.v, kinematics.acceleration)

    def plain(expression):
        return ca.jtimes(expression, moving, rate)

    pose = ca.vertcat(links.position(frame, point), ca.vec(links.rotation(frame)))
    own = ca.vertcat(kinematics.position(frame, point), ca.vec(kinematics.rotation(frame)))
    spin = kinematics.angular_velocity(frame)
    (R, v, w, slope, *pairs), _ = numbers(
        links,
        {"acceleration": kinematics.acceleration},
        {
            "R": links.rotation(frame),
            "v": kinematics.value(kinematics.velocity(frame, point)),
            "w": kinematics.value(spin),
            "slope": kinematics.value(kinematics.derivative(spin)),
            "own": kinematics.value(own),
            "pose": pose,
            "own rate": kinematics.value(kinematics.derivative(own)),
            "rate": plain(pose),
            "own twice": kinematics.value(kinematics.derivative(kinematics.derivative(own))),
            "twice": plain(plain(pose)),
        },
    )
    for ours, theirs in zip(pairs[::2], pairs[1::2], strict=True):
        np.testing.assert_allclose(ours, theirs, **CLOSE)
    rate, twice = pairs[3], pairs[5]
    np.testing.assert_allclose(v, rate[:3], **CLOSE)
    turning = rate[3:].reshape(3, 3, order="F")
    np.testing.assert_allclose(turning, np.cross(w, R.T).T, **CLOSE)
    # R'' = w' x R + w x (w x R)
    expected = np.cross(slope, R.T).T + np.cross(w, np.cross(w, R.T)).T
    np.testing.assert_allclose(twice[3:].reshape(3, 3, order="F"), expected, **CLOSE)


def test_forces_have_the_power_of_their_work(links):
    """tau . v = F . p' + M . w, and inverse dynamics is M v' + H - tau."""
    point = (0.3, -0.2, 0.5)
    kinematics = links.kinematics()
    F, M = ca.SX.sym("F", 3), ca.SX.sym("M", 3)
    velocity, spin = kinematics.velocity("tool", point), kinematics.angular_velocity("tool")
    power = ca.dot(F, velocity) + ca.dot(M, spin)
    reaction = kinematics.push("tool", F, point) + kinematics.push("world", M)
    reaction += kinematics.reaction(ca.dot(M, spin))
    acceleration = kinematics.acceleration
    (tau, power, balance, longer), values = numbers(
        links,
        {"F": F, "M": M, "acceleration": acceleration},
        {
            "tau": links.generalized_force(kinematics, reaction),
            "power": kinematics.value(power),
            "balance": links.inverse_dynamics(kinematics, reaction),
            "longer": links.mass_matrix @ acceleration + links.bias,
        },
    )
    assert tau @ values[1] == pytest.approx(power[0], abs=1e-10)
    np.testing.assert_allclose(balance, longer - tau, **CLOSE)


KNOWN = {"floating": 1, "chain": 3, "two_link": 2, "seven_joint": 7}


@pytest.mark.parametrize("name", MAKERS)
def test_a_joint_axis_is_a_unit_of_the_generalized_force(name):
    """On the child, and the opposite on the parent: tau is one for the joint and no other."""
    links = made(name)
    kinematics, found = links.kinematics(), 0
    for i, signal in enumerate(links.position_signals):
        axis = kinematics.joint_axis(signal.name)
        if axis is None:
            continue
        found += 1
        acting = Reaction(ca.SX(links.v.numel(), 1))
        for frame, sign in ((axis.frame_b, 1.0), (axis.frame_a, -1.0)):
            # The force acts at the point, to which the frame's origin has a lever.
            moment = axis.moment_axes + ca.cross(
                axis.point - kinematics.position(frame), axis.force_axes
            )
            power = ca.dot(axis.force_axes, kinematics.velocity(frame))
            power += ca.dot(moment, kinematics.angular_velocity(frame))
            acting += kinematics.reaction(sign * power)
        tau = links.generalized_force(kinematics, acting)
        (tau,), _ = numbers(links, {}, {"tau": tau})
        np.testing.assert_allclose(tau, np.eye(len(tau))[i], atol=1e-12)
    assert found == KNOWN.get(name, 0)
