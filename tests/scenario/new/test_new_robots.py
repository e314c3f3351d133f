"""What `new` finds out of files that say too little, or too much."""

import os
import subprocess
import sys
import sysconfig
from pathlib import Path

import numpy as np
import pytest
from runs import run_scenario
from vendors import binary_stl, joint, link, robot

from drake_dae import load_scenario, new_scenario
from drake_dae.cli import main
from drake_dae.errors import ScenarioError
from drake_dae.scenario.new.robot import new_robot

ROBOTS = Path(sysconfig.get_path("purelib"), "cmeel.prefix/share/example-robot-data/robots")

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


@pytest.mark.parametrize(("count", "is_drawn"), [(2, True), (2, False), (3, True), (4, False)])
def test_a_planar_arm_works_with_the_far_end_of_its_last_link(count, is_drawn, tmp_path):
    """That of a box, or else where the end of a rod is: the frame itself is on the last joint."""
    (tmp_path / "arm.urdf").write_text(arm(count, is_drawn))
    found = new_robot(str(tmp_path / "arm.urdf"))
    assert found.tip == f"link{count - 1}"
    np.testing.assert_allclose(found.point, [0.0, 0.0, -0.4], atol=1e-4)
    # Whoever names a tip means it.
    assert new_robot(str(tmp_path / "arm.urdf"), found.tip, (0.0, 0.0, -0.2)).point[2] == -0.2


@pytest.mark.slow
def test_a_planar_arm_runs_with_the_far_end_of_its_last_link(tmp_path):
    (tmp_path / "arm.urdf").write_text(arm(2))
    _, text = new_scenario(str(tmp_path / "arm.urdf"), folder=tmp_path)
    assert "point: [0.0, 0.0, -0.4]  # in that frame, m: its far end" in text
    (tmp_path / "task.yaml").write_text(text)
    loop, _, record = run_scenario(load_scenario(tmp_path / "task.yaml", ["duration=0.3"]))
    off = np.abs(record["tracking_error"] - loop.predicted_error(record)).max()
    assert off < 1e-8  # The accuracy of the integrator.


@pytest.mark.slow
def test_its_text_may_be_saved_anywhere_unless_a_folder_is_named(tmp_path, monkeypatch):
    """In a folder below the working directory, too, where a relative name would be another file."""
    monkeypatch.chdir(tmp_path)
    Path("arm.urdf").write_text(arm(2))
    Path("below").mkdir()
    for folder, saved in ((None, "below/task.yaml"), ("", "task.yaml"), (tmp_path, "named.yaml")):
        _, text = new_scenario("arm.urdf", folder=folder)
        assert ("file: arm.urdf" in text) == (folder is not None)
        Path(saved).write_text(text)
        file = load_scenario(saved).robot.file
        assert os.path.realpath(file) == os.path.realpath("arm.urdf")


def test_an_end_that_has_a_frame_keeps_it(tmp_path):
    """A wrist that turns about its own axis moves the flange nowhere, and needs not."""
    names = ["base", "one", "two", "three", "four", "wrist"]
    axes = ["0 0 1", "0 1 0", "0 1 0", "0 1 0", "0 0 1"]
    joints = [joint(f"j{k}", names[k], names[k + 1], axis) for k, axis in enumerate(axes)]
    (tmp_path / "arm.urdf").write_text(robot("arm", *(link(n, 1.0) for n in names), *joints))
    found = new_robot(str(tmp_path / "arm.urdf"))
    assert (found.tip, found.point) == ("wrist", (0.0, 0.0, 0.0))


@pytest.mark.parametrize("kind", ["revolute", "prismatic"])
def test_joints_without_room_get_it_where_no_others_work(kind, tmp_path):
    text = arm(2, kind=kind).replace('lower="-2.9" upper="2.9"', 'lower="0" upper="0"')
    text = text.replace('<axis xyz="0 1 0"/>', '<axis xyz="1 0 0"/>', 1)
    (tmp_path / "arm.urdf").write_text(text)
    found = new_robot(str(tmp_path / "arm.urdf"))
    assert found.robot.leave_out == ["empty_limits"]
    assert found.chain == ("j0", "j1")
    # One that others can do without stays where it is.
    (tmp_path / "arm.urdf").write_text(
        arm(3).replace('lower="-2.9" upper="2.9"', 'lower="0" upper="0"', 1)
    )
    found = new_robot(str(tmp_path / "arm.urdf"))
    assert (found.robot.leave_out, found.chain) == ([], ("j1", "j2"))


