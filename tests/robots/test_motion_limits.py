"""A robot's own limits, and friction cones, as limits of a motion."""

import numpy as np
import pytest
from arms import arm

from drake_dae import FrictionCone, PathTiming, TimeOptimalReference, robot_motion_limits
from drake_dae.errors import ModelError
from drake_dae.scenario.files import load_scenario
from drake_dae.scenario.model import scenario_model, scenario_structure
from drake_dae.scenario.shipped import find_scenario


def test_shares_of_the_limits_of_drives_and_joints():
    model = arm("two_link").model
    limits = robot_motion_limits(
        model, efforts=0.5, joint_speeds=0.25, forces={"wall.force": (2.0, 30.0)}
    )
    plant = model.links.plant
    efforts = [plant.get_joint_actuator(i).effort_limit() for i in plant.GetJointActuatorIndices()]
    assert limits.controls == {
        name: (-0.5 * most, 0.5 * most)
        for name, most in zip(("joint1_motor", "joint2_motor"), efforts, strict=True)
    }
    high = plant.GetVelocityUpperLimits()
    assert limits.states["joint2_w"] == (-0.25 * high[1], 0.25 * high[1])
    assert limits.forces == {"wall.force": (2.0, 30.0)}
    # What can only push does not pull.
    assert robot_motion_limits(model).forces == {"wall.force": (0.0, None)}


@pytest.mark.parametrize("share", [0.0, 1.01, -1.0])
def test_a_share_is_above_zero_and_at_most_one(share):
    with pytest.raises(ModelError, match="share of the robot's own limits"):
        robot_motion_limits(arm("two_link").model, efforts=share)


def test_a_pyramid_is_inside_its_cone():
    rows = FrictionCone("n", ("a", "b"), 0.5).rows(["a", "n", "other", "b"])
    angles = np.linspace(0.0, 2.0 * np.pi, 1000)
    directions = np.column_stack([np.cos(angles), 0 * angles, 0 * angles, np.sin(angles)])
    reached = 1.0 / np.max(directions @ rows.T, axis=1)
    # |tangent| up to which all rows hold with n = 1.
    normal = rows[:, 1]
    assert np.all(normal == normal[0])
    most = -normal[0] * reached
    assert most.max() <= 0.5 + 1e-12
    assert most.min() >= 0.98 * 0.5
    line = FrictionCone("n", ["a"], 0.5).rows(["a", "n"])
    np.testing.assert_array_equal(line, [[1.0, -0.5], [-1.0, -0.5]])


@pytest.mark.parametrize(
    ("cone", "text"),
    [
        (
            {"normal": "n", "tangents": ["a"], "friction": 0.0},
            "friction of a cone must be positive",
        ),
        ({"normal": "n", "tangents": [], "friction": 0.5}, "one or two tangential forces, got 0"),
    ],
)
def test_a_cone_that_is_none(cone, text):
    with pytest.raises(ModelError, match=text):
        FrictionCone(**cone)


@pytest.mark.thorough
def test_a_held_box_does_not_slide_in_the_time_optimal_motion():
    """Two arms carry a box; how they press along and across it follows from Newton's law."""
    scenario = load_scenario(find_scenario("two_arms_free_box"))
    model = scenario_model(scenario)
    timing = {}
    for cones in ((), [FrictionCone("right.fx", ["right.fy", "right.fz"], 1.0)]):
        limits = robot_motion_limits(model, cones=cones)
        timing[len(cones)] = PathTiming(scenario_structure(model), limits).profile(
            scenario.references, 1.5, points=200
        )
    profile = timing[1]
    assert profile.duration > 1.05 * timing[0].duration
    assert profile.shares["largest friction cone of right.fx"] > 0.3

    names = [signal.name for signal in model.dae.output_signals]
    degrees = [2 if name.startswith("object") or "joint3" in name else 0 for name in names]
    times = np.linspace(0.0, profile.duration, 400)
    rows = TimeOptimalReference(profile).pieces(degrees).at_all(times)
    first = dict(zip(names, np.cumsum([0, *[degree + 1 for degree in degrees]]), strict=False))
    body = model.links.plant.GetBodyByName("object")
    mass = body.default_mass()
    force = mass * np.array([rows[:, first[f"object_{axis}"] + 2] for axis in "xyz"])
    force[2] += 9.81 * mass
    tilt = rows[:, first["object_qy"]]  # It turns about y alone.
    along = np.cos(tilt) * force[0] - np.sin(tilt) * force[2]
    up = np.sin(tilt) * force[0] + np.cos(tilt) * force[2]
    normal = rows[:, first["squeeze"]] - along / 2.0
    reached = np.hypot(force[1] / 2.0, up / 2.0) / normal
    # The pyramid is up to 2 % smaller than the cone; a limit may be exceeded by 2 % at points.
    assert reached.max() <= 1.0 + 1e-3
    assert reached.max() >= 0.97
