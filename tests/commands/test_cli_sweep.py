"""`drake-dae sweep`: what it prints and leaves, and what it refuses."""

import json

import pytest

from drake_dae.cli import main
from drake_dae.studies.study import FILES

SHORT = ["--set", "duration=0.2", "--set", "compiled=false"]
VARY = ["--vary", "start.errors.tool.z=0..0.05:3"]


@pytest.mark.slow
def test_it_leaves_its_files_and_tells_programs_and_people(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    folder = tmp_path / "runs" / "two_link_wall-sweep"
    words = ["sweep", "two_link_wall", "--workers=1", "--vary=start.errors.tool.z=[0, 0.01, 9]"]
    assert main([*words, *SHORT, "--json", "--check"]) == 2
    found = json.loads(capsys.readouterr().out)
    assert found["outcomes"] == {"finished": 2, "no start": 1}
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


@pytest.mark.parametrize(
    ("options", "line"),
    [
        (["--vary", "start.errors.tool=0.1"], "start.errors: no output 'tool'"),
        (["--vary", "start.error=0.1"], "start: has no key 'error'; did you mean 'errors'"),
        (["--vary", "duration=1..2"], "duration: 1..2 needs the number of its values"),
        (["--vary", "duration=1..2", "--random", "0"], "count must be a whole number from 1"),
        (["--vary", "duration=1", "--workers", "0"], "workers must be a whole number from 1"),
        (["--vary", "plant.parameters.a=1"], "plant.parameters: two_link_arm: no parameter 'a'"),
    ],
)
def test_errors_are_reported_before_anything_runs(options, line, tmp_path, capsys):
    folder = tmp_path / "out"
    assert main(["sweep", "two_link_wall", *options, *SHORT, "--out", str(folder)]) == 1
    (said,) = capsys.readouterr().err.splitlines()
    assert said.startswith("error: ")
    assert line in said
    assert not folder.exists()


def test_the_files_of_others_are_left_alone(tmp_path, capsys):
    (tmp_path / "runs.csv").write_text("mine")
    assert main(["sweep", "two_link_wall", *VARY, *SHORT, "--out", str(tmp_path)]) == 1
    assert "runs.csv" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["runs.csv"]


@pytest.mark.parametrize("options", [[], [*VARY, "--random", "3", "--together"]])
def test_wrong_usage_exits_with_2(options, capsys):
    with pytest.raises(SystemExit) as caught:
        main(["sweep", "two_link_wall", *options])
    assert caught.value.code == 2
    assert "usage: drake-dae sweep" in capsys.readouterr().err
