"""What a scenario file says is what the library makes of it."""

from dataclasses import fields

import numpy as np
import pytest
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import MultibodyPlant
from pydrake.systems.analysis import SimulatorConfig
from runs import scenario as shipped
from scenario_texts import run

import drake_dae as dd
from drake_dae.errors import ModelError, ScenarioError
from drake_dae.references import PathLimits
from drake_dae.scenario import parts as forms
from drake_dae.scenario.robot_file.robot import Pose, Robot
from drake_dae.scenario.scenario import Scenario, WeldedFramesForm, save_scenario
from drake_dae.scenario.shipped import find_scenario

LIMITS = PathLimits(0.2, 1.0)


def test_forms_that_no_shipped_scenario_has_read_back_equal(tmp_path):
    surfaces = dd.Ellipsoid((1, 2, 3), (0.1, 0.2, 0.3)), dd.Torus((1, 2, 3), (0, 0, 1), 0.5, 0.1)
    scenario = Scenario(
        description="on: ä # 'quoted'\nsecond line",
        robot=Robot("/some/where.urdf", {"other": "/else/where"}),
        constraints=[
            dd.PointOnSurface("a", surfaces[1], (0.1, 1e-17, -0.0), "c"),
            WeldedFramesForm("a", "b::c", Pose((0.1, 0.2, 0.3), (90.0, 0.0, -45.0)), "w"),
            dd.FixedDistance("a", (1.0, 2.0, 3.0), "b", (4.0, 5.0, 6.0), 1 / 3, "r"),
            dd.JointCoupler("a", "b", -1 / 3, 0.1, "m", "j"),
            dd.AxisNormalToSurface("a", surfaces[0], (0.0, 0.6, -0.8), (0.1, 0.2, 0.3), "n"),
        ],
        outputs=[dd.PointCoordinates("yes", "xy"), dd.JointPositions(["joint1", "2"])],
        forces=["c.force", dd.ForceCombination({"c.force": 1 / 3, "r.thrust": -1.0}, "d")],
        actuation=[
            dd.FlexibleJoints([[8e3, 5e2], [5e2, 6e3]], [1.0, 1 / 3], 2.0),
            dd.ElectrohydraulicServos(1e6, np.diag([1e-6, 2e-6]), np.eye(2)),
        ],
        sensors=forms.Sensors(force=forms.MeasuredForce(0.005, 0.001, [1.0, -1.0])),
        law=forms.Law(
            forms.Matrices([[[[1.0, 0.5], [0.0, 2.0]], [[3.0, 0.0], [0.0, 4.0]]]]), force_gain=2.0
        ),
        references={
            "c.d, e": dd.PointToPointReference([0.0], [1.0], 0.5, 2.0, 4),
            "f": 2.0,
            "h": dd.CircleReference([0, 1], 0.1, limits=LIMITS, turns=-2.0, phase=0.5),
            "i": dd.PolylineReference([[0, 0], [1, 0], [1, 1]], LIMITS, 0.1, order=3),
            "j": dd.WaypointsReference([[0, 0], [1, 0]], [0, 2], order=2),
            "k": dd.WaypointsReference([[0, 0], [1, 0], [0, 1]], limits=LIMITS),
            "l": dd.CsvReference("/a.csv", ["y", "z"], smoothing=0.1, start_time=2.0),
        },
        start=forms.Start({"joint1": 1e-9}, {"a.b": -1e300}),
        duration=1e-3,
        integrator=SimulatorConfig(integration_scheme="radau3", max_step_size=0.5),
        write=forms.Write(False, True, False),
    )
    save_scenario(scenario, tmp_path / "all.yaml")
    copy = dd.load_scenario(tmp_path / "all.yaml")
    assert copy == scenario
    # Not only equal as data: the objects are of their classes.
    assert copy.constraints == scenario.constraints
    assert copy.outputs == scenario.outputs
    assert copy.forces == scenario.forces
    assert copy.references == scenario.references
    assert copy.law.gains == scenario.law.gains
    assert copy.sensors.force.sample_period == 0.001
    pairs = list(zip(copy.actuation, scenario.actuation, strict=True))
    for one, other in [*pairs, (copy.sensors.force, scenario.sensors.force)]:
        assert type(one) is type(other)
        for item in fields(one):
            np.testing.assert_array_equal(getattr(one, item.name), getattr(other, item.name))
    for key in ("integration_scheme", "max_step_size", "accuracy", "use_error_control"):
        assert getattr(copy.integrator, key) == getattr(scenario.integrator, key)


