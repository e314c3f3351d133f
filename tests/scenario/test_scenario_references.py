"""References in scenarios: each kind as a file says it, what is refused, and a run behind them."""

import pytest
from runs import scenario

from drake_dae import (
    CircleReference,
    CsvReference,
    LineReference,
    PolylineReference,
    WaypointsReference,
    build_scenario,
    load_scenario,
)
from drake_dae.errors import ScenarioError
from drake_dae.references import PathLimits
from drake_dae.scenario.scenario import save_scenario
from drake_dae.scenario.shipped import find_scenario

GENTLE = "limits: {speed: 0.2, acceleration: 1}"
LIMITS = PathLimits(0.2, 1.0)
FORMS = {
    f"!Line {{start: [0, 1], end: [1, 2], {GENTLE}}}": LineReference([0, 1], [1, 2], LIMITS),
    "!Circle {center: [0, 1], radius: 0.1, period: 3}": CircleReference([0, 1], 0.1, 3.0),
    f"!Circle {{center: [0, 1], radius: 0.1, turns: -2, phase: 0.5, {GENTLE}}}": CircleReference(
        [0, 1], 0.1, limits=LIMITS, turns=-2.0, phase=0.5
    ),
    f"!Polyline {{points: [[0, 0], [1, 0], [1, 1]], corner: 0.1, order: 3, {GENTLE}}}": (
        PolylineReference([[0, 0], [1, 0], [1, 1]], LIMITS, 0.1, order=3)
    ),
    "!Waypoints {points: [[0, 0], [1, 0]], times: [0, 2], order: 2}": (
        WaypointsReference([[0, 0], [1, 0]], [0, 2], order=2)
    ),
    f"!Waypoints {{points: [[0, 0], [1, 0], [0, 1]], {GENTLE}}}": (
        WaypointsReference([[0, 0], [1, 0], [0, 1]], limits=LIMITS)
    ),
    "!Csv {file: /a.csv, columns: [y, z], smoothing: 0.1, start_time: 2}": CsvReference(
        "/a.csv", ["y", "z"], smoothing=0.1, start_time=2.0
    ),
}


@pytest.mark.parametrize("form", FORMS)
def test_a_form_is_its_reference_and_is_written_as_such(form, tmp_path):
    chosen = scenario("two_link_wall", f"references={{tool: {form}}}")
    assert chosen.references == {"tool": FORMS[form]}
    save_scenario(chosen, tmp_path / "copy.yaml")
    assert load_scenario(tmp_path / "copy.yaml").references == chosen.references


def refusal(form):
    with pytest.raises(ScenarioError) as caught:
        build_scenario(scenario("two_link_wall", f"references.tool.z={form}"))
    return str(caught.value)


@pytest.mark.parametrize(
    ("form", "message"),
    [
        ("!Line {start: [0.2], end: [0.3], limits: {speed: 1}}", ".limits: "),
        (
            "!Line {start: [0.2], end: [0.3], limits: {speed: 1, acceleration: 0}}",
            ".limits: acceleration",
        ),
        (f"!Line {{start: [0.2], end: [[1]], {GENTLE}}}", ": end"),
        (f"!Line {{start: [0.2], end: [0.2], {GENTLE}}}", ": start and end"),
        ("!Circle {center: [0, 0], radius: 1, period: 2}", ": 2"),
        (f"!Polyline {{points: [0, 1], corner: 1, {GENTLE}}}", ".points.0: "),
        (
            f"!Polyline {{points: [[0], [0]], corner: 0.1, {GENTLE}}}",
            ": points 0 and 1",
        ),
        ("!Waypoints {points: [[0], [1]], times: [0, 0]}", "times"),
        ("!Csv {file: none.csv, columns: [z]}", "/none.csv'"),
        ("!Csv {file: 'a\0b', columns: [z]}", ""),
        (f"!Csv {{file: {find_scenario('biped')}, columns: [z]}}", "'time'"),
    ],
)
def test_what_is_wrong_is_reported_with_its_key(form, message):
    found = refusal(form)
    assert found.startswith("references.tool.z")
    assert message in found


def test_files_in_settings_of_a_shipped_scenario_are_in_the_working_directory(
    tmp_path, monkeypatch
):
    (tmp_path / "path.csv").write_text("time,y\n0,0\n1,0.1\n2,0\n")
    monkeypatch.chdir(tmp_path)
    chosen = scenario("two_link_wall", "references={tool.y: !Csv {file: path.csv, columns: [y]}}")
    assert chosen.references["tool.y"].table.shape == (3, 2)


def test_a_reference_along_a_surface_names_the_output_that_is_missing():
    chosen = scenario("seven_joint_pipe", "outputs.0=!PointCoordinates {frame: tool, axes: yz}")
    remedy = r"pipe\.a.*!SurfaceCoordinates"
    with pytest.raises(ScenarioError, match=remedy):
        build_scenario(chosen)
