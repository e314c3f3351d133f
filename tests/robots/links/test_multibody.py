"""MultibodyExpressions against MultibodyPlant, which derives the same terms by other algorithms.

Drake works with articulated bodies and world-frame Jacobians in floating point; the expressions
come from recursions in link frames. Both are exact up to round-off, which for the 17 to 19
velocities here is below 1e-14 of the largest entry; a tolerance of 1e-12 leaves room for other
machines, and any wrong term is far above it.
"""

from functools import cache
from types import SimpleNamespace

import casadi as ca
import numpy as np
import pytest
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import (
    BallRpyJoint,
    DoorHinge,
    DoorHingeConfig,
    FixedOffsetFrame,
    FrameIndex,
    JacobianWrtVariable,
    LinearBushingRollPitchYaw,
    LinearSpringDamper,
    MultibodyForces,
    PlanarJoint,
    PrismaticJoint,
    PrismaticSpring,
    QuaternionFloatingJoint,
    RevoluteJoint,
    RevoluteSpring,
    RpyFloatingJoint,
    ScrewJoint,
    SpatialInertia,
    UnitInertia,
    UniversalJoint,
    WeldJoint,
)

from drake_dae.errors import ModelError
from drake_dae.robots.links import multibody
from drake_dae.robots.links.multibody import MultibodyExpressions
from drake_dae.trace.functions import TracedFunction

TOLERANCE = 1e-12
SEEDS = range(20)
JOINTS = (
    "revolute",
    "prismatic",
    "screw",
    "universal",
    "planar",
    "ball_rpy",
    "rpy_floating",
    "weld",
)


def random_inertia(random):
    """Of eight point masses, so that it is physically valid."""
    masses, points = random.uniform(0.1, 1.0, 8), random.normal(0.0, 0.3, (8, 3))
    mass = masses.sum()
    second = (points.T * masses) @ points / mass
    unit = np.trace(second) * np.eye(3) - second
    moments_and_products = [unit[i] for i in ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))]
    return SpatialInertia(mass, masses @ points / mass, UnitInertia(*moments_and_products))


def random_pose(random):
    return RigidTransform(RollPitchYaw(random.uniform(-3.0, 3.0, 3)), random.normal(0.0, 0.5, 3))


def random_axis(random):
    axis = random.normal(size=3)
    coordinate = np.eye(3)[random.integers(3)] * random.choice([-1.0, 1.0])
    return coordinate if random.random() < 0.5 else axis / np.linalg.norm(axis)


def make_joint(kind, name, parent, child, random):
    if kind == "revolute":
        return RevoluteJoint(name, parent, child, random_axis(random), damping=random.random())
    if kind == "prismatic":
        return PrismaticJoint(name, parent, child, random_axis(random), damping=random.random())
    if kind == "screw":
        pitch = random.normal()
        return ScrewJoint(name, parent, child, random_axis(random), pitch, random.random())
    if kind == "universal":
        return UniversalJoint(name, parent, child, damping=random.random())
    if kind == "planar":
        return PlanarJoint(name, parent, child, damping=random.random(3))
    if kind == "ball_rpy":
        return BallRpyJoint(name, parent, child, damping=random.random())
    if kind == "rpy_floating":
        return RpyFloatingJoint(name, parent, child, random.random(), random.random())
    return WeldJoint(name, parent, child, random_pose(random))


