"""The command: what it prints, what it leaves, and how it ends."""

import os
import re
import shlex
import subprocess
import sys
import warnings
import webbrowser
from pathlib import Path

import numpy as np
import pytest
from command_line import BARE, QUICK, command, error_line, shown_on_a_terminal

import drake_dae
from drake_dae import Record, load_scenario
from drake_dae.cli import main
from drake_dae.commands import runs, scenarios
from drake_dae.commands.runs import FILES
from drake_dae.commands.writing import program
from drake_dae.errors import NonMinimumPhaseWarning, ScenarioError
from drake_dae.pictures import PLOTS
from drake_dae.scenario.shipped import DEFAULT_SCENARIO, find_scenario, shipped_scenarios

PLOTTED = "write.plots=true"


@pytest.fixture(scope="module")
def demo(tmp_path_factory):
    """The default scenario, as `make demo` runs it except for its length, and with plots."""
    folder = tmp_path_factory.mktemp("demo") / "run"
    process = command("simulate", "--out", folder, "--set", "duration=2", "--set", PLOTTED)
    out, err = process.communicate(timeout=600)
    assert process.returncode == 0, err
    return folder, out, err


def test_the_run_folder_is_complete(demo):
    folder, _, _ = demo
    assert sorted(path.name for path in folder.iterdir()) == sorted(FILES)
    for name in PLOTS:
        data = (folder / name).read_bytes()
        assert data.startswith(b"\x89PNG")
        assert data.endswith(b"IEND\xaeB`\x82")


def test_it_prints_the_summary(demo):
    folder, out, err = demo
    text = (folder / "summary.txt").read_text()
    assert text in out
    written, watch = out.splitlines()[-2:]
    assert written == f"written to {folder}/: {', '.join(FILES)}"
    assert watch.endswith(f" play {folder}")
    for name in ("tool.y", "tool.z", "joint7", "wall.force", "joint1_motor"):
        assert name in text
    # Lines of progress are for runs that last.
    assert err == ""


@pytest.mark.slow
def test_the_scenario_as_run_gives_the_same_record(demo, tmp_path):
    folder, _, _ = demo
    path = folder / "scenario.yaml"
    assert path.read_text().splitlines()[0] == (
        f"# Scenario as run by drake-dae {drake_dae.__version__}"
    )
    assert load_scenario(path) == load_scenario(
        find_scenario(DEFAULT_SCENARIO), ["duration=2", PLOTTED]
    )
    assert main(["simulate", str(path), "--out", str(tmp_path), *QUICK]) == 0
    first, second = (Record.load(p / "record.npz") for p in (folder, tmp_path))
    np.testing.assert_array_equal(first.time, second.time)
    for name in first.signals:
        np.testing.assert_array_equal(first[name], second[name], err_msg=name)


def test_view_opens_the_animation(demo, monkeypatch, capsys):
    folder, _, _ = demo
    opened = []
    monkeypatch.setattr(webbrowser, "open", lambda address: not opened.append(address))
    assert main(["play", str(folder)]) == 0
    assert opened == [(folder / "animation.html").resolve().as_uri()]
    assert capsys.readouterr().out == f"opened {opened[0]}\n"
    monkeypatch.setattr(webbrowser, "open", lambda _: False)
    assert main(["play", str(folder)]) == 1
    assert opened[0] in error_line(capsys)


def test_view_says_what_is_missing(demo, tmp_path, capsys):
    folder, _, _ = demo
    run = tmp_path / "run"
    run.mkdir()
    for path, text in (
        (folder.parent / "runn", "'.*runn' is no folder of a run"),
        (run, "'.*run' is no folder of a run"),
    ):
        assert main(["play", str(path)]) == 1
        assert re.search(text, error_line(capsys))
    for name in ("scenario.yaml", "outputs.png"):
        (run / name).touch()
    assert main(["play", str(run)]) == 1
    assert "animation.html" in error_line(capsys)


def test_ctrl_c_in_the_middle_of_a_step_keeps_the_record(tmp_path, monkeypatch, capsys):
    """As a second Ctrl-C does, or one while the files are written."""

    def stop(diagram, context, *_arguments, **_options):
        drake_dae.simulate(diagram, context, 0.1, load_scenario(scenario).integrator)
        raise KeyboardInterrupt

    scenario = find_scenario("two_link_wall")
    monkeypatch.setattr(runs, "simulate", stop)
    assert main(["simulate", "two_link_wall", "--out", str(tmp_path), *QUICK]) == 130
    assert capsys.readouterr().err == "interrupted\n"
    assert Record.load(tmp_path / "record.npz").time[-1] == 0.1
    assert "interrupted" in (tmp_path / "summary.txt").read_text()


def test_list(capsys):
    assert main(["list"]) == 0
    lines = capsys.readouterr().out.splitlines()
    told = dict(line.split(maxsplit=1) for line in lines)
    assert {"seven_joint_wall", "seven_joint_dome", "two_link_wall"} <= {*told}
    files = shipped_scenarios()
    assert told == {name: load_scenario(path).description for name, path in files.items()}


