"""The rules of `PositionOutput` and of `ForceOutput`, on every member."""

from dataclasses import dataclass
from functools import cache

import casadi as ca
import numpy as np
import pytest
from arms import arm
from members import Pull, subclasses
from runs import scenario, scenario_model

from drake_dae import (
    AxisCoordinates,
    CoincidentPoints,
    Cylinder,
    ExpressionOutput,
    ForceCombination,
    ForceOutput,
    JointCoupler,
    JointPositions,
    Plane,
    PointCoordinates,
    PointOnSurface,
    RobotModel,
    Signal,
    Squeeze,
    SurfaceCoordinates,
    TiltFromNormal,
)
from drake_dae.errors import ModelError
from drake_dae.robots import ConstraintSet, PositionOutput, as_force_outputs, force_rows
from drake_dae.trace.functions import TracedFunction

WALL = PointOnSurface("tool", Plane((0.7, 0, 0), (-1, 0, 0)), name="wall")
PIPE = PointOnSurface("tool", Cylinder((0.7, 0, 0.4), (0, 1, 0), 0.1), name="pipe")
MEMBERS = {
    "point": PointCoordinates("tool", "zx"),
    "other point": PointCoordinates("tool", "y", (0.0, 0.0, 0.1), "heel"),
    "axis": AxisCoordinates("tool", "z", "xy"),
    "wall": SurfaceCoordinates(WALL),
    "pipe": SurfaceCoordinates(PIPE),
    "tilt": TiltFromNormal(PIPE, "z"),
    "one tilt": TiltFromNormal(WALL, "x", "z"),
    "joints": JointPositions(["joint7", "joint3"]),
    "expression": ExpressionOutput(
        lambda links: ca.sumsqr(links.position("tool")), [Signal("reach", "m^2")]
    ),
}


def test_no_member_is_left_out():
    assert subclasses(PositionOutput) <= {type(output) for output in MEMBERS.values()}


@pytest.fixture(params=MEMBERS)
def output(request):
    return MEMBERS[request.param]


def test_rows_are_as_many_as_names(output):
    links = arm("seven_joint").model.links
    names = [signal.name for signal in output.signals(links)]
    assert output.expression(links).shape == (len(names), 1)
    assert len(set(names)) == len(names) > 0


def test_rows_are_independent_functions_of_the_positions(output):
    """Their gradients are, at a configuration of no special kind."""
    links = arm("seven_joint").model.links
    contacts = [p for c in (WALL, PIPE) for p in c.parameters]
    parameters = ca.vertcat(*[p.symbol for p in (*links.parameters, *contacts)])
    values = np.concatenate([p.value for p in (*links.parameters, *contacts)])
    expression = output.expression(links)
    assert not ca.depends_on(expression, links.v)
    function = TracedFunction(
        "rows", {"q": links.q, "p": parameters}, {"slope": ca.jacobian(expression, links.q)}
    )
    slope = function(np.linspace(-0.9, 0.7, 7), values)[0].reshape(-1, 7)
    assert np.linalg.svd(slope, compute_uv=False)[-1] > 1e-3


@pytest.mark.parametrize(
    ("output", "message"),
    [
        (PointCoordinates("tol"), "'tol'.*'tool'"),
        (AxisCoordinates("tol", "z", "xy"), "'tol'"),
        (JointPositions(["joint9"]), "'joint9'"),
        (TiltFromNormal(PointOnSurface("tol", WALL.surface), "z"), "'tol'"),
        (TiltFromNormal(CoincidentPoints("world", (0, 0, 0), "tool", (0, 0, 0)), "z"), "'pin'"),
        (SurfaceCoordinates(PointOnSurface("tol", WALL.surface)), "'tol'"),
    ],
)
def test_what_is_unknown_is_named(output, message):
    with pytest.raises(ModelError, match=message):
        output.expression(arm("seven_joint").model.links)


def test_a_tilt_is_the_sine_of_the_angle_to_the_normal():
    """The tool turned by joint7 and joint6, against the pose of MultibodyPlant."""
    model = arm("seven_joint").model
    links, plant = model.links, model.links.plant
    parameters = (*links.parameters, *PIPE.parameters)
    function = TracedFunction(
        "tilt",
        {"q": links.q, "p": ca.vertcat(*[p.symbol for p in parameters])},
        {"rows": TiltFromNormal(PIPE, "z").expression(links)},
    )
    q = np.linspace(-0.9, 0.7, 7)
    context = plant.CreateDefaultContext()
    plant.SetPositions(context, q)
    pose = plant.GetFrameByName("tool").CalcPoseInWorld(context)
    across = (pose.translation() - PIPE.surface.position) * [1, 0, 1]
    normal = pose.rotation().matrix().T @ (across / np.linalg.norm(across))
    rows = function(q, np.concatenate([p.value for p in parameters]))[0]
    np.testing.assert_allclose(rows, normal[:2], atol=1e-14)
    sine = np.linalg.norm(np.cross(normal, [0, 0, 1]))
    assert np.linalg.norm(rows) == pytest.approx(sine)


