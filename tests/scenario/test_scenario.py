"""Scenario files: read, refused with one line that names the key, built, and written."""

import json
from copy import deepcopy
from dataclasses import fields

import jsonschema
import numpy as np
import pytest
from pydrake.systems.analysis import SimulatorConfig
from runs import run_scenario, scenario_validator
from two_arms import GRASP, two_arms

from drake_dae import (
    AxisCoordinates,
    AxisNormalToSurface,
    Blade,
    CoincidentPoints,
    ConstantReference,
    Cylinder,
    DcMotors,
    ElectrohydraulicServos,
    Ellipsoid,
    FixedDistance,
    FlexibleJoints,
    ForceCombination,
    JointCoupler,
    JointPositions,
    Plane,
    PointCoordinates,
    PointOnSurface,
    PointToPointReference,
    RollingBall,
    RollingWheel,
    SinusoidReference,
    Sphere,
    Squeeze,
    Torus,
    build_scenario,
    load_scenario,
    scenario_schema,
)
from drake_dae.errors import ScenarioError
from drake_dae.scenario import parts as forms
from drake_dae.scenario.forms.typed_yaml import TAG, load_yaml
from drake_dae.scenario.scenario import Scenario, save_scenario
from drake_dae.scenario.shipped import find_scenario, shipped_scenarios
from drake_dae.trace.functions import TracedFunction

TWO_LINK = find_scenario("two_link_wall").read_text()

ONE_JOINT = """<robot name="lever"><link name="world"/>
  <link name="arm"><inertial><origin xyz="0.5 0 0"/><mass value="2"/>
    <inertia ixx="0.1" iyy="0.1" izz="0.1" ixy="0" ixz="0" iyz="0"/></inertial>
    <visual><geometry>{shape}</geometry></visual></link>
  <joint name="joint" type="revolute"><parent link="world"/><child link="arm"/>
    <axis xyz="0 -1 0"/><limit lower="-3" upper="3" velocity="3" effort="40"/></joint>
  <frame name="tip" link="arm" xyz="1 0 0" rpy="0 0 0"/>{drive}</robot>"""

DRIVE = """<transmission><type>transmission_interface/SimpleTransmission</type>
  <joint name="joint"/><actuator name="motor"/></transmission>"""

LEVER = """robot: {file: lever.urdf}
constraints:
- {name: wall, frame: tip, surface: !Plane {point: [0.8, 0, 0], normal: [-1, 0, 0]}}
references: {wall.force: 10}
start: {positions: {joint: 0.6}}
duration: 0.1
"""

MESH = """v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"""


def two_link(*settings):
    return load_scenario(find_scenario("two_link_wall"), settings)


def refusal(*settings):
    """The message about a changed two_link_wall."""
    with pytest.raises(ScenarioError) as caught:
        build_scenario(two_link(*settings))
    message = str(caught.value)
    lines = [f"{key}: {text}" for key, text in caught.value.problems]
    assert message.splitlines() == lines
    return message


def lever(folder, shape='<box size="1 0.1 0.1"/>', drive=DRIVE, scenario=LEVER):
    folder.mkdir(exist_ok=True)
    (folder / "lever.urdf").write_text(ONE_JOINT.format(shape=shape, drive=drive))
    (folder / "lever.yaml").write_text(scenario)
    return folder / "lever.yaml"


def run(scenario):
    """The loop, its record, and the largest distance of each error from the predicted one."""
    loop, _, record = run_scenario(scenario)
    return loop, record, np.abs(record["tracking_error"] - loop.predicted_error(record)).max(axis=0)


# The shipped ones.


RIGID = ["two_link_wall", "seven_joint_wall", "seven_joint_dome", "two_arms", "five_bar"]


