"""Couplers and rods: from a plant, and what they do, by Drake and by hand."""

import casadi as ca
import numpy as np
import pytest
from arms import fixed_step
from grippers import gripper, parsed
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import (
    PrismaticJoint,
    RevoluteJoint,
    SpatialInertia,
    UnitInertia,
)

from drake_dae import (
    CoincidentPoints,
    ConstantReference,
    FixedDistance,
    FlexibleJoints,
    JointCoupler,
    JointPositions,
    LinkExpressions,
    PointCoordinates,
    RobotModel,
    RobotPlant,
    SinusoidReference,
    TrackingLaw,
    find_structure,
    make_closed_loop,
    poles,
    simulate,
)
from drake_dae.errors import ModelError
from drake_dae.robots import MultibodyExpressions, plant_constraints

# What is read from a plant.


@pytest.mark.slow
@pytest.mark.parametrize("time_step", [0.0, 1e-3])
@pytest.mark.parametrize("multiplier", [-0.7, 1.0, -1.0, 2.5])
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


def test_a_mimic_joint_of_sdformat_is_a_coupler():
    text = '<sdf version="1.11" xmlns:drake="http://drake.mit.edu"><model name="m">'
    for k, mimic in enumerate(["", '<drake:mimic joint="j0" multiplier="2" offset="0.1"/>']):
        text += (
            f'<link name="b{k}"/><joint name="j{k}" type="revolute"><parent>world</parent>'
            f"<child>b{k}</child><axis><xyz>0 1 0</xyz></axis>{mimic}</joint>"
        )
    plant = MultibodyPlant(0.0)
    Parser(plant).AddModelsFromString(f"{text}</model></sdf>", "sdf")
    plant.Finalize()
    (coupler,) = plant_constraints(MultibodyExpressions(plant))
    assert coupler == JointCoupler("j1", "j0", 2.0, 0.1, name="j1_coupler")


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


@pytest.mark.parametrize("leader", [0, 1, 2])
def test_fingers_that_all_mirror_one_finger_have_couplers_of_their_own(leader):
    """q_i + q_leader = offset_i says the same about both; the names differ, and so do the laws."""
    plant = MultibodyPlant(0.0)
    inertia = SpatialInertia.SolidSphereWithMass(0.3, 0.05)
    joints = []
    for k in range(3):
        body = plant.AddRigidBody(f"finger{k}", inertia)
        frames = plant.world_frame(), body.body_frame()
        joints.append(plant.AddJoint(RevoluteJoint(f"hinge{k}", *frames, [0, 0, 1])))
    plant.AddJointActuator("motor", joints[leader])
    others = [k for k in range(3) if k != leader]
    for k in others:
        plant.AddCouplerConstraint(joints[k], joints[leader], -1.0, 0.1 * k)
    plant.Finalize()
    outputs = [JointPositions([f"hinge{leader}"])]
    model = RobotModel.from_multibody(plant, [], outputs, forces=[])
    q = model.configuration([0.7], np.zeros(3))
    np.testing.assert_allclose(q[others], 0.1 * np.array(others) - 0.7, atol=1e-12)
    assert len({constraint.name for constraint in model.constraints}) == 2


def test_rods_of_a_plant_are_fixed_distances():
    """Behind the constraints that are given."""

    def rods(plant, first, second):
        plant.AddDistanceConstraint(first, [0.4, 0, 0], second, [0.0, 0.5, 0.0], 0.7)
        plant.AddDistanceConstraint(plant.world_body(), [1, 0, 0], second, [0.0, 0.0, 0.3], 1.1)

    links = MultibodyExpressions(two_wheels(rods))
    own = JointCoupler("hinge0", "hinge1")
    with pytest.raises(ModelError, match=r"3.*2"):
        RobotModel(links, [own], [])
    model = RobotModel(links, [own], [], [0.0, 0.0], forces=["rod1.thrust", "rod0.thrust"])
    assert model.constraints == (
        own,
        FixedDistance("first", (0.4, 0.0, 0.0), "second", (0.0, 0.5, 0.0), 0.7, "rod0"),
        FixedDistance("world", (1.0, 0.0, 0.0), "second", (0.0, 0.0, 0.3), 1.1, "rod1"),
    )


