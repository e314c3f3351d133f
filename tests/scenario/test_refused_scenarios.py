"""What a scenario refuses: the key, the value and what would be right, all problems at once."""

import pytest
from runs import scenario
from scenario_texts import written

from drake_dae import build_scenario, load_scenario
from drake_dae.errors import ScenarioError
from drake_dae.scenario.shipped import find_scenario

TWO_LINK = find_scenario("two_link_wall").read_text()


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", ["scenario: ", "'robot'"]),
        ("- a list", ["scenario: ", "['a list']"]),
        ("robot:\n\tfile: x", ["s.yaml: ", "line 2: ", "'\\t'"]),
        (b"\xff\xfe", ["s.yaml: ", "UTF-8"]),
        (TWO_LINK + "duration: 3\n", ["s.yaml: ", "line 34: ", "'duration'"]),
        (TWO_LINK.replace("joint1: 1.2", "on: 1.2"), ["s.yaml: ", "line 26: ", "'on'"]),
        (TWO_LINK + "compiled: maybe\n", ["compiled: ", "'maybe'", "auto", "[s.yaml:34]"]),
        (TWO_LINK + "---\na: 1\n", ["s.yaml: ", "line 34: "]),
        (TWO_LINK.replace("duration: 10.0", "duration: !Foo 1"), ["s.yaml: ", "line 29: ", "!Foo"]),
        (TWO_LINK + "x: !!python/object/apply:os.getcwd []", ["line 34: ", "os.getcwd"]),
        (TWO_LINK.replace("gains: {", "gains: !Pole {"), ["gains: ", "!Poles", "!Pole"]),
        (TWO_LINK.replace("!Plane", ""), None),
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
        assert load_scenario(path) == scenario("two_link_wall")
        return
    with pytest.raises(ScenarioError) as caught:
        load_scenario(path)
    message = str(caught.value)
    assert len(message.splitlines()) == len(caught.value.problems)
    assert [word for word in words if word not in message] == [], message