@pytest.mark.slow
@pytest.mark.parametrize("name", RIGID)
def test_rigid_scenario_has_the_predicted_error(name):
    """In 3 s all outputs move and the start errors decay by 1e-4.

    The accuracy of 1e-8 in a step leaves less than 1e-6 along the way; the force has no dynamics,
    so that its error is round-off alone.
    """
    scenario = load_scenario(find_scenario(name), ["duration=3"])
    loop, record, distance = run(scenario)
    positions = len(loop.plant.model.position_signals)
    assert record.time[-1] == 3.0
    assert np.max(distance[:positions]) < 1e-6
    assert np.max(distance[positions:]) < 1e-11
    assert np.max(np.abs(record["constraint_residual"])) < 1e-8
    # The wall's, the dome's, what squeezes the box and what preloads the pin.
    assert np.all(record["constraint_force"][:, 0] > 0.0)
    limits = loop.plant.model.links
    assert np.all(np.abs(record["control"]) < limits.effort_limits)
    pairs = zip(limits.position_limits, limits.velocity_limits, strict=True)
    low, high = map(np.concatenate, pairs)
    links = record["state"][:, : low.size]
    assert np.all((low <= links) & (links <= high))


ACTUATED = {
    "two_link_flexible": 1e-9,
    "two_link_motors": 1e-9,
    "two_link_hydraulics": 1e-9,
    "two_link_flexible_motors": 1e-8,
    "seven_joint_flexible": 1e-7,
    "seven_joint_flexible_motors": 1e-4,
}


@pytest.mark.slow
@pytest.mark.parametrize("name", ACTUATED)
def test_actuated_scenario_has_the_predicted_error(name):
    """In 1 s, relative to the start errors of some cm and 5 N.

    Steps and round-off leave 5e-11 to 8e-10 of the two-link arm's, and 1e-8 and 6e-6 of the
    seven-joint arm's, whose wrist is light. The tolerances leave a factor of ten.
    """
    scenario = load_scenario(find_scenario(name), ["duration=1"])
    loop, record, distance = run(scenario)
    signals = loop.plant.dae.output_signals
    errors = [abs(scenario.start.errors.get(signal.name, 0.03)) for signal in signals]
    assert record.time[-1] == pytest.approx(1.0, abs=1e-9)
    assert np.max(distance / errors) < ACTUATED[name]
    assert np.all(record["constraint_force"] > 0.0)
    # By then the force error has fallen.
    assert np.abs(record["tracking_error"][-1, -1]) < 0.3 * 5.0


# Drake's own contact, and one that opens, have suites of their own: the former touches without a
# force at the start.
IDEAL = [name for name in shipped_scenarios() if not name.startswith("wall_")]


@pytest.mark.slow
@pytest.mark.parametrize("name", IDEAL)
def test_shipped_scenario_runs_from_its_start_errors(name):
    scenario = load_scenario(find_scenario(name), ["duration=0.3"])
    assert scenario.description
    loop, record, distance = run(scenario)
    assert record.time[-1] == 0.3
    for i, signal in enumerate(loop.plant.dae.output_signals):
        wanted = scenario.start.errors.get(signal.name, 0.0)
        # With a degree of 0 the law meets the reference at once, if its model is right.
        if loop.controller.law.degrees[i] or not scenario.plant_parameters:
            assert record["tracking_error"][0, i] == pytest.approx(wanted, abs=1e-9)
    if not scenario.plant_parameters:
        # Accuracy 1e-8 in a step; of the actuated ones see ACTUATED.
        assert np.max(distance) < 1e-5 * max(map(abs, scenario.start.errors.values()))


@pytest.mark.slow
@pytest.mark.parametrize("name", shipped_scenarios())
def test_a_saved_scenario_reads_back_equal(name, tmp_path):
    scenario = load_scenario(find_scenario(name))
    save_scenario(scenario, tmp_path / "copy.yaml", "# A comment.")
    copy = load_scenario(tmp_path / "copy.yaml")
    assert copy == scenario
    assert (tmp_path / "copy.yaml").read_text().startswith("# A comment.\ndescription:")
    copy.integrator.accuracy *= 2.0
    assert copy != scenario


