"""What commands tell programs, JSON and exit codes, and what of earlier runs they keep."""

import json
import os
import signal
import subprocess
import sys
import time

import numpy as np
import pytest
from runs import some

from drake_dae import Record, load_scenario
from drake_dae.cli import main
from drake_dae.commands import written
from drake_dae.running.rollout.run import num_cores
from drake_dae.scenario.build import build_completed
from drake_dae.scenario.scenario import read_scenario, save_scenario
from drake_dae.scenario.shipped import find_scenario, shipped_scenarios
from drake_dae.scenario.start import start_scenario

BARE = ("--set=write.plots=false", "--set=write.animation=false")
QUICK = ("--set=duration=0.2", *BARE)


def told(arguments, capsys):
    """The exit code, and what was printed as JSON."""
    code = main([*map(str, arguments)])
    return code, json.loads(capsys.readouterr().out)


MISSED = {
    # Steps of 0.05 s are too long for Euler's method, and nothing else is wrong.
    "without a reason": [
        "--set=integrator={integration_scheme: explicit_euler, use_error_control: false, "
        "max_step_size: 0.05}",
        "--set=duration=2",
    ],
    # The force would pull: -5 N.
    "a contact that pulls": ["--set=references.wall.force=-5", "--set=duration=0.2"],
    # The mass is another one, to the end.
    "a plant that the law does not know": [
        "--set=plant.parameters={link1.mass: 20}",
        "--set=duration=1",
    ],
}


@pytest.mark.slow
@pytest.mark.parametrize("reason", MISSED)
def test_a_run_that_missed_its_task_is_reported_by_code_and_json(reason, tmp_path, capsys):
    run = ["simulate", "two_link_wall", "--json", *BARE, *MISSED[reason]]
    code, found = told([*run, "--check", f"--out={tmp_path / 'one'}"], capsys)
    assert (code, found["missed"]) == (2, True)
    assert found["outcome"] == "bad"
    kinds = {one["kind"] for one in found["findings"]}
    assert ("prediction" in kinds) is (reason != "a contact that pulls")
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


