"""RobotModel: textbook equations against MultibodyPlant, outputs, starts, and what it refuses."""

import casadi as ca
import numpy as np
import pytest
from arms import arm, consistent_states, numbers
from members import Mirror
from pydrake.common.eigen_geometry import AngleAxis
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import RpyFloatingJoint, SpatialInertia
from vendors import joint, link, robot

from drake_dae import (
    AxisCoordinates,
    CoincidentPoints,
    ExpressionOutput,
    JointCoupler,
    JointPositions,
    LinkExpressions,
    Plane,
    PointCoordinates,
    PointOnSurface,
    PrismaticLoopJoint,
    RevoluteLoopJoint,
    RobotModel,
    RobotPlant,
    Signal,
    TrackingLaw,
    WeldedFrames,
    find_structure,
    poles,
)
from drake_dae.errors import InconsistentStateError, ModelError
from drake_dae.robots import FrictionCone
from drake_dae.trace.functions import TracedFunction

WALL = PointOnSurface("tool", Plane((1.2, 0, 0), (-1, 0, 0)), name="wall")


def textbook_links(**changes):
    """The shipped two-link arm by hand: rods of 1 m, 12 kg and 6 kg, in the x-z plane."""
    q, v = ca.SX.sym("q", 2), ca.SX.sym("v", 2)
    c, s, g = ca.cos(q[1]), ca.sin(q[1]), 9.81
    c1, c12 = ca.cos(q[0]), ca.cos(q[0] + q[1])
    mass = ca.vertcat(ca.horzcat(12 + 6 * c, 2 + 3 * c), ca.horzcat(2 + 3 * c, 2))
    bias = ca.vertcat(
        -3 * s * (2 * v[0] * v[1] + v[1] ** 2) + g * (12 * c1 + 3 * c12),
        3 * s * v[0] ** 2 + 3 * g * c12,
    )
    tip = ca.vertcat(c1 + c12, 0, ca.sin(q[0]) + ca.sin(q[0] + q[1]))
    given = {"q": q, "v": v, "mass_matrix": mass, "bias": bias, "frames": {"tool": tip}}
    return LinkExpressions(**{**given, **changes})


def textbook(outputs=None, constraints=(WALL,), forces=None, **changes):
    outputs = [PointCoordinates("tool", "z")] if outputs is None else outputs
    return RobotModel(textbook_links(**changes), constraints, outputs, [1.2, -1.6], forces=forces)


@pytest.mark.equation(43, 44, 45)
def test_textbook_arm_is_the_urdf_arm():
    """f, g, h, k, l of (43)-(45) from two sources; round-off of about 30 operations each."""
    ours, theirs = textbook().dae, arm("two_link").model.dae
    for letter in "fghklm":
        first, second = (
            TracedFunction(
                letter, {"x": dae.state, "p": dae.parameter_symbol}, {letter: getattr(dae, letter)}
            )
            for dae in (ours, theirs)
        )
        for state in consistent_states("two_link", 10):
            np.testing.assert_allclose(
                first(state, ours.parameter_values)[0],
                second(state, theirs.parameter_values)[0],
                rtol=1e-11,
                atol=1e-12,
            )


@pytest.mark.parametrize("name", ["two_link", "seven_joint"])
def test_configuration_inverts_the_outputs(name):
    """q = psi(z_1) of (58), checked by MultibodyPlant's own outputs."""
    model = arm(name).model
    for state in consistent_states(name, 5, seed=8):
        q, v = np.split(state, 2)
        wanted = numbers(name, q, v).outputs
        nominal = model.dae.nominal_state[: q.size]
        found = model.configuration(wanted, nominal)
        np.testing.assert_allclose(numbers(name, found, v).outputs, wanted, atol=1e-10)


def test_configuration_out_of_reach_is_refused():
    with pytest.raises(InconsistentStateError, match=r"2.5"):
        textbook().configuration([2.5], [1.2, -1.6])


def test_underactuated_robot_takes_an_actuation_matrix():
    """One motor at the shoulder, the tip on a wall: the one output is the force."""
    model = textbook(outputs=[], actuation_matrix=np.array([[1.0], [0.0]]))
    assert model.dae.num_controls == 1
    structure = find_structure(model.dae)
    assert structure.output_degrees == (0,)
    # n - sum r = 2 states, none of them steered.
    assert structure.zero_dynamics_dimension == 2