@pytest.mark.slow
@pytest.mark.parametrize("name", shipped_scenarios())
def test_the_json_schema_holds_for_shipped_scenarios(name, tmp_path):
    """As they are written, and with all keys and tags."""
    path = find_scenario(name)
    save_scenario(load_scenario(path), tmp_path / "full.yaml")
    for file in (path, tmp_path / "full.yaml"):
        data = load_yaml(file.read_text(), name)
        scenario_validator().validate(data)
        data["constraints"][0]["nmae"] = "wall"
        with pytest.raises(jsonschema.ValidationError):
            scenario_validator().validate(data)


@pytest.mark.parametrize("name", ["two_link_wall", "two_link_flexible_motors", "wall_polish"])
def test_a_schema_without_tags_is_for_plain_readers(name):
    """Of YAML without its tags, as a plain validator gets it."""
    schema = scenario_schema(tags=False)
    assert TAG not in json.dumps(schema)
    jsonschema.Draft202012Validator.check_schema(schema)

    def plain(data):
        if isinstance(data, dict):
            return {key: plain(value) for key, value in data.items() if key != TAG}
        return [*map(plain, data)] if isinstance(data, list) else data

    data = load_yaml(find_scenario(name).read_text(), name)
    validator = jsonschema.Draft202012Validator(schema)
    validator.validate(plain(data))
    for wrong in ({**plain(data), "nothing": 1}, {**plain(data), "duration": "long"}):
        with pytest.raises(jsonschema.ValidationError):
            validator.validate(wrong)


def test_every_form_reads_back_equal(tmp_path):
    surfaces = [
        Plane((1, 2, 3), (0.2, 0.3, 0.7)),
        Sphere((1, 2, 3), 0.1, (1, 0, 0), True),
        Cylinder((1, 2, 3), (0, 1, 0), 1 / 3),
        Ellipsoid((1, 2, 3), (0.1, 0.2, 0.3)),
        Torus((1, 2, 3), (0, 0, 1), 0.5, 0.1),
    ]
    scenario = Scenario(
        description="on: ä # 'quoted'\nsecond line",
        robot=forms.Robot("/some/where.urdf", {"other": "/else/where"}),
        constraints=[
            *[
                PointOnSurface("a", surface, (0.1, 1e-17, -0.0), f"c{i}")
                for i, surface in enumerate(surfaces)
            ],
            forms.WeldedFrames("a", "b::c", forms.Pose((0.1, 0.2, 0.3), (90.0, 0.0, -45.0)), "w"),
            CoincidentPoints("a", (1.0, 2.0, 3.0), "b", (4.0, 5.0, 6.0), "zx", "p"),
            FixedDistance("a", (1.0, 2.0, 3.0), "b", (4.0, 5.0, 6.0), 1 / 3, "r"),
            JointCoupler("a", "b", -1 / 3, 0.1, "m", "j"),
            AxisNormalToSurface("a", surfaces[3], (0.0, 0.6, -0.8), (0.1, 0.2, 0.3), "n"),
            Blade("a", (0.0, 0.6, 0.8), (0.1, 0.2, 0.3), "e"),
            RollingWheel("a", 0.1, (1, 0, 0), (0.1, 0.2, 0.3), (0, 1, 0), False, "l"),
            RollingBall("a", surfaces[1], 0.1, (0.1, 0.2, 0.3), (0, 1, 0), "o"),
        ],
        outputs=[
            PointCoordinates("yes", "xy"),
            AxisCoordinates("b", "z", "xy"),
            forms.SurfaceCoordinates("c0"),
            JointPositions(["joint1", "2"]),
        ],
        forces=[
            "l.traction",
            "c0.force",
            Squeeze("a", "w", "p"),
            ForceCombination({"c1.force": 1 / 3, "c2.force": -1.0}, "d"),
        ],
        actuation=[
            FlexibleJoints([[8e3, 5e2], [5e2, 6e3]], [1.0, 1 / 3], 2.0),
            DcMotors(0.1, np.array([1e-3, 2e-3]), 0.5),
            ElectrohydraulicServos(1e6, np.diag([1e-6, 2e-6]), np.eye(2)),
        ],
        force=forms.MeasuredForce(0.005, 0.001, [1.0, -1.0], gain=np.eye(2)),
        gains=forms.Matrices([[[[1.0, 0.5], [0.0, 2.0]], [[3.0, 0.0], [0.0, 4.0]]]]),
        references={
            "a": ConstantReference([1.0]),
            "b": SinusoidReference(1.0, [2.0], [3.0], [4.0]),
            "c.d, e": PointToPointReference([0.0], [1.0], 0.5, 2.0, 4),
            "f": 2.0,
        },
        start=forms.Start({"joint1": 1e-9}, {"a.b": -1e300}),
        duration=1e-3,
        integrator=SimulatorConfig(integration_scheme="radau3", max_step_size=0.5),
        write=forms.Write(False, True, False),
    )
    save_scenario(scenario, tmp_path / "all.yaml")
    copy = load_scenario(tmp_path / "all.yaml")
    assert copy == scenario
    # Not only equal as data: the objects are of their classes.
    assert copy.constraints == scenario.constraints
    assert copy.outputs == scenario.outputs
    assert copy.forces == scenario.forces
    assert copy.references == scenario.references
    assert copy.gains == scenario.gains
    assert copy.force.sensor(2).sample_period == 0.001
    pairs = list(zip(copy.actuation, scenario.actuation, strict=True))
    for one, other in [*pairs, (copy.force, scenario.force)]:
        assert type(one) is type(other)
        for item in fields(one):
            np.testing.assert_array_equal(getattr(one, item.name), getattr(other, item.name))
    for key in ("integration_scheme", "max_step_size", "accuracy", "use_error_control"):
        assert getattr(copy.integrator, key) == getattr(scenario.integrator, key)


