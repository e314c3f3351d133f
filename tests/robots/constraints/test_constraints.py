"""Constraints against MultibodyPlant: what their Jacobians are, and what their multipliers do.

Drake and the library compute the same numbers of order 1 to 100 by different recursions, so the
tolerance of 1e-10 is round-off with room.
"""

from functools import cache

import casadi as ca
import numpy as np
import pytest
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import (
    FixedOffsetFrame,
    JacobianWrtVariable,
    RevoluteJoint,
    RpyFloatingJoint,
    SpatialInertia,
)
from two_arms import APART, NOMINAL, two_arms

from drake_dae import (
    CoincidentPoints,
    JointPositions,
    LinkExpressions,
    RobotModel,
    RobotPlant,
    WeldedFrames,
    find_structure,
)
from drake_dae.errors import AssumptionError, ModelError
from drake_dae.robots import MultibodyExpressions
from drake_dae.trace.functions import TracedFunction

VELOCITY = JacobianWrtVariable.kV
PAIRS = [
    ("object", "right::tool"),
    ("right::link5", "left::link3"),
    ("world", "left::tool"),
    ("right::tool", "world"),
    ("left::link2", "object"),
]


@cache
def arms():
    model = two_arms()
    return model, find_structure(model.dae)


def evaluate(constraint, links, q):
    """phi and J = (dphi/dq) N at a configuration, shapes (m,) and (m, nv)."""
    phi = constraint.residual(links)
    symbols = ca.vertcat(ca.SX(0, 1), *[p.symbol for p in constraint.parameters])
    function = TracedFunction(
        constraint.name,
        {"q": links.q, "p": symbols},
        {"phi": phi, "jacobian": ca.mtimes(ca.jacobian(phi, links.q), links.velocity_map)},
    )
    values = np.concatenate([np.zeros(0), *[p.value for p in constraint.parameters]])
    residual, jacobian = function(q, values)
    assert len(residual) == len(constraint.force_signals) == len(constraint.residual_signals)
    return residual, jacobian.reshape(len(residual), -1)


def configurations(count, seed=0):
    """Random ones of the two arms, with Drake's context there."""
    plant = arms()[0].links.plant
    random = np.random.default_rng(seed)
    for _ in range(count):
        q = random.uniform(-2.0, 2.0, plant.num_positions())
        context = plant.CreateDefaultContext()
        plant.SetPositions(context, q)
        yield q, context, random


def frames(*names):
    """Of the two arms, by scoped name."""
    plant = arms()[0].links.plant
    for name in names:
        *instance, own = name.split("::")
        yield plant.GetFrameByName(own, *map(plant.GetModelInstanceByName, instance))


def random_pose(random):
    return RigidTransform(RollPitchYaw(random.uniform(-1, 1, 3)), random.uniform(-1, 1, 3))


@pytest.mark.slow
@pytest.mark.parametrize(("first", "second"), PAIRS)
def test_weld_measures_a_pose_and_its_rate_the_relative_velocity(first, second):
    """Anywhere, also far off the constraint: phi from Drake's angle and axis, and

    r' = w + w x r / 2 + (w . r) r / 4.
    """
    links = arms()[0].links
    a, b = frames(first, second)
    for q, context, random in configurations(5):
        pose = random_pose(random)
        phi, jacobian = evaluate(WeldedFrames(first, second, pose), links, q)
        found = links.plant.CalcRelativeTransform(context, a, b)
        turn = (found.rotation() @ pose.rotation().inverse()).ToAngleAxis()
        r = 2.0 * np.tan(turn.angle() / 2.0) * turn.axis()
        scale = 1.0 + r @ r  # Where phi goes to infinity, its errors do.
        np.testing.assert_allclose(phi[:3], found.translation() - pose.translation(), atol=1e-10)
        np.testing.assert_allclose(phi[3:], r, atol=1e-10 * scale)
        velocity = links.plant.CalcJacobianSpatialVelocity(context, VELOCITY, b, np.zeros(3), a, a)
        turning = np.eye(3) - _cross(r) / 2.0 + np.outer(r, r) / 4.0
        np.testing.assert_allclose(jacobian[:3], velocity[3:], atol=1e-10)
        np.testing.assert_allclose(jacobian[3:], turning @ velocity[:3], atol=1e-10 * scale)


