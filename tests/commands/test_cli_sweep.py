"""`drake-dae sweep`: what it prints and leaves, and what it refuses."""

import pytest

from drake_dae.cli import main
from drake_dae.studies.study import FILES

SHORT = ["--set", "duration=0.2", "--set", "compiled=false"]
VARY = ["--vary", "start.errors.tool.z=0..0.05:3"]


@pytest.mark.slow
def test_it_leaves_its_files_and_prints_the_summary(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    for _ in range(2):  # The second time it has all runs already.
        assert main(["sweep", "two_link_wall", *VARY, *SHORT, "--workers=1"]) == 0
        printed = capsys.readouterr()
        folder = tmp_path / "runs" / "two_link_wall-sweep"
        assert printed.out.startswith("3 runs: 3 finished\n")
        assert printed.out.endswith(f"/: {', '.join(['runs.db', *FILES])}\n")
        assert printed.err == ""
        assert sorted(path.name for path in folder.iterdir()) == sorted([*FILES, "runs.db"])
    other = ["sweep", "two_link_wall", *VARY, *SHORT[2:], "--set", "duration=0.3"]
    assert main(other) == 1
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
