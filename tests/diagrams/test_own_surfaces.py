"""Surfaces of a user's own in scenarios: formulas, height maps and meshes, held as predicted."""

import json

import numpy as np
from runs import run_scenario, scenario

from drake_dae import load_scenario
from drake_dae.cli import main
from drake_dae.scenario.judging import judge_run
from drake_dae.scenario.scenario import save_scenario
from drake_dae.scenario.shipped import find_scenario

SHORT = ["duration=0.3", "integrator.max_step_size=0.005", "integrator.use_error_control=false"]
CYLINDER = "constraints.0.surface=!Cylinder {point: [1.7, 0, 0.3], axis: [0, 1, 0], radius: 0.5}"
FORMULA = (
    "constraints.0.surface=!ImplicitSurface {function: sqrt(x**2 + z**2) - r, "
    "parameters: {r: 0.5}, point: [1.7, 0, 0.3]}"
)


PLACE = "size: [0.8, 0.8], point: [1.2, 0, 0.3], normal: [-1, 0, 0]"


def bump(folder):
    """Writes a table of a bump of 3 cm."""
    y, z = np.linspace(-0.4, 0.4, 9), np.linspace(-0.4, 0.4, 41)
    heights = 0.03 * np.exp(-8.0 * z**2)[:, None] + 0.0 * y
    np.savetxt(folder / "bump.csv", heights, delimiter=",")


def test_a_formula_runs_as_the_built_in_surface():
    """The same numbers up to round-off, which error feedback does not let grow."""
    records = [
        run_scenario(scenario("two_link_wall", one, *SHORT))[2] for one in (CYLINDER, FORMULA)
    ]
    for name in ("state", "control", "constraint_force", "tracking_error"):
        np.testing.assert_allclose(records[0][name], records[1][name], rtol=1e-9, atol=1e-9)


def test_files_are_beside_the_scenario_and_what_smoothing_costs_is_in_the_summary(
    tmp_path, monkeypatch, capsys
):
    bump(tmp_path)
    text = find_scenario("two_link_wall").read_text()
    old = text[text.index("  surface: !Plane") : text.index("outputs:")]
    new = f"  surface: !MeasuredSurface {{file: bump.csv, {PLACE}}}\n"
    (tmp_path / "mine.yaml").write_text(text.replace(old, new))
    monkeypatch.chdir("/")
    options = [f"--set={one}" for one in (*SHORT, "duration=0.01", "write.plots=false")]
    assert (
        main(["simulate", str(tmp_path / "mine.yaml"), "--out", str(tmp_path / "run"), *options])
        == 0
    )
    told = "wall: MeasuredSurface 'bump.csv'"
    assert told in capsys.readouterr().out
    text = (tmp_path / "run" / "summary.txt").read_text()
    assert told in text
    assert "beyond the edge" not in text
    assert (tmp_path / "run" / "animation.html").stat().st_size > 0
    # As run it means the same file from anywhere.
    again = load_scenario(tmp_path / "run" / "scenario.yaml")
    assert str(again.constraints[0].surface.file) == str(tmp_path / "bump.csv")
    save_scenario(again, tmp_path / "run" / "again.yaml")
    assert load_scenario(tmp_path / "run" / "again.yaml") == again


def test_where_the_robot_leaves_the_data_is_reported(tmp_path):
    """The tool starts 5 cm above its reference z = 0.3, and this map ends at z = 0.34."""
    bump(tmp_path)
    file = json.dumps(str(tmp_path / "bump.csv"))
    place = PLACE.replace("[0.8, 0.8]", "[0.8, 0.08]")
    surface = f"constraints.0.surface=!MeasuredSurface {{file: {file}, {place}, scale: 0.01}}"
    case = scenario("two_link_wall", surface, *SHORT, "duration=0.02")
    loop, context, record = run_scenario(case)
    _, told = judge_run(case, loop, context, record).notes
    assert "wall: the robot is beyond the edge of the data by up to 1" in told
    assert "1 mm, first at 0 s; there the surface continues as a plane" in told