def rod(joint):
    """A rod of 3 kg and 0.8 m along the x axis of its frame, whose origin is one end."""
    plant = MultibodyPlant(0.0)
    inertia = SpatialInertia.ThinRodWithMassAboutEnd(3.0, 0.8, [1.0, 0.0, 0.0])
    body = plant.AddRigidBody("rod", inertia)
    plant.AddFrame(FixedOffsetFrame("tip", body.body_frame(), RigidTransform([0.8, 0.0, 0.0])))
    wall = RigidTransform(RollPitchYaw(0.3, -0.7, 1.1), [0.5, 0.2, 0.9])
    plant.AddFrame(FixedOffsetFrame("wall", plant.world_frame(), wall))
    plant.AddJoint(joint(plant.world_frame(), body.body_frame()))
    return plant


WEIGHT = 3.0 * 9.81


def test_wall_holds_a_cantilever():
    """Its weight, and the weight's moment about the welded tip, in the axes of the wall."""
    plant = rod(lambda world, frame: RpyFloatingJoint("free", world, frame))
    plant.Finalize()
    context = plant.CreateDefaultContext()
    random = np.random.default_rng(5)
    q = random.uniform(-1.0, 1.0, 6)
    plant.SetPositions(context, q)
    wall, tip = plant.GetFrameByName("wall"), plant.GetFrameByName("tip")
    pose = plant.CalcRelativeTransform(context, wall, tip)
    links = MultibodyExpressions(plant)
    _, jacobian = evaluate(WeldedFrames("wall", "tip", pose), links, q)
    # At rest M v' + H = J^T lambda with v' = 0, and J is regular.
    multiplier = np.linalg.solve(jacobian.T, -plant.CalcGravityGeneralizedForces(context))
    X_WT, R_WA = tip.CalcPoseInWorld(context), wall.CalcPoseInWorld(context).rotation()
    lever = X_WT.rotation() @ np.array([-0.4, 0.0, 0.0])  # To the rod's middle.
    up = np.array([0.0, 0.0, WEIGHT])
    np.testing.assert_allclose(R_WA @ multiplier[:3], up, atol=1e-10)
    np.testing.assert_allclose(R_WA @ multiplier[3:], np.cross(lever, up), atol=1e-10)


def test_support_carries_half_of_a_rod():
    """A level rod on a hinge: at its other end, half its weight and what the motor presses."""
    plant = rod(lambda world, frame: RevoluteJoint("hinge", world, frame, [0.0, 1.0, 0.0]))
    plant.AddJointActuator("motor", plant.GetJointByName("hinge"))
    plant.Finalize()
    support = CoincidentPoints("world", (0.8, 0.0, 0.0), "rod", (0.8, 0.0, 0.0), "z", "support")
    system = RobotPlant(RobotModel.from_multibody(plant, [support], []))
    context = system.CreateDefaultContext()
    for torque in (0.0, 7.0):
        system.GetInputPort("control").FixValue(context, torque)
        force = system.GetOutputPort("constraint_force").Eval(context)
        # A positive torque about y turns the x axis down.
        np.testing.assert_allclose(force, WEIGHT / 2.0 + torque / 0.8, rtol=1e-12)


def turntable():
    """One joint about z."""
    q, v = ca.SX.sym("q"), ca.SX.sym("v")
    c, s = ca.cos(q), ca.sin(q)
    rotation = ca.SX(3, 3)
    rotation[0, 0], rotation[0, 1], rotation[1, 0], rotation[1, 1], rotation[2, 2] = c, -s, s, c, 1
    pose = (rotation, ca.SX.zeros(3))
    return LinkExpressions(
        q, v, ca.SX(1), ca.SX(0), frames={"plate": pose, "point": ca.SX.zeros(3)}
    )