VARY = ["sweep", "two_link_wall", "--vary", "a=1"]


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ([], "usage: drake-dae"),
        (["simulat"], "'simulat'"),
        (["simulate", "a", "b"], "b"),
        (["simulate", "--out", ""], "--out"),
        (["play", ""], "RUN"),
        (["sweep", "two_link_wall"], "--vary"),
        ([*VARY, "--out="], "--out"),
        ([*VARY, "--random=x"], "'x'"),
        ([*VARY, "--random", "3", "--together"], "--together"),
    ],
)
def test_wrong_usage_exits_with_2(arguments, words, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as caught:
        main(arguments)
    assert caught.value.code == 2
    assert words in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
def test_a_printed_command_works_as_printed(tmp_path):
    """As after `make demo`, where no `drake-dae` is on PATH."""
    script = Path(sys.executable).with_name("drake-dae")
    if not script.exists():
        pytest.skip("the package is not installed")
    bare = os.environ | {"PATH": "/usr/bin:/bin"}
    out = tmp_path / "a run"
    arguments = ["simulate", "two_link_wall", "--out", out, "--set", "duration=0.1"]
    run = subprocess.run([script, *arguments], env=bare, capture_output=True, text=True, check=True)
    (line,) = re.findall("^watch it: (.*)$", run.stdout, re.MULTILINE)
    play, plot = line.split("; plots: ")
    subprocess.run(f"{plot} --all", shell=True, env=bare, cwd=tmp_path, check=True)
    assert list(out.glob("*.png"))
    assert shlex.split(play)[0] == sys.executable


@pytest.mark.parametrize("first", ["own", "other"])
def test_a_printed_command_is_that_of_this_installation(first, tmp_path, monkeypatch):
    for name in ("own", "other"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "drake-dae").write_text("#!/bin/sh\n")
        (tmp_path / name / "drake-dae").chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path / first))
    monkeypatch.setattr(sys, "argv", [str(tmp_path / "own" / "drake-dae")])
    module = shlex.join([sys.executable, "-m", "drake_dae"])
    assert program() == ("drake-dae" if first == "own" else module)
    monkeypatch.setattr(sys, "argv", [str(tmp_path / "drake_dae" / "__main__.py")])
    assert program() == module


@pytest.mark.slow
def test_meshcat_reports_where_and_asks_drake_for_real_time(tmp_path, capsys):
    arguments = ["simulate", "two_link_wall", "--meshcat", "--out", str(tmp_path), *QUICK]
    assert main([*arguments, "--set", "duration=0.1"]) == 0
    captured = capsys.readouterr()
    assert re.search(r"^watch at http://localhost:\d+$", captured.out, re.MULTILINE)
    assert load_scenario(tmp_path / "scenario.yaml").integrator.target_realtime_rate == 1.0


@pytest.mark.slow
@pytest.mark.parametrize(("columns", "width"), [(0, 79), (60, 60)])
def test_a_bar_on_a_terminal(columns, width, tmp_path):
    """One that does not know its width, as in some containers, or is narrow."""
    settings = ["--set", "duration=0.5", "--set", "integrator.target_realtime_rate=1"]
    words = ["simulate", "two_link_wall", *BARE, *settings]
    shown = shown_on_a_terminal(words, columns, cwd=tmp_path)
    steps = shown.rstrip().split("\r")
    assert len(steps) > 3
    assert width - 2 <= max(map(len, steps)) <= width
    assert re.search(r"100%\|.*\| 0\.50/0\.50 s, \d+\.\d x real time", steps[-1])


@pytest.mark.filterwarnings("always")
def test_warnings_are_printed_like_errors_without_the_line_of_code(monkeypatch, capsys):
    """Each once. `analyze` tells of unstable zero dynamics in its report, and warns of none."""

    def warn(name):
        for _ in "ab":
            warnings.warn("two tanks: non-minimum phase", NonMinimumPhaseWarning, stacklevel=1)
        raise ScenarioError(("", "empty"))

    for command_of in (runs, scenarios):
        monkeypatch.setattr(command_of, "find_scenario", warn)
    assert main(["simulate", "two_tanks"]) == 1
    assert capsys.readouterr().err == "warning: two tanks: non-minimum phase\nerror: empty\n"
    assert main(["analyze", "two_tanks"]) == 1
    assert capsys.readouterr().err == "error: empty\n"


def test_a_shipped_scenario_is_shown_as_it_is_or_where_it_is(capsys):
    assert main(["print", "seven_joint_dome"]) == 0
    assert capsys.readouterr().out == find_scenario("seven_joint_dome").read_text()
    assert main(["print", "--path"]) == 0
    assert capsys.readouterr().out.strip() == str(find_scenario(DEFAULT_SCENARIO))
