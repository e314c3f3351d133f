"""Studies from the first run to the table, with processes that die in between."""

import csv
import json
import os
import signal
import subprocess
import sys
import time

import numpy as np
import pytest
from runs import scenario, some

import drake_dae as dd
from drake_dae.errors import ModelError, ScenarioError
from drake_dae.studies.results import Outcome, RunResult
from drake_dae.studies.study import FILES, Study

KEYS = {
    "start.errors.tool.z": np.linspace(-0.05, 0.05, 10),
    "plant_parameters.link1.mass": [9.0, 11.0],
}
VARIATIONS = dd.grid_variations(KEYS)
COUNT = len(VARIATIONS)
SETTINGS = ("duration=0.5", "compiled=false")


def chosen():
    return scenario("two_link_wall", *SETTINGS)


@pytest.fixture(scope="module")
def study(tmp_path_factory):
    """An undisturbed study, on one process."""
    return dd.sweep(chosen(), VARIATIONS, tmp_path_factory.mktemp("one") / "runs.jsonl", workers=1)


@pytest.fixture(scope="module")
def first_three(tmp_path_factory):
    """Its first runs, and what their file holds."""
    file = tmp_path_factory.mktemp("three") / "runs.jsonl"
    study = dd.sweep(chosen(), VARIATIONS[:3], file, workers=1)
    return study, file.read_bytes()


@pytest.fixture(scope="module")
def rolled(tmp_path_factory):
    """The same by rollouts."""
    file = tmp_path_factory.mktemp("rolled") / "runs.jsonl"
    return dd.sweep(chosen(), VARIATIONS, file, workers=1, rollout=True)


@pytest.mark.slow
def test_rollouts_give_the_figures_of_drake(study, rolled):
    """To what an accuracy of 1e-8 leaves; largest values to what lies between rows, 1/1000 apart.

    Residuals of Drake are those before a projection; how many steps there are is its own affair.
    """
    assert rolled.figures == study.figures
    assert rolled.table()["outcome"] == study.table()["outcome"]
    for name in set(study.figures) - {"steps", "largest residual"}:
        found, wanted = rolled.values(name), study.values(name)
        unit = max(1.0, np.max(np.abs(wanted)))
        tolerance = 1e-7 if name.startswith(("final", "end")) else 1e-3
        np.testing.assert_allclose(found, wanted, rtol=0.0, atol=tolerance * unit, err_msg=name)


@pytest.mark.slow
def test_the_number_of_processes_changes_nothing(study, tmp_path):
    other = dd.sweep(chosen(), VARIATIONS, tmp_path / "runs.jsonl", workers=2)
    assert other.table() == study.table()
    assert study.table()["outcome"] == ["finished"] * COUNT


@pytest.mark.slow
def test_a_finished_study_runs_nothing_again(first_three, tmp_path):
    file, (first, data) = tmp_path / "runs.jsonl", first_three
    file.write_bytes(data)
    assert dd.sweep(chosen(), VARIATIONS[:3], file, workers=1).table() == first.table()
    assert file.read_bytes() == data
    with pytest.raises(ModelError, match=f"3 runs there, {COUNT} here"):
        dd.sweep(chosen(), VARIATIONS, file)


def lines(file):
    """How many runs the file of a study has."""
    return file.read_bytes().count(b"\n") - 1 if file.exists() else 0


def wait_for(count, file, process):
    limit = time.monotonic() + 100
    while lines(file) < count:
        assert process.poll() is None, process.communicate()
        assert time.monotonic() < limit
        time.sleep(0.002)


