"""The constraints of scenarios: each runs from a file, and is looked at by Drake's kinematics."""

import numpy as np
import pytest
from runs import run_scenario, scenario_validator, untagged

from drake_dae import build_scenario, load_scenario
from drake_dae.errors import ScenarioError
from drake_dae.scenario.typed_yaml import load_yaml

BALL = """<mujoco model="ball"><compiler angle="radian"/><worldbody>
<body name="ball" pos="0 0 0.15">
<joint name="x" type="slide" axis="1 0 0"/><joint name="y" type="slide" axis="0 1 0"/>
<joint name="z" type="slide" axis="0 0 1"/><joint name="turn_x" type="hinge" axis="1 0 0"/>
<joint name="turn_y" type="hinge" axis="0 1 0"/><joint name="turn_z" type="hinge" axis="0 0 1"/>
<geom type="sphere" size="0.15" mass="1"/></body></worldbody>
<actuator><motor joint="x"/><motor joint="y"/><motor joint="z"/></actuator></mujoco>"""
TWO_LINK = "robot: {file: package://drake_dae_models/two_link_arm.urdf}"

ROD = f"""{TWO_LINK}
constraints:
- !FixedDistance
  frame_a: world
  point_a: [1.6, 0.0, 0.0]
  frame_b: tool
  point_b: [0.0, 0.0, 0.0]
  length: 0.7
outputs: [!PointCoordinates {{frame: tool, axes: z}}]
law:
  gains: !Poles {{all: [-4.0]}}
references:
  tool.z: !Sinusoids {{offset: 0.35, amplitudes: [0.05], frequencies: [2.0]}}
  rod.thrust: 30.0
start: {{positions: {{joint1: 1.2, joint2: -1.6}}, errors: {{tool.z: 0.02}}}}
"""
MARBLE = """robot: {file: ball.xml}
constraints:
- !RollingBall
  frame: ball
  surface: !Sphere {center: [0, 0, -2], radius: 2}
  radius: 0.15
  name: dome
outputs: [!PointCoordinates {frame: ball, axes: xy}]
forces: [dome.force]
law:
  gains: !Poles {all: [-4.0]}
references:
  ball.x: !Sinusoids {offset: 0.0, amplitudes: [0.2], frequencies: [1.0]}
  ball.y: 0.1
  dome.force: 25.0
start: {errors: {ball.x: 0.03}}
"""
END = """duration: 0.5
integrator: {integration_scheme: runge_kutta5, accuracy: 1.0e-8, use_error_control: true}
"""


def scenario_file(folder, text, robot=""):
    (folder / "ball.xml").write_text(robot)
    (folder / "own.yaml").write_text(text + END)
    return folder / "own.yaml"


def rod_holds(plant, context, _):
    place = plant.GetFrameByName("tool").CalcPoseInWorld(context).translation()
    return [np.linalg.norm(place - [1.6, 0, 0]) - 0.7]


def velocity(plant, context, frame, lever=(0, 0, 0)):
    """Of the body's point that is at the frame's origin plus a lever in the world."""
    moving = plant.GetFrameByName(frame).CalcSpatialVelocityInWorld(context)
    return moving.translational() + np.cross(moving.rotational(), lever)


def ball_rolls(plant, context, _):
    place = plant.GetFrameByName("ball").CalcPoseInWorld(context).translation()
    center = place - np.array([0, 0, -2])
    normal = center / np.linalg.norm(center)
    return [np.linalg.norm(center) - 2.15, *velocity(plant, context, "ball", -0.15 * normal)]


CASES = {
    "rod": (ROD, "", rod_holds, ["tool.z", "rod.thrust"]),
    "ball": (MARBLE, BALL, ball_rolls, ["ball.x", "ball.y", "dome.force"]),
}


# A ball that spins freely has zero dynamics with eigenvalues 0 in pairs: round-off takes sides.
@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::drake_dae.errors.NonMinimumPhaseWarning")
@pytest.mark.parametrize("name", CASES)
def test_a_constraint_of_a_scenario_holds_with_the_predicted_error(name, tmp_path):
    """The accuracy of 1e-8 in a step leaves less than 1e-6 along the way, and the forces are met
    at once. The constraint is looked at by Drake: projection leaves round-off."""
    text, robot, holds, outputs = CASES[name]
    path = scenario_file(tmp_path, text, robot)
    scenario_validator().validate(untagged(load_yaml(path.read_text(), "own")))
    loop, _, record = run_scenario(load_scenario(path))
    assert [signal.name for signal in loop.plant.dae.output_signals] == outputs
    distance = np.abs(record["tracking_error"] - loop.predicted_error(record)).max(axis=0)
    positions = len(loop.plant.model.position_signals)
    assert np.max(distance[:positions]) < 1e-6
    assert np.max(distance[positions:], initial=0.0) < 1e-9
    assert np.abs(record["tracking_error"][0]).max() > 0.009
    plant = loop.plant.model.links.plant
    context = plant.CreateDefaultContext()
    size = plant.num_positions() + plant.num_velocities()
    for state in record["state"][::10]:
        plant.SetPositionsAndVelocities(context, state[:size])
        np.testing.assert_allclose(holds(plant, context, state), 0.0, atol=1e-8)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "settings", "words"),
    [
        ("rod", ["constraints.0.length=0"], ["constraints.0: ", "'rod.length'"]),
        ("rod", ["constraints.0.frame_b=tol"], ["constraints.0: ", "'tool'"]),
        ("ball", ["forces=null"], ["outputs: ", "3"]),
        ("ball", ["forces=[dome]"], ["forces.0: ", "'dome'", "dome.force"]),
        (
            "ball",
            ["constraints.0.surface=!Ellipsoid {center: [0, 0, -2], semi_axes: [1, 2, 2]}"],
            ["constraints.0: ", "Ellipsoid"],
        ),
    ],
)
def test_what_does_not_fit_is_refused_with_its_key(name, settings, words, tmp_path):
    text, robot, *_ = CASES[name]
    path = scenario_file(tmp_path, text, robot)
    with pytest.raises(ScenarioError) as caught:
        build_scenario(load_scenario(path, settings))
    message = str(caught.value)
    assert [word for word in words if word not in message] == [], message
