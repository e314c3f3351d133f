"""Time-optimal profiles, against Drake's Toppra, a linear program, and Drake's inverse dynamics."""

import numpy as np
import pytest
from arms import arm, law, numbers, parse
from pydrake.multibody.optimization import Toppra
from pydrake.trajectories import PiecewisePolynomial
from runs import some
from scipy.optimize import linprog
from scipy.sparse import diags, vstack

from drake_dae import (
    CircleReference,
    ConstantReference,
    ExpressionReference,
    FlexibleJoints,
    JointPositions,
    LineReference,
    MotionLimits,
    PathLimits,
    PathTiming,
    Plane,
    PointCoordinates,
    PointOnSurface,
    RobotModel,
    SinusoidReference,
    TimeOptimalReference,
    TrajectoryReference,
    find_structure,
)
from drake_dae.dae.system.layout import DerivativeLayout
from drake_dae.dae.timing.curve import Curve
from drake_dae.errors import ModelError, ReferenceSignalError

LINE = SinusoidReference(0.3, 0.3, 1.5)
PRESS = SinusoidReference(20.0, 5.0, 2.0)
EFFORTS = (200.0, 90.0)
MOTORS = ("joint1_motor", "joint2_motor")


def two_link_limits(efforts=EFFORTS, **more):
    controls = {name: (-most, most) for name, most in zip(MOTORS, efforts, strict=True)}
    return MotionLimits(controls=controls, **more)


def two_link_profile(limits, references=(LINE, PRESS), end=4.0, **more):
    return PathTiming(arm("two_link").structure, limits).profile(references, end, **more)


def needed(q, v, acceleration, force):
    """The torques of the two-link arm on its wall, from MultibodyPlant alone."""
    found = numbers("two_link", q, v)
    return found.mass @ acceleration + found.bias - found.constraint_jacobian[0] * force


def joints_at(z, near):
    """q with the tip on the wall x = 1.2 at a height, by Newton's method on Drake's kinematics."""
    plant, q = arm("two_link").plant, np.array(near)
    context, tool = plant.CreateDefaultContext(), plant.GetFrameByName("tool")
    for _ in range(50):
        plant.SetPositions(context, q)
        x = tool.CalcPoseInWorld(context).translation()[[0, 2]]
        found = numbers("two_link", q, np.zeros(2))
        # The normal of the wall points along -x.
        jacobian = np.vstack([-found.constraint_jacobian[0], found.output_jacobian[0]])
        step = np.linalg.solve(jacobian, x - [1.2, z])
        q = q - step
        if np.abs(step).max() < 1e-14:
            break
    return q, jacobian, found


def along_the_wall(heights, slopes, bends):
    """q, q_s and q_ss where the tip has the heights z, with z_s and z_ss."""
    q, rows = [1.2, -1.6], []
    for z, slope, bend in zip(heights, slopes, bends, strict=True):
        q, jacobian, _ = joints_at(z, q)
        rate = np.linalg.solve(jacobian, [0.0, slope])
        found = numbers("two_link", q, rate)
        # J v' + J' v = (0, z'').
        bias = [-found.constraint_acceleration[0], _bias_of_height(q, rate)]
        rows.append((q, rate, np.linalg.solve(jacobian, [0.0, bend] - np.array(bias))))
    return [np.array(column) for column in zip(*rows, strict=True)]


def _bias_of_height(q, v):
    plant = arm("two_link").plant
    context, tool = plant.CreateDefaultContext(), plant.GetFrameByName("tool")
    plant.SetPositions(context, q)
    plant.SetVelocities(context, v)
    world = plant.world_frame()
    from pydrake.multibody.tree import JacobianWrtVariable

    bias = plant.CalcBiasSpatialAcceleration(
        context, JacobianWrtVariable.kV, tool, np.zeros(3), world, world
    )
    return bias.translational()[2]


