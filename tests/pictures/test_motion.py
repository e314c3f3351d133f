"""Paths of points on surfaces, of a course made by hand."""

import casadi as ca
import numpy as np
import pytest
from runs import run_scenario, scenario

from drake_dae import LinkExpressions, PointCoordinates, PointOnSurface, RobotModel, Sphere
from drake_dae.pictures.motion import RunMotion, contact_paths, follow
from drake_dae.robots import ConstraintWrenches


@pytest.mark.parametrize("turns", [0.25, 1.0])
def test_a_path_around_a_sphere_is_seen_from_a_side(turns):
    """It swings from side to side by the radius, or less.

    Of a quarter the mean normal is at 45 degrees; of a whole turn no normal is the mean, and the
    path is seen along its first one.
    """
    q, v = ca.SX.sym("q", 3), ca.SX.sym("v", 3)
    links = LinkExpressions(q, v, ca.SX.eye(3), ca.SX(3, 1), {"tip": q}, actuation_matrix=np.eye(3))
    center, radius = np.array([0.1, 0.2, 0.3]), 0.5
    ball = PointOnSurface("tip", Sphere(tuple(center), radius), name="ball")
    start = center + radius * np.array([0.6, 0.0, 0.8])
    model = RobotModel(links, [ball], [PointCoordinates("tip", "xy")], start.tolist())
    # Directions of even places, without round-off in their sum over a whole turn.
    corners = np.array([[1.0, 0, 0], [0, 1.0, 0], [-1.0, 0, 0], [0, -1.0, 0]])
    places = center + radius * (corners if turns == 1.0 else corners[:2])
    states = np.hstack([places, np.zeros_like(places)])
    parameters = np.tile(model.dae.parameter_values, (len(places), 1))
    acting = ConstraintWrenches(model, model.dae.parameter_values)
    wrenches = [acting(x, np.array([10.0]), p) for x, p in zip(states, parameters, strict=True)]
    times, nothing = np.arange(len(places)) * 0.1, np.zeros((0, 6))
    course = RunMotion(model, times, 0.0, states, parameters, wrenches, nothing, acting)
    (path,) = contact_paths(course)
    assert path.name == "ball"
    assert path.desired.shape == (0, 2)
    width = 2.0 * radius if turns == 1.0 else np.sqrt(2.0) * radius
    ends = path.actual[[1, 3]] if turns == 1.0 else path.actual
    np.testing.assert_allclose(np.linalg.norm(ends[1] - ends[0]), width, rtol=1e-12)
    assert np.linalg.norm(np.ptp(path.actual, axis=0)) == pytest.approx(width)


@pytest.mark.slow
def test_wheels_turn_in_the_desired_course_as_they_turned():
    """The outputs leave open how far: it is as it was, while the rest of the cart is elsewhere."""
    loop, _, record = run_scenario(scenario("cart_wall", "duration=0.2"))
    course = follow(loop, record, loop.diagram.CreateDefaultContext())
    names = [signal.name for signal in loop.plant.dae.state_signals]
    axles = [names.index("left_axle"), names.index("right_axle")]
    assert len(course.desired) == len(course.states)
    assert np.ptp(course.states[:, axles], axis=0).min() > 0.01
    np.testing.assert_allclose(course.desired[:, axles], course.states[:, axles], atol=1e-9)
    assert np.abs(course.desired - course.states)[:, names.index("rod")].max() > 0.01
