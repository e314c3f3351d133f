"""What a scenario refuses: the key, the value and what would be right, all problems at once."""

import pytest
from runs import scenario
from scenario_texts import two_link

from drake_dae import build_scenario, load_scenario
from drake_dae.errors import ScenarioError
from drake_dae.scenario.shipped import find_scenario

TWO_LINK = find_scenario("two_link_wall").read_text()


def refusal(*settings):
    """The message about a changed two_link_wall."""
    with pytest.raises(ScenarioError) as caught:
        build_scenario(two_link(*settings))
    message = str(caught.value)
    lines = [f"{key}: {text}" for key, text in caught.value.problems]
    assert message.splitlines() == lines
    return message


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", ["scenario: ", "'robot'"]),
        ("- a list", ["scenario: ", "['a list']"]),
        ("a: [1\nb: 2", ["s.yaml: ", "line 2: "]),
        ("robot:\n\tfile: x", ["s.yaml: ", "line 2: ", "'\\t'"]),
        ("a: \x07", ["s.yaml: ", "x0007"]),
        (b"\xff\xfe", ["s.yaml: ", "UTF-8"]),
        (TWO_LINK + "duration: 3\n", ["s.yaml: ", "line 34: ", "'duration'"]),
        (TWO_LINK.replace("joint1: 1.2", "on: 1.2"), ["s.yaml: ", "line 26: ", "'on'"]),
        (TWO_LINK + "compiled: maybe\n", ["compiled: ", "'maybe'", "auto", "[s.yaml:34]"]),
        (TWO_LINK + "---\na: 1\n", ["s.yaml: ", "line 34: "]),
        ("!Foo\n" + TWO_LINK, ["scenario: ", "!Foo"]),
        (TWO_LINK.replace("start:", "start: !Foo"), ["start: ", "!Foo"]),
        (TWO_LINK.replace("duration: 10.0", "duration: !Foo 1"), ["s.yaml: ", "line 29: ", "!Foo"]),
        (
            TWO_LINK + "x: !!python/object/apply:os.getcwd []",
            ["line 34: ", "os.getcwd"],
        ),
        (TWO_LINK.replace("gains: {", "gains: !Pole {"), ["gains: ", "!Poles", "!Pole"]),
        (TWO_LINK.replace("!Plane", ""), None),
        ("\ufeff" + TWO_LINK, None),
        ("_mine: &z 0.3\n" + TWO_LINK.replace("offset: 0.3", "offset: *z"), None),
        (
            TWO_LINK.replace("tool.z: !Sinusoids", "tool.z:"),
            ["references.tool.z: ", "!Constant", "'offset'", "!Sinusoids"],
        ),
    ],
)
def test_texts(text, words, tmp_path):
    path = tmp_path / "s.yaml"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    if words is None:
        assert load_scenario(path) == two_link()
        return
    with pytest.raises(ScenarioError) as caught:
        load_scenario(path)
    message = str(caught.value)
    assert len(message.splitlines()) == len(caught.value.problems)
    assert [word for word in words if word not in message] == [], message