@pytest.fixture(scope="module")
def motion():
    """A profile of the two-link arm, and its motion at 1,500 times, by Drake's kinematics."""
    profile = two_link_profile(two_link_limits(), end=0.9, begin=-0.9)
    times = np.linspace(-0.9, -0.9 + profile.duration, 1500)
    rows = TimeOptimalReference(profile).pieces((2, 0)).at_all(times)
    q, v, acceleration = along_the_wall(rows[:, 0], rows[:, 1], rows[:, 2])
    torques = [needed(*each, row[3]) for *each, row in zip(q, v, acceleration, rows, strict=True)]
    return profile, times, rows, np.array(torques)


@pytest.mark.slow
def test_the_torques_of_the_motion_are_within_their_limits_and_reach_them(motion):
    _, _, _, torques = motion
    shares = np.abs(torques) / EFFORTS
    # Between the points of the grid the excess is of second order in its width.
    assert shares.max() <= 1.0 + 1e-3
    # At each time one of them is at its limit, except at the jumps.
    assert np.mean(shares.max(axis=1) > 0.995) > 0.97


@pytest.mark.slow
@pytest.mark.thorough
def test_the_time_is_that_of_a_linear_program_on_a_fine_grid(motion):
    profile, *_ = motion
    # The path by its height, where it does not turn: b = z'^2, the force by time of the reference.
    count = 2000
    heights = np.linspace(LINE.derivatives([0])(-0.9)[0], LINE.derivatives([0])(0.9)[0], count + 1)
    q, slope, bend = along_the_wall(heights, np.ones(count + 1), np.zeros(count + 1))
    moments = np.arcsin((heights - 0.3) / 0.3) / 1.5
    force = 20.0 + 5.0 * np.sin(2.0 * moments)
    still = np.zeros(2)
    c = np.array([needed(a, still, still, f) for a, f in zip(q, force, strict=True)])
    n = np.array([needed(a, still, s, f) for a, s, f in zip(q, slope, force, strict=True)]) - c
    m = np.array([needed(a, s, d, f) for a, s, d, f in zip(q, slope, bend, force, strict=True)]) - c
    width, rows, room = np.diff(heights), [], []
    for joint, most in enumerate(EFFORTS):
        for sign in (1.0, -1.0):
            # In the middle of each interval.
            by_a = sign * (n[1:, joint] + n[:-1, joint]) / 2.0 / (2.0 * width)
            by_b = sign * (m[1:, joint] + m[:-1, joint]) / 4.0
            rows.append(diags([by_b - by_a, by_b + by_a], [0, 1], shape=(count, count + 1)))
            room.append(most - sign * (c[1:, joint] + c[:-1, joint]) / 2.0)
    bounds = [(0.0, 0.0), *[(0.0, None)] * (count - 1), (0.0, 0.0)]
    # In units in which b is about one.
    found = linprog(
        -np.ones(count + 1), A_ub=vstack(rows).tocsr(), b_ub=np.concatenate(room), bounds=bounds
    )
    speed = np.sqrt(np.maximum(found.x, 0.0))
    fine = float(np.sum(2.0 * width / (speed[1:] + speed[:-1])))
    assert profile.duration == pytest.approx(fine, rel=1e-3)


def test_the_reference_follows_the_same_path_with_the_forces_there(motion):
    _, _, rows, _ = motion
    # The time of the first reference at these heights, and its force.
    moments = np.arcsin(np.clip((rows[:, 0] - 0.3) / 0.3, -1.0, 1.0)) / 1.5
    # 5e-4 of the largest force.
    np.testing.assert_allclose(rows[:, 3], 20.0 + 5.0 * np.sin(2.0 * moments), atol=1.3e-2)