# What a file says.


def test_defaults_are_those_of_the_dataclasses(tmp_path):
    scenario = load_scenario(lever(tmp_path))
    assert scenario.write == forms.Write(True, True, True)
    assert scenario.integrator.integration_scheme == "runge_kutta5"
    assert scenario.integrator.use_error_control
    assert scenario.gains == forms.Poles(all=[-4.0])


def test_a_robot_file_is_relative_to_its_scenario(tmp_path, monkeypatch):
    path = lever(tmp_path / "robots")
    (tmp_path / "scenarios").mkdir()
    away = tmp_path / "scenarios" / "away.yaml"
    away.write_text(path.read_text().replace("lever.urdf", "../robots/lever.urdf"))
    monkeypatch.chdir("/")
    scenario = load_scenario(away)
    assert scenario.robot.file == str((tmp_path / "robots" / "lever.urdf").resolve())
    assert run(scenario)[1].time[-1] == 0.1


def test_packages_of_a_robot(tmp_path):
    path = lever(tmp_path / "robots")
    settings = ["robot.file=package://mine/lever.urdf", "robot.packages.mine=."]
    assert build_scenario(load_scenario(path, settings))[0].plant.dae.name == "lever"


@pytest.mark.parametrize(
    ("setting", "read"),
    [
        ("duration=5", lambda s: s.duration == 5.0),
        ("integrator.accuracy=1e-9", lambda s: s.integrator.accuracy == 1e-9),
        ("write.plots=false", lambda s: s.write.plots is False),
        ("constraints.0.surface.point.0=1.1", lambda s: s.constraints[0].surface.point[0] == 1.1),
        ("constraints.0.surface.point=[1, 0, 0]", lambda s: s.constraints[0].surface.point[0] == 1),
        ("gains=!Coefficients {all: [16, 8]}", lambda s: s.gains == forms.Coefficients([16, 8])),
        ("references.wall.force=9", lambda s: s.references["wall.force"] == 9.0),
        ("references.wall.force.offset=9", lambda s: s.references["wall.force"].offset == 9.0),
        ("references.tool=0.3", lambda s: list(s.references) == ["tool.z", "wall.force", "tool"]),
        ("start.errors.tool.z=0.01", lambda s: s.start.errors == {"tool.z": 0.01}),
        ("gains={outputs: {tool.z: [-3]}}", lambda s: s.gains.outputs == {"tool.z": [-3]}),
        ("tolerances.outputs.tool.z=2", lambda s: s.tolerances.outputs == {"tool.z": 2.0}),
        ("plant_parameters.link2.mass=[5]", lambda s: s.plant_parameters == {"link2.mass": [5]}),
        ("description=a b", lambda s: s.description == "a b"),
        ("description=", None),
    ],
)
def test_settings(setting, read):
    if read is None:
        with pytest.raises(ScenarioError, match="description: expected text, got nothing"):
            two_link(setting)
    else:
        assert read(two_link(setting))