PIN = "constraints.0=!CoincidentPoints {frame_a: world, point_a: [1.2, 0, 0], frame_b: link2,"
PIN = f"{PIN} point_b: [1, 0, 0], axes:"
WALL = "{name: wall, frame: tool, surface: {point: [1.2, 0, 0], normal: [-1, 0, 0]}}"
TWO_WALLS = f"constraints=[{WALL}, {WALL.replace('name: wall', 'name: b')}]"
LINE, GENTLE = (
    "references.tool.z=!Line {start: [0.2], end:",
    "limits: {speed: 0.2, acceleration: 1}",
)
DWELL = "!Dwell {name: away, until: [{of: signal, name: go, above: 0.5}]}"
ENCODERS = "sensors.encoders={position_noise: 1.0e-5}", "estimator={rate: 60, state_rate: 200}"
ROD = (
    "!FixedDistance {frame_a: world, point_a: [0, 0, 0], frame_b: tool, point_b: [0, 0, 0], "
    "length: 0}"
)
# Scenario -> its settings -> parts of the message, between which "|" stands.
REFUSED = {
    "two_link_wall": {
        f"constraints.0={ROD}": "constraints.0: |'rod.length'",
        "forces=[wall]": "forces.0: |'wall'|wall.force",
        "forces=[wall.force, wall.force]": "forces: a force output is named twice: wall.force",
        "robot.actuators=[]": "outputs: |no actuators",
        # Settings and the run.
        "duration": "--set duration: ",
        "duration=[1": "duration: |line 1: ",
        "duration=0": "duration: |0",
        "integrator.integration_scheme=runge_kuta5": "integrator: |'runge_kutta5'",
        # The robot's file and parameters.
        "robot.file=no.urdf": "robot.file: |/no.urdf",
        f"robot.file={find_scenario('two_link_wall')}": "robot.file: |two_link_wall.yaml|.urdf",
        "plant.parameters={link9.mass: [1]}": "plant.parameters: |link9.mass|link2.mass",
        "bounds={link2.mass: [12, 6]}": "bounds: |'link2.mass'",
        "bounds={link2.mass: [6]}": "bounds.link2.mass: |[6]",
        # Constraints.
        "constraints.0.name=''": "constraints.0.name: ",
        f"constraints=[{WALL}, {WALL}]": "constraints.1.name: |'wall'",
        ("outputs=[]", TWO_WALLS): "constraints: |(2)",
        "constraints.0.surface.point=[3, 0, 0]": "start.positions: |wall.distance",
        "constraints.0=!WeldedFrames {frame_a: world, frame_b: tool}": "outputs: |6|2",
        ("outputs=[]", f"{PIN} yz}}"): "constraints: |'pin.y'",
        (f"{PIN} x}}", "outputs.0=!SurfaceCoordinates {constraint: pin}"): "outputs.0: |'pin'",
        "constraints.0.surface=!ImplicitSurface {function: z - q}": (
            "constraints.0.surface: |column 5|'q'"
        ),
        "constraints.0.surface=!MeasuredSurface {size: [1, 1], heights: [[0, 1], [1]]}": (
            "constraints.0.surface.heights: |length"
        ),
        # Outputs, gains, actuation, force, and what the plant has alone.
        ("sensors.force={}", "law.force_gain=1"): "time_constant",
        ("sensors.force={sample_period: 0.01}", "law.force_gain=2"): "sensors.force: ",
        "plant.disturbances=[{frame: tol, force: [0, 0, 1]}]": "plant.disturbances.0: |'tol'",
        "plant.payloads=[{frame: tool, mass: 0}]": "plant.payloads.0: |mass",
        ("outputs=[]", "forces=[]", "references={}"): "outputs: |2",
        "outputs.0.axes=xz": "outputs: |1|2|(tool.x, tool.z)",
        "judgement.tolerances={tool.q: 1}": "judgement.tolerances: |'tool.q'",
        "law.gains.all=[1]": "gains: |Hurwitz",
        "law.gains=!Matrices {groups: [[[[1, 0]], [[1]]]]}": "gains: |(1, 2)|tool.z",
        "actuation=[!FlexibleJoints {stiffness: [1, 2, 3], inertia: [1]}]": (
            "actuation.0: |stiffness"
        ),
        "sensors.force={time_constant: 1, seed: -1}": "sensors.force.seed: |-1",
        # References.
        "references={}": "references: |tool.z|wall.force",
        "references.tool.z=!Constant {values: [1, 2, 3]}": "references.tool.z: |3|1|tool.z",
        "references={'wall.force, tool.z': !Constant {values: [1]}}": (
            "references.wall.force, tool.z: |1|2"
        ),
        "references.tool.z=!PointToPoint {start: [1], end: [2], end_time: 1, order: 1}": (
            "tool.z: |order=2"
        ),
        f"{LINE} [0.3], limits: {{speed: 1}}}}": "references.tool.z.limits: ",
        f"references.tool.z=!Polyline {{points: [[0], [0]], corner: 0.1, {GENTLE}}}": (
            "references.tool.z: points 0 and 1"
        ),
        "references.tool.z=!Csv {file: none.csv, columns: [z]}": "references.tool.z|/none.csv'",
        # The start.
        "start.positions.joint1=9": "start.positions: |9|-3.1416|3.1416",
        "start.errors.tool.x=1": "start.errors: |'tool.x'|tool.z",
        "start.errors.tool.z=5": "start: |tool.z|5.3",
        # A stretched arm that touches the wall.
        "start={positions: {joint1: 0.927295218, joint2: 0}}": (
            "outputs: Assumption (4)|start.positions"
        ),
    },
    "seven_joint_wall": {
        "start={positions: {joint1: 0}}": "outputs: Assumption (5)|start.positions"
    },
    "seven_joint_pipe": {
        "outputs.0=!PointCoordinates {frame: tool, axes: yz}": "pipe.a|!SurfaceCoordinates"
    },
    "three_fingers": {
        "robot.free=[objct]": "robot.free: |'objct'",
        "forces.1.frame=obj": "forces.1: |'grip2'|'obj'",
        "forces.2=!ForceCombination {weights: {grip1.f: 1}, name: a}": "forces.2: |'grip1.f'",
    },
    "seven_joint_moving_plate": {
        "exogenous={plate.positio: []}": "exogenous: |'plate.positio'",
        "exogenous={plate.rpy: []}": "plate.rpy: |3|0",
    },
    "task": {
        "task.phases=[]": "task: ",
        "task.phases.0.speed=-1": "task.phases.0: |speed|-1",
        "task.phases.2.references={tool.x: 1}": "Move: |'tool.x'",
        "task.contact=floor": "task.contact: 'floor'",
        "references={tool.z: 0.3}": "references: ",
        "law.integral=[wall.force]": "integral: |wall.force",
        "task.phases.0={name: feel, on_failure: park}": "task: |feel: on_failure: |'park'",
        f"task.phases.2={DWELL}": "task.signals.go",
        "task.signals={go: 1}": "'go'",
        "plant=!IdealConstraints {}": "task|CompliantContact",
    },
    "observed_task": {
        ("sensors.force=null", *ENCODERS): "observer",
        "task.contact_force=0.1": "contact_force: |0.3|0.1",
        "task.tare_time=0.01": "task: tare_time: |0.01",
    },
}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "settings"),
    [(name, settings) for name, cases in REFUSED.items() for settings in cases],
)
def test_refused_with_key_value_and_remedy(name, settings, tmp_path):
    path = written(name, tmp_path)
    with pytest.raises(ScenarioError) as caught:
        build_scenario(load_scenario(path, [settings] if isinstance(settings, str) else settings))
    message, problems = str(caught.value), caught.value.problems
    assert message.splitlines() == [f"{key}: {text}" for key, text in problems]
    words = REFUSED[name][settings].split("|")
    assert [word for word in words if word not in message] == [], message


def test_a_file_that_is_not_there(tmp_path):
    with pytest.raises(ScenarioError, match="'nowhere'"):
        find_scenario("nowhere")
    with pytest.raises(ScenarioError, match=tmp_path.name):
        find_scenario(str(tmp_path))
    with pytest.raises(ScenarioError, match=r"gone\.yaml"):
        load_scenario(tmp_path / "gone.yaml")
