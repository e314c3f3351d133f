"""Welds, couplers and rods: by Drake, by hand, and as a plant has them.

Drake and the library compute the same numbers of order 1 to 100 by different recursions, so the
tolerance of 1e-10 is round-off with room.
"""

import casadi as ca
import numpy as np
import pytest
from grippers import gripper, parsed
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import JacobianWrtVariable, RevoluteJoint, SpatialInertia, UnitInertia
from two_arms import two_arms

from drake_dae import (
    AxisNormalToSurface,
    CoincidentPoints,
    FixedDistance,
    JointCoupler,
    JointPositions,
    LinkExpressions,
    Plane,
    RobotModel,
    RobotPlant,
    RollingWheel,
    WeldedFrames,
    find_structure,
)
from drake_dae.errors import ModelError
from drake_dae.trace.functions import TracedFunction

VELOCITY = JacobianWrtVariable.kV
PAIRS = [("right::link5", "left::link3"), ("right::tool", "world")]


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


@pytest.mark.slow
@pytest.mark.parametrize(("first", "second"), PAIRS)
def test_weld_measures_a_pose_and_its_rate_the_relative_velocity(first, second):
    """Anywhere, also far off the constraint: phi from Drake's angle and axis, and

    r' = w + w x r / 2 + (w . r) r / 4.
    """
    links = two_arms().links
    a, b = (
        links.plant.GetFrameByName(own, *map(links.plant.GetModelInstanceByName, instance))
        for *instance, own in (first.split("::"), second.split("::"))
    )
    random, context = np.random.default_rng(0), links.plant.CreateDefaultContext()
    for _ in range(5):
        q = random.uniform(-2.0, 2.0, links.plant.num_positions())
        links.plant.SetPositions(context, q)
        turned, shift = RollPitchYaw(random.uniform(-1, 1, 3)), random.uniform(-1, 1, 3)
        pose = RigidTransform(turned, shift)
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


def _cross(vector):
    x, y, z = vector
    return np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])


@pytest.mark.slow
@pytest.mark.parametrize(("time_step", "multiplier"), [(0.0, -0.7), (1e-3, -1.0)])
def test_a_mimic_joint_is_a_coupler(time_step, multiplier):
    """In continuous and in discrete time, with the numbers of its tag."""
    plant = parsed(gripper(multiplier=multiplier), time_step)
    positions = [JointPositions(["arm"])]
    model = RobotModel.from_multibody(plant, [], positions)
    (coupler,) = model.constraints
    # q_right + q_left = offset says the same about both.
    follower = coupler.follower
    leader = {"right": "left", "left": "right"}[follower]
    assert follower == "right" or multiplier == -1.0
    assert coupler == JointCoupler(
        follower, leader, multiplier, 0.05, "m", name=f"{follower}_coupler"
    )
    assert [s.name for s in model.dae.output_signals] == ["arm", f"{follower}_coupler.force"]


def two_wheels(add):
    """Two bodies on hinges in discrete time, and a constraint."""
    plant = MultibodyPlant(1e-3)
    inertia = SpatialInertia(1.5, [0.1, 0.0, 0.2], UnitInertia(0.1, 0.2, 0.2))
    bodies = [plant.AddRigidBody(name, inertia) for name in ("first", "second")]
    for k, body in enumerate(bodies):
        joint = RevoluteJoint(f"hinge{k}", plant.world_frame(), body.body_frame(), [0, 1, k])
        plant.AddJointActuator(f"motor{k}", plant.AddJoint(joint))
    add(plant, *bodies)
    plant.Finalize()
    return plant


def test_gears_of_a_plant_are_couplers():
    def gears(plant, *_):
        joints = [plant.GetJointByName(f"hinge{k}") for k in (1, 0)]
        plant.AddCouplerConstraint(*joints, -3.0, 0.25)

    model = RobotModel.from_multibody(two_wheels(gears), [], [JointPositions(["hinge0"])])
    assert model.constraints == (
        JointCoupler("hinge1", "hinge0", -3.0, 0.25, name="hinge1_coupler"),
    )
    q = model.configuration([0.3], [0.0, 0.0])
    np.testing.assert_allclose(q, [0.3, -3.0 * 0.3 + 0.25], atol=1e-12)


@pytest.mark.parametrize(
    ("add", "message"),
    [
        (
            lambda plant, a, b: plant.AddBallConstraint(a, [0, 0, 0], b, [0, 0, 0]),
            "CoincidentPoints",
        ),
        (
            lambda plant, a, b: plant.AddDistanceConstraint(a, [0, 0, 0], b, [0, 0, 0.1], 0.5),
            "FixedDistance",
        ),
    ],
)
def test_what_a_plant_has_besides_is_refused(add, message):
    with pytest.raises(ModelError, match=message):
        RobotModel.from_multibody(two_wheels(add), [], [])


def test_gears_carry_the_moment_of_the_textbook():
    """(I_0 + r^2 I_1) q_0'' = u_0 + r u_1, and the moment on the follower is I_1 q_1'' - u_1.

    Two flywheels of 2 and 0.5 kg m^2.
    """
    q, v = ca.SX.sym("q", 2), ca.SX.sym("v", 2)
    links = LinkExpressions(q, v, ca.diag(ca.SX([2.0, 0.5])), ca.SX(2, 1))
    gears = JointCoupler("q1", "q0", -3.0, 0.1)
    model = RobotModel(links, [gears], [JointPositions(["q0"])], [0.0, 0.1])
    assert find_structure(model.dae).constraint_degrees == (2,)
    block = RobotPlant(model)
    context = block.CreateDefaultContext()
    u = np.array([5.0, -1.2])
    block.set_state(context, [0.2, -0.5, 1.0, -3.0])
    block.GetInputPort("control").FixValue(context, u)
    faster = (u[0] - 3.0 * u[1]) / (2.0 + 9.0 * 0.5)
    rate = block.EvalTimeDerivatives(context).CopyToVector()
    np.testing.assert_allclose(rate[2:], [faster, -3.0 * faster], rtol=1e-13)
    moment = block.GetOutputPort("constraint_force").Eval(context)
    np.testing.assert_allclose(moment, 0.5 * -3.0 * faster - u[1], rtol=1e-13)
    # Nobody knows where joints of textbook equations are.
    assert block.GetOutputPort("constraint_wrenches").size() == 0


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: CoincidentPoints("a", (0, 0, 0), "b", (0, 0, 0), "xx"), "'xx'"),
        (lambda: WeldedFrames("a", "b", RigidTransform([np.inf, 0, 0])), r"weld\.position"),
        (lambda: JointCoupler("a", "b", unit="deg"), "'deg'"),
        (lambda: AxisNormalToSurface("a", Plane((0, 0, 0), (0, 0, 1)), (0.0, 0.0, 0.0)), "axis"),
        (lambda: FixedDistance("a", (0, 0, 0), "b", (0, 0, 0), 0.0), r"'rod\.length'"),
        (lambda: RollingWheel("a", 0.0), r"'wheel\.radius'"),
    ],
)
def test_what_makes_no_sense_is_refused(make, words):
    with pytest.raises(ModelError, match=words):
        make()


@pytest.mark.parametrize(
    ("coupler", "words"),
    [(JointCoupler("right", "lef", unit="m"), "'lef'"), (JointCoupler("right", "arm"), "'right'")],
)
def test_a_coupler_that_does_not_fit_its_robot_is_refused(coupler, words):
    positions = [JointPositions(["arm", "left"])]
    with pytest.raises(ModelError, match=words):
        RobotModel.from_multibody(parsed(gripper()), [coupler], positions, forces=[])
