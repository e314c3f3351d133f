"""`drake-dae new`: a scenario for a robot of which only the file is known."""

import re
from dataclasses import replace

import numpy as np
import pytest
from runs import run_scenario
from vendors import joint, link, mobile_arm, robot, write_panda

from drake_dae import load_scenario, new_scenario
from drake_dae.cli import main
from drake_dae.errors import ScenarioError
from drake_dae.scenario.new.robot import new_robot

# Written by hand: three joints in a plane, no transmissions, no base, a tool on a fixed joint.
BY_HAND = robot(
    "planar",
    link("foot", 3.0),
    link("thigh", 2.0),
    link("shank", 1.5),
    link("hand", 0.5),
    link("tool", 0.2),
    joint("hip", "foot", "thigh", "0 1 0", (0.0, 0.0, 0.2), limits=(-2.0, 2.0)),
    joint("knee", "thigh", "shank", "0 1 0", (0.0, 0.0, 0.5), limits=(-2.5, 2.5)),
    joint("wrist", "shank", "hand", "0 1 0", (0.0, 0.0, 0.4), limits=(-2.0, 2.0), effort=20.0),
    '<joint name="mount" type="fixed"><origin xyz="0 0 0.1"/><parent link="hand"/>'
    '<child link="tool"/></joint>\n',
)

# A crane that slides, in SDFormat: it is welded to the world, and has no link named as a tool.
SDF = """<sdf version="1.9"><model name="crane">
{links}
<joint name="hold" type="fixed"><parent>world</parent><child>post</child></joint>
<joint name="slew" type="revolute"><parent>post</parent><child>jib</child>
  <axis><xyz>0 0 1</xyz><limit><lower>-3</lower><upper>3</upper><effort>200</effort></limit></axis>
</joint>
<joint name="reach" type="prismatic"><parent>jib</parent><child>trolley</child>
  <axis><xyz>1 0 0</xyz><limit><lower>0.1</lower><upper>1</upper><effort>200</effort></limit></axis>
</joint>
<joint name="hoist" type="prismatic"><parent>trolley</parent><child>hook</child>
  <axis><xyz>0 0 1</xyz><limit><lower>-0.8</lower><upper>0</upper><effort>200</effort></limit>
  </axis></joint>
</model></sdf>"""

BODY = """<link name="{name}"><pose>0 0 {height} 0 0 0</pose><inertial><mass>2</mass><inertia>
<ixx>0.02</ixx><iyy>0.02</iyy><izz>0.02</izz></inertia></inertial></link>"""

CRANE = SDF.format(
    links="\n".join(
        BODY.format(name=name, height=height)
        for name, height in (("post", 0), ("jib", 1), ("trolley", 1), ("hook", 0.9))
    )
)


def refusal(*arguments, **options):
    with pytest.raises(ScenarioError) as caught:
        new_scenario(*map(str, arguments), **options)
    return str(caught.value)


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    """The command's file for the robot that was written by hand, beside that."""
    folder = tmp_path_factory.mktemp("by_hand")
    (folder / "planar.urdf").write_text(BY_HAND)
    file = folder / "task.yaml"
    assert main(["new", str(folder / "planar.urdf"), "--out", str(file)]) == 0
    return file


@pytest.mark.slow
def test_the_command_writes_a_commented_file_with_units_that_names_the_robot_beside_it(written):
    text = written.read_text()
    assert "\n  file: planar.urdf\n" in text
    assert "base: {weld: foot}  # nothing in the file holds it" in text
    assert "actuators: all  # " in text
    assert "frame: tool  # the end of the longest chain, of 3 joints" in text
    assert "Units: m, rad, s, N, N m." in text
    lines = text.splitlines()
    assert len(lines) <= 40
    assert max(map(len, lines)) <= 100
    # As many comments as there are choices.
    assert text.count("#") > 12


