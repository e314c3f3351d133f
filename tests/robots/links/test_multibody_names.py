"""Names, units and limits of what is read from a MultibodyPlant, and what is refused."""

import casadi as ca
import numpy as np
import pytest
from pydrake.math import RigidTransform
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import (
    DoorHinge,
    DoorHingeConfig,
    LinearBushingRollPitchYaw,
    QuaternionFloatingJoint,
    WeldJoint,
)
from random_plants import (
    assert_close,
    default_masses,
    one_body,
    random_robot,
    revolute,
    state,
    terms_of,
)

from drake_dae.errors import ModelError
from drake_dae.robots import MultibodyExpressions, multibody

URDF = """<robot name="crane">
  <link name="base"><inertial><mass value="3"/>
    <inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <link name="boom"><inertial><origin xyz="0.5 0 0" rpy="0.1 0.2 0.3"/><mass value="2"/>
    <inertia ixx="0.1" iyy="0.4" izz="0.45" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <link name="slider"><inertial><mass value="1"/>
    <inertia ixx="0.1" iyy="0.1" izz="0.1" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <link name="hook"/>
  <joint name="anchor" type="fixed"><parent link="world"/><child link="base"/></joint>
  <joint name="swing" type="revolute"><parent link="base"/><child link="boom"/>
    <origin xyz="0 0 1" rpy="1.5707963267948966 0 0"/><axis xyz="0 1 0"/>
    <limit lower="-1" upper="2" velocity="3" effort="40"/><dynamics damping="0.7"/></joint>
  <joint name="slide" type="prismatic"><parent link="boom"/><child link="slider"/>
    <axis xyz="1 0 0"/><limit lower="0" upper="0.5"/></joint>
  <joint name="hold" type="fixed"><parent link="slider"/><child link="hook"/>
    <origin xyz="0.1 0 -0.2"/></joint>
  <link name="world"/>
  <transmission type="SimpleTransmission"><actuator name="swing_motor">
    <drake:rotor_inertia value="0.0001" xmlns:drake="http://drake.mit.edu"/>
    <drake:gear_ratio value="50" xmlns:drake="http://drake.mit.edu"/></actuator>
    <joint name="swing"/></transmission>
  <transmission type="SimpleTransmission"><actuator name="slide_motor"/>
    <joint name="slide"/></transmission>
</robot>"""


def crane(count=1):
    plant = MultibodyPlant(0.0)
    parser = Parser(plant)
    parser.SetAutoRenaming(True)
    for _ in range(count):
        parser.AddModelsFromString(URDF, "urdf")
    plant.Finalize()
    return plant


def test_urdf_gives_names_units_and_limits():
    plant = crane()
    expressions = MultibodyExpressions(plant)
    pairs = lambda signals: [(signal.name, signal.unit) for signal in signals]  # noqa: E731
    assert pairs(expressions.position_signals) == [("swing", "rad"), ("slide", "m")]
    assert pairs(expressions.velocity_signals) == [("swing_w", "rad/s"), ("slide_v", "m/s")]
    assert pairs(expressions.actuator_signals) == [("swing_motor", "N m"), ("slide_motor", "N")]
    assert [(p.name, p.value[0]) for p in expressions.parameters] == [
        ("base.mass", 3.0),
        ("boom.mass", 2.0),
        ("slider.mass", 1.0),
    ]
    np.testing.assert_array_equal(expressions.position_limits, [[-1, 0], [2, 0.5]])
    np.testing.assert_array_equal(expressions.velocity_limits, [[-3, -np.inf], [3, np.inf]])
    np.testing.assert_array_equal(expressions.effort_limits, [40, np.inf])
    np.testing.assert_array_equal(expressions.default_positions, plant.GetDefaultPositions())
    np.testing.assert_array_equal(expressions.actuation_matrix, np.eye(2))
    # About its axis the boom turns with its own inertia, the slider's, and the rotor's 0.25.
    own = MultibodyExpressions(plant)
    still = plant.CreateDefaultContext()
    M = terms_of(own)(*state(plant, still), default_masses(own))[0]
    assert_close(M, plant.CalcMassMatrix(still), "mass matrix")
    assert M[0, 0] > 0.25 + 2.0 * 0.5**2