def random_plant(seed, time_step=0.0):
    """A tree with every supported joint, at random places in random order, and two more."""
    random = np.random.default_rng(seed)
    plant = MultibodyPlant(time_step)
    plant.mutable_gravity_field().set_gravity_vector(random.normal(0.0, 8.0, 3))
    instances = [plant.AddModelInstance(name) for name in ("first", "second")]
    bodies = [plant.world_body()]
    kinds = [*JOINTS, *random.choice(["revolute", "prismatic", "weld"], 2)]
    for index, kind in enumerate(random.permutation(kinds)):
        instance = instances[random.integers(2)]
        # A welded body may be massless: it moves nothing on its own.
        massless = kind == "weld" and random.random() < 0.5
        inertia = SpatialInertia.Zero() if massless else random_inertia(random)
        body = plant.AddRigidBody(f"body{index}", instance, inertia)
        inboard = bodies[random.integers(max(0, len(bodies) - 3), len(bodies))]
        parent, child = (
            plant.AddFrame(
                FixedOffsetFrame(f"{kind}{index}_{end}", of.body_frame(), random_pose(random))
            )
            for end, of in (("parent", inboard), ("child", body))
        )
        if kind in ("revolute", "prismatic", "weld") and random.random() < 0.4:
            parent, child = child, parent
        joint = plant.AddJoint(make_joint(kind, f"{kind}{index}", parent, child, random))
        bodies.append(body)
        if joint.num_velocities() == 1 and random.random() < 0.7:
            actuator = plant.AddJointActuator(f"motor{index}", joint, random.uniform(1.0, 9.0))
            actuator.set_default_rotor_inertia(random.uniform(0.0, 1e-3))
            actuator.set_default_gear_ratio(random.uniform(-100.0, 100.0))
        if kind == "revolute":
            plant.AddForceElement(RevoluteSpring(joint, random.normal(), random.uniform(0, 9)))
        if kind == "prismatic":
            plant.AddForceElement(PrismaticSpring(joint, random.normal(), random.uniform(0, 9)))
    for _ in range(2):
        first, second = random.choice(len(bodies), 2, replace=False)
        ends, numbers = random.normal(size=(2, 3)), random.uniform(0.5, 9.0, 3)
        plant.AddForceElement(
            LinearSpringDamper(bodies[first], ends[0], bodies[second], ends[1], *numbers)
        )
    if seed % 2:
        plant.set_gravity_enabled(instances[1], False)
    plant.Finalize()
    return plant


@cache
def random_robot(seed, time_step=0.0):
    """The plant, its expressions, and these as functions of (q, v, masses)."""
    plant = random_plant(seed, time_step)
    expressions = MultibodyExpressions(plant)
    return SimpleNamespace(plant=plant, expressions=expressions, terms=terms_of(expressions))


def terms_of(expressions):
    inputs = {
        "q": expressions.q,
        "v": expressions.v,
        "masses": ca.vertcat(*[parameter.symbol for parameter in expressions.parameters]),
    }
    outputs = {
        "M": expressions.mass_matrix,
        "H": expressions.bias,
        "N": expressions.velocity_map,
        "energies": ca.vertcat(expressions.kinetic_energy, expressions.potential_energy),
    }
    return TracedFunction("terms", inputs, outputs)


def default_masses(expressions):
    return np.concatenate([parameter.value for parameter in expressions.parameters])


def random_context(plant, random):
    """A context at a random state, farther out than the comparison on construction goes."""
    context = plant.CreateDefaultContext()
    plant.SetPositions(context, random.uniform(-3.0, 3.0, plant.num_positions()))
    plant.SetVelocities(context, random.normal(0.0, 2.0, plant.num_velocities()))
    return context


def state(plant, context):
    return plant.GetPositions(context), plant.GetVelocities(context)


def plant_bias(plant, context):
    forces = MultibodyForces(plant)
    plant.CalcForceElementsContribution(context, forces)
    return plant.CalcBiasTerm(context) - plant.CalcGeneralizedForces(context, forces)


def assert_close(own, other, what, scale=0.0):
    """Compares up to round-off of the largest entry, or of `scale`."""
    own, other = np.asarray(own), np.asarray(other)
    assert own.shape == other.shape, what
    error = np.abs(own - other).max(initial=0.0)
    assert error <= TOLERANCE * max(np.abs(other).max(initial=0.0), scale), f"{what}: {error}"


def assert_terms_agree(plant, context, terms, masses):
    q, v = state(plant, context)
    M, H, N, energies = terms(q, v, masses)
    assert_close(M.reshape(v.size, v.size), plant.CalcMassMatrix(context), "mass matrix")
    assert_close(H, plant_bias(plant, context), "bias")
    assert_close(N.reshape(v.size, v.size) @ v, plant.MapVelocityToQDot(context, v), "velocity map")
    assert_close(energies[0], plant.CalcKineticEnergy(context), "kinetic energy")
    assert_close(energies[1], plant.CalcPotentialEnergy(context), "potential energy")


@pytest.mark.slow
@pytest.mark.parametrize("seed", SEEDS)
def test_terms_are_those_of_the_plant(seed):
    robot = random_robot(seed)
    random = np.random.default_rng(100 + seed)
    for _ in range(3):
        context = random_context(robot.plant, random)
        assert_terms_agree(robot.plant, context, robot.terms, default_masses(robot.expressions))


