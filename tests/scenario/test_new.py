"""`drake-dae new`: a scenario for a robot of which only the file is known."""

import logging
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from runs import run_scenario
from vendors import joint, link, mobile_arm, robot, write_panda

from drake_dae import load_scenario, new_scenario
from drake_dae.cli import main
from drake_dae.errors import ScenarioError

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
BOX = (
    '<visual><origin xyz="0 0 -0.2"/><geometry><box size="0.04 0.04 0.4"/></geometry></visual>'
    "</link>"
)


def arm(count: int, is_drawn: bool = True, kind: str = "revolute") -> str:
    """Links of 0.4 m along -z that turn in a plane, the last without a frame at its end."""
    names = ["base", *(f"link{k}" for k in range(count))]
    links = [link(name, 1.0).replace("0.01 -0.02 0.12", "0 0 -0.2") for name in names]
    if is_drawn:
        links[-1] = links[-1].replace("</link>", BOX)
    places = [(0.0, 0.0, 0.0), *[(0.0, 0.0, -0.4)] * count]
    joints = [
        joint(f"j{k}", names[k], names[k + 1], "0 1 0", places[k], kind) for k in range(count)
    ]
    return robot("arm", *links, *joints)


def test_the_command_writes_a_file_that_it_checked(tmp_path, capsys):
    (tmp_path / "planar.urdf").write_text(BY_HAND)
    file = tmp_path / "task.yaml"
    assert main(["new", str(tmp_path / "planar.urdf"), "--out", str(file)]) == 0
    printed = capsys.readouterr()
    assert "checked: GOOD" in printed.out
    assert "s: looking for a place" in printed.err
    lines = file.read_text().splitlines()
    assert len(lines) <= 40
    assert max(map(len, lines)) <= 110
    assert "  file: planar.urdf" in lines
    # Nothing is written over.
    assert main(["new", str(tmp_path / "planar.urdf"), "--out", str(file)]) == 1
    assert file.read_text().splitlines() == lines


@pytest.mark.slow
def test_an_arm_works_on_a_ball_with_a_tip_and_the_text_says_the_same(tmp_path):
    (tmp_path / "planar.urdf").write_text(BY_HAND)
    planar = str(tmp_path / "planar.urdf")
    scenario, text = new_scenario(planar, "sphere", "tool", (0.0, 0.0, 0.1), tmp_path)
    (tmp_path / "task.yaml").write_text(text)
    assert load_scenario(tmp_path / "task.yaml") == scenario
    loop, _, record = run_scenario(replace(scenario, duration=0.3))
    off = np.abs(record["tracking_error"] - loop.predicted_error(record)).max()
    assert off < 1e-4  # Of an accuracy of 1e-6.


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::drake_dae.errors.GeometryWarning")
def test_fingers_and_wheels_are_locked_and_what_mimics_follows(tmp_path):
    found = new_scenario(str(write_panda(tmp_path)))[0]
    assert [*found.start.positions] == [f"panda_joint{k + 1}" for k in range(7)]
    assert found.robot.locked == {"panda_finger_joint1": 0.0}
    assert found.robot.actuators == "all"
    assert found.robot.base.weld == "panda_link0"
    (tmp_path / "mobile.urdf").write_text(mobile_arm())
    mobile = new_scenario(str(tmp_path / "mobile.urdf"))[0]
    assert [*mobile.start.positions] == ["shoulder", "elbow"]
    assert set(mobile.robot.locked) == {"left_axle", "right_axle"}


@pytest.mark.slow
def test_an_arm_ends_where_a_hand_branches_whatever_its_joints_are_called(tmp_path):
    """Two chains of two joints each on the last link of six; one of them would be the longest."""
    text = (Path(__file__).parents[2] / "examples/tasks/six_joint_arm.urdf").read_text()
    ends = [("polisher", "p1"), ("p1", "p2"), ("polisher", "q1"), ("q1", "q2")]
    parts = [link(child, 0.05) for _, child in ends]
    parts += [joint(f"{child}_turn", *pair, "0 1 0") for pair in ends for child in pair[1:]]
    (tmp_path / "arm.urdf").write_text(text.replace("</robot>", "".join(parts) + "</robot>"))
    found = new_scenario(str(tmp_path / "arm.urdf"))[0]
    assert [*found.start.positions] == [f"joint{k}" for k in range(1, 7)]
    assert {*found.robot.locked} == {f"{child}_turn" for _, child in ends}


