"""Members of the families in simulations and closed loops, compared with closed forms.

Most of them the package does not know: each of these is one class in `members`.
"""

import casadi as ca
import numpy as np
import pytest
import scipy.integrate
from arms import arm, consistent_states, fixed_step, numbers, parse
from members import FrictionalPoint, Saddle, TorqueLag

from drake_dae import (
    AxisCoordinates,
    Blade,
    ConstantReference,
    ExpressionOutput,
    FixedDistance,
    FlexibleJoints,
    JointPositions,
    LinkExpressions,
    Plane,
    PointCoordinates,
    PointOnSurface,
    RobotModel,
    RobotPlant,
    Signal,
    SinusoidReference,
    TrackingLaw,
    find_structure,
    make_closed_loop,
    poles,
    simulate,
)
from drake_dae.trace.functions import TracedFunction

GRAVITY = 9.81


def particle(mass=2.0, slope=0.0):
    """A point mass in the x-z plane, moved by a force along each axis; gravity leans to +x."""
    q, v = ca.SX.sym("q", 2), ca.SX.sym("v", 2)
    weight = mass * GRAVITY * ca.SX([-np.sin(slope), np.cos(slope)])
    place = ca.vertcat(q[0], 0.0, q[1])
    return LinkExpressions(q, v, mass * ca.SX.eye(2), weight, frames={"bob": place})


def run(plant, state, duration, step=1e-3):
    """The state after a while without control."""
    context = plant.CreateDefaultContext()
    plant.GetInputPort("control").FixValue(context, np.zeros(plant.dae.num_controls))
    plant.set_state(context, state)
    simulate(plant, context, duration, fixed_step(step))
    return plant.state(context), plant.GetOutputPort("constraint_force").Eval(context)


def follow(model, state, references, duration=1.0, step=2e-3):
    """The record of a closed loop with double poles at -4."""
    law = TrackingLaw(model.dae, poles(-4.0))
    loop = make_closed_loop(RobotPlant(model, structure=law.structure), law, references)
    context = loop.diagram.CreateDefaultContext()
    own = loop.plant.GetMyMutableContextFromRoot(context)
    loop.plant.set_consistent_state(own, state)
    simulate(loop.diagram, context, duration, fixed_step(step))
    return loop.record(context)


def double_pole(error, rate, t):
    return (error + (rate + 4.0 * error) * t) * np.exp(-4.0 * t)


# A constraint on positions: two points at a fixed distance.


def test_a_bob_on_a_rod_is_a_pendulum():
    """a'' = -g / l sin a, and the rod pulls with m (l a'^2 + g cos a). RK5 leaves 1e-12."""
    length, mass, duration = 0.7, 2.0, 1.3
    rod = FixedDistance("world", (0.0, 0.0, 1.0), "bob", (0.0, 0.0, 0.0), length)
    model = RobotModel(particle(mass), [rod], [JointPositions(["q0"])], [0.3, 0.4])
    structure = find_structure(model.dae)
    assert structure.constraint_degrees == (2,)
    assert structure.output_degrees == (2, 0)
    angle, speed = 0.8, -1.5
    place = [length * np.sin(angle), 1.0 - length * np.cos(angle)]
    rate = [length * speed * np.cos(angle), length * speed * np.sin(angle)]
    state, thrust = run(RobotPlant(model, structure=structure), [*place, *rate], duration)
    angle, speed = scipy.integrate.solve_ivp(
        lambda t, y: [y[1], -GRAVITY / length * np.sin(y[0])],
        (0.0, duration),
        [angle, speed],
        method="DOP853",
        rtol=1e-13,
        atol=1e-13,
    ).y[:, -1]
    np.testing.assert_allclose(
        state[:2], [length * np.sin(angle), 1.0 - length * np.cos(angle)], atol=1e-11
    )
    pull = mass * (length * speed**2 + GRAVITY * np.cos(angle))
    np.testing.assert_allclose(thrust, -pull, rtol=1e-10)


def test_an_arm_on_a_rod_tracks_motion_and_thrust():
    """e(t) of double poles at -4, and the thrust at once; RK5 at 2 ms leaves 1e-12."""
    rod = FixedDistance("world", (1.6, 0.0, 0.0), "tool", (0.0, 0.0, 0.0), 0.7)
    outputs = [PointCoordinates("tool", "z")]
    model = RobotModel.from_multibody(parse("two_link_arm"), [rod], outputs, [1.2, -1.6])
    q = model.configuration([0.3], [1.2, -1.6])
    tip = TracedFunction("tip", {"q": model.links.q}, {"p": model.links.position("tool")})(q)[0]
    assert np.linalg.norm(tip - [1.6, 0.0, 0.0]) == pytest.approx(0.7, abs=1e-12)
    wanted = [SinusoidReference(0.35, 0.05, 2.0), SinusoidReference(30.0, 10.0, 3.0)]
    record = follow(model, [*q, 0.0, 0.0], wanted)
    error = double_pole(-0.05, -0.1, record.time)
    np.testing.assert_allclose(record["tracking_error"][:, 0], error, atol=1e-10)
    thrust = 30.0 + 10.0 * np.sin(3.0 * record.time)
    np.testing.assert_allclose(record["constraint_force"][:, 0], thrust, rtol=1e-10)
    assert np.max(np.abs(record["constraint_residual"])) < 1e-10