def command(folder, *more, keys=KEYS):
    vary = [f"--vary={key}={json.dumps(list(values))}" for key, values in keys.items()]
    settings = [f"--set={setting}" for setting in SETTINGS]
    return [sys.executable, "-m", "drake_dae", "sweep", "two_link_wall", f"--out={folder}",
            "--workers=2", *vary, *settings, *more]  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kills", "options"),
    [
        pytest.param((9,), (), id="drake", marks=pytest.mark.thorough),
        pytest.param((2, 9), (), id="drake twice", marks=pytest.mark.thorough),
        pytest.param((9,), ("--rollout",), marks=pytest.mark.thorough),
    ],
)
def test_killed_in_the_middle_it_continues_there_to_the_same_table(
    kills, options, request, tmp_path
):
    study = request.getfixturevalue("rolled" if options else "study")
    folder, file = tmp_path / "study", tmp_path / "study" / "runs.jsonl"
    call = command(folder, *options)
    for wanted in kills:
        process = subprocess.Popen(call, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
        wait_for(wanted, file, process)
        process.send_signal(signal.SIGKILL)
        process.communicate()
        # What the kernel leaves of a line that is cut off.
        with open(file, "ab") as broken:
            broken.write(b'{"run":3,"outcome":"fini')
    before = file.read_bytes().removesuffix(b'{"run":3,"outcome":"fini')
    assert kills[-1] <= before.count(b"\n") - 1 < COUNT
    done = subprocess.run(call, check=True, capture_output=True, text=True)
    assert file.read_bytes().startswith(before)
    assert lines(file) == COUNT
    assert done.stdout.startswith(f"{COUNT} runs: {COUNT} finished\n")
    again = dd.sweep(chosen(), VARIATIONS, file, rollout=bool(options))
    assert again.table() == study.table()
    with pytest.raises(ModelError, match="another study: rollout = "):
        dd.sweep(chosen(), VARIATIONS, file, rollout=not options)
    with open(folder / "runs.csv", newline="", encoding="utf-8") as table:
        head, *rows = csv.reader(table)
    assert head == list(study.table())
    assert [row[0] for row in rows] == [str(run) for run in range(COUNT)]
    errors = [float(row[head.index("largest error of tool.z [m]")]) for row in rows]
    np.testing.assert_array_equal(errors, study.values("largest error of tool.z [m]"))


@pytest.mark.usefixtures("signals_of_a_shell")
@pytest.mark.slow
def test_ctrl_c_keeps_what_has_ended(tmp_path):
    folder = tmp_path / "study"
    process = subprocess.Popen(command(folder), stderr=subprocess.PIPE, text=True)
    wait_for(3, folder / "runs.jsonl", process)
    process.send_signal(signal.SIGINT)
    _, said = process.communicate(timeout=60)
    assert process.returncode == 130
    assert said == (
        f"runs that have ended are in {folder}/runs.jsonl; the same command continues\n"
        "interrupted\n"
    )
    assert 3 <= lines(folder / "runs.jsonl") < COUNT


@pytest.mark.usefixtures("signals_of_a_shell")
@pytest.mark.slow
@pytest.mark.thorough
def test_a_process_that_dies_is_the_outcome_of_its_run_alone(study, tmp_path):
    """As Drake's C++ may end one: it is killed in a run that lasts, against the clock, 20 s."""
    rates = [0.0, 0.0, 0.0, 0.025, 0.0, 0.0]
    vary = f"--vary=integrator.target_realtime_rate={rates}"
    values = {key: [changes[key] for changes in VARIATIONS[:6]] for key in KEYS}
    process = subprocess.Popen(
        command(tmp_path, vary, "--together", "--workers=1", keys=values),
        stdout=subprocess.PIPE,
        text=True,
    )
    wait_for(3, tmp_path / "runs.jsonl", process)
    listed = subprocess.run(
        ["pgrep", "-P", str(process.pid)], check=True, capture_output=True, text=True
    )
    (worker,) = map(int, listed.stdout.split())
    os.kill(worker, signal.SIGKILL)
    said, _ = process.communicate(timeout=100)
    assert process.returncode == 1
    words = " ".join(said.split())  # Lines are filled.
    assert words.startswith("6 runs: 5 finished, 1 crashed run 3, tool.z=")
    assert ", crashed: the process ended with signal SIGKILL figure" in words
    with open(tmp_path / "runs.csv", newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    name = "largest error of tool.z [m]"
    assert rows[3]["outcome"] == "crashed"
    assert rows[3][name] == ""
    others = [run for run in range(6) if run != 3]
    assert [float(rows[run][name]) for run in others] == list(study.values(name)[others])


@pytest.mark.slow
@pytest.mark.parametrize("outcome", some(["crashed", "timed out"]))
def test_a_run_whose_process_died_is_tried_again_and_no_other(outcome, first_three, tmp_path):
    file, first = tmp_path / "runs.jsonl", first_three[0]
    data = first_three[1].decode().splitlines()
    (place,) = [i for i, line in enumerate(data) if line.startswith('{"run":1,')]
    died = RunResult(1, Outcome(outcome), "it died")
    data[place] = json.dumps(died.to_dict())
    file.write_text("\n".join([*data, ""]))
    again = dd.sweep(chosen(), VARIATIONS[:3], file, workers=1)
    assert again.table() == first.table()
    assert lines(file) == 4


@pytest.mark.thorough
@pytest.mark.parametrize("stopped", [True, False])
def test_a_run_without_end_is_ended_at_the_limit(stopped, tmp_path):
    """Its process is stopped, or it runs against the clock, 10,000 s; other runs are not lost."""
    rates = [0.0, 0.05 if stopped else 0.00005, 0.0]
    vary = f"--vary=integrator.target_realtime_rate={rates}"
    process = subprocess.Popen(
        command(tmp_path, vary, "--workers=1", "--time-limit=5", keys={}),
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    if stopped:
        wait_for(1, tmp_path / "runs.jsonl", process)
        listed = subprocess.run(
            ["pgrep", "-P", str(process.pid)], check=True, capture_output=True, text=True
        )
        os.kill(int(listed.stdout), signal.SIGSTOP)
    said, error = process.communicate(timeout=100)
    assert process.returncode == 1
    words = " ".join(said.split())  # Lines are filled.
    assert words.startswith(
        "3 runs: 2 finished, 1 timed out run 1, integrator.target_realtime_rate"
    )
    assert ", timed out: no end within 5 s " in words
    assert "1 run died or took too long; the same command tries again: 1" in error


@pytest.mark.slow
@pytest.mark.parametrize(
    ("variations", "words"),
    [
        ([], "at least one variation"),
        ([{"start.error.tool.z": 1.0}], "start: has no key 'error'; did you mean 'errors'"),
        ([{"duration": 1.0}, {"duration": "a"}], "duration: expected a number, got 'a'"),
        (
            [{"duration": value} for value in (1.0, float("nan"), 2.0)],
            "duration: expected a number, got nan",
        ),
        (
            [{"force_feedback.seed": 0.0}, {"force_feedback.seed": 1}],
            "force_feedback: !ModelForce has no key 'seed'",
        ),
        ([{"duration": -1.0}], "duration: a duration must be positive, got -1.0"),
        ([{"outputs.3.axes": "z"}], "outputs: no entry '3'; entries: 0"),
        ([{"a..b": 1}], "expected a dotted key"),
        ([{"duration": object()}], "duration: expected plain data"),
        ([{"robot.file": "arm.urdf"}], "robot: a path that varies is absolute"),
        ([{"start.errors.tool.x": 0.1}], "start.errors: no output 'tool.x'; did you mean 'tool.z'"),
        ([{"plant_parameters.link1.mas": 1.0}], "no parameter 'link1.mas'; did you mean"),
        ([{"start.positions.joint9": 0.1}], "start.positions: no joint position 'joint9'"),
        ([{"plant_parameters.wall.position": [1.0, 2.0]}], "wall.position' has 3 entries"),
    ],
)
def test_what_cannot_be_is_reported_before_anything_runs(variations, words, tmp_path):
    file = tmp_path / "new" / "runs.jsonl"
    with pytest.raises(ScenarioError, match=words):
        dd.sweep(chosen(), variations, file)
    assert not file.parent.exists()


@pytest.mark.parametrize(("workers", "words"), [(0, "from 1"), (1.5, "a whole number")])
def test_workers_are_counted(workers, words, tmp_path):
    with pytest.raises(ValueError, match=words):
        dd.sweep(chosen(), [{}], tmp_path / "runs.jsonl", workers=workers)


# What it says and draws.


def made(outcomes=("finished", "failed", "finished", "no start")):
    """A study of which all is known."""
    variations, results = [], []
    for run, outcome in enumerate(outcomes):
        figures = (
            {"largest error of z [m]": 0.1 * run, "steps": 7.0} if outcome != "no start" else {}
        )
        left = ("motor",) if run == 2 else ()
        reason = "" if outcome == "finished" else "it cannot go on"
        variations.append({"a": run // 2, "b": [float(run % 2)]})
        results.append(RunResult(run, Outcome(outcome), reason, figures, left))
    return Study(tuple(variations), tuple(results))


def test_the_table_and_the_summary():
    study = made()
    assert study.table() == {
        "run": [0, 1, 2, 3],
        "a": [0, 0, 1, 1],
        "b": [[0.0], [1.0], [0.0], [1.0]],
        "outcome": ["finished", "failed", "finished", "no start"],
        "reason": ["", "it cannot go on", "", "it cannot go on"],
        "beyond limits": ["", "", "motor", ""],
        "largest error of z [m]": [0.0, 0.1, 0.2, None],
        "steps": [7.0, 7.0, 7.0, None],
    }
    text = str(study)
    assert text.startswith("4 runs: 2 finished, 1 failed, 1 no start\n")
    assert "run 1, a=0, b=[1.0], failed: it cannot go on\n" in text
    assert "run 3, a=1, b=[1.0], no start: it cannot go on\n" in text
    assert "beyond their limits: motor in 1 run\n" in text
    row = next(line.split() for line in text.splitlines() if line.startswith("largest error"))
    assert row[-5:] == ["0", "0", "0.1", "0.2", "2"]
    assert repr(study) == "Study(4 runs: 2 finished, 1 failed, 1 no start)"
    np.testing.assert_array_equal(study.values("steps"), [7.0, 7.0, 7.0, np.nan])
    with pytest.raises(ModelError, match="no figure 'step'; did you mean 'steps'"):
        study.values("step")


def test_it_leaves_its_files(tmp_path):
    written = made().save(tmp_path / "new")
    assert [path.name for path in written] == list(FILES)
    assert written[2].read_text("utf-8").startswith("<!DOCTYPE html>")
    for path in written[3:]:
        assert path.read_bytes().startswith(b"\x89PNG")
    with open(written[0], newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert (rows[3]["b"], rows[3]["largest error of z [m]"], rows[3]["outcome"]) == (
        "[1.0]", "", "no start",
    )  # fmt: skip


def test_without_figures_nothing_is_drawn(tmp_path):
    written = made(("no start", "no start")).save(tmp_path)
    assert [path.name for path in written] == list(FILES[:3])
    assert sorted(os.listdir(tmp_path)) == sorted(FILES[:3])