def test_the_file_runs_as_predicted_within_all_limits(written):
    loop, _, record = run_scenario(load_scenario(written, ["duration=0.5"]))
    off = np.abs(record["tracking_error"] - loop.predicted_error(record)).max()
    assert off < 1e-8  # The accuracy of the integrator.
    model = loop.plant.model
    assert np.all(np.abs(record["control"]).max(axis=0) < 0.8 * model.control_limits)
    low, high = model.links.position_limits
    q = record["state"][:, : low.size]
    assert np.all((low < q) & (q < high))


@pytest.mark.slow
def test_a_crane_in_sdformat_works_on_a_ball_with_a_tip_and_the_text_says_the_same(tmp_path):
    (tmp_path / "crane.sdf").write_text(CRANE)
    crane = str(tmp_path / "crane.sdf")
    scenario, text = new_scenario(crane, "sphere", "hook", (0.0, 0.0, -0.1), tmp_path)
    (tmp_path / "task.yaml").write_text(text)
    assert "file: crane.sdf" in text
    assert "point: [0.0, 0.0, -0.1]  # in that frame, m" in text
    assert load_scenario(tmp_path / "task.yaml") == scenario
    assert scenario.robot.base is None
    loop, _, record = run_scenario(replace(scenario, duration=0.3))
    off = np.abs(record["tracking_error"] - loop.predicted_error(record)).max()
    assert off < 1e-8


def test_fingers_and_wheels_are_locked_and_what_mimics_follows(tmp_path):
    found = new_robot(str(write_panda(tmp_path)))
    assert found.chain == tuple(f"panda_joint{k + 1}" for k in range(7))
    assert found.robot.locked == {"panda_finger_joint1": 0.0}
    assert found.robot.actuators == "all"
    assert found.robot.base.weld == "panda_link0"
    (tmp_path / "mobile.urdf").write_text(mobile_arm())
    mobile = new_robot(str(tmp_path / "mobile.urdf"))
    assert mobile.chain == ("shoulder", "elbow")
    assert set(mobile.robot.locked) == {"left_axle", "right_axle"}


@pytest.mark.parametrize(
    ("text", "options", "message"),
    [
        (
            robot("rock", link("rock", 1.0)),
            {},
            "robot.file: ",
        ),
        (BY_HAND, {"tip": "tol"}, "robot.file: no tip 'tol'"),
        (BY_HAND, {"tip": "foot"}, "robot.file: "),
        (
            robot("two", link("one", 1.0), link("other", 1.0)),
            {},
            "robot.file: ",  # Drake's words, which are others in other versions.
        ),
        (
            re.sub("<inertial>.*?</inertial>", "", BY_HAND, flags=re.DOTALL),
            {},
            "robot.file: ",
        ),
        (
            # A lever alone can press, but move along nothing.
            robot(
                "lever",
                link("foot", 1.0),
                link("lever", 1.0),
                joint("hip", "foot", "lever", "0 1 0"),
            ),
            {},
            "robot.file: the tip 'lever'",
        ),
    ],
)
def test_robots_that_cannot_are_refused_with_the_reason(tmp_path, text, options, message):
    (tmp_path / "robot.urdf").write_text(text)
    assert refusal(tmp_path / "robot.urdf", **options).startswith(message)


def test_a_file_that_is_not_there_is_named(tmp_path):
    assert refusal(tmp_path / "gone.urdf").startswith("robot.file: no file '")


def test_nothing_is_written_over_and_a_wrong_tip_is_reported(tmp_path, capsys):
    (tmp_path / "planar.urdf").write_text(BY_HAND)
    out = tmp_path / "mine.yaml"
    out.write_text("mine")
    assert main(["new", str(tmp_path / "planar.urdf"), "--out", str(out)]) == 1
    assert "exists" in capsys.readouterr().err
    assert out.read_text() == "mine"
    tip = ["--tip", "tool:1,2", "--out", str(tmp_path / "new.yaml")]
    assert main(["new", str(tmp_path / "planar.urdf"), *tip]) == 1
    assert "--tip: " in capsys.readouterr().err