@pytest.mark.slow
@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["simulate", "two_link_wall", "--set=duration=-1"], "duration"),
        (["simulate", "no_such"], "no_such"),
        (["analyze", "two_link_wall", "--set=gains={all: [4]}"], ""),
        (["sweep", "two_link_wall", "--vary=a=1"], "a"),
    ],
)
def test_an_error_is_json_too(arguments, words, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    code = main([*arguments, "--json"])
    said = capsys.readouterr()
    found = json.loads(said.out)
    if "error" in found:
        assert code == 1
        assert words in found["error"]
        assert said.err.startswith("error: ")


def test_the_list_is_json(capsys):
    code, found = told(["list", "--json"], capsys)
    assert code == 0
    assert list(found) == list(shipped_scenarios())


@pytest.mark.slow
def test_a_study_is_json(tmp_path, capsys):
    study = ["sweep", "two_link_wall", "--json", "--workers=1", *QUICK, f"--out={tmp_path}"]
    code, found = told([*study, "--vary=start.errors.tool.z=[0, 0.01, 9]", "--check"], capsys)
    assert code == 2
    assert found["outcomes"] == {"finished": 2, "no start": 1}
    assert [run["run"] for run in found["not_finished"]] == [2]
    extent = found["figures"]["largest error of tool.z [m]"]
    assert 0.0 <= extent["least"] <= extent["median"] <= extent["largest"] < 0.1
    assert {*found["files"]} <= {path.name for path in tmp_path.iterdir()}


# What it takes.


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["simulate", "--out", ""], "--out"),
        (["sweep", "--vary", "a=1", "--out="], "--out"),
        (["play", ""], "RUN"),
        (["sweep", "--vary", "a=1", "--random=1_0"], "'1_0'"),
        (["sweep", "--vary", "a=1", "--time-limit=nan"], "--time-limit"),
    ],
)
def test_words_that_mean_nothing_are_wrong_usage(arguments, words, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as ended:
        main(arguments)
    assert ended.value.code == 2
    assert words in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("tip", ["a:1,2,nan", "a:1_0,2,3", "a:1,2", "a:1,2,3,4", "a:1,inf,2"])
def test_the_point_of_a_tip_is_three_numbers(tip, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(["new", "a.urdf", f"--tip={tip}"]) == 1
    assert "LINK:x,y,z" in capsys.readouterr().err


# What it keeps.


def test_a_record_has_what_repeats_the_run(tmp_path):
    out = tmp_path / "run"
    settings = ("--set=sensors.force.seed=7", *QUICK)
    assert main(["simulate", "two_link_measured_force", *settings, f"--out={out}"]) == 0
    record = Record.load(out / "record.npz")
    assert {"drake_dae", "drake", "casadi", "numpy", "python"} <= {*record.about["versions"]}
    assert record.about["scenario"]["sensors"]["force"]["seed"] == 7
    # As a scenario of its own it gives the same numbers.
    again = tmp_path / "again"
    save_scenario(read_scenario(record.about["scenario"]), tmp_path / "again.yaml")
    assert main(["simulate", str(tmp_path / "again.yaml"), f"--out={again}"]) == 0
    other = Record.load(again / "record.npz")
    for name in record.signals:
        np.testing.assert_array_equal(record[name], other[name], err_msg=name)


@pytest.mark.slow
@pytest.mark.parametrize("sent", [signal.SIGTERM])
def test_a_film_that_is_ended_leaves_nothing_behind(sent, tmp_path):
    folder = tmp_path / "run"
    settings = ("--set=duration=5", *BARE)
    assert main(["simulate", "two_link_wall", *settings, f"--out={folder}"]) == 0
    before = sorted(path.name for path in folder.iterdir())
    code = (
        "import signal, sys\n"
        "signal.signal(signal.SIGINT, signal.default_int_handler)\n"
        "from drake_dae.cli import main\nsys.exit(main(sys.argv[1:]))"
    )
    command = [sys.executable, "-c", code, "plot", "--film", str(folder)]
    process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
    limit = time.monotonic() + 60
    while not list(folder.glob(".unfinished-*")):
        assert process.poll() is None
        assert time.monotonic() < limit
        time.sleep(0.005)
    process.send_signal(sent)
    _, said = process.communicate(timeout=60)
    assert process.returncode == 128 + sent
    assert said.splitlines()[-1] == "interrupted"
    assert sorted(path.name for path in folder.iterdir()) == before


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="lists threads as Linux does")
@pytest.mark.parametrize(("chosen", "threads"), [({}, 1), ({"OMP_NUM_THREADS": "2"}, 2)])
def test_the_command_starts_no_threads_of_linear_algebra(chosen, threads):
    """They wait in a loop: a fifth of the CPU time of a short run. A user's choice is kept."""
    code = (
        "import os, sys, drake_dae.__main__, numpy.linalg\n"
        "print(len(os.listdir('/proc/self/task')), 'drake_dae.cli' in sys.modules)"
    )
    names = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS")
    surroundings = {name: text for name, text in os.environ.items() if name not in names}
    done = subprocess.run(
        [sys.executable, "-c", code],
        env={**surroundings, **chosen},
        capture_output=True,
        text=True,
        check=True,
        timeout=60,
    )
    assert done.stdout.split() == [str(min(threads, num_cores())), "True"]


# Where it starts.

TASKS = ("seven_joint_dome", "two_link_wall")


@pytest.mark.slow
@pytest.mark.parametrize("name", some(TASKS))
def test_all_commands_start_at_the_same_state(name, tmp_path, monkeypatch):
    """Also where start.positions are left out, and the robot's default leads elsewhere."""
    found = {}

    def kept(loop, context, *_):
        own = loop.plant.GetMyContextFromRoot(context)
        found["export"] = own.get_continuous_state_vector().CopyToVector()
        return []

    monkeypatch.setattr(written, "export_code", kept)
    settings = ["--set=start={}", "--set=duration=0.01", *BARE]
    assert main(["export", name, *settings, f"--out={tmp_path / 'code'}"]) == 0
    assert main(["simulate", name, *settings, f"--out={tmp_path / 'run'}"]) == 0
    first = Record.load(tmp_path / "run" / "record.npz")["state"][0]
    np.testing.assert_allclose(found["export"], first, atol=1e-9)
    # And a loop that is started by what it was built from.
    scenario = load_scenario(find_scenario(name), ["start={}"])
    _, loop = build_completed(scenario)
    context = start_scenario(scenario, loop)
    own = loop.plant.GetMyContextFromRoot(context)
    state = own.get_continuous_state_vector().CopyToVector()
    np.testing.assert_allclose(state, first, atol=1e-9)
