"""`drake-dae bound`, and runs of the scenario that it writes."""

import json

import pytest

from drake_dae.cli import main

SHORT = [
    *("--compiled", "false", "--set", "duration=0.5", "--set", "start.errors={}"),
    *("--set", "write={record: false, plots: false, animation: false}"),
]
MASS = "plant_parameters.link1.mass"
BOUND = [
    "bound",
    "two_link_wall",
    *SHORT,
    "--rollout",
    "--corners=8",
    "--vary",
    f"{MASS}=9.5..10.5",
]


@pytest.mark.slow
def test_a_run_says_whether_the_bound_of_its_scenario_held(tmp_path, capsys):
    file, out = tmp_path / "bounded.yaml", str(tmp_path / "run")
    assert main([*BOUND, "--after=0.1", "--out", str(file)]) == 0
    printed = capsys.readouterr().out
    assert MASS in printed
    assert f"written: {file}" in printed
    run = ["simulate", str(file), "--rollout", "--out", out, "--check"]
    main([*run, "--set", f"{MASS}=10.3"])
    printed = capsys.readouterr().out
    assert (
        "error bound from 0.1 s on, in units of the outputs: tool.z" in printed
    )  # Before the run.
    assert "The error bound held. Closest: " in printed
    assert main([*run, "--set", f"{MASS}=13.0", "--json"]) == 2
    captured = capsys.readouterr()
    assert "The error bound did not hold:\n  the error of tool.z exceeds its bound" in captured.err
    worst = json.loads(captured.out)["error_bound"]
    assert {each["signal"]["name"] for each in worst} == {"tool.z", "wall.force"}
    assert max(each["largest"] / each["bound"] for each in worst) > 1.1


@pytest.mark.slow
def test_without_a_bound_nothing_is_written(tmp_path, capsys):
    file = tmp_path / "bounded.yaml"
    ends = ["--vary", "start.errors.tool.z=0..2"]  # The tool does not reach that far.
    assert main([*BOUND, *ends, "--json", "--out", str(file)]) == 2
    report = json.loads(capsys.readouterr().out)
    assert report["bound"] is None
    assert report["failed"]
    assert not file.exists()


def test_a_file_is_not_overwritten(tmp_path, capsys):
    file = tmp_path / "bounded.yaml"
    file.write_text("mine")
    assert main([*BOUND, "--out", str(file)]) == 1
    assert "is not overwritten" in capsys.readouterr().err
    assert file.read_text() == "mine"


def test_a_bound_of_an_unknown_output_is_refused_before_the_run(tmp_path, capsys):
    wrong = ["--set", "error_bound={outputs: {tool.q: 1.0}}", "--out", str(tmp_path / "run")]
    assert main(["simulate", "two_link_wall", *SHORT, *wrong]) == 1
    assert "error_bound: no output 'tool.q'" in capsys.readouterr().err