# A reaction of its own: friction.


def frictional(friction=0.3, speed=0.05):
    wall = Plane((1.2, 0.0, 0.0), (-1.0, 0.0, 0.0))
    contact = FrictionalPoint("tool", wall, name="wall", coefficient=friction, speed=speed)
    outputs = [PointCoordinates("tool", "z")]
    return RobotModel.from_multibody(parse("two_link_arm"), [contact], outputs, [1.2, -1.6])


def test_a_block_that_slides_is_braked_by_its_weight():
    """g(x) = (0, 0, -mu s, 1) / m with s = 0.3 / 0.5, and x'' = g (sin a - mu s cos a)."""
    slope, mass = 0.5, 2.0
    floor = FrictionalPoint("bob", Plane((0, 0, 0), (0, 0, 1)), coefficient=0.25, speed=0.4)
    model = RobotModel(particle(mass, slope), [floor], [JointPositions(["q0"])], [0.0, 0.0])
    x = np.array([0.7, 0.0, 0.3, 0.0])
    explicit = model.dae.explicit
    g = TracedFunction(
        "g", {"x": explicit.state, "p": explicit.parameter_symbol}, {"g": explicit.g}
    )(x, explicit.parameter_values)[0]
    np.testing.assert_allclose(g, [0.0, 0.0, -0.25 * 0.6 / 2.0, 0.5], rtol=0, atol=1e-15)
    plant = RobotPlant(model)
    context = plant.CreateDefaultContext()
    plant.GetInputPort("control").FixValue(context, np.zeros(2))
    plant.set_state(context, x)
    rate = plant.EvalTimeDerivatives(context).CopyToVector()
    braked = GRAVITY * (np.sin(slope) - 0.25 * 0.6 * np.cos(slope))
    np.testing.assert_allclose(rate, [0.3, 0.0, braked, 0.0], atol=1e-14)
    force = plant.GetOutputPort("constraint_force").Eval(context)
    np.testing.assert_allclose(force, mass * GRAVITY * np.cos(slope), rtol=1e-14)


def test_friction_enters_as_the_reaction_says():
    """g = M^-1 (J_n - mu s J_t)^T, with M and the Jacobians of MultibodyPlant."""
    friction, speed = 0.3, 0.05
    explicit = frictional(friction, speed).dae.explicit
    function = TracedFunction(
        "g", {"x": explicit.state, "p": explicit.parameter_symbol}, {"g": explicit.g}
    )
    for state in consistent_states("two_link", 5):
        q, v = np.split(state, 2)
        n = numbers("two_link", q, v)
        sliding = n.output_jacobian @ v
        s = sliding / np.hypot(sliding, speed)
        column = n.constraint_jacobian[0] - friction * s * n.output_jacobian[0]
        expected = np.concatenate([np.zeros(2), np.linalg.solve(n.mass, column)])
        found = function(state, explicit.parameter_values)[0]
        np.testing.assert_allclose(found, expected, rtol=1e-11, atol=1e-13)


@pytest.mark.slow
def test_a_law_that_knows_the_friction_cancels_it():
    """Errors as without friction; the controls are not those without it."""
    model = frictional()
    structure = find_structure(model.dae)
    assert structure.constraint_degrees == (2,)
    assert structure.output_degrees == (2, 0)
    wanted = [SinusoidReference(0.3, 0.1, 1.5), SinusoidReference(20.0, 5.0, 2.0)]
    q = model.configuration([0.25], [1.2, -1.6])
    record = follow(model, [*q, 0.0, 0.0], wanted)
    error = double_pole(-0.05, -0.15, record.time)
    np.testing.assert_allclose(record["tracking_error"][:, 0], error, atol=1e-9)
    force = 20.0 + 5.0 * np.sin(2.0 * record.time)
    np.testing.assert_allclose(record["constraint_force"][:, 0], force, rtol=1e-9)
    smooth = follow(arm("two_link").model, [*q, 0.0, 0.0], wanted)
    assert np.max(np.abs(record["control"] - smooth["control"])) > 3.0


# A constraint on velocities alone.


