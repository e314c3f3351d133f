"""MultibodyExpressions against MultibodyPlant, which derives the same terms by other algorithms.

Drake works with articulated bodies and world-frame Jacobians in floating point; the expressions
come from recursions in link frames. Both are exact up to round-off, which for the 17 to 19
velocities here is below 1e-14 of the largest entry; a tolerance of 1e-12 leaves room for other
machines, and any wrong term is far above it.
"""

import casadi as ca
import numpy as np
import pytest
from pydrake.multibody.tree import FrameIndex, JacobianWrtVariable
from random_plants import (
    assert_close,
    assert_terms_agree,
    default_masses,
    random_context,
    random_robot,
    state,
)
from runs import some

from drake_dae.trace.functions import TracedFunction

SEEDS = range(20)


@pytest.mark.slow
@pytest.mark.parametrize("seed", some(SEEDS, of=7))
def test_terms_are_those_of_the_plant(seed):
    robot = random_robot(seed)
    random = np.random.default_rng(100 + seed)
    for _ in range(3):
        context = random_context(robot.plant, random)
        assert_terms_agree(robot.plant, context, robot.terms, default_masses(robot.expressions))


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
