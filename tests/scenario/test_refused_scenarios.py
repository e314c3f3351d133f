"""What a scenario refuses: the key, the value and what would be right, all problems at once."""

import pytest
from scenario_texts import two_link

from drake_dae import (
    build_scenario,
    load_scenario,
)
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
        ("", ["scenario: ", "needs the key 'robot'"]),
        ("# only a comment", ["needs the key 'robot'"]),
        ("- a list", ["scenario: expected keys description, robot", "got ['a list']"]),
        ("word", ["scenario: expected keys", "got 'word'"]),
        ("a: [1\nb: 2", ["s.yaml: line 2: ", "expected ',' or ']'"]),
        ("robot:\n\tfile: x", ["s.yaml: line 2: ", "'\\t'"]),
        ("a: \x07", ["s.yaml: ", "x0007"]),
        (b"\xff\xfe", ["s.yaml: ", "UTF-8"]),
        (TWO_LINK + "duration: 3\n", ["s.yaml: line 34: ", "'duration' is given twice"]),
        (TWO_LINK + "3: 4\n", ["s.yaml: line 34: ", "'3' is not text"]),
        (TWO_LINK.replace("joint1: 1.2", "on: 1.2"), ["s.yaml: line 26: ", "'on' is not text"]),
        (TWO_LINK + "---\na: 1\n", ["s.yaml: line 34: ", "another document"]),
        ("!Foo\n" + TWO_LINK, ["scenario: takes no tag, got !Foo"]),
        (TWO_LINK.replace("start:", "start: !Foo"), ["start: takes no tag, got !Foo"]),
        (
            TWO_LINK.replace("references:", "references: !Foo"),
            ["references: takes no tag, ", "!Foo"],
        ),
        (TWO_LINK.replace("duration: 10.0", "duration: !Foo 1"), ["s.yaml: line 29: ", "!Foo"]),
        (TWO_LINK + "x: !!python/object/apply:os.getcwd []", ["s.yaml: line 34: ", "os.getcwd"]),
        (TWO_LINK.replace("!Poles", "!Pole"), ["gains: expected one of !Poles, ", "got !Pole"]),
        (TWO_LINK.replace("!Plane", ""), None),
        ("\ufeff" + TWO_LINK, None),
        ("_mine: &z 0.3\n" + TWO_LINK.replace("offset: 0.3", "offset: *z"), None),
        (
            TWO_LINK.replace("tool.z: !Sinusoids", "tool.z:"),
            ["references.tool.z: !Constant has no key 'offset'", "No tag is given", "!Sinusoids"],
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


SPHERE = "constraints.0.surface=!Sphere"


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
        # Keys.
        ("foo=1", ["scenario: ", "no key 'foo'", "keys: description, robot"]),
        ("duratoin=1", ["scenario: ", "did you mean 'duration'?"]),
        ("start.error=1", ["start: ", "did you mean 'errors'?"]),
        ("integrator.acuracy=1", ["integrator: ", "did you mean 'accuracy'?"]),
        ("constraints.0.surface.radius=1", ["constraints.0.surface: !Plane", "point, normal"]),
        (f"{SPHERE} {{center: [0, 0, 0]}}", ["constraints.0.surface: !Sphere needs", "'radius'"]),
        ("constraints.0={frame: tool}", ["constraints.0: ", "needs the key 'surface'"]),
        ("outputs.0=!JointPositions {}", ["outputs.0: !JointPositions needs the key 'joints'"]),
        # Settings.
        ("duration", ["--set duration: expected key=value"]),
        ("", ["--set : expected key=value"]),
        ("=1", ["--set =1: expected key=value"]),
        ("start..errors=1", ["--set start..errors=1: expected key=value"]),
        ("duration=[1", ["duration: line 1: ", "expected ',' or ']'"]),
        ("duration=1: 2", ["duration: line 1: ", "'1' is not text"]),
        ("duration=1\nfoo: 2", ["duration: line 2: "]),
        ("duration.x=1", ["duration: 10.0 has no entry 'x'"]),
        ("constraints.2=1", ["constraints: no entry '2'; entries: 0"]),
        ("constraints.-1=1", ["constraints: no entry '-1'"]),
        ("constraints.²=1", ["constraints: no entry '²'"]),
        ("constraints.wall.frame=tool", ["constraints: no entry 'wall'; entries: 0"]),
        ("gains.all.3=1", ["gains.all: no entry '3'; entries: 0"]),
        # Types.
        ("duration=abc", ["duration: expected a number, got 'abc'"]),
        ("duration=10 s", ["duration: expected a number, got '10 s'"]),
        ("duration=.nan", ["duration: expected a number, got nan"]),
        ("duration=true", ["duration: expected a number, got True"]),
        ("duration=", ["duration: expected a number, got nothing"]),
        ("duration=2020-01-01", ["duration: expected a number, got '2020-01-01'"]),
        ("constraints={}", ["constraints: expected a list, got {}"]),
        ("robot=arm.urdf", ["robot: expected keys file, packages, free, ", ", got 'arm.urdf'"]),
        ("constraints.0.surface=3", ["constraints.0.surface: expected one of !Plane, ", "got 3"]),
        ("constraints.0.frame=3", ["constraints.0.frame: expected text, got 3; ", "quotes"]),
        ("write.plots=maybe", ["write.plots: expected true or false, got 'maybe'"]),
        (f"{MOVE} {{start: [0], end: [1], end_time: 1, order: 2.5}}", ["tool.z.order: ", "whole"]),
        ("start.errors=[0.1]", ["start.errors: expected names with values, got [0.1]"]),
        ("start.positions.joint1=a", ["start.positions.joint1: expected a number, got 'a'"]),
        ("gains.all=[-4+1j]", ["gains.all.0: expected a number, got '-4+1j'"]),
        ("outputs.0=!Foo {}", ["outputs.0: expected one of !PointCoordinates, ", "got !Foo"]),
        # The robot's file.
        ("robot.file=no.urdf", ["robot.file: no file '", "/no.urdf", "folder"]),
        ("robot.file=/tmp", ["robot.file: no file '/tmp'"]),
        ("robot.file=package://x/y.urdf", ["robot.file: ", "unknown package 'x'"]),
        (
            f"robot.file={find_scenario('two_link_wall')}",
            ["robot.file: ", "two_link_wall.yaml", ".urdf"],
        ),
        # Constraints.
        ("constraints.0.frame=tol", ["constraints.0: ", "'tol'", "did you mean 'tool'?", "link2"]),
        ("constraints.0.point=[1, 2]", ["constraints.0.point: expected 3 numbers, got [1, 2]"]),
        ("constraints.0.name=", ["constraints.0.name: expected text"]),
        ("constraints.0.name=''", ["constraints.0.name: ", "name of its own"]),
        (f"constraints=[{WALL}, {WALL}]", ["constraints.1.name: ", "'wall'"]),
        (
            ("outputs=[]", f"constraints=[{WALL}, {WALL.replace('name: wall', 'name: b')}]"),
            ["constraints: Assumption (2)"],
        ),
        ("constraints.0.surface.normal=[0, 0, 0]", ["constraints.0.surface: normal", "zero"]),
        ("constraints.0.surface.normal=[0, 1]", ["0.surface.normal: expected 3 numbers"]),
        (f"{SPHERE} {{center: [0, 0, 0], radius: -1}}", ["constraints.0.surface: radius", "-1"]),
        ("constraints.0.surface.point=[3, 0, 0]", ["start.positions: ", "wall.distance"]),
        # Welds and pins.
        ("constraints.0=!Weld {}", ["0: expected one of !PointOnSurface, !WeldedFrames, !Coinc"]),
        ("constraints.0=!WeldedFrames {frame_a: world}", ["!WeldedFrames needs", "'frame_b'"]),
        ("constraints.0=!WeldedFrames {frame: tool}", ["!WeldedFrames has no key 'frame'", "_a"]),
        (f"{WELD} frame_b: tol}}", ["constraints.0: ", "'tol'", "did you mean 'tool'?"]),
        (f"{WELD} frame_b: tool, name: ''}}", ["constraints.0.name: ", "name of its own"]),
        (
            f"{WELD} frame_b: tool, pose: {{rpy_deg: [0, 90]}}}}",
            ["constraints.0.pose.rpy_deg: expected 3 numbers, got [0, 90]"],
        ),
        (
            f"{WELD} frame_b: tool, pose: {{translation: []}}}}",
            ["constraints.0.pose.translation: expected 3 numbers, got []"],
        ),
        (
            f"{WELD} frame_b: tool, pose: {{rpy: [0, 0, 0]}}}}",
            ["constraints.0.pose: has no key 'rpy'", "keys: translation, rpy_deg"],
        ),
        (f"{WELD} frame_b: tool}}", ["outputs: ", "6 constraint forces", "2 actuators"]),
        (f"{PIN} point_b: [1, 0]}}", ["constraints.0.point_b: expected 3 numbers, got [1, 0]"]),
        (f"{PIN} point_b: [1, 0, 0], axes: xx}}", ["constraints.0: axes", "'xx'"]),
        (f"{PIN} axes: x}}", ["constraints.0: !CoincidentPoints needs the key 'point_b'"]),
        (
            ("outputs=[]", f"{PIN} point_b: [1, 0, 0], axes: yz}}"),
            ["constraints: ", "'pin.y'"],
        ),
        (
            (f"{PIN} point_b: [1, 0, 0], axes: x}}", f"{ALONG} {{constraint: pin}}"),
            ["outputs.0: ", "'pin'", "no coordinates"],
        ),
        # Outputs.
        ("outputs.0.axes=xz", ["outputs: ", "1 position output", "2 (tool.x, tool.z)"]),
        ("outputs.0.axes=x", ["outputs: Assumption (5)", "'tool.x'"]),
        ("outputs.0.axes=zz", ["outputs.0: axes", "'zz'"]),
        ("outputs.0.frame=tol", ["outputs.0: ", "'tol'", "did you mean 'tool'?"]),
        ("outputs.0=!JointPositions {joints: [joint9]}", ["outputs.0: ", "'joint9'", "joint1"]),
        ("outputs.0=!SurfaceCoordinates {constraint: wal}", ["outputs.0: ", "'wal'", "'wall'?"]),
        (
            "plant_parameters={wall.position: [[1, 0, 0]]}",
            ["plant_parameters.wall.position: expected a number or a list, got [[1, 0, 0]]"],
        ),
        # Gains.
        ("gains.all=[1]", ["gains: ", "not Hurwitz", "real parts must be negative"]),
        ("gains.all=[0]", ["gains: ", "not Hurwitz"]),
        ("gains.all=[]", ["gains: ", "no gains for: tool.z"]),
        ("gains.all=[-1, -2, -3]", ["gains: ", "'tool.z'", "1 or 2 poles, got 3"]),
        ("gains.outputs={tool.z: [-1]}", ["gains: ", "'all' or 'outputs', not both"]),
        ("gains=!Poles {outputs: {tool.q: [-1]}}", ["gains: ", "unknown outputs: tool.q"]),
        ("gains=!Poles {outputs: {tool.z: [-1], wall.force: [-1]}}", ["gains: ", "wall.force"]),
        ("gains=!Coefficients {all: [16]}", ["gains: ", "'tool.z'", "2 coefficients", "got 1"]),
        ("gains=!Matrices {groups: [[[[1]]]]}", ["gains: ", "2 matrices, got 1"]),
        ("gains=!Matrices {groups: [[[[1, 0]], [[1]]]]}", ["gains: ", "(1, 2)", "tool.z"]),
        ("gains=!Matrices {groups: [[[[1, 0], [1]], [[1]]]]}", ["gains: groups: ", "lengths"]),
        # References.
        ("references={}", ["references: missing: tool.z, wall.force"]),
        ("references=[1, 2]", ["references: expected names with values, got [1, 2]"]),
        ("references={tool: 1}", ["references: missing: wall.force"]),
        ("references={tool.z: a}", ["references.tool.z: expected one of !C", "a number, "]),
        ("references={tool.z: true}", ["references.tool.z: expected one of !Constant", "got True"]),
        ("references.wall.forc=1", ["references.wall.forc: no output", "mean 'wall.force'?"]),
        ("references.tool.zz=1", ["references.tool.zz: no output 'tool.zz'", "'tool.z'?"]),
        ("references.tool=1", ["references: 'tool.z' has two, by 'tool.z' and 'tool'"]),
        ("references.tool.z, =1", ["references.tool.z, : no output ''"]),
        (
            "references.tool.z=!Constant {values: [1, 2, 3]}",
            ["references.tool.z: 3 values for 1 output: tool.z"],
        ),
        (
            "references={'wall.force, tool.z': !Constant {values: [1]}}",
            ["references.wall.force, tool.z: 1 value for 2 outputs: wall.force, tool.z"],
        ),
        ("references.wall.force=!Constant {values: []}", ["references.wall.force: values: empty"]),
        (f"{SINES} {{offset: 1, amplitudes: [1], frequencies: [1, 2]}}", ["frequencies has 2"]),
        (
            f"{SINES} {{offset: 1, amplitudes: [1, 2], frequencies: [1, 2], phases: [0]}}",
            ["references.wall.force: ", "amplitudes has 2", "phases has 1"],
        ),
        (
            f"{SINES} {{offset: 1, amplitudes: [], frequencies: []}}",
            ["wall.force: ", "at least one"],
        ),
        (f"{MOVE} {{start: [1, 2], end: [1], end_time: 1}}", ["start has 2, end has 1"]),
        (f"{MOVE} {{start: [1], end: [2], end_time: 0}}", ["references.tool.z: end_time 0"]),
        (f"{MOVE} {{start: [1], end: [2], end_time: 1, order: 1}}", ["tool.z: ", "order=2"]),
        # Actuation and force.
        ("actuation=[!FlexibleJoints {stiffness: []}]", ["actuation.0.stiffness: empty"]),
        (
            "actuation=[!FlexibleJoints {stiffness: [1, 2, 3], inertia: [1]}]",
            ["actuation.0: ", "stiffness"],
        ),
        (f"{SPRINGS} abc}}]", ["actuation.0.stiffness: ", "a matrix as a list of rows", "'abc'"]),
        (f"{SPRINGS} [1, abc]}}]", ["actuation.0.stiffness: expected a number", "got 'abc'"]),
        (f"{SPRINGS} {{a: 1}}}}]", ["actuation.0.stiffness: expected a number", "got {'a': 1}"]),
        (f"{SPRINGS} .inf}}]", ["actuation.0.stiffness: expected a number", "got inf"]),
        (f"{SPRINGS} [1, [2]]}}]", ["actuation.0.stiffness: expected a number", "got [2]"]),
        (f"{SPRINGS} [[1, [2]]]}}]", ["actuation.0.stiffness: expected a number", "got [2]"]),
        (f"{SPRINGS} [[1, 0], [0]]}}]", ["actuation.0.stiffness: the rows of [[1, 0], [0]] "]),
        (f"{SPRINGS} [[1, 2], [3, 9]]}}]", ["actuation.0: ", "stiffness must be symmetric"]),
        (f"{SPRINGS} [[1, 2], [2, 1]]}}]", ["actuation.0: ", "positive definite", "-1"]),
        (f"{SPRINGS} [[1, 0, 0], [0, 1, 0]]}}]", ["actuation.0: ", "(2,) or (2, 2)"]),
        (
            "force_feedback=!ModelForce",
            ["force_feedback: ", "!ModelForce must be followed by keys, or by {}"],
        ),
        (
            "force_feedback={gain: 1}",
            ["force_feedback: !ModelForce has no key 'gain'; keys: none", "!MeasuredForce"],
        ),
        (
            "force_feedback=!MeasuredForce {time_constant: 1, seed: -1}",
            ["force_feedback: seed: ", "got -1"],
        ),
        ("plant_parameters={link9.mass: [1]}", ["plant_parameters: ", "link9.mass", "link2.mass"]),
        # The start.
        ("start.positions.joint9=1", ["start.positions: ", "'joint9'", "there are joint1, joint2"]),
        (
            "start.positions.joint1=9",
            ["start.positions: joint1 = 9 rad is outside its limits, -3.1416 to 3.1416 rad"],
        ),
        ("start.errors.tool.x=1", ["start.errors: ", "'tool.x'", "there are tool.z"]),
        ("start.errors.wall.force=1", ["start.errors: ", "'wall.force'"]),
        ("start.errors.tool.z=5", ["start: ", "tool.z = 5.3 m", "reach"]),
        # The run.
        ("duration=-1", ["duration: ", "positive", "-1"]),
        ("duration=0", ["duration: ", "positive", "0"]),
        ("integrator.integration_scheme=runge_kuta5", ["integrator: ", "mean 'runge_kutta5'?"]),
        ("integrator.integration_scheme=cenic", ["integrator: integration_scheme: ", "'cenic'"]),
        ("integrator.integration_scheme=runge_kutta2", ["integrator: use_error_control: "]),
        ("integrator.accuracy=0", ["integrator: accuracy must be positive, got 0"]),
        ("integrator.max_step_size=-1", ["integrator: max_step_size must be positive, got -1"]),
        ("integrator.target_realtime_rate=-1", ["integrator: target_realtime_rate ", "-1"]),
    ],
)
def test_refused_with_key_value_and_remedy(settings, words):
    message = refusal(*([settings] if isinstance(settings, str) else settings))
    assert [word for word in words if word not in message] == [], message