@pytest.mark.parametrize(
    ("add", "message"),
    [
        (
            lambda plant, a, b: plant.AddBallConstraint(a, [0, 0, 0], b, [0, 0, 0]),
            "CoincidentPoints",
        ),
        (
            lambda plant, a, b: plant.AddDistanceConstraint(
                a, [0, 0, 0], b, [0, 0, 0.1], 0.5, 1e4, 1.0
            ),
            "'first'.*'second'.*10000",
        ),
    ],
)
def test_what_a_plant_has_besides_is_refused(add, message):
    with pytest.raises(ModelError, match=message):
        RobotModel.from_multibody(two_wheels(add), [], [])


# What they do.


def geared(ratio=-3.0):
    """Two flywheels of 2 and 0.5 kg m^2, as equations."""
    q, v = ca.SX.sym("q", 2), ca.SX.sym("v", 2)
    links = LinkExpressions(q, v, ca.diag(ca.SX([2.0, 0.5])), ca.SX(2, 1))
    return links, JointCoupler("q1", "q0", ratio, 0.1)


def test_gears_carry_the_moment_of_the_textbook():
    """(I_0 + r^2 I_1) q_0'' = u_0 + r u_1, and the moment on the follower is I_1 q_1'' - u_1."""
    links, gears = geared()
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


# Fewer motors than there are constraint forces.


def test_a_gripper_with_one_motor_for_both_fingers_tracks():
    """e(t) of double poles at -4 with the coupler's force steered by nobody.

    RK5 at 2 ms leaves 1e-11. The fingers' mass is 0.5 + 0.7^2 0.4 kg, as Drake has it.
    """
    plant = parsed(gripper())
    positions = [JointPositions(["arm", "left"])]
    with pytest.raises(ModelError, match=r"2.*2"):
        RobotModel.from_multibody(plant, [], positions)
    model = RobotModel.from_multibody(plant, [], positions, forces=[])
    structure = find_structure(model.dae)
    assert structure.output_degrees == (2, 2)
    assert structure.constraint_degrees == (2,)
    law = TrackingLaw(model.dae, poles(-4.0), structure=structure)
    wanted = [SinusoidReference(0.3, 0.2, 2.0), SinusoidReference(0.02, 0.01, 3.0)]
    loop = make_closed_loop(RobotPlant(model, structure=structure), law, wanted)
    context = loop.diagram.CreateDefaultContext()
    own = loop.plant.GetMyMutableContextFromRoot(context)
    q = model.configuration([0.35, 0.03], [0.3, 0.0, 0.0])
    loop.plant.set_consistent_state(own, model.rest_state(q, []))
    simulate(loop.diagram, context, 1.0, fixed_step(2e-3))
    record = loop.record(context)
    t = record.time
    for i, (error, rate) in enumerate([(0.05, -0.4), (0.01, -0.03)]):
        expected = (error + (rate + 4.0 * error) * t) * np.exp(-4.0 * t)
        np.testing.assert_allclose(record["tracking_error"][:, i], expected, atol=1e-10)
    state = record["state"]
    np.testing.assert_allclose(state[:, 2], 0.05 - 0.7 * state[:, 1], atol=1e-12)


def test_a_rest_state_behind_springs_bears_the_forces_that_are_no_outputs():
    """The shafts stand so that nothing moves: x' = 0 with the control that holds it."""
    plant = parsed(gripper())
    springs = [FlexibleJoints(900.0, 0.3)]
    positions = [JointPositions(["arm", "left"])]
    model = RobotModel.from_multibody(plant, [], positions, actuation=springs, forces=[])
    q = model.configuration([0.4, 0.1], [0.3, 0.0, 0.0])
    state = model.rest_state(q, [])
    block = RobotPlant(model)
    context = block.CreateDefaultContext()
    block.set_state(context, state)
    torque = block.GetOutputPort("joint_torque").Eval(context)
    block.GetInputPort("control").FixValue(context, torque)
    rate = block.EvalTimeDerivatives(context).CopyToVector()
    np.testing.assert_allclose(rate, 0.0, atol=1e-9)
    assert np.abs(torque).max() > 1.0