@pytest.mark.slow
@pytest.mark.parametrize("seed", some([0, 1]))
def test_without_contact_it_is_drakes_toppra(seed):
    plant = parse("seven_joint_arm")
    names = [f"joint{i}" for i in range(1, 8)]
    nominal = np.array([0.0, -0.2, 0.0, -1.9, 0.0, 0.56, 0.0])
    model = RobotModel.from_multibody(plant, [], [JointPositions(names)], nominal)
    points = nominal + np.random.default_rng(seed).uniform(-0.6, 0.6, (5, 7))
    path = PiecewisePolynomial.CubicWithContinuousSecondDerivatives(range(5), points.T)
    efforts = np.array([120.0, 120.0, 60.0, 60.0, 30.0, 20.0, 10.0])
    speed, acceleration = np.full(7, 1.5), np.full(7, 8.0)
    toppra = Toppra(path, plant, np.linspace(0.0, 4.0, 1001))
    toppra.AddJointVelocityLimit(-speed, speed)
    toppra.AddJointAccelerationLimit(-acceleration, acceleration)
    toppra.AddJointTorqueLimit(-efforts, efforts)
    wanted = toppra.SolvePathParameterization().end_time()

    dae = model.dae
    velocities = [signal.name for signal in model.links.velocity_signals]
    limits = MotionLimits(
        controls={s.name: (-e, e) for s, e in zip(dae.control_signals, efforts, strict=True)},
        states=dict.fromkeys(velocities, (-1.5, 1.5)),
        rates=dict.fromkeys(velocities, (-8.0, 8.0)),
    )
    found = PathTiming(find_structure(dae), limits).profile([TrajectoryReference(path)], 4.0)
    # Both have grids of 1,000 intervals, at other points.
    assert found.duration == pytest.approx(wanted, rel=2e-3)


def test_a_rest_beyond_a_limit_is_refused_with_its_place_and_its_motor():
    with pytest.raises(ReferenceSignalError, match=r"at rest at t = .* joint1_motor is .* at most"):
        two_link_profile(two_link_limits((40.0, 90.0)))
    forces = two_link_limits(forces={"wall.force": (16.0, None)})
    with pytest.raises(
        ReferenceSignalError, match=r"t = 2\.3\d* s .* wall\.force is 15 N, and must"
    ):
        two_link_profile(forces)


@pytest.mark.slow
def test_limits_of_speed_and_acceleration_of_joints_hold():
    limits = two_link_limits(
        states=dict.fromkeys(("joint1_w", "joint2_w"), (-0.8, 0.8)),
        rates=dict.fromkeys(("joint1_w", "joint2_w"), (-4.0, 4.0)),
    )
    profile = two_link_profile(limits, points=400)
    times = np.linspace(0.0, profile.duration, 400)
    rows = TimeOptimalReference(profile).pieces((2, 0)).at_all(times)
    _, v, acceleration = along_the_wall(*rows[:, :3].T)
    assert np.abs(v).max() == pytest.approx(0.8, rel=2e-3)
    assert np.abs(acceleration).max() == pytest.approx(4.0, rel=5e-3)


def test_a_reference_that_turns_has_a_piece_for_each_way():
    profile = two_link_profile(two_link_limits(), points=200)
    ends = [one.piece.times[-1] for one in profile.pieces]
    turns = np.pi / 3.0 * np.array([1.0, 3.0])
    np.testing.assert_allclose(ends, [*turns, 4.0], rtol=1e-9)
    assert all(one.b[0] == one.b[-1] == 0.0 for one in profile.pieces)
    assert sum(profile.shares.values()) == pytest.approx(1.0)


def test_pauses_last_as_in_the_reference_and_the_last_one_is_left_out():
    line = LineReference(0.3, 0.5, PathLimits(10.0, 100.0), start_time=0.7)
    profile = two_link_profile(two_link_limits(), (line, ConstantReference(20.0)), 5.0, points=100)
    pause, move = profile.pieces
    # Where the reference moves by less than 1e-9 of its speed it rests.
    assert pause.piece.is_pause
    assert pause.times[-1] == pytest.approx(0.7, abs=1e-2)
    assert move.piece.times[-1] == pytest.approx(0.7 + line.travel.duration, abs=1e-2)


