"""Mistakes, folders that cannot be written to, runs that fail: one line, and what fits is kept."""

import os
import re
import subprocess
import sys

import numpy as np
import pytest
from command_line import BARE, SHORT, error_line
from recordings import animation

from drake_dae import Record
from drake_dae.cli import main
from drake_dae.pictures import PLOTS
from drake_dae.scenario.shipped import find_scenario


@pytest.mark.parametrize("name", ["scenario.yaml", "controls.png"])
def test_files_of_others_are_never_overwritten(name, tmp_path, capsys):
    (tmp_path / name).write_text("mine")
    assert main(["simulate", "two_link_wall", "--out", str(tmp_path), *SHORT, *BARE]) == 1
    assert re.search(rf"error: .*{name}", error_line(capsys))
    assert [path.name for path in tmp_path.iterdir()] == [name]
    assert (tmp_path / name).read_text() == "mine"


def test_a_robot_is_not_replaced_by_its_scenario(tmp_path, capsys):
    robot = tmp_path / "arm.urdf"
    robot.write_text("<robot/>")
    assert main(["new", str(robot), "--out", str(robot), "--force"]) == 1
    assert "arm.urdf" in error_line(capsys)
    assert robot.read_text() == "<robot/>"


@pytest.mark.parametrize(
    ("words", "suffix"),
    [("new arm.urdf", "html"), ("plot one", "svg"), ("page two_link_wall", "html")],
)
def test_a_file_is_replaced_by_force_alone_and_what_is_none_never(words, suffix, tmp_path, capsys):
    names = ("file", "target", "folder", "link")
    file, target, folder, link = (tmp_path / f"{name}.{suffix}" for name in names)
    for path in (file, target):
        path.write_text("mine")
    folder.mkdir()
    link.symlink_to(target)
    for path, force in ((file, []), (folder, ["--force"]), (link, ["--force"])):
        assert main([*words.split(), f"--out={path}", *force]) == 1
        assert f"'{path}'" in error_line(capsys)
    assert (file.read_text(), target.read_text()) == ("mine", "mine")


@pytest.mark.parametrize(
    ("arguments", "line"),
    [
        (["two_link_wal"], "error: .*'two_link_wal'.*'two_link_wall'"),
        (["two_link_wall", "--set", "duration=-1"], "error: duration: .*-1"),
        (["two_link_wall", "--set", "duration"], "error: --set duration: "),
        (["two_link_wall", "--set", "outputs.0.frame=tol"], "error: outputs.0: .*'tol'"),
        (["two_link_wall", "--set", "robot.file=x.urdf"], "error: robot.file: .*x.urdf"),
    ],
)
def test_a_mistake_is_one_line_and_leaves_nothing(arguments, line, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(["simulate", *arguments]) == 1
    assert re.match(line, error_line(capsys))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
def test_a_reference_out_of_reach_ends_the_run_and_keeps_the_record(tmp_path, capsys):
    """The arm is stretched out at z = 1.6 m, which the reference passes after 0.13 s."""
    move = "references.tool.z=!PointToPoint {start: [0.3], end: [3], end_time: 0.3}"
    arguments = ["simulate", "two_link_wall", "--out", str(tmp_path), "--set", "duration=0.5"]
    assert main([*arguments, "--set", move, "--set", "write.plots=false"]) == 1
    assert re.match(r"error: .* at t = 0\.1\d+ s.*, state \[", error_line(capsys))
    record = Record.load(tmp_path / "record.npz")
    assert 0.1 < record.time[-1] < 0.2
    assert 1.0 < record["controlled_output"][-1, 0] < 1.6
    text = (tmp_path / "summary.txt").read_text()
    assert re.match(r"BAD: the run broke off at 0\.1\d+ s: ", text)
    assert "simulated" not in text
    assert animation((tmp_path / "animation.html").read_text())


@pytest.mark.slow
def test_a_full_disk_prints_the_summary(tmp_path, monkeypatch, capsys):
    """And leaves no file that is cut off."""

    def fill(*_arguments, **_options):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(np, "savez_compressed", fill)
    arguments = ["simulate", "two_link_wall", "--out", str(tmp_path), "--set", "duration=0.5"]
    assert main([*arguments, "--set", "write.plots=true"]) == 1
    out, err = capsys.readouterr()
    assert "simulated            0.5 s in" in out
    assert err == f"error: {tmp_path}/record.npz: No space left on device\n"
    assert {path.name for path in tmp_path.iterdir()} == {"scenario.yaml"}


@pytest.mark.parametrize("rows", [0, 3])
@pytest.mark.parametrize("kind", ["--film", "--all", "--errors"])
def test_a_record_without_rows_or_the_signals_of_its_loop_is_one_line(kind, rows, tmp_path, capsys):
    (tmp_path / "scenario.yaml").write_text(find_scenario("two_link_wall").read_text())
    Record(np.arange(float(rows)), {}).save(tmp_path / "record.npz")
    assert (
        main(["plot", kind, str(tmp_path), *[f"--out={tmp_path}/a.png"] * (kind != "--all")]) == 1
    )
    assert error_line(capsys)


@pytest.mark.parametrize("text", ["1 / 0", "class P:\n    def __init__(self, *_):\n        1 / 0"])
def test_a_plant_of_ones_own_that_fails_is_one_line(text, tmp_path, monkeypatch, capsys):
    name = f"plants_{abs(hash(text))}"
    (tmp_path / f"{name}.py").write_text(text)
    monkeypatch.syspath_prepend(str(tmp_path))
    own = ["--set", f"plant=!OwnPlant {{maker: '{name}:P'}}"]
    assert main(["simulate", "two_link_wall", *own, "--out", str(tmp_path / "run")]) == 1
    assert "ZeroDivisionError" in error_line(capsys)


NO_HOME = """
import os, pwd, sys
def unknown(uid): raise KeyError(uid)
pwd.getpwuid = unknown
from drake_dae.cli import main
sys.exit(main())
"""


@pytest.mark.slow
def test_neither_a_home_nor_a_backend_nor_an_open_stdout_is_needed(tmp_path):
    words = ["simulate", "two_link_wall", "--out", tmp_path / "run", *SHORT]
    words += ["--set", "write.animation=false", "--set", "write.plots=true"]
    others = {k: v for k, v in os.environ.items() if k not in ("HOME", "XDG_CACHE_HOME")}
    shell = f'"{sys.executable}" -c "$0" "$@" >&-'
    done = subprocess.run(
        ["sh", "-c", shell, NO_HOME, *map(str, words)],
        env=others | {"MPLBACKEND": "nonsense", "MPLCONFIGDIR": str(tmp_path)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "run" / PLOTS[0]).exists()