def test_chosen_forces_are_outputs_in_their_order():
    """z_2 = S lambda; all of lambda stays on its port."""
    inertia = SpatialInertia(2.0, [0.1, 0.0, 0.0], UnitInertia(0.1, 0.2, 0.2))
    plant = MultibodyPlant(0.0)
    plant.AddRigidBody("body", inertia)
    for name in ("x", "z"):
        mass = SpatialInertia.SolidSphereWithMass(0.1, 0.05)
        plant.AddRigidBody(name, mass)
    chain = ["x", "z", "body"]
    parents = [plant.world_frame(), *(plant.GetFrameByName(name) for name in chain[:2])]
    axes = ([1, 0, 0], [0, 0, 1], [0, 1, 0])
    kinds = (PrismaticJoint, PrismaticJoint, RevoluteJoint)
    for name, parent, kind, axis in zip(chain, parents, kinds, axes, strict=True):
        joint = kind(f"move_{name}", parent, plant.GetFrameByName(name), axis)
        plant.AddJointActuator(f"motor_{name}", plant.AddJoint(joint))
    plant.Finalize()
    pin = CoincidentPoints("world", (0.2, 0.0, 0.1), "body", (0.3, 0.0, 0.0), "xz")
    outputs = [JointPositions(["move_body"]), PointCoordinates("body", "x", name="middle")]
    plain = RobotModel.from_multibody(plant, [pin], outputs[:1])
    assert [s.name for s in plain.dae.output_signals] == ["move_body", "pin.fx", "pin.fz"]
    model = RobotModel.from_multibody(plant, [pin], outputs[:1], forces=["pin.fz", "pin.fx"])
    assert [s.name for s in model.dae.output_signals] == ["move_body", "pin.fz", "pin.fx"]
    block = RobotPlant(model)
    context = block.CreateDefaultContext()
    block.GetInputPort("control").FixValue(context, [1.0, 2.0, 3.0])
    z = block.GetOutputPort("controlled_output").Eval(context)
    force = block.GetOutputPort("constraint_force").Eval(context)
    np.testing.assert_array_equal(z[1:], force[::-1])
    for forces, words in (
        (["pin.f"], "'pin.f'"),
        (["pin.fx"] * 2, "pin.fx"),
    ):
        with pytest.raises(ModelError, match=words):
            RobotModel.from_multibody(plant, [pin], outputs[:1], forces=forces)


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: JointCoupler("a", "a"), "'a'"),
        (lambda: JointCoupler("a", "b", 0.0), "ratio"),
        (lambda: JointCoupler("a", "b", unit="deg"), "'deg'"),
        (lambda: FixedDistance("a", (0, 0, 0), "b", (0, 0, 0), 0.0), r"'rod\.length'"),
    ],
)
def test_what_makes_no_sense_is_refused(make, words):
    with pytest.raises(ModelError, match=words):
        make()


@pytest.mark.parametrize(
    ("coupler", "words"),
    [
        (JointCoupler("right", "lef", unit="m"), "'lef'"),
        (JointCoupler("right", "arm"), "'right'"),
    ],
)
def test_a_coupler_that_does_not_fit_its_robot_is_refused(coupler, words):
    positions = [JointPositions(["arm", "left"])]
    with pytest.raises(ModelError, match=words):
        RobotModel.from_multibody(parsed(gripper()), [coupler], positions, forces=[])


def test_the_references_of_a_coupled_robot_are_those_of_its_outputs():
    links, gears = geared()
    model = RobotModel(links, [gears], [JointPositions(["q0"])], [0.0, 0.1])
    law = TrackingLaw(model.dae, poles(-4.0))
    loop = make_closed_loop(RobotPlant(model), law, [ConstantReference([0.3, 2.0])])
    context = loop.diagram.CreateDefaultContext()
    simulate(loop.diagram, context, 0.1, fixed_step(1e-2))
    moment = loop.record(context)["constraint_force"]
    np.testing.assert_allclose(moment, 2.0, rtol=1e-10)
