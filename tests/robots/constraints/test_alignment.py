"""An axis that is held normal to a surface, against Drake's kinematics and by closed forms."""

import casadi as ca
import numpy as np
import pytest
from arms import fixed_step, parse

from drake_dae import (
    AxisNormalToSurface,
    ConstantReference,
    JointPositions,
    LinkExpressions,
    Plane,
    PointCoordinates,
    PointOnSurface,
    RobotModel,
    RobotPlant,
    SinusoidReference,
    Sphere,
    TrackingLaw,
    find_structure,
    make_closed_loop,
    poles,
    simulate,
)
from drake_dae.errors import ModelError
from drake_dae.trace.functions import TracedFunction


def pole():
    """A body in the x-z plane, q = (x, z, angle about -y): its z axis is (-sin, 0, cos)."""
    q, v = ca.SX.sym("q", 3), ca.SX.sym("v", 3)
    c, s = ca.cos(q[2]), ca.sin(q[2])
    turned = ca.vertcat(ca.horzcat(c, 0, -s), ca.horzcat(0, 1, 0), ca.horzcat(s, 0, c))
    place = ca.vertcat(q[0], 0, q[1])
    return LinkExpressions(
        q, v, ca.diag(ca.SX([2, 2, 0.3])), ca.SX(3, 1), {"body": (turned, place)}
    )


def rows(constraint, links, q):
    function = TracedFunction(
        "rows",
        {"q": links.q, "p": ca.vertcat(*[p.symbol for p in constraint.parameters])},
        {"phi": constraint.residual(links), "J": ca.jacobian(constraint.residual(links), links.q)},
    )
    return function(q, np.concatenate([p.value for p in constraint.parameters]))


@pytest.mark.parametrize("angle", [-2.5, -0.4, 0.0, 0.3, 1.9])
def test_it_measures_the_tilt_and_has_no_second_zero(angle):
    """2 tan(t / 2) of the tilt t against the normal, whose other end is infinitely far.

    axes_along(z) are x and y, and a tilt about -y is one about -c: phi = (0, 2 tan(-t / 2)).
    """
    links = pole()
    constraint = AxisNormalToSurface("body", Plane((0, 0, 0), (0, 0, 1)))
    phi, _ = rows(constraint, links, [0.3, 0.1, angle])
    np.testing.assert_allclose(phi, [0.0, -2.0 * np.tan(angle / 2.0)], atol=1e-13)


def test_on_a_sphere_the_normal_turns_with_the_point():
    """At distance d from the center the normal turns by x' / d: phi' = -(angle' + x' / d)."""
    links = pole()
    constraint = AxisNormalToSurface("body", Sphere((0.0, 0.0, -1.0), 0.5))
    phi, jacobian = rows(constraint, links, [0.0, 0.4, 0.0])
    np.testing.assert_allclose(phi, 0.0, atol=1e-15)
    np.testing.assert_allclose(jacobian[1], [-1.0 / 1.4, 0.0, -1.0], atol=1e-14)
    np.testing.assert_allclose(jacobian[0], 0.0, atol=1e-14)


NOMINAL = [0.0, -0.2583, 0.0, -1.5038, 0.0, -1.3795, 0.0]
DOME = Sphere((0.5, 0.0, 0.0), 0.45)


def polisher():
    """The 7-joint arm with its disk flush on a dome; its z axis points out of the tool."""
    constraints = [
        PointOnSurface("tool", DOME, name="dome"),
        AxisNormalToSurface("tool", DOME, (0.0, 0.0, -1.0), name="flush"),
    ]
    outputs = [PointCoordinates("tool", "xy"), JointPositions(["joint3", "joint7"])]
    return RobotModel.from_multibody(parse("seven_joint_arm"), constraints, outputs, NOMINAL)


@pytest.mark.slow
def test_a_disk_stays_flush_on_a_dome_with_chosen_moments():
    """e(t) as predicted, the moments at once, and the axis along the normal by Drake; RK5 at 4 ms
    leaves 1e-9."""
    model = polisher()
    structure = find_structure(model.dae)
    assert structure.constraint_degrees == (2, 2, 2)
    assert structure.output_degrees == (2,) * 4 + (0,) * 3
    law = TrackingLaw(model.dae, poles(-4.0), structure=structure)
    wanted = [
        SinusoidReference(0.5, 0.08, 2.0),
        SinusoidReference(0.0, 0.08, 1.5),
        ConstantReference([0.0, 0.0]),
        SinusoidReference(20.0, 5.0, 2.0),
        SinusoidReference(0.0, 0.6, 3.0),
        ConstantReference(0.4),
    ]
    loop = make_closed_loop(RobotPlant(model, structure=structure), law, wanted)
    context = loop.diagram.CreateDefaultContext()
    own = loop.plant.GetMyMutableContextFromRoot(context)
    q = model.configuration([0.53, 0.02, 0.0, 0.0], NOMINAL)
    loop.plant.set_consistent_state(own, [*q, *np.zeros(7)])
    simulate(loop.diagram, context, 1.0, fixed_step(4e-3))
    record = loop.record(context)
    np.testing.assert_allclose(
        record["tracking_error"], loop.predicted_error(record), rtol=0, atol=1e-8
    )
    plant = model.links.plant
    tool, fresh = plant.GetFrameByName("tool"), plant.CreateDefaultContext()
    for state in record["state"][::25]:
        plant.SetPositions(fresh, state[:7])
        pose = tool.CalcPoseInWorld(fresh)
        normal = (pose.translation() - DOME.center) / DOME.radius
        np.testing.assert_allclose(-pose.rotation().matrix()[:, 2], normal, atol=1e-8)
    # The moments on the tool, about the two axes across its own, by the port.
    wrenches = loop.plant.GetOutputPort("constraint_wrenches").Eval(own).reshape(-1, 6)
    names = [signal.name for signal in loop.plant.wrench_signals[::6]]
    flush = dict(zip(names, wrenches, strict=True))["flush.tool.mx"]
    moments = record["constraint_force"][-1, 1:]
    plant.SetPositions(fresh, loop.plant.state(own)[:7])
    R = tool.CalcPoseInWorld(fresh).rotation().matrix()
    np.testing.assert_allclose(R.T @ flush[:3], [moments[0], -moments[1], 0.0], atol=1e-6)


def test_an_axis_of_no_length_is_refused():
    with pytest.raises(ModelError, match="axis"):
        AxisNormalToSurface("tool", DOME, (0.0, 0.0, 0.0))