def test_only_a_scalar_in_place_of_text_is_advised_to_go_in_quotes():
    assert refusal("constraints.0.frame=[a]") == "constraints.0.frame: expected text, got ['a']"


def test_all_problems_are_reported_at_once():
    """Also below a wrong key, in several entries of a list, and beside a missing key."""
    message = refusal(
        "outputs.0.axs=z",
        "outputs.0.frame=3",
        "start.errors={tool.z: a, b: c}",
        "duration=.nan",
        "write.plots=maybe",
    )
    assert [line.split(": ")[0] for line in message.splitlines()] == [
        *["outputs.0.frame", "outputs.0"],
        *["start.errors.tool.z", "start.errors.b"],
        *["duration", "write.plots"],
    ]
    message = refusal(f"{SPHERE} {{center: [0, 0], radius: big, side: 1, inside: 0}}")
    assert message.splitlines() == [
        "constraints.0.surface.center: expected 3 numbers, got [0, 0]",
        "constraints.0.surface.radius: expected a number, got 'big'",
        "constraints.0.surface.inside: expected true or false, got 0",
        "constraints.0.surface: !Sphere has no key 'side'; did you mean 'inside'? keys: center, "
        "radius, axis, inside",
    ]
    # What a class refuses itself, in several places.
    message = refusal(
        f"{SPHERE} {{center: [0, 0, 0], radius: -1}}",
        "outputs.0.axes=zz",
        f"{MOVE} {{start: [1], end: [2], end_time: 0}}",
    )
    keys = [line.split(": ")[0] for line in message.splitlines()]
    assert keys == ["constraints.0.surface", "outputs.0", "references.tool.z"]


def test_a_file_that_is_not_there(tmp_path):
    with pytest.raises(ScenarioError, match=r"no scenario file 'nowhere'; there are .*five_bar,"):
        find_scenario("nowhere")
    with pytest.raises(ScenarioError, match=r"did you mean 'two_link_wall'\?"):
        find_scenario("two_link_wal")
    with pytest.raises(ScenarioError, match="no scenario file"):
        find_scenario(str(tmp_path))
    with pytest.raises(ScenarioError, match=r"gone.yaml: .*No such file"):
        load_scenario(tmp_path / "gone.yaml")