def test_settings_reach_names_with_dots_in_lists():
    task = "task={phases: [!Move {references: {tool.z: 0.3}, duration: 1}]}"
    (phase,) = two_link(task, "task.phases.0.references.tool.z=0.4").task.phases
    assert phase.references == {"tool.z": 0.4}


def test_later_settings_see_earlier_ones():
    change = ["constraints.0.surface=!Sphere {center: [0, 0, 0], radius: 1}"]
    change.append("constraints.0.surface.radius=2")
    assert two_link(*change).constraints[0].surface == Sphere((0, 0, 0), 2.0)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("form", "surface"),
    [
        ("!Plane {point: [1.2, 0, 0], normal: [-1, 0, 0]}", Plane((1.2, 0, 0), (-1, 0, 0))),
        (
            "!Sphere {center: [1.4, 0, 0.3], radius: 0.3, axis: [0, 1, 0]}",
            Sphere((1.4, 0, 0.3), 0.3, (0, 1, 0)),
        ),
        (
            "!Cylinder {point: [1, 0, 0.3], axis: [0, 1, 0], radius: 0.4, inside: true}",
            Cylinder((1, 0, 0.3), (0, 1, 0), 0.4, True),
        ),
        (
            "!Ellipsoid {center: [1.5, 0, 0.3], semi_axes: [0.4, 0.5, 0.6]}",
            Ellipsoid((1.5, 0, 0.3), (0.4, 0.5, 0.6)),
        ),
        (
            "!Torus {center: [1.6, 0, 0.3], axis: [0, 1, 0], major_radius: 0.4, minor_radius: 0.1}",
            Torus((1.6, 0, 0.3), (0, 1, 0), 0.4, 0.1),
        ),
    ],
)
def test_surfaces(form, surface):
    still = "references={tool.z: 0.3, wall.force: 20}"
    scenario = two_link(f"constraints.0.surface={form}", still, "duration=0.2")
    loop, record, distance = run(scenario)
    assert loop.plant.model.constraints[0].surface == surface
    # The accuracy is 1e-8 in a step.
    assert np.max(distance) < 1e-6
    np.testing.assert_allclose(record["constraint_force"], 20.0, atol=1e-10)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("form", "poles"),
    [
        ("!Poles {all: [-3, -5]}", [-5, -3]),
        ("!Poles {outputs: {tool.z: [-2]}}", [-2, -2]),
        ("!Coefficients {all: [25, 6]}", [-3 - 4j, -3 + 4j]),
        ("!Coefficients {outputs: {tool.z: [15, 8]}}", [-5, -3]),
        ("!Matrices {groups: [[[[15]], [[8]]]]}", [-5, -3]),
    ],
)
def test_gains(form, poles):
    loop, _ = build_scenario(two_link(f"gains={form}"))
    # A double pole is found to the root of the round-off.
    found = np.sort_complex(loop.controller.law.gains.poles)
    np.testing.assert_allclose(found, poles, atol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("form", "signal"),
    [
        ("!Constant {values: [0.4]}", ConstantReference([0.4])),
        (
            "!Sinusoids {offset: 0.3, amplitudes: [0.1, 0.2], frequencies: [1, 2]}",
            SinusoidReference(0.3, [0.1, 0.2], [1, 2]),
        ),
        (
            "!Sinusoids {offset: 0.3, amplitudes: [0.1], frequencies: [1], phases: [0.5]}",
            SinusoidReference(0.3, [0.1], [1], [0.5]),
        ),
        (
            "!PointToPoint {start: [0.2], end: [0.4], start_time: 0.5, end_time: 2, order: 3}",
            PointToPointReference([0.2], [0.4], 0.5, 2, 3),
        ),
        (
            "!PointToPoint {start: [0.2], end: [0.4], end_time: 2}",
            PointToPointReference([0.2], [0.4], 0, 2),
        ),
    ],
)
def test_references(form, signal):
    loop, _ = build_scenario(two_link(f"references.tool.z={form}"))
    truth = signal.derivatives([2])
    for time in (0.0, 0.7, 1.3):
        np.testing.assert_allclose(loop.reference.reference(time)[:3], truth(time), atol=1e-15)