def test_a_force_in_a_pause_is_within_its_limits_and_that_of_the_reference():
    line = LineReference(0.3, 0.5, PathLimits(10.0, 100.0), start_time=2.0)
    wave = SinusoidReference(20.0, 5.0, 3.0)
    timing = PathTiming(
        arm("two_link").structure, two_link_limits(forces={"wall.force": (14.0, None)})
    )
    profile = timing.profile((line, wave), 5.0, points=200)
    # While nothing moves time passes as in the reference.
    times = np.linspace(0.0, 1.9, 500)
    rows = TimeOptimalReference(profile).pieces((2, 0)).at_all(times)
    # 5e-4 of the largest force.
    np.testing.assert_allclose(rows[:, 3], 20.0 + 5.0 * np.sin(3.0 * times), atol=1.3e-2)
    above = PathTiming(
        arm("two_link").structure, two_link_limits(forces={"wall.force": (16.0, None)})
    )
    # In the pause: 3 t = 3 pi / 2.
    with pytest.raises(ReferenceSignalError, match=r"t = 1\.57 s .* wall\.force is 15 N, and"):
        above.profile((line, wave), 5.0, points=200)


def test_a_path_with_limits_of_its_own_keeps_them_and_has_no_other_end():
    limits = PathLimits(0.25, 1.0, 3.0)
    line = LineReference(0.3, 0.5, limits, order=4)
    profile = two_link_profile(two_link_limits(), (line, ConstantReference(20.0)), 5.0)
    # Without a limit of the jerk: a trapezoid.
    assert profile.duration == pytest.approx(0.2 / 0.25 + 0.25 / 1.0, rel=1e-3)
    assert profile.duration < line.travel.duration
    rows = TimeOptimalReference(profile).pieces((2, 0)).at_all(np.linspace(0.0, 2.0, 999))
    # Accelerations are accurate to 5e-4.
    assert np.abs(rows[:, 1]).max() <= 0.25 * (1.0 + 1e-4)
    assert np.abs(rows[:, 2]).max() <= 1.0 + 1e-3
    np.testing.assert_allclose(rows[[0, -1], 0], [0.3, 0.5], atol=1e-12)


def test_the_largest_rate_of_one_is_nowhere_faster_than_the_reference():
    slow = two_link_profile(two_link_limits(), largest_rate=1.0, points=400)
    assert slow.duration >= 4.0
    for one in slow.pieces:
        rate = np.sqrt(one.b[1:-1]) / one.piece.speeds[1:-1]
        # Between two points b is a little higher where their limits are curved.
        assert rate.max() <= 1.0 + 1e-2


@pytest.mark.slow
@pytest.mark.parametrize("friction", some([{"viscous_friction": 60.0}, {"friction": 0.5}]))
def test_friction_makes_no_limit_exceeded(friction):
    wall = PointOnSurface("tool", Plane((1.2, 0, 0), (-1, 0, 0)), name="wall", **friction)
    model = RobotModel.from_multibody(
        parse("two_link_arm"), [wall], [PointCoordinates("tool", "z")], [1.2, -1.6]
    )
    structure = find_structure(model.dae)
    profile = PathTiming(structure, two_link_limits()).profile([LINE, PRESS], 0.9, begin=-0.9)
    frictionless = two_link_profile(two_link_limits(), end=0.9, begin=-0.9)
    assert profile.duration > 1.01 * frictionless.duration
    times = np.linspace(-0.9, -0.9 + profile.duration, 300)
    rows = TimeOptimalReference(profile).pieces((2, 0)).at_all(times)
    q, v, acceleration = along_the_wall(*rows[:, :3].T)
    shares = []
    for *each, row in zip(q, v, acceleration, rows, strict=True):
        # The friction of the sliding tip, by its law.
        speed = row[1]
        pull = friction.get("friction", 0.0) * row[3] * speed / np.hypot(speed, 1e-3)
        pull += friction.get("viscous_friction", 0.0) * speed
        tangent = numbers("two_link", each[0], each[1]).output_jacobian[0]
        shares.append(np.abs(needed(*each, row[3]) + tangent * pull) / EFFORTS)
    # At the last point Coulomb friction does not help to brake.
    reached = np.max(shares, axis=1)[:-1]
    assert reached.max() <= 1.0 + 2e-3
    assert np.mean(reached > 0.99) > 0.9