def test_a_skate_on_a_slope_goes_along_a_cycloid():
    """x = a sin^2 wt, y = a (wt - sin 2wt / 2), a = g / 2w^2; the side force is 2 m g sin wt.

    Chaplygin's skate (Neimark and Fufaev, 1972): it does not slide down, it goes across.
    """
    mass, pull, spin, duration = 1.5, 3.0, 2.0, 2.2
    q, v = ca.SX.sym("q", 3), ca.SX.sym("v", 3)
    c, s = ca.cos(q[2]), ca.sin(q[2])
    turned = ca.vertcat(ca.horzcat(c, -s, 0), ca.horzcat(s, c, 0), ca.horzcat(0, 0, 1))
    links = LinkExpressions(
        q,
        v,
        ca.diag(ca.SX([mass, mass, 0.2])),
        ca.SX([-mass * pull, 0.0, 0.0]),
        frames={"blade": (turned, ca.vertcat(q[0], q[1], 0.0))},
    )
    along = ExpressionOutput(lambda links: links.q[0], [Signal("x", "m")])
    model = RobotModel(links, [Blade("blade")], [along, JointPositions(["q2"])])
    structure = find_structure(model.dae)
    assert structure.constraint_degrees == (1,)
    assert structure.output_degrees == (2, 2, 0)
    plant = RobotPlant(model, structure=structure)
    state, force = run(plant, [0.0, 0.0, 0.0, 0.0, 0.0, spin], duration)
    turn, size = spin * duration, pull / (2.0 * spin**2)
    place = [size * np.sin(turn) ** 2, size * (turn - np.sin(2.0 * turn) / 2.0), turn]
    np.testing.assert_allclose(state[:3], place, atol=1e-10)
    np.testing.assert_allclose(force, 2.0 * mass * pull * np.sin(turn), atol=1e-9)


# A surface.


@pytest.mark.slow
def test_a_tool_stays_on_a_saddle():
    """z = 0.5 (x^2 - y^2) above its middle all along, and the normal force is the desired one."""
    contact = PointOnSurface("tool", Saddle((0.5, 0.0, 0.45), 0.5), name="saddle")
    outputs = [
        PointCoordinates("tool", "xy"),
        AxisCoordinates("tool", "z", "xy"),
        JointPositions(["joint3", "joint7"]),
    ]
    nominal = [0.0, -0.2583, 0.0, -1.5038, 0.0, -1.3795, 0.0]
    plant = parse("seven_joint_arm")
    model = RobotModel.from_multibody(plant, [contact], outputs, nominal)
    assert find_structure(model.dae).output_degrees == (2,) * 6 + (0,)
    q = model.configuration([0.55, 0.05, 0.0, 0.0, 0.0, 0.0], nominal)
    wanted = [
        SinusoidReference(0.5, 0.1, 2.0),
        SinusoidReference(0.05, 0.1, 2.0),
        ConstantReference([0.0] * 4),
        SinusoidReference(20.0, 5.0, 2.0),
    ]
    record = follow(model, [*q, *np.zeros(7)], wanted, step=4e-3)
    context = plant.CreateDefaultContext()
    tool = plant.GetFrameByName("tool")
    for state in record["state"][::20]:
        plant.SetPositions(context, state[:7])
        x, y, z = tool.CalcPoseInWorld(context).translation() - [0.5, 0.0, 0.45]
        assert z == pytest.approx(0.5 * (x**2 - y**2), abs=1e-8)
    error = double_pole(0.05, -0.2, record.time)
    np.testing.assert_allclose(record["tracking_error"][:, 0], error, atol=1e-8)
    force = 20.0 + 5.0 * np.sin(2.0 * record.time)
    np.testing.assert_allclose(record["constraint_force"][:, 0], force, rtol=1e-9)


# A stage.


def lagging(*before):
    model = arm("two_link").model
    outputs = [PointCoordinates("tool", "z")]
    stages = [*before, TorqueLag([0.02, 0.03])]
    plant = parse("two_link_arm")
    return RobotModel.from_multibody(
        plant, model.constraints, outputs, [1.2, -1.6], "two_link_arm", stages
    )


def test_a_lag_adds_one_to_every_degree():
    for stages, degrees in (([], (3, 1)), ([FlexibleJoints(8e3, 1.0)], (5, 3))):
        structure = find_structure(lagging(*stages).dae)
        assert structure.constraint_degrees == (2,)
        assert structure.output_degrees == degrees


def test_a_lag_moves_as_it_says():
    """The torques of the state move the links, and tau' = (u - tau) / T."""
    model = lagging()
    plant = RobotPlant(model)
    context = plant.CreateDefaultContext()
    torque, u = np.array([30.0, -20.0]), np.array([7.0, 11.0])
    rigid = RobotPlant(arm("two_link").model)
    other = rigid.CreateDefaultContext()
    for link in consistent_states("two_link", 3):
        plant.set_state(context, [*link, *torque])
        plant.GetInputPort("control").FixValue(context, u)
        rigid.set_state(other, link)
        rigid.GetInputPort("control").FixValue(other, torque)
        rate = plant.EvalTimeDerivatives(context).CopyToVector()
        expected = rigid.EvalTimeDerivatives(other).CopyToVector()
        np.testing.assert_allclose(rate[:4], expected, rtol=1e-12, atol=1e-12)
        np.testing.assert_allclose(rate[4:], (u - torque) / [0.02, 0.03], rtol=1e-12)
        shown = plant.GetOutputPort("lagged_torque").Eval(context)
        np.testing.assert_array_equal(shown, torque)
    names = [signal.name for signal in model.dae.state_signals[4:]]
    assert names == ["joint1_motor.torque", "joint2_motor.torque"]