def test_names_that_collide_get_the_model_instance():
    plant = crane(count=2)
    expressions = MultibodyExpressions(plant)
    assert [signal.name for signal in expressions.position_signals] == [
        "crane::swing",
        "crane::slide",
        "crane_1::swing",
        "crane_1::slide",
    ]
    assert expressions.actuator_signals[3].name == "crane_1::slide_motor"
    assert expressions.parameters[0].name == "crane::base.mass"
    expressions.position("crane_1::hook")
    with pytest.raises(ModelError, match=r"'hook'.*crane::hook, crane_1::hook"):
        expressions.position("hook")


def test_multi_dof_joints_are_named_by_suffix():
    expressions = random_robot(0).expressions
    units = {signal.name: signal.unit for signal in expressions.position_signals}
    units |= {signal.name: signal.unit for signal in expressions.velocity_signals}
    assert len(units) == 2 * expressions.q.numel()
    base = next(name for name in units if name.startswith("rpy_floating")).rsplit("_", 1)[0]
    assert [units[f"{base}_{suffix}"] for suffix in ("qx", "z", "wx", "vz")] == [
        "rad",
        "m",
        "rad/s",
        "m/s",
    ]
    screw = next(name for name in units if name.startswith("screw"))
    assert units[screw] == "rad"
    assert units[f"{screw}_w"] == "rad/s"


def with_bushing():
    plant = one_body(revolute, finalize=False)
    frames = plant.world_frame(), plant.GetFrameByName("box")
    plant.AddForceElement(LinearBushingRollPitchYaw(*frames, *np.ones((4, 3))))
    plant.Finalize()
    return plant


def with_hinge():
    plant = one_body(revolute, finalize=False)
    plant.AddForceElement(DoorHinge(plant.GetJointByName("joint"), DoorHingeConfig()))
    plant.Finalize()
    return plant


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: one_body(revolute, finalize=False), "Finalize"),
        (lambda: "robot.urdf", "plant.*'robot.urdf'"),
        (lambda: one_body(), "'box'"),
        (lambda: one_body(QuaternionFloatingJoint), "'joint'.*quaternion_floating"),
        (lambda: one_body(lambda *args: WeldJoint(*args, RigidTransform())), "joint"),
        (with_bushing, "LinearBushingRollPitchYaw"),
        (with_hinge, "DoorHinge"),
    ],
)
def test_what_is_not_supported_is_refused_with_a_remedy(make, message):
    with pytest.raises(ModelError, match=message):
        MultibodyExpressions(make())


def test_unknown_frame_lists_near_and_known_names():
    expressions = MultibodyExpressions(crane())
    with pytest.raises(ModelError, match=r"'hok'.*'hook'"):
        expressions.rotation("hok")
    with pytest.raises(ModelError, match="hook"):
        expressions.rotation(crane().GetFrameByName("hook"))
    with pytest.raises(ModelError, match="point"):
        expressions.position("hook", [1.0, np.nan, 0.0])
    np.testing.assert_array_equal(ca.DM(expressions.rotation("world")), np.eye(3))
    np.testing.assert_array_equal(ca.DM(expressions.position("world", [1, 2, 3])), [[1], [2], [3]])


@pytest.mark.parametrize(
    ("function", "broken", "quantity"),
    [
        ("mass_matrix", lambda *args: 1.000001 * args[0], "mass matrix"),
        ("inverse_dynamics", lambda result: result + 1e-6, "bias"),
        ("joint_velocity_map", lambda result: 1.000001 * result, "velocity map"),
    ],
)
def test_a_wrong_expression_is_caught_on_construction(monkeypatch, function, broken, quantity):
    right = getattr(multibody, function)
    monkeypatch.setattr(multibody, function, lambda *args: broken(right(*args)))
    with pytest.raises(ModelError, match=rf"^{quantity}.*e-0"):
        MultibodyExpressions(crane())