def test_with_damping_the_time_of_the_motion_is_not_that_of_the_reference():
    """The path alone determines the motion: a reference 20 times as slow has the same."""
    wall = PointOnSurface(
        "tool", Plane((1.2, 0, 0), (-1, 0, 0)), name="wall", viscous_friction=150.0
    )
    model = RobotModel.from_multibody(
        parse("two_link_arm"), [wall], [PointCoordinates("tool", "z")], [1.2, -1.6]
    )
    timing, found = PathTiming(find_structure(model.dae), two_link_limits()), []
    for slower in (1.0, 20.0):
        references = SinusoidReference(0.3, 0.3, 1.5 / slower), ConstantReference(20.0)
        ends = {"begin": -0.9 * slower, "end": 0.9 * slower}
        found.append(timing.profile(references, **ends, points=300).duration)
    assert found[0] > 1.1 * two_link_profile(two_link_limits(), end=0.9, begin=-0.9).duration
    assert found[1] == pytest.approx(found[0], rel=1e-6)


def test_what_has_no_profile_is_refused_in_a_sentence():
    springs = RobotModel.from_multibody(
        parse("two_link_arm"),
        [PointOnSurface("tool", Plane((1.2, 0, 0), (-1, 0, 0)), name="wall")],
        [PointCoordinates("tool", "z")],
        [1.2, -1.6],
        actuation=[FlexibleJoints(8000.0, inertia=0.5)],
    )
    with pytest.raises(ReferenceSignalError, match=r"rigid joints.*'tool\.z' has degree 4"):
        PathTiming(find_structure(springs.dae), MotionLimits())
    with pytest.raises(ReferenceSignalError, match="no position of the reference moves"):
        two_link_profile(two_link_limits(), (ConstantReference(0.3), PRESS))
    with pytest.raises(ReferenceSignalError, match=r"at t = .* the path is out of reach"):
        two_link_profile(two_link_limits(), (SinusoidReference(1.5, 0.9, 1.5), PRESS))
    assert repr(two_link_profile(two_link_limits())).endswith("3 motions from rest to rest)")
    with pytest.raises(ReferenceSignalError, match="nothing limits the motion"):
        two_link_profile(MotionLimits())
    with pytest.raises(ModelError, match="did you mean 'joint1_motor'"):
        two_link_profile(MotionLimits(controls={"joint1_moto": (-1.0, 1.0)}))
    with pytest.raises(ReferenceSignalError, match="cover 1 outputs"):
        two_link_profile(two_link_limits(), (LINE,))
    with pytest.raises(ReferenceSignalError, match="0 derivatives, the law needs 2"):
        TimeOptimalReference(two_link_profile(two_link_limits())).derivatives((2, 2))


def test_a_circle_on_the_wall_keeps_its_shape():
    found = arm("seven_joint")
    velocities = [signal.name for signal in found.model.links.velocity_signals]
    limits = MotionLimits(
        states=dict.fromkeys(velocities, (-1.0, 1.0)), rates=dict.fromkeys(velocities, (-5.0, 5.0))
    )
    references = {
        "tool.yz": CircleReference((0.0, 0.6), 0.1, limits=PathLimits(10.0, 100.0), order=4),
        "tool.z_axis, joint3, joint7": 0.0,
        "wall.force": 20.0,
    }
    profile = PathTiming(found.structure, limits).profile(references, 2.0, points=300)
    times = np.linspace(0.0, profile.duration, 500)
    rows = TimeOptimalReference(profile).pieces(law("seven_joint").degrees).at_all(times)
    radius = np.hypot(rows[:, 0], rows[:, 3] - 0.6)
    # The reference is within 1e-6 of its range.
    np.testing.assert_allclose(radius, 0.1, atol=4e-7)


def test_a_turn_where_a_path_comes_to_rest_gets_no_points():
    """Its last 1e-8 of the speed turns by 45 degrees, in the last 1e-4 of the time.

    Points in it were 1e-12 apart, with large curvatures, so that a motion could not go on there.
    """
    references = [
        ExpressionReference(lambda t: 2e-8 * t - (1.0 - t) ** 3),
        ExpressionReference(lambda t: (1.0 - t) ** 3),
    ]
    (piece,) = Curve(references, DerivativeLayout((2, 2)), 0.0, 1.0, 100).pieces
    assert np.diff(piece.distances[:-1]).min() > 1e-7
    assert np.abs(piece.curvatures[:-1]).max() < 1.0