def test_weld_has_no_other_root():
    """The orientation error grows up to half a turn, where it is infinite."""
    turns = [*np.linspace(0.0, 3.14, 50), np.pi]
    sizes = [evaluate(WeldedFrames("world", "plate"), turntable(), [q])[0][5] for q in turns]
    assert np.all(np.diff(sizes) >= np.diff(turns))
    assert sizes[-1] == np.inf
    model = arms()[0]
    midway = [APART / 2, 0.0, 0.4, *np.zeros(5)]
    # From a right hand that is turned by nearly half a turn, Newton's method turns it back.
    for turn in (-3.0, -1.6, 1.6, 3.0):
        guess = NOMINAL + turn * np.eye(14)[13]
        np.testing.assert_allclose(model.configuration(midway, guess), NOMINAL, atol=1e-6)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: CoincidentPoints("a", (0, 0, 0), "b", (0, 0, 0), "xx"), "'xx'"),
        (lambda: WeldedFrames("a", "b", RigidTransform([np.inf, 0, 0])), r"weld\.position"),
        (lambda: WeldedFrames("world", "plat").residual(turntable()), "'plat'"),
        (lambda: WeldedFrames("world", "point").residual(turntable()), "point"),
    ],
)
def test_refusals(make, message):
    with pytest.raises(ModelError, match=message):
        make()


# A four-bar linkage in the x-z plane: crank, coupler and rocker, thin rods between two hinges in
# the ground. The crank can turn all the way round (Grashof: 0.3 + 0.8 < 0.7 + 0.5).

LENGTHS = {"crank": 0.3, "coupler": 0.7, "rocker": 0.5}
GROUND = 0.8
DENSITY = 2.0  # kg/m


def four_bar(axes="xz"):
    plant = MultibodyPlant(0.0)
    for name, length in LENGTHS.items():
        inertia = SpatialInertia.ThinRodWithMassAboutEnd(DENSITY * length, length, [1.0, 0.0, 0.0])
        plant.AddRigidBody(name, inertia)
    elbow = FixedOffsetFrame(
        "elbow", plant.GetFrameByName("crank"), RigidTransform([LENGTHS["crank"], 0.0, 0.0])
    )
    base = FixedOffsetFrame("base", plant.world_frame(), RigidTransform([GROUND, 0.0, 0.0]))
    hinges = {
        "crank": plant.world_frame(),
        "coupler": plant.AddFrame(elbow),
        "rocker": plant.AddFrame(base),
    }
    for name, parent in hinges.items():
        # About -y a positive angle turns x toward z.
        joint = plant.AddJoint(
            RevoluteJoint(name, parent, plant.GetFrameByName(name), [0.0, -1.0, 0.0])
        )
        plant.AddJointActuator(name, joint)
    plant.Finalize()
    ends = [(LENGTHS[name], 0.0, 0.0) for name in ("coupler", "rocker")]
    pin = CoincidentPoints("coupler", ends[0], "rocker", ends[1], axes)
    outputs = [JointPositions(["crank"])] if len(axes) == 2 else []
    return RobotModel.from_multibody(plant, [pin], outputs, [1.0, -0.5, 1.6], "four-bar")


def linkage(crank):
    """Angles of coupler and rocker from the ground, and their ratios and its derivatives.

    The loop L1 e(a) + L2 e(b) = D + L3 e(c), differentiated by hand: b' = k2 a', c' = k3 a'.
    """
    first, second, third = LENGTHS.values()
    reach = np.array([GROUND - first * np.cos(crank), -first * np.sin(crank)])
    distance = np.hypot(*reach)
    # The law of cosines at the pin's end of the crank: coupler above the diagonal.
    cosine = (second**2 + distance**2 - third**2) / (2.0 * second * distance)
    b = np.arctan2(reach[1], reach[0]) + np.arccos(cosine)
    tip = second * np.array([np.cos(b), np.sin(b)]) - reach
    c = np.arctan2(tip[1], tip[0])
    k2 = first * np.sin(crank - c) / (second * np.sin(c - b))
    k3 = first * np.sin(crank - b) / (third * np.sin(c - b))
    fall = np.cos(c - b) * (k3 - k2) / np.sin(c - b)
    k2_rate = first * np.cos(crank - c) * (1.0 - k3) / (second * np.sin(c - b)) - k2 * fall
    k3_rate = first * np.cos(crank - b) * (1.0 - k2) / (third * np.sin(c - b)) - k3 * fall
    return b, c, k2, k3, k2_rate, k3_rate


def test_third_equation_of_a_plane_linkage_is_refused():
    with pytest.raises(AssumptionError, match=r"pin\.y"):
        find_structure(four_bar("xyz").dae)


def _cross(vector):
    x, y, z = vector
    return np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