def test_outputs():
    """The outputs of seven_joint_wall in other words."""
    settings = [
        "outputs.0=!SurfaceCoordinates {constraint: wall}",
        "start.errors={wall.across: 0.02}",
        "references={wall: !Constant {values: [0, 0.6]}, tool.z_axis: 0, 'joint3, joint7': 0, "
        "wall.force: 20}",
    ]
    loop, context = build_scenario(load_scenario(find_scenario("seven_joint_wall"), settings))
    names = [signal.name for signal in loop.plant.dae.output_signals]
    assert names[:3] == ["wall.along", "wall.across", "tool.z_axis.y"]
    assert names[3:] == ["tool.z_axis.z", "joint3", "joint7", "wall.force"]
    error = loop.diagram.GetOutputPort("tracking_error").Eval(context)
    np.testing.assert_allclose(error, [0, 0.02, 0, 0, 0, 0, 0], atol=1e-9)


def test_a_run_begins_at_its_start_time_with_the_errors_there():
    scenario = two_link("integrator.start_time=3", "duration=0.5")
    _, record, distance = run(scenario)
    assert record.time[0] == 3.0
    assert record.time[-1] == 3.5
    assert record["desired_output"][0, 0] == pytest.approx(0.3 + 0.3 * np.sin(4.5), abs=1e-12)
    assert record["tracking_error"][0, 0] == pytest.approx(0.05, abs=1e-9)
    # The accuracy is 1e-8 in a step.
    assert np.max(distance) < 1e-6


def test_a_start_is_at_rest():
    loop, context = build_scenario(two_link("integrator.start_time=3"))
    assert context.get_time() == 3.0
    state = loop.plant.state(loop.plant.GetMyContextFromRoot(context))
    np.testing.assert_array_equal(state[2:], 0.0)


def test_build_leaves_the_scenario_alone():
    scenario = two_link(
        "references.tool.z={_tag: '!Sinusoids', offset: 0.3, amplitudes: [0.1], frequencies: [1]}"
    )
    before = deepcopy(scenario)
    build_scenario(scenario)
    assert scenario == before


@pytest.mark.slow
def test_weld():
    """The shipped scenario is the model of tests/support/two_arms.py."""
    loop, _ = build_scenario(load_scenario(find_scenario("two_arms")))
    (weld,) = loop.plant.model.constraints
    assert (weld.frame_a, weld.frame_b, weld.name) == (GRASP.frame_a, GRASP.frame_b, "grasp")
    np.testing.assert_allclose(
        weld.pose.GetAsMatrix4(), GRASP.pose.GetAsMatrix4(), rtol=0, atol=1e-15
    )
    ours, wanted = loop.plant.dae, two_arms().dae
    assert ours.name == "two_arms"
    for name in ("state_signals", "control_signals", "output_signals", "constraint_input_signals"):
        assert getattr(ours, name) == getattr(wanted, name)
    # A pose that is left out is that of frames that coincide.
    plain = load_scenario(
        find_scenario("two_arms"),
        ["constraints.0=!WeldedFrames {frame_a: left::tool, frame_b: right::tool}"],
    )
    assert plain.constraints[0] == forms.WeldedFrames("left::tool", "right::tool", forms.Pose())