@pytest.mark.slow
@pytest.mark.parametrize("seed", SEEDS)
def test_gravity_is_the_bias_at_rest(seed):
    """At rest H is gravity and springs, which Drake computes apart from the rest."""
    robot = random_robot(seed)
    plant, random = robot.plant, np.random.default_rng(200 + seed)
    context = random_context(plant, random)
    q, v = state(plant, context)
    plant.SetVelocities(context, 0.0 * v)
    springs = -plant_bias(plant, context) - plant.CalcGravityGeneralizedForces(context)
    H = robot.terms(q, 0.0 * v, default_masses(robot.expressions))[1]
    gravity = plant.CalcGravityGeneralizedForces(context)
    assert_close(-H - springs, gravity, "gravity", scale=np.abs(H).max())


@pytest.mark.parametrize("seed", SEEDS)
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
    M, H, N, _ = robot.terms(q, v, default_masses(expressions))
    acceleration = derivatives[q.size :]
    inertial = M @ acceleration
    assert_close(N @ v, derivatives[: q.size], "q'")
    assert_close(
        expressions.actuation_matrix @ u - H, inertial, "M v'", np.abs(M * acceleration).max()
    )


@pytest.mark.slow
@pytest.mark.parametrize("seed", SEEDS)
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
        {
            "R": ca.horzcat(*rotations),
            "p": ca.horzcat(*positions),
            "J": ca.vertcat(*jacobians),
        },
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
@pytest.mark.parametrize("seed", range(8))
def test_contact_forces_and_their_constraints_by_inverse_dynamics(seed):
    """J against the plant's frame Jacobians; the rest against M v' + H - J^T lambda and phi''.

    The constraint depends on the poses of two frames and, directly, on q.
    """
    robot = random_robot(seed)
    plant, expressions = robot.plant, robot.expressions
    random = np.random.default_rng(600 + seed)
    first, second = (
        plant.get_frame(FrameIndex(int(i)))
        for i in random.choice(np.arange(1, plant.num_frames()), 2, replace=False)
    )
    point, direction = random.normal(size=(2, 3))

    def phi(links):
        apart = links.rotation(second).T @ (links.position(first, point) - links.position(second))
        tilt = ca.dot(links.rotation(first) @ ca.SX(direction), links.rotation(second)[:, 0])
        return ca.vertcat(apart, tilt * ca.sin(links.q[0]) + links.q[-1] ** 2)

    q, v, N = expressions.q, expressions.v, expressions.velocity_map
    a, force = ca.SX.sym("a", v.numel()), ca.SX.sym("f", 4)
    speed = N @ v
    rate = ca.jtimes(phi(expressions), q, speed)
    twice = ca.jtimes(rate, ca.vertcat(q, v), ca.vertcat(speed, a))
    kinematics = expressions.kinematics(a)
    own_rate = kinematics.derivative(phi(kinematics))
    reaction = kinematics.reaction(ca.dot(force, own_rate))
    residual = expressions.inverse_dynamics(kinematics, reaction)
    second_rate = kinematics.value(kinematics.derivative(own_rate))
    columns = reaction.map(lambda part: ca.jacobian(part, force))
    jacobian = expressions.generalized_force(kinematics, columns).T
    masses = ca.vertcat(*[parameter.symbol for parameter in expressions.parameters])
    function = TracedFunction(
        "balance",
        {"q": q, "v": v, "a": a, "f": force, "masses": masses},
        {"J": jacobian, "own": residual, "rate": second_rate, "twice": twice},
    )
    context = random_context(plant, random)
    numbers = state(plant, context)
    acceleration, load = random.normal(size=v.numel()), random.normal(size=4)
    J, own, own_rate, other_rate = function(
        *numbers, acceleration, load, default_masses(expressions)
    )
    M, H = plant.CalcMassMatrix(context), plant_bias(plant, context)
    scale = np.abs(M * acceleration).max() + np.abs(J.T * load).max()
    assert_close(own, M @ acceleration + H - J.T @ load, "M v' + H - J^T lambda", scale)
    assert_close(own_rate, other_rate, "phi''", np.abs(J * acceleration).max())
    world = plant.world_frame()

    def twist(frame, offset):
        return plant.CalcJacobianSpatialVelocity(
            context, JacobianWrtVariable.kV, frame, offset, world, world
        )

    X_1, X_2 = (plant.CalcRelativeTransform(context, world, f) for f in (first, second))
    R_2, apart = X_2.rotation().matrix(), X_1 @ point - X_2.translation()
    spin_1, spin_2 = twist(first, point)[:3], twist(second, np.zeros(3))[:3]
    moved = twist(first, point)[3:] - twist(second, np.zeros(3))[3:]
    wanted = R_2.T @ (moved + np.array([np.cross(apart, w) for w in spin_2.T]).T)
    assert_close(J[:3], wanted, "J", np.abs(moved).max())
    arrow, axis = X_1.rotation().matrix() @ direction, R_2[:, 0]
    row = np.sin(numbers[0][0]) * np.cross(arrow, axis) @ (spin_1 - spin_2)
    row += robot.terms(*numbers, default_masses(expressions))[2].reshape(v.numel(), -1)[0] * (
        np.cos(numbers[0][0]) * arrow @ axis
    )
    row += 2 * numbers[0][-1] * robot.terms(*numbers, default_masses(expressions))[2][-1]
    assert_close(J[3], row, "J of an angle", 1.0)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(4))