FORCES = {
    "combination": ForceCombination({"grip1.fz": 0.5, "grip3.fz": -0.5}, "share"),
    "squeeze": Squeeze("object", "grip1", "grip2"),
    "squeeze of the fingers": Squeeze("finger1::tip", "grip1", "other", name="pinch"),
    "own": Pull("object", "grip3", (0.6, 0.0, 0.8)),
}


@cache
def robot() -> RobotModel:
    return scenario_model(scenario("three_fingers"))


def bound() -> ConstraintSet:
    coupler = JointCoupler("finger1::joint3", "finger1::joint2", name="gear")
    tip = CoincidentPoints("finger1::tip", (0, 0, -0.02), "world", (0, 0, 0), name="other")
    return ConstraintSet([*robot().constraints, tip, coupler])


@pytest.fixture(params=FORCES)
def force_output(request):
    return FORCES[request.param]


def rows(output: ForceOutput, q: np.ndarray) -> np.ndarray:
    links, constraints = robot().links, bound()
    S = force_rows([output], constraints, links)
    parameters = robot().dae.parameter_symbol
    function = TracedFunction("rows", {"q": links.q, "p": parameters}, {"S": S})
    return function(q, robot().dae.parameter_values)[0].reshape(-1, constraints.size)


def test_no_force_output_is_left_out():
    assert subclasses(ForceOutput) <= {type(output) for output in FORCES.values()}


def test_force_rows_are_as_many_as_names(force_output):
    names = [signal.name for signal in force_output.signals(bound())]
    q = np.random.default_rng(0).uniform(-0.5, 0.5, robot().links.q.numel())
    S = rows(force_output, q)
    assert len(set(names)) == len(names) == len(S) > 0
    assert np.linalg.matrix_rank(S) == len(S)


def test_force_rows_are_functions_of_positions_alone(force_output):
    S = force_rows([force_output], bound(), robot().links)
    assert not ca.depends_on(S, robot().links.v)


@pytest.mark.equation(40)
def test_rows_of_names_and_combinations_are_their_weights():
    q = np.zeros(robot().links.q.numel())
    expected = np.zeros((1, bound().size))
    expected[0, [2, 8]] = 0.5, -0.5
    np.testing.assert_array_equal(rows(FORCES["combination"], q), expected)
    (named,) = as_force_outputs(["grip2.fz"], bound())
    assert named.signals(bound()) == (Signal("grip2.fz", "N"),)
    np.testing.assert_array_equal(rows(named, q), np.eye(bound().size)[[5]])


@pytest.mark.parametrize("name", ["squeeze", "squeeze of the fingers"])
def test_a_squeeze_is_half_the_force_toward_the_other_contact(name):
    """e_ij / 2 of what acts on the frame at i and the opposite at j, places by Drake."""
    output, plant = FORCES[name], robot().links.plant
    q = np.random.default_rng(1).uniform(-0.5, 0.5, robot().links.q.numel())
    context = plant.CreateDefaultContext()
    plant.SetPositions(context, q)
    places, signs, columns = [], [], []
    for constraint, part in bound().parts():
        if constraint.name in (output.first, output.second):
            model, _, own = constraint.frame_b.rpartition("::")
            instance = [plant.GetModelInstanceByName(model)] if model else []
            frame = plant.GetFrameByName(own, *instance)
            places.append(frame.CalcPoseInWorld(context) @ np.array(constraint.point_b))
            signs.append(1.0 if constraint.frame_b == output.frame else -1.0)
            columns.append(part)
    along = (places[1] - places[0]) / np.linalg.norm(places[1] - places[0])
    expected = np.zeros((1, bound().size))
    expected[0, columns[0]] = signs[0] * along / 2.0
    expected[0, columns[1]] = -signs[1] * along / 2.0
    np.testing.assert_allclose(rows(output, q), expected, atol=1e-12)


@dataclass(frozen=True)
class Pressed(ForceOutput):
    """No member: it is not linear."""

    shift: float = 0.0

    def expression(self, constraints, kinematics, constraint_force):
        return constraint_force[0] + self.shift if self.shift else constraint_force[0] ** 2

    def signals(self, constraints):
        return (Signal("pressed", "N"),)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Squeeze("object", "grip1", "grip1"), "'grip1'"),
        (lambda: ForceCombination({}, "none"), "'none'"),
        (
            lambda: ForceCombination({"grip1.fx": 1.0, "gear.moment": 1.0}, "a").signals(bound()),
            "'a'",
        ),
        *(
            (lambda output=output: force_rows([output], bound(), robot().links), message)
            for output, message in (
                (Pressed(), "pressed"),
                (ForceCombination({"grip2.f": 1.0}, "a"), "'grip2.f'"),
                (Squeeze("object", "grip1", "grip4"), "'grip4'"),
                (Squeeze("finger1::tip", "grip1", "grip2"), "'grip2'.*'finger1::tip'"),
                (Pull("object", "grip", (1, 0, 0)), "'grip'"),
            )
        ),
    ],
)
def test_force_outputs_that_make_no_sense_are_refused(make, message):
    with pytest.raises(ModelError, match=message):
        make()