@pytest.mark.parametrize(
    ("count", "is_drawn"), [(2, True), pytest.param(3, False, marks=pytest.mark.slow)]
)
def test_a_planar_arm_works_with_the_far_end_of_its_last_link(count, is_drawn, tmp_path):
    """That of a box, or else where the end of a rod is: the frame itself is on the last joint."""
    (tmp_path / "arm.urdf").write_text(arm(count, is_drawn))
    (contact,) = new_scenario(str(tmp_path / "arm.urdf"))[0].constraints
    assert contact.frame == f"link{count - 1}"
    np.testing.assert_allclose(contact.point, [0.0, 0.0, -0.4], atol=1e-4)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::drake_dae.errors.RobotFileWarning")
def test_only_what_must_be_left_out_is(tmp_path):
    friction = arm(2).replace("</joint>", '<dynamics friction="1"/></joint>', 1)
    both = friction.replace('ixx="0.02"', 'ixx="9"', 1)
    empty = arm(2).replace('lower="-2.9" upper="2.9"', 'lower="0" upper="0"')
    for text, wanted in ((both, ["dynamics/friction", "inertia"]), (empty, ["empty_limits"])):
        (tmp_path / "arm.urdf").write_text(text)
        assert new_scenario(str(tmp_path / "arm.urdf"))[0].robot.leave_out == wanted


LOOP = """<sdf version="1.9"><model name="loop"><link name="a"/><link name="b"/><link name="c"/>
<joint name="one" type="revolute"><parent>a</parent><child>b</child><axis><xyz>0 1 0</xyz></axis>
</joint><joint name="two" type="revolute"><parent>b</parent><child>c</child><axis><xyz>0 1 0</xyz>
</axis></joint><joint name="three" type="revolute"><parent>a</parent><child>c</child><axis>
<xyz>0 1 0</xyz></axis></joint></model></sdf>"""


@pytest.mark.parametrize(
    ("name", "text", "options", "words"),
    [
        ("loop.sdf", LOOP, {}, ["one"]),
        ("rock.urdf", robot("rock", link("rock", 1)), {}, []),
        ("tip.urdf", BY_HAND, {"tip": "tol"}, ["'tol'"]),
        ("foot.urdf", BY_HAND, {"tip": "foot"}, ["'foot'"]),
        ("two.urdf", robot("two", link("one", 1.0), link("other", 1.0)), {}, []),
        ("light.urdf", re.sub("<inertial>.*?</inertial>", "", BY_HAND, flags=re.DOTALL), {}, []),
        (
            "claw.urdf",
            robot(
                "claw",
                *(link(name, 1) for name in ("palm", "one", "two")),
                joint("a", "palm", "one", "0 1 0"),
                joint("b", "palm", "two", "0 1 0", rest='<mimic joint="a"/>'),
            ),
            {},
            ["a, b"],
        ),
        (
            "hinge.urdf",
            robot("hinge", link("base", 1), link("lid", 1), joint("j", "base", "lid", "0 0 1")),
            {"tip": "lid", "point": (0.0, 0.1, 0.0)},
            ["'lid'", "(j)"],
        ),
    ],
)
def test_robots_that_cannot_are_refused_with_the_reason(name, text, options, words, tmp_path):
    (tmp_path / name).write_text(text)
    with pytest.raises(ScenarioError) as caught:
        new_scenario(str(tmp_path / name), **options)
    message = str(caught.value)
    assert message.startswith("robot.file: ")
    assert [word for word in words if word not in message] == [], message


def test_a_file_that_is_not_there_and_a_tip_without_numbers_are_named(tmp_path, capsys):
    with pytest.raises(ScenarioError, match="gone"):
        new_scenario(str(tmp_path / "gone.urdf"))
    (tmp_path / "planar.urdf").write_text(BY_HAND)
    tip = ["--tip", "tool:1,2", "--out", str(tmp_path / "new.yaml")]
    assert main(["new", str(tmp_path / "planar.urdf"), *tip]) == 1
    assert "--tip: " in capsys.readouterr().err
    # What Drake remarks of a file is heard by this command and after it.
    assert logging.getLogger("drake").isEnabledFor(logging.WARNING)
