"""MultibodyExpressions against MultibodyPlant, which derives the same terms by other algorithms.

Drake works with articulated bodies and world-frame Jacobians in floating point; the expressions
come from recursions in link frames. Both are exact up to round-off, which for the 17 to 19
velocities here is below 1e-14 of the largest entry; a tolerance of 1e-12 leaves room for other
machines, and any wrong term is far above it.
"""

import casadi as ca
import numpy as np
import pytest
from pydrake.math import RigidTransform
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import (
    FrameIndex,
    JacobianWrtVariable,
    LinearBushingRollPitchYaw,
    QuaternionFloatingJoint,
    RevoluteJoint,
    WeldJoint,
)
from random_plants import (
    TOLERANCE,
    assert_close,
    assert_terms_agree,
    default_masses,
    one_body,
    random_context,
    random_robot,
    revolute,
    state,
    terms_of,
)
from runs import some

from drake_dae.errors import ModelError
from drake_dae.robots import MultibodyExpressions, multibody
from drake_dae.trace.functions import TracedFunction

SEEDS = range(20)


@pytest.mark.slow
@pytest.mark.parametrize("seed", some(SEEDS, of=7, first=2))
def test_accelerations_are_those_of_the_continuous_plant(seed):
    """Holds damping, springs, actuation and rotors to what Drake simulates.

    The plant's v' is put into M v' + H = B u, since solving for v' here would multiply round-off
    by the condition number of M, up to 1e4. The controls stay within the effort limits, to which
    the plant clips them.
    """
    robot = random_robot(seed)
    plant, expressions = robot.plant, robot.expressions
    random = np.random.default_rng(300 + seed)
    context = random_context(plant, random)
    u = random.uniform(-1.0, 1.0, len(expressions.actuator_signals))
    if u.size:
        plant.get_actuation_input_port().FixValue(context, u)
    q, v = state(plant, context)
    derivatives = plant.EvalTimeDerivatives(context).CopyToVector()
    M, H, N = robot.terms(q, v, default_masses(expressions))
    acceleration = derivatives[q.size :]
    inertial = M @ acceleration
    assert_close(N @ v, derivatives[: q.size], "q'")
    assert_close(
        expressions.actuation_matrix @ u - H, inertial, "M v'", np.abs(M * acceleration).max()
    )


@pytest.mark.slow
@pytest.mark.parametrize("seed", some(SEEDS, of=7, first=1))
def test_frames_are_where_the_plant_has_them(seed):
    robot = random_robot(seed)
    plant, expressions = robot.plant, robot.expressions
    random = np.random.default_rng(400 + seed)
    context = random_context(plant, random)
    q, _ = state(plant, context)
    frames = [plant.get_frame(FrameIndex(i)) for i in range(plant.num_frames())]
    points = random.normal(size=(len(frames), 3))
    rotations = [expressions.rotation(frame) for frame in frames]
    positions = [
        expressions.position(frame, point) for frame, point in zip(frames, points, strict=True)
    ]
    jacobians = [ca.jacobian(p, expressions.q) @ expressions.velocity_map for p in positions]
    function = TracedFunction(
        "frames",
        {"q": expressions.q},
        {"R": ca.horzcat(*rotations), "p": ca.horzcat(*positions), "J": ca.vertcat(*jacobians)},
    )
    R, p, J = function(q)
    for i, (frame, point) in enumerate(zip(frames, points, strict=True)):
        pose = frame.CalcPoseInWorld(context)
        assert_close(R[:, 3 * i : 3 * i + 3], pose.rotation().matrix(), f"R of {frame.name()}")
        assert_close(p[:, i], pose @ point, f"p of {frame.name()}")
        expected = plant.CalcJacobianTranslationalVelocity(
            context, JacobianWrtVariable.kV, frame, point, plant.world_frame(), plant.world_frame()
        )
        assert_close(J[3 * i : 3 * i + 3], expected, f"J of {frame.name()}", scale=1.0)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(2))
def test_masses_change_as_with_set_mass(seed):
    robot = random_robot(seed)
    plant, expressions = robot.plant, robot.expressions
    random = np.random.default_rng(600 + seed)
    context = random_context(plant, random)
    masses = default_masses(expressions) * random.uniform(0.5, 2.0, len(expressions.parameters))
    for parameter, mass in zip(expressions.parameters, masses, strict=True):
        assert parameter.unit == "kg"
        plant.GetBodyByName(parameter.name.removesuffix(".mass")).SetMass(context, mass)
    assert_terms_agree(plant, context, robot.terms, masses)


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


def geared(ratio):
    plant = one_body(revolute, finalize=False)
    plant.AddJointActuator("motor", plant.GetJointByName("joint")).set_default_gear_ratio(ratio)
    plant.Finalize()
    return plant


def with_bushing():
    plant = one_body(revolute, finalize=False)
    frames = plant.world_frame(), plant.GetFrameByName("box")
    plant.AddForceElement(LinearBushingRollPitchYaw(*frames, *np.ones((4, 3))))
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
        (
            lambda: one_body(lambda *args: RevoluteJoint(*args, [0, 0, 1], damping=1e300)),
            r"'joint'.*1e\+300",
        ),
        (lambda: geared(np.inf), "'motor' is inf"),
        (lambda: geared(np.nan), "'motor' is nan"),
    ],
)
def test_what_is_not_supported_is_refused_with_a_remedy(make, message):
    with pytest.raises(ModelError, match=message):
        MultibodyExpressions(make())


def test_a_frame_of_another_plant_and_a_point_that_is_none_are_refused():
    expressions = MultibodyExpressions(crane())
    with pytest.raises(ModelError, match="hook"):
        expressions.rotation(crane().GetFrameByName("hook"))
    with pytest.raises(ModelError, match="point"):
        expressions.position("hook", [1.0, np.nan, 0.0])


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


def test_of_two_motors_on_a_joint_the_last_rotor_counts():
    """So does Drake, where one might expect the sum."""
    plant = one_body(revolute, finalize=False)
    for name, rotor_inertia in (("first", 0.5), ("last", 0.25)):
        actuator = plant.AddJointActuator(name, plant.GetJointByName("joint"))
        actuator.set_default_rotor_inertia(rotor_inertia)
    plant.Finalize()
    expressions = MultibodyExpressions(plant)
    np.testing.assert_array_equal(expressions.actuation_matrix, [[1.0, 1.0]])
    M = terms_of(expressions)([0.0], [0.0], default_masses(expressions))[0]
    # A unit cube of mass 1 turns about z with 1 / 6.
    np.testing.assert_allclose(M, 1 / 6 + 0.25, rtol=TOLERANCE)