def test_only_what_must_be_left_out_is(tmp_path):
    friction = arm(2).replace("</joint>", '<dynamics friction="1"/></joint>', 1)
    heavy = arm(2).replace('ixx="0.02"', 'ixx="9"', 1)
    both = friction.replace('ixx="0.02"', 'ixx="9"', 1)
    for text, wanted in (
        (arm(2), []),
        (friction, ["dynamics/friction"]),
        (heavy, ["inertia"]),
        (both, ["dynamics/friction", "inertia"]),
    ):
        (tmp_path / "arm.urdf").write_text(text)
        assert new_robot(str(tmp_path / "arm.urdf")).robot.leave_out == wanted


@pytest.mark.parametrize("where", ["", "above"])
def test_a_package_without_package_xml_is_the_folder_beside_the_file(where, tmp_path):
    (tmp_path / "parts").mkdir()
    (tmp_path / "parts" / "link.stl").write_bytes(binary_stl())
    home = tmp_path / where
    home.mkdir(exist_ok=True)
    text = arm(2).replace(
        '<box size="0.04 0.04 0.4"/>', '<mesh filename="package://parts/link.stl"/>'
    )
    (home / "arm.urdf").write_text(text)
    found = new_robot(str(home / "arm.urdf"))
    assert found.robot.packages == {"parts": str(tmp_path / "parts")}


LOOP = """<sdf version="1.9"><model name="loop"><link name="a"/><link name="b"/><link name="c"/>
<joint name="one" type="revolute"><parent>a</parent><child>b</child><axis><xyz>0 1 0</xyz></axis>
</joint><joint name="two" type="revolute"><parent>b</parent><child>c</child><axis><xyz>0 1 0</xyz>
</axis></joint><joint name="three" type="revolute"><parent>a</parent><child>c</child><axis>
<xyz>0 1 0</xyz></axis></joint></model></sdf>"""

HINGE = robot("hinge", link("base", 1), link("lid", 1), joint("j", "base", "lid", "0 0 1"))


@pytest.mark.parametrize(
    ("name", "text", "words"),
    [
        ("loop.sdf", LOOP, ["five_bar"]),
        ("rock.urdf", robot("rock", link("rock", 1)), ["robot.file: "]),
        (
            "claw.urdf",
            robot(
                "claw",
                *(link(name, 1) for name in ("palm", "one", "two")),
                joint("a", "palm", "one", "0 1 0"),
                joint("b", "palm", "two", "0 1 0", rest='<mimic joint="a"/>'),
            ),
            ["robot.file: ", "a, b"],
        ),
        ("hinge.urdf", HINGE, ["'lid'", "(j)"]),
    ],
)
def test_what_no_scenario_can_be_written_for_is_reported_with_what_to_do(
    name, text, words, tmp_path
):
    (tmp_path / name).write_text(text)
    with pytest.raises(ScenarioError) as caught:
        new_scenario(str(tmp_path / name))
    message = str(caught.value)
    assert [word for word in words if word not in message] == [], message


@pytest.mark.slow
@pytest.mark.thorough
@pytest.mark.filterwarnings("ignore::drake_dae.errors.GeometryWarning")
@pytest.mark.filterwarnings("ignore::drake_dae.errors.RobotFileWarning")
@pytest.mark.parametrize(
    "name", ["pr2_description/urdf/pr2.urdf", "centauro_description/urdf/centauro.urdf"]
)
def test_a_task_that_keeps_off_singular_states_is_written_and_runs(name, tmp_path):
    """Around the start B(x) is singular at some states, along the reference it is not."""
    file = tmp_path / "task.yaml"
    assert main(["new", str(ROBOTS / name), "--out", str(file)]) == 0
    assert "# B(x) is singular beside the reference, not along it" in file.read_text()
    loop, _, record = run_scenario(load_scenario(file, ["duration=0.5"]))
    off = np.abs(record["tracking_error"] - loop.predicted_error(record)).max()
    assert off < 1e-8


@pytest.mark.slow
@pytest.mark.thorough
def test_the_campaign_runs_robots_of_packages():
    command = [sys.executable, str(Path(__file__).parents[2] / "campaign" / "real_robots.py")]
    done = subprocess.run(
        [*command, "--only", "finger_edu", "--surfaces", "plane", "--set", "duration=0.1"],
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert "1 robots; finished: {'plane': 1}" in done.stdout