def test_two_motors_on_one_joint_share_its_torque_by_their_weights():
    """With weights 1 and 3 the first has three quarters; by the law of one motor, to round-off."""
    one = TrackingLaw(textbook().dae, poles(-4.0))
    double = textbook_links(actuation_matrix=np.array([[1.0, 1.0, 0.0], [0.0, 0.0, 1.0]]))
    wall, outputs = [WALL], [PointCoordinates("tool", "z")]
    model = RobotModel(double, wall, outputs, [1.2, -1.6], control_weights=[1.0, 3.0, 2.0])
    both = TrackingLaw(model.dae, poles(-4.0))
    x, R = one.structure.states[1], [0.2, 0.1, -0.3, 5.0]
    first, second = one.control(x, R)
    np.testing.assert_allclose(both.control(x, R), [0.75 * first, 0.25 * first, second], rtol=1e-11)
    with pytest.raises(ModelError, match="2"):
        RobotModel(double, wall, outputs, [1.2, -1.6])


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: textbook(outputs=[]), "1.*0"),
        (lambda: textbook(outputs=[JointPositions(["q0", "q1"])]), "q0, q1"),
        (lambda: textbook(outputs=[PointCoordinates("tol", "z")]), "'tol'"),
        (lambda: textbook(outputs=[JointPositions(["q7"])]), "q7"),
        (lambda: textbook(outputs=[PointCoordinates("tool", "w")]), "'w'"),
        (lambda: textbook(outputs=[AxisCoordinates("tool", "q", "x")]), "'q'"),
        (lambda: textbook(outputs=[AxisCoordinates("tool", "z", "x")]), "'tool'"),
        (lambda: textbook(mass_matrix=ca.DM([[1, 2], [2, 1]])), "M.q."),
        (lambda: textbook(mass_matrix=ca.DM.eye(3)), r"mass_matrix.*\(3, 3\)"),
        (lambda: textbook(actuation_matrix=np.eye(3)), r"actuation_matrix.*\(3, 3\)"),
        (lambda: textbook(constraints=[WALL, WALL], outputs=[]), "wall"),
        (lambda: textbook(mass_matrix=ca.DM([[2, 1], [0, 2]])), "not symmetric, by 1"),
        (lambda: textbook(forces=["wall.force"] * 2, outputs=[]), "named twice: wall.force"),
        (lambda: textbook(actuation_matrix=np.zeros((2, 0))), "no actuators"),
        (lambda: textbook(constraints=[Unequal(0, 1, 0.0)], outputs=[]), "'mirror' has 2.*1 force"),
        (lambda: FrictionCone("wall.force", [], 0.3), "got 0"),
        (lambda: FrictionCone("wall.force", ["a", "b", "c"], 0.3), "got 3"),
        (lambda: JointCoupler("q0", "q0"), "'q0' cannot follow itself"),
        (lambda: JointCoupler("q0", "q1", ratio=0.0), "ratio"),
        *(
            (lambda of=of, names=names: textbook(outputs=[ExpressionOutput(of, names)]), message)
            for of, names, message in (
                (lambda links: links.q, [Signal("a")], "returned 2 components, named were a"),
                (lambda links: None, [Signal("a"), Signal("b")], "returned 1.*named were a, b"),
            )
        ),
    ],
)
def test_refusals(make, message):
    with pytest.raises(ModelError, match=message):
        make()


class Unequal(Mirror):
    """Two equations and one force."""

    def residual(self, frames):
        return frames.q


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("position_signals", (Signal("a"),)),
        ("velocity_signals", ["a", "b"]),
        ("actuator_signals", None),
        ("effort_limits", np.ones(3)),
        ("effort_limits", [1.0, 2.0]),
        ("effort_limits", -np.ones(2)),
        ("reflected_inertia", np.ones(1)),
        ("gear_ratios", np.array([1.0, np.inf])),
        ("gear_ratios", np.array(["a", "b"])),
        ("default_positions", np.zeros(3)),
        ("position_limits", (np.ones(2), -np.ones(2))),
        ("position_limits", np.ones(2)),
        ("velocity_limits", (np.zeros(2), np.array([1.0, np.nan]))),
    ],
)
def test_attributes_of_links_that_do_not_fit_are_named(name, value):
    links = textbook_links()
    setattr(links, name, value)
    with pytest.raises(ModelError, match=name):
        RobotModel(links, [WALL], [PointCoordinates("tool", "z")])