def test_discrete_plant_has_the_same_terms(seed):
    continuous, discrete = random_robot(seed), random_robot(seed, time_step=1e-3)
    context = random_context(discrete.plant, np.random.default_rng(500 + seed))
    masses = default_masses(discrete.expressions)
    assert_terms_agree(discrete.plant, context, discrete.terms, masses)
    arguments = (*state(discrete.plant, context), masses)
    for own, other in zip(discrete.terms(*arguments), continuous.terms(*arguments), strict=True):
        np.testing.assert_array_equal(own, other)


@pytest.mark.parametrize("seed", range(4))
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


# Structure.


def arm(twist=np.pi / 2, random_offsets=True):
    """Seven revolute z axes, each at `twist` to the last, with random inertias."""
    random = np.random.default_rng(0)
    plant = MultibodyPlant(0.0)
    parent = plant.world_frame()
    for k in range(7):
        body = plant.AddRigidBody(f"link{k + 1}", random_inertia(random))
        angle = 0.0 if k == 0 else twist if k % 2 else -twist
        offset = random.normal(size=3) if random_offsets else [0.0, 0.0, 0.4]
        pose = RigidTransform(RollPitchYaw(angle, 0.0, 0.0), offset)
        frame = plant.AddFrame(FixedOffsetFrame(f"frame{k + 1}", parent, pose))
        plant.AddJoint(RevoluteJoint(f"joint{k + 1}", frame, body.body_frame(), [0, 0, 1]))
        parent = body.body_frame()
    plant.Finalize()
    return plant


def operations(plant):
    expressions = MultibodyExpressions(plant)
    masses = ca.vertcat(*[parameter.symbol for parameter in expressions.parameters])
    inputs = {"q": expressions.q, "v": expressions.v, "masses": masses}
    return tuple(
        TracedFunction("term", inputs, {"term": term}).num_operations
        for term in (expressions.mass_matrix, expressions.bias)
    )


def test_seven_joint_arm_takes_few_operations():
    """A law differentiates these up to four times: 1002 and 1030 now, a regression counts."""
    assert max(operations(arm())) < 1100
    assert max(operations(arm(random_offsets=False))) < 950


def test_pi_with_fourteen_digits_costs_no_operations():
    assert operations(arm(float("1.57079632679490"))) == operations(arm())


def test_branches_are_structurally_decoupled():
    plant = MultibodyPlant(0.0)
    random = np.random.default_rng(1)
    parents = {"trunk": None, "left": "trunk", "right": "trunk", "hand": "left"}
    for name, parent in parents.items():
        body = plant.AddRigidBody(name, random_inertia(random))
        base = plant.GetBodyByName(parent) if parent else plant.world_body()
        frame = plant.AddFrame(
            FixedOffsetFrame(f"{name}_base", base.body_frame(), random_pose(random))
        )
        plant.AddJoint(RevoluteJoint(name, frame, body.body_frame(), [1, 2, 3]))
    plant.Finalize()
    expressions = MultibodyExpressions(plant)
    names = [signal.name for signal in expressions.position_signals]
    coupled = {
        (names[i], names[j])
        for i in range(4)
        for j in range(4)
        if expressions.mass_matrix.has_nz(i, j)
    }
    apart = {("left", "right"), ("hand", "right")}
    apart |= {pair[::-1] for pair in apart}
    assert coupled == {(a, b) for a in names for b in names} - apart


