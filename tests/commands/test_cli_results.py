"""What commands tell programs, JSON and exit codes, and what of earlier runs they keep."""

import json

import pytest

from drake_dae import Record
from drake_dae.cli import main
from drake_dae.studies.study import FILES

BARE = ("--set=write.plots=false", "--set=write.animation=false")
QUICK = ("--set=duration=0.2", *BARE)


def told(arguments, capsys):
    """The exit code, and what was printed as JSON."""
    code = main([*map(str, arguments)])
    return code, json.loads(capsys.readouterr().out)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("changes", "is_off"),
    [
        # Steps of 0.05 s are too long for Euler's method, and nothing else is wrong.
        (
            [
                "--set=integrator={integration_scheme: explicit_euler, use_error_control: false, "
                "max_step_size: 0.05}",
                "--set=duration=2",
            ],
            True,
        ),
        # The force would pull: -5 N.
        (["--set=references.wall.force=-5", "--set=duration=0.2"], False),
    ],
)
def test_a_run_that_missed_its_task_is_reported_by_code_and_json(changes, is_off, tmp_path, capsys):
    run = ["simulate", "two_link_wall", "--json", *BARE, *changes]
    code, found = told([*run, "--check", f"--out={tmp_path / 'one'}"], capsys)
    assert (code, found["missed"], found["outcome"]) == (2, True, "bad")
    assert ("prediction" in {one["kind"] for one in found["findings"]}) is is_off
    # Whoever does not ask gets 0 for a run that came to its end.
    code, again = told([*run, f"--out={tmp_path / 'two'}"], capsys)
    assert (code, again["missed"]) == (0, True)


def test_a_good_run_is_reported_with_figures_and_files(tmp_path, capsys):
    arguments = ["simulate", "two_link_wall", "--json", "--check", *QUICK, f"--out={tmp_path}"]
    code, found = told(arguments, capsys)
    assert code == 0
    assert found["folder"] == str(tmp_path)
    assert (found["missed"], found["outcome"]) == (False, "good")
    assert sorted(found["files"]) == sorted(path.name for path in tmp_path.iterdir())
    record = Record.load(tmp_path / "record.npz")
    assert found["simulated_time"] == pytest.approx(record.time[-1])
    outputs = {one["name"]: one for one in found["outputs"]}
    assert [*outputs] == [s.name for s in record.signals["tracking_error"].signals]
    assert 0.0 <= max(one["off_prediction"] for one in outputs.values()) < 1e-6


# Of a study.

SHORT = ["--set", "duration=0.2", "--set", "compiled=false"]
VARY = ["--vary", "start.errors.tool.z=0..0.05:3"]


@pytest.mark.slow
def test_it_leaves_its_files_and_tells_programs_and_people(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    folder = tmp_path / "runs" / "two_link_wall-sweep"
    words = ["sweep", "two_link_wall", "--workers=1", "--vary=start.errors.tool.z=[0, 0.01, 9]"]
    assert main([*words, *SHORT, "--json", "--check"]) == 2
    found = json.loads(capsys.readouterr().out)
    assert found["outcomes"] == {"finished": 2, "refused": 1}
    assert [run["run"] for run in found["not_finished"]] == [2]
    extent = found["figures"]["largest error of tool.z [m]"]
    assert 0.0 <= extent["least"] <= extent["median"] <= extent["largest"] < 0.1
    assert found["files"] == ["runs.db", *FILES]
    assert {path.name for path in folder.iterdir()} == {*found["files"]}
    # It has all runs already.
    assert main([*words, *SHORT]) == 0
    printed = capsys.readouterr()
    assert printed.out.startswith("3 runs: 2 finished")
    assert printed.out.endswith(f"/: {', '.join(['runs.db', *FILES])}\n")
    assert main([*words, *SHORT[2:], "--set", "duration=0.3"]) == 1
    said = capsys.readouterr().err
    assert "duration" in said
    assert "runs/two_link_wall-sweep/runs.db" in said