def four_bar(folder, far=0.3):
    """A crank of 0.1 m, a coupler and a rocker of 0.4 m; the coupler ends at the rocker."""
    names = ["base", "crank", "coupler", "rocker"]
    text = robot(
        "four_bar",
        *(link(name, 1.0) for name in names),
        joint("a", "base", "crank", "0 1 0", (0.0, 0.0, 0.0)),
        joint("b", "crank", "coupler", "0 1 0", (0.0, 0.0, 0.1)),
        joint("c", "base", "rocker", "0 1 0", (far, 0.0, 0.0)),
    )
    (folder / "bar.urdf").write_text(text)
    plant = MultibodyPlant(0.0)
    Parser(plant).AddModels(str(folder / "bar.urdf"))
    plant.WeldFrames(plant.world_frame(), plant.GetFrameByName("base"))
    for name in "abc":
        plant.AddJointActuator(name, plant.GetJointByName(name))
    plant.Finalize()
    ends = CoincidentPoints(
        "coupler", (0.0, 0.0, 0.4), "rocker", (0.0, 0.0, 0.4), axes="xz", name="pin"
    )
    return plant, ends


def test_a_robot_with_drives_is_simulated_without_outputs_and_nominal_positions(tmp_path):
    plant, pin = four_bar(tmp_path)
    model = RobotModel.from_multibody(plant, [pin])
    assert model.dae.num_outputs == 0
    mechanism = RobotPlant(model)
    context = mechanism.CreateDefaultContext()
    state = mechanism.set_consistent_state(context, {"a": 0.3, "a_w": 5.24})
    assert (state[0], state[3]) == pytest.approx((0.3, 5.24), abs=1e-15)
    assert np.abs(mechanism.GetOutputPort("constraint_residual").Eval(context)).max() < 1e-10
    with pytest.raises(InconsistentStateError, match="a, b, c"):
        mechanism.set_consistent_state(context, dict.fromkeys("abc", 0.0))


def test_constraints_that_nothing_meets_name_the_argument(tmp_path):
    plant, pin = four_bar(tmp_path, far=3.0)
    with pytest.raises(ModelError, match="nominal_positions"):
        RobotModel.from_multibody(plant, [pin])


@pytest.mark.parametrize("off", [0.0, 1e-9])
@pytest.mark.parametrize("cls", [WeldedFrames, RevoluteLoopJoint, PrismaticLoopJoint])
def test_frames_that_are_half_a_turn_off_are_turned_to_each_other(cls: type, off: float):
    """The rotations of these constraints have poles there, which no step shows."""
    plant = MultibodyPlant(0.0)
    for name in "ab":
        body = plant.AddRigidBody(name, SpatialInertia.SolidBoxWithMass(1.0, 0.1, 0.2, 0.3))
        plant.AddJoint(RpyFloatingJoint(name, plant.world_frame(), body.body_frame()))
    plant.Finalize()
    mechanism = RobotPlant(RobotModel.from_multibody(plant, [cls("a", "b")], [], forces=[]))
    random, context = np.random.default_rng(0), plant.CreateDefaultContext()
    frames = [plant.GetFrameByName(name) for name in "ab"]
    for _ in range(5):
        across = np.append(random.normal(size=2), 0.0)
        turned = RigidTransform(
            AngleAxis(np.pi - off, across / np.linalg.norm(across)), np.zeros(3)
        )
        start = RigidTransform(RollPitchYaw(*random.uniform(-0.8, 0.8, 3)), random.normal(size=3))
        poses = [
            (RollPitchYaw(X.rotation()).vector(), X.translation()) for X in (start, start @ turned)
        ]
        guess = np.concatenate([part for pose in poses for part in pose])
        state = mechanism.set_consistent_state(
            mechanism.CreateDefaultContext(), [*guess, *[0.0] * 12]
        )
        plant.SetPositions(context, state[:12])
        a, b = (frame.CalcPoseInWorld(context).rotation().matrix() for frame in frames)
        free = 2 if cls is RevoluteLoopJoint else slice(None)
        np.testing.assert_allclose(a[:, free], b[:, free], atol=1e-12)