def test_gravity_can_be_disabled_for_a_body_welded_to_a_heavy_one():
    plant = MultibodyPlant(0.0)
    instance = plant.AddModelInstance("balloon")
    inertia = random_inertia(np.random.default_rng(2))
    body = plant.AddRigidBody("body", plant.GetModelInstanceByName("DefaultModelInstance"), inertia)
    light = plant.AddRigidBody("light", instance, inertia)
    plant.AddJoint(RevoluteJoint("joint", plant.world_frame(), body.body_frame(), [0, 1, 0]))
    plant.WeldFrames(body.body_frame(), light.body_frame(), RigidTransform([0.3, 0.2, 0.1]))
    plant.set_gravity_enabled(instance, False)
    plant.Finalize()
    expressions = MultibodyExpressions(plant)
    context = random_context(plant, np.random.default_rng(3))
    assert_terms_agree(plant, context, terms_of(expressions), default_masses(expressions))


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


# Names, units, limits.

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
    with pytest.raises(ModelError, match=r"several frames 'hook'.*crane::hook, crane_1::hook"):
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


# Errors.


def one_body(joint=None, time_step=0.0, finalize=True):
    plant = MultibodyPlant(time_step)
    body = plant.AddRigidBody("box", SpatialInertia.SolidCubeWithDensity(1.0, 1.0))
    if joint is not None:
        plant.AddJoint(joint("joint", plant.world_frame(), body.body_frame()))
    if finalize:
        plant.Finalize()
    return plant


def revolute(name, parent, child):
    return RevoluteJoint(name, parent, child, [0, 0, 1])


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
        (lambda: one_body(revolute, finalize=False), r"plant\.Finalize\(\) first"),
        (lambda: "robot.urdf", "plant must be a MultibodyPlant, got 'robot.urdf'"),
        (lambda: MultibodyPlant(0.0), r"plant\.Finalize\(\) first"),
        (lambda: one_body(), r"body 'box' is free.*weld it.*RpyFloatingJoint"),
        (
            lambda: one_body(QuaternionFloatingJoint),
            r"joint 'joint' has type quaternion_floating.*supported are revolute, .*rpy_floating",
        ),
        (
            lambda: one_body(lambda *args: WeldJoint(*args, RigidTransform())),
            r"no joint that moves",
        ),
        (with_bushing, r"LinearBushingRollPitchYaw.*supported are .*LinearSpringDamper"),
        (with_hinge, r"DoorHinge, which is not supported"),
    ],
)
def test_what_is_not_supported_is_refused_with_a_remedy(make, message):
    with pytest.raises(ModelError, match=message):
        MultibodyExpressions(make())


def test_unknown_frame_lists_near_and_known_names():
    expressions = MultibodyExpressions(crane())
    with pytest.raises(
        ModelError, match=r"no frame 'hok'; did you mean 'hook'\?.*there are .*boom"
    ):
        expressions.rotation("hok")
    with pytest.raises(ModelError, match="frame 'hook' belongs to another plant"):
        expressions.rotation(crane().GetFrameByName("hook"))
    with pytest.raises(ModelError, match="point must be finite real numbers"):
        expressions.position("hook", [1.0, np.nan, 0.0])
    np.testing.assert_array_equal(ca.DM(expressions.rotation("world")), np.eye(3))
    np.testing.assert_array_equal(ca.DM(expressions.position("world", [1, 2, 3])), [[1], [2], [3]])


@pytest.mark.parametrize(
    ("function", "broken", "quantity"),
    [
        ("mass_matrix", lambda *args: 1.000001 * args[0], "mass matrix"),
        ("inverse_dynamics", lambda result: result + 1e-6, "Coriolis and centrifugal forces"),
        ("joint_velocity_map", lambda result: 1.000001 * result, "velocity map"),
    ],
)
def test_a_wrong_expression_is_caught_on_construction(monkeypatch, function, broken, quantity):
    right = getattr(multibody, function)
    monkeypatch.setattr(multibody, function, lambda *args: broken(right(*args)))
    with pytest.raises(ModelError, match=rf"^{quantity} differs from the plant's own by \S*e-0"):
        MultibodyExpressions(crane())
