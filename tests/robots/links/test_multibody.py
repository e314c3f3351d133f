"""MultibodyExpressions against MultibodyPlant, which derives the same terms by other algorithms.

Drake works with articulated bodies and world-frame Jacobians in floating point; the expressions
come from recursions in link frames. Both are exact up to round-off, which for the 17 to 19
velocities here is below 1e-14 of the largest entry; a tolerance of 1e-12 leaves room for other
machines, and any wrong term is far above it.
"""

import casadi as ca
import numpy as np
import pytest
from pydrake.multibody.tree import (
    FrameIndex,
    JacobianWrtVariable,
)
from random_plants import (
    assert_close,
    assert_terms_agree,
    default_masses,
    plant_bias,
    random_context,
    random_robot,
    state,
)
from runs import some

from drake_dae.trace.functions import TracedFunction

SEEDS = range(20)


@pytest.mark.slow
@pytest.mark.parametrize("seed", some(SEEDS, of=4))
def test_terms_are_those_of_the_plant(seed):
    robot = random_robot(seed)
    random = np.random.default_rng(100 + seed)
    for _ in range(3):
        context = random_context(robot.plant, random)
        assert_terms_agree(robot.plant, context, robot.terms, default_masses(robot.expressions))


@pytest.mark.slow
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
@pytest.mark.parametrize("seed", some(SEEDS, of=4, first=1))
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
@pytest.mark.parametrize("seed", some(range(8), of=3))
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
