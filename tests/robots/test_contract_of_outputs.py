"""The rules of `PositionOutput`, on every member."""

import casadi as ca
import numpy as np
import pytest
from arms import arm
from members import subclasses

from drake_dae import (
    AxisCoordinates,
    CoincidentPoints,
    Cylinder,
    ExpressionOutput,
    JointPositions,
    Plane,
    PointCoordinates,
    PointOnSurface,
    Signal,
    SurfaceCoordinates,
    TiltFromNormal,
)
from drake_dae.errors import ModelError
from drake_dae.robots import PositionOutput
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