def test_coincident_points():
    loop, context = build_scenario(load_scenario(find_scenario("five_bar")))
    (pin,) = loop.plant.model.constraints
    assert pin == CoincidentPoints("left2", (0.5, 0, 0), "right2", (0.5, 0, 0), "xz", "pin")
    # The ends meet, by Drake's kinematics.
    plant = loop.plant.model.links.plant
    own = plant.CreateDefaultContext()
    state = loop.plant.state(loop.plant.GetMyContextFromRoot(context))
    plant.SetPositions(own, state[:4])
    left, right = (
        plant.GetFrameByName(f"{side}2").CalcPoseInWorld(own) @ np.array([0.5, 0.0, 0.0])
        for side in ("left", "right")
    )
    np.testing.assert_allclose(left, right, rtol=0, atol=1e-10)
    np.testing.assert_allclose(left, [0.12 - 0.04, 0.0, 0.55 + 0.03], rtol=0, atol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("form", "stage"),
    [
        ("!FlexibleJoints {stiffness: 8e3, inertia: 1}", FlexibleJoints(8e3, 1.0)),
        ("!FlexibleJoints {stiffness: [8e3], inertia: [1]}", FlexibleJoints(8e3, 1.0)),
        (
            "!FlexibleJoints {stiffness: [8e3, 6e3], inertia: [[1, 0.1], [0.1, 2]], damping: 3}",
            FlexibleJoints([8e3, 6e3], [[1.0, 0.1], [0.1, 2.0]], 3.0),
        ),
        (
            "!FlexibleJoints {stiffness: [[8e3, 5e2], [5e2, 6e3]], inertia: 1}",
            FlexibleJoints([[8e3, 5e2], [5e2, 6e3]], 1.0),
        ),
        (
            "!DcMotors {torque_constant: [0.5, 0.4], inductance: 0.01, resistance: 1}",
            DcMotors([0.5, 0.4], 0.01, 1.0),
        ),
        (
            "!ElectrohydraulicServos {stiffness: 1e6, leakage: [[2e-6, 1e-6], [1e-6, 3e-6]], "
            "geometry: [[0.05, 0.01], [0, 0.04]]}",
            ElectrohydraulicServos(1e6, [[2e-6, 1e-6], [1e-6, 3e-6]], [[0.05, 0.01], [0, 0.04]]),
        ),
    ],
)
def test_stages(form, stage):
    """Numbers, diagonals and full matrices reach the equations: x' is that of the stage in Python.

    The rows of G = [[0.05, 0.01], [0, 0.04]] and its columns differ, so that a transposed matrix
    would show.
    """
    loop, context = build_scenario(two_link(f"actuation=[{form}]"))
    model = loop.plant.model
    rebuilt = type(model)(model.links, model.constraints, model.positions, actuation=[stage])
    assert [p.name for p in rebuilt.dae.parameters] == [p.name for p in model.dae.parameters]
    np.testing.assert_array_equal(rebuilt.dae.parameter_values, model.dae.parameter_values)
    state = loop.plant.state(loop.plant.GetMyContextFromRoot(context))
    state = state + 0.1 * np.random.default_rng(0).standard_normal(state.size)
    rates = []
    for dae in (model.dae, rebuilt.dae):
        inputs = [dae.state, dae.parameter_symbol]
        function = TracedFunction("f", dict(zip("xp", inputs, strict=True)), {"f": dae.f})
        rates.append(function(state, dae.parameter_values)[0])
    np.testing.assert_array_equal(*rates)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("gain", "matrix"),
    [
        ("2", 2.0 * np.eye(2)),
        ("[2]", 2.0 * np.eye(2)),
        ("[[2, 0.5], [0.5, 3]]", [[2, 0.5], [0.5, 3]]),
    ],
)
def test_force_gain(gain, matrix):
    force = f"force=!MeasuredForce {{time_constant: 0.01, gain: {gain}}}"
    loop, _ = build_scenario(load_scenario(find_scenario("five_bar"), [force]))
    np.testing.assert_array_equal(loop.controller.law.measured_force.gain, matrix)