def test_files_in_settings_of_a_shipped_scenario_are_in_the_working_directory(
    tmp_path, monkeypatch
):
    (tmp_path / "path.csv").write_text("time,y\n0,0\n1,0.1\n2,0\n")
    monkeypatch.chdir(tmp_path)
    chosen = shipped("two_link_wall", "references={tool.y: !Csv {file: path.csv, columns: [y]}}")
    assert chosen.references["tool.y"].table.shape == (3, 2)


def test_a_robot_file_is_relative_to_its_scenario(tmp_path, monkeypatch):
    for folder in ("robots", "scenarios"):
        (tmp_path / folder).mkdir()
    (tmp_path / "robots" / "arm.urdf").write_text(dd.shipped_model("two_link_arm.urdf").read_text())
    text, models = find_scenario("two_link_wall").read_text(), "package://drake_dae_models/"
    away = tmp_path / "scenarios" / "away.yaml"
    away.write_text(text.replace(f"{models}two_link_arm.urdf", "../robots/arm.urdf"))
    monkeypatch.chdir("/")
    scenario = dd.load_scenario(away, ["duration=0.1"])
    assert scenario.robot.file == str((tmp_path / "robots" / "arm.urdf").resolve())
    assert run(scenario)[1].time[-1] == 0.1


@pytest.mark.parametrize(
    ("setting", "read"),
    [
        ("duration=5", lambda s: s.duration == 5.0),
        ("integrator.accuracy=1e-9", lambda s: s.integrator.accuracy == 1e-9),
        ("constraints.0.surface.point.0=1.1", lambda s: s.constraints[0].surface.point[0] == 1.1),
        (
            "law.gains=!Coefficients {all: [16, 8]}",
            lambda s: s.law.gains == forms.Coefficients([16, 8]),
        ),
        ("references.wall.force=9", lambda s: s.references["wall.force"] == 9.0),
        ("references.wall.force.offset=9", lambda s: s.references["wall.force"].offset == 9.0),
        ("references.tool=0.3", lambda s: list(s.references) == ["tool.z", "wall.force", "tool"]),
        ("start.errors.tool.z=0.01", lambda s: s.start.errors == {"tool.z": 0.01}),
        ("law.gains={outputs: {tool.z: [-3]}}", lambda s: s.law.gains.outputs == {"tool.z": [-3]}),
        ("plant.parameters.link2.mass=[5]", lambda s: s.plant.parameters == {"link2.mass": [5]}),
        ("description=a b", lambda s: s.description == "a b"),
    ],
)
def test_settings(setting, read):
    assert read(shipped("two_link_wall", setting))


def test_settings_reach_names_with_dots_in_lists():
    task = "task={phases: [!Move {references: {tool.z: 0.3}, duration: 1}]}"
    (phase,) = shipped("two_link_wall", task, "task.phases.0.references.tool.z=0.4").task.phases
    assert phase.references == {"tool.z": 0.4}


def test_a_run_begins_at_its_start_time_with_the_errors_there():
    scenario = shipped("two_link_wall", "integrator.start_time=3", "duration=0.5")
    _, record, distance = run(scenario)
    assert record.time[0] == 3.0
    assert record.time[-1] == 3.5
    assert record["desired_output"][0, 0] == pytest.approx(0.3 + 0.3 * np.sin(4.5), abs=1e-12)
    assert record["tracking_error"][0, 0] == pytest.approx(0.05, abs=1e-9)
    # The accuracy is 1e-8 in a step.
    assert np.max(distance) < 1e-6


TILTED = (
    "constraints=[{name: wall, frame: tool, surface: !ImplicitSurface "
    "{function: 'a * (1.2 - x) + (1 - a) * y', parameters: {a: 1.0}}}]"
)


def test_bounds_of_parameters_are_those_at_which_the_structure_is_looked_at():
    """At a = 0 the wall is y = 0, along which the whole arm moves: A(x) is zero."""
    loop, _ = dd.build_scenario(shipped("two_link_wall", TILTED, "bounds={wall.a: [0.5, 2]}"))
    for system in (loop.plant.dae, loop.controller.law.system):
        assert {p.name: p.bounds for p in system.parameters if p.bounds} == {"wall.a": (0.5, 2.0)}
    with pytest.raises(ScenarioError, match=r"A\(x\).*'wall\.a'"):
        dd.build_scenario(shipped("two_link_wall", TILTED, "bounds={wall.a: [0, 2]}"))


def test_a_model_is_found_by_its_name():
    plant = MultibodyPlant(0.0)
    (arm,) = Parser(plant).AddModels(str(dd.shipped_model("two_link_arm.urdf")))
    assert plant.GetModelInstanceName(arm) == "two_link_arm"


def test_a_name_that_is_none_is_reported_with_those_that_are():
    with pytest.raises(ModelError, match=r"two_link_arm\.urdf"):
        dd.shipped_model("two_link_arm")