SINES = "references.wall.force=!Sinusoids"
MOVE = "references.tool.z=!PointToPoint"
WELD = "constraints.0=!WeldedFrames {frame_a: world,"
PIN = "constraints.0=!CoincidentPoints {frame_a: world, point_a: [1.2, 0, 0], frame_b: link2,"
ALONG = "outputs.0=!SurfaceCoordinates"
SPRINGS = "actuation=[!FlexibleJoints {inertia: 1, stiffness:"
WALL = "{name: wall, frame: tool, surface: !Plane {point: [1.2, 0, 0], normal: [-1, 0, 0]}}"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("settings", "words"),
    [
        # Settings.
        ("duration", ["--set duration: "]),
        ("duration=[1", ["duration: ", "line 1: "]),
        ("duration=1\nfoo: 2", ["duration: ", "line 2: "]),
        # The robot's file.
        ("robot.file=no.urdf", ["robot.file: ", "/no.urdf"]),
        (
            f"robot.file={find_scenario('two_link_wall')}",
            ["robot.file: ", "two_link_wall.yaml", ".urdf"],
        ),
        # Constraints.
        ("constraints.0.name=''", ["constraints.0.name: "]),
        (f"constraints=[{WALL}, {WALL}]", ["constraints.1.name: ", "'wall'"]),
        (
            ("outputs=[]", f"constraints=[{WALL}, {WALL.replace('name: wall', 'name: b')}]"),
            ["constraints: ", "(2)"],
        ),
        ("constraints.0.surface.point=[3, 0, 0]", ["start.positions: ", "wall.distance"]),
        # Welds and pins.
        (f"{WELD} frame_b: tool}}", ["outputs: ", "6", "2"]),
        (
            ("outputs=[]", f"{PIN} point_b: [1, 0, 0], axes: yz}}"),
            ["constraints: ", "'pin.y'"],
        ),
        (
            (f"{PIN} point_b: [1, 0, 0], axes: x}}", f"{ALONG} {{constraint: pin}}"),
            ["outputs.0: ", "'pin'"],
        ),
        # Outputs.
        ("outputs.0.axes=xz", ["outputs: ", "1", "2", "(tool.x, tool.z)"]),
        ("judgement.tolerances={tool.z: -1}", ["judgement.tolerances.tool.z: ", "-1"]),
        ("judgement.tolerances={tool.q: 1}", ["judgement.tolerances: ", "'tool.q'"]),
        # Gains.
        ("law.gains.all=[1]", ["gains: ", "Hurwitz"]),
        ("law.gains=!Matrices {groups: [[[[1, 0]], [[1]]]]}", ["gains: ", "(1, 2)", "tool.z"]),
        # References.
        ("references={}", ["references: ", "tool.z", "wall.force"]),
        (
            "references.tool.z=!Constant {values: [1, 2, 3]}",
            ["references.tool.z: ", "3", "1", "tool.z"],
        ),
        (
            "references={'wall.force, tool.z': !Constant {values: [1]}}",
            ["references.wall.force, tool.z: ", "1", "2", "wall.force", "tool.z"],
        ),
        (
            f"{SINES} {{offset: 1, amplitudes: [], frequencies: []}}",
            ["wall.force.amplitudes: "],
        ),
        (f"{MOVE} {{start: [1], end: [2], end_time: 1, order: 1}}", ["tool.z: ", "order=2"]),
        # Actuation and force.
        (
            "actuation=[!FlexibleJoints {stiffness: [1, 2, 3], inertia: [1]}]",
            ["actuation.0: ", "stiffness"],
        ),
        (f"{SPRINGS} [[1, 0, 0], [0, 1, 0]]}}]", ["actuation.0: ", "(2,)", "(2, 2)"]),
        ("sensors.force={time_constant: 1, seed: -1}", ["sensors.force.seed: ", "-1"]),
        ("plant.parameters={link9.mass: [1]}", ["plant.parameters: ", "link9.mass", "link2.mass"]),
        # The start.
        (
            "start.positions.joint1=9",
            ["start.positions: ", "9", "-3.1416", "3.1416"],
        ),
        ("start.errors.tool.x=1", ["start.errors: ", "'tool.x'", "tool.z"]),
        ("start.errors.tool.z=5", ["start: ", "tool.z", "5.3"]),
        # The run.
        ("duration=0", ["duration: ", "0"]),
        ("integrator.integration_scheme=runge_kuta5", ["integrator: ", "'runge_kutta5'"]),
    ],
)
def test_refused_with_key_value_and_remedy(settings, words):
    message = refusal(*([settings] if isinstance(settings, str) else settings))
    assert [word for word in words if word not in message] == [], message


def test_a_file_that_is_not_there(tmp_path):
    with pytest.raises(ScenarioError, match="'nowhere'"):
        find_scenario("nowhere")
    with pytest.raises(ScenarioError, match=tmp_path.name):
        find_scenario(str(tmp_path))
    with pytest.raises(ScenarioError, match=r"gone\.yaml"):
        load_scenario(tmp_path / "gone.yaml")


@pytest.mark.parametrize(
    ("name", "setting", "words"),
    [
        (
            "two_link_wall",  # A stretched arm that touches the wall.
            "start={positions: {joint1: 0.927295218, joint2: 0}}",
            ["outputs: Assumption (4)", "start.positions"],
        ),
        (
            "seven_joint_wall",
            "start={positions: {joint1: 0}}",
            ["outputs: Assumption (5)", "start.positions"],
        ),
    ],
)
def test_a_robot_that_cannot_start_is_sent_to_its_keys(name, setting, words):
    with pytest.raises(ScenarioError) as caught:
        build_scenario(scenario(name, setting))
    message = str(caught.value)
    assert [word for word in words if word not in message] == [], message