# Robots of one's own.


def test_a_lever_has_nothing_to_move_but_presses(tmp_path):
    """One joint, one contact: the force alone is an output, and needs no gain."""
    loop, record, _ = run(load_scenario(lever(tmp_path)))
    assert loop.controller.law.degrees == (0,)
    # The wall helps against gravity: u + lambda sin(q) 1 m = m g cos(q) 0.5 m, and cos(q) = 0.8.
    np.testing.assert_allclose(record["state"][:, 0], np.arccos(0.8), rtol=1e-12)
    np.testing.assert_allclose(record["control"], 2.0 * 9.81 * 0.5 * 0.8 - 10.0 * 0.6, rtol=1e-12)


def test_a_robot_with_a_mesh(tmp_path):
    path = lever(tmp_path, shape='<mesh filename="shape.obj"/>')
    (tmp_path / "shape.obj").write_text(MESH)
    loop, _ = build_scenario(load_scenario(path))
    links = loop.plant.model.links
    assert len(links.plant.GetVisualGeometriesForBody(links.plant.GetBodyByName("arm"))) == 1


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"drive": ""}, ["robot.actuators: no joint of 'lever.urdf' is driven", "all"]),
        ({"shape": '<mesh filename="shape.obj"/>'}, ["robot.file: ", "shape.obj", "not exist"]),
        ({"drive": "<transmission>"}, ["robot.file: ", "lever.urdf", "XML"]),
        ({"world": "base"}, ["robot.file: ", "body 'base' is free", "quaternion", "{weld: base}"]),
        ({"scenario": LEVER.replace("0.8", "1.8")}, ["start.positions: ", "wall.distance"]),
    ],
)
def test_a_robot_that_does_not_fit(change, words, tmp_path):
    world = change.pop("world", None)
    path = lever(tmp_path, **change)
    if world:
        inertia = '<inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" '
        text = (tmp_path / "lever.urdf").read_text()
        text = text.replace(
            '<link name="world"/>', f'<link name="base">{inertia}iyz="0"/></inertial></link>'
        )
        (tmp_path / "lever.urdf").write_text(text.replace('link="world"', 'link="base"'))
    with pytest.raises(ScenarioError) as caught:
        build_scenario(load_scenario(path))
    message = str(caught.value)
    assert "\n" not in message
    assert [word for word in words if word not in message] == [], message


# What is refused.


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
        ("robot.file=no.urdf", ["robot.file: no file '", "scenarios/no.urdf", "folder"]),
        ("robot.file=/tmp", ["robot.file: no file '/tmp'"]),
        ("robot.file=package://x/y.urdf", ["robot.file: ", "unknown package 'x'"]),
        ("robot.file=two_link_wall.yaml", ["robot.file: ", "two_link_wall.yaml", ".urdf"]),
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
        ("references={}", ["references: left without one: tool.z, wall.force"]),
        ("references=[1, 2]", ["references: expected names with values, got [1, 2]"]),
        ("references={tool: 1}", ["references: left without one: wall.force"]),
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
        ("force=!ModelForce", ["force: ", "!ModelForce must be followed by keys, or by {}"]),
        ("force={gain: 1}", ["force: !ModelForce has no key 'gain'; keys: none", "!MeasuredForce"]),
        ("force=!MeasuredForce {time_constant: 1, seed: -1}", ["force: seed: ", "got -1"]),
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


def test_all_problems_are_told_at_once():
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
