"""Sweeps from the first run to the table, with processes that die in between."""

import csv
import json
import os
import shutil
import signal
import sqlite3
import subprocess
import sys
import time
from contextlib import closing

import numpy as np
import pytest
from distributed import Client, LocalCluster
from runs import scenario

import drake_dae as dd
from drake_dae.errors import ModelError, ScenarioError
from drake_dae.studies import Study, make_variations
from drake_dae.studies.study import FILES, Outcome, RunResult

KEYS = {
    "start.errors.tool.z": np.linspace(-0.05, 0.05, 5),
    "plant.parameters.link1.mass": [9.0, 11.0],
}
VARIATIONS = make_variations(KEYS)
COUNT = len(VARIATIONS)
SETTINGS = ("duration=0.5", "compiled=false")


def chosen():
    return scenario("two_link_wall", *SETTINGS)


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """The file of an undisturbed study, on one process."""
    return tmp_path_factory.mktemp("one") / "runs.db"


@pytest.fixture(scope="module")
def study(whole):
    return dd.sweep(chosen(), VARIATIONS, whole, workers=1)


@pytest.fixture(scope="module")
def rolled(tmp_path_factory):
    """The same by rollouts."""
    file = tmp_path_factory.mktemp("rolled") / "runs.db"
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
    other = dd.sweep(chosen(), VARIATIONS, tmp_path / "runs.db", workers=2)
    assert other.table() == study.table()
    assert study.table()["outcome"] == ["finished"] * COUNT


@pytest.mark.slow
def test_it_continues_with_what_is_missing_and_runs_nothing_again(study, whole, tmp_path):
    file = shutil.copy(whole, tmp_path)
    with closing(sqlite3.connect(file)) as database:
        database.execute("DELETE FROM runs WHERE run = 3")
        # What has ended stays as it is; what died is made again.
        for run, outcome in ((2, "crashed"), (4, "finished")):
            text = json.dumps({"outcome": outcome, "reason": "mine", "figures": {}})
            database.execute("UPDATE runs SET result = ? WHERE run = ?", (text, run))
        database.commit()
    again = dd.sweep(chosen(), VARIATIONS, file, workers=1)
    assert again.results[4].reason == "mine"
    assert [run for run in range(COUNT) if again.results[run] != study.results[run]] == [4]
    with pytest.raises(ModelError, match="variations"):
        dd.sweep(chosen(), VARIATIONS[:3], file)


@pytest.mark.slow
def test_a_dask_cluster_runs_them_too(study, tmp_path):
    local = {"n_workers": 1, "threads_per_worker": 2, "processes": False}
    with LocalCluster(**local, dashboard_address=None) as cluster, Client(cluster) as client:
        executor = client.get_executor()
        found = dd.sweep(chosen(), VARIATIONS, tmp_path / "runs.db", executor=executor)
    assert found.table() == study.table()


def lines(file):
    """How many runs the file of a study has."""
    if not file.exists():
        return 0
    with closing(sqlite3.connect(file, timeout=60.0)) as database:
        try:
            return database.execute("SELECT count(*) FROM runs").fetchone()[0]
        except sqlite3.OperationalError:  # It is being made.
            return 0


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
def test_a_script_needs_no_guard_for_its_processes(tmp_path):
    script = tmp_path / "script.py"
    script.write_text(
        "import drake_dae as dd\n"
        "print('once')\n"
        f"scenario = dd.load_scenario('two_link_wall', {list(SETTINGS)})\n"
        f"print(dd.sweep(scenario, [{{}}, {{}}], {str(tmp_path / 'runs.db')!r}, workers=2).results)"
    )
    done = subprocess.run(
        [sys.executable, script], check=True, capture_output=True, text=True, timeout=600
    )
    assert done.stderr == ""  # The workers leave nothing behind.
    assert done.stdout.count("once") == 1
    assert done.stdout.count("finished") == 2


def worker_of(process):
    """The process that makes the runs of a sweep with one."""
    call = ["pgrep", "-P", str(process.pid), "-f", "spawn_main"]
    return int(subprocess.run(call, check=True, capture_output=True, text=True).stdout)


@pytest.mark.usefixtures("signals_of_a_shell")
@pytest.mark.slow
def test_ctrl_c_keeps_what_has_ended(tmp_path):
    """Three runs end at once; each other would last some minutes."""
    folder = tmp_path / "study"
    call = command(folder, keys={"duration": [0.5, 0.6, 0.7, 1e6, 2e6, 3e6]})
    process = subprocess.Popen(call, stderr=subprocess.PIPE, text=True)
    wait_for(3, folder / "runs.db", process)
    process.send_signal(signal.SIGINT)
    _, said = process.communicate(timeout=600)
    assert process.returncode == 130
    kept = f"runs that have ended are in {folder}/runs.db; the same command continues"
    assert said.splitlines() == [kept, "interrupted"]
    assert lines(folder / "runs.db") == 3


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
    wait_for(3, tmp_path / "runs.db", process)
    os.kill(worker_of(process), signal.SIGKILL)
    said, _ = process.communicate(timeout=600)
    assert process.returncode == 1
    words = " ".join(said.split())  # Lines are filled.
    assert words.startswith("6 runs: 5 finished, 1 crashed run 3, ")
    assert ": crashed: " in words
    assert "-9" in words
    with open(tmp_path / "runs.csv", newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    name = "largest error of tool.z [m]"
    assert rows[3]["outcome"] == "crashed"
    assert rows[3][name] == ""
    others = [run for run in range(6) if run != 3]
    assert [float(rows[run][name]) for run in others] == list(study.values(name)[others])


@pytest.mark.thorough
def test_a_run_without_end_is_ended_at_the_limit(tmp_path):
    """It runs against the clock, 10,000 s; other runs are not lost."""
    rates = [0.0, 0.00005, 0.0]
    vary = f"--vary=integrator.target_realtime_rate={rates}"
    process = subprocess.Popen(
        command(tmp_path, vary, "--workers=1", "--time-limit=5", keys={}),
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    said, error = process.communicate(timeout=600)
    assert process.returncode == 1
    words = " ".join(said.split())  # Lines are filled.
    assert words.startswith(
        "3 runs: 2 finished, 1 timed out run 1, integrator.target_realtime_rate"
    )
    assert ": timed out: " in words
    assert "runs 1 died or took too long; the same command tries again" in error


@pytest.mark.slow
@pytest.mark.parametrize(
    ("variations", "words"),
    [
        ([], "variation"),
        ([{"start.error.tool.z": 1.0}], r"start: .*'error'.*'errors'"),
        ([{"duration": 1.0}, {"duration": "a"}], r"duration: .*'a'"),
        ([{"duration": value} for value in (1.0, float("nan"), 2.0)], r"duration: .*nan"),
        ([{"outputs.3.axes": "z"}], r"outputs: .*'3'"),
        ([{"duration": object()}], "duration: "),
        ([{"start.errors.tool.x": 0.1}], r"start.errors: .*'tool.x'"),
        ([{"plant.parameters.link1.mas": 1.0}], "'link1.mas'"),
        ([{"plant.parameters.wall.position": [1.0, 2.0]}], r"wall.position' .*3"),
    ],
)
def test_what_cannot_be_is_reported_before_anything_runs(variations, words, tmp_path):
    file = tmp_path / "new" / "runs.db"
    with pytest.raises(ScenarioError, match=words):
        dd.sweep(chosen(), variations, file)
    assert not file.parent.exists()


# What it says and draws.


def made(outcomes=("finished", "failed", "finished", "refused")):
    """A study of which all is known."""
    variations, results = [], []
    for run, outcome in enumerate(outcomes):
        figures = (
            {"largest error of z [m]": 0.1 * run, "steps": 7.0} if outcome != "refused" else {}
        )
        reason = "" if outcome == "finished" else "it cannot go on"
        variations.append({"a": run // 2, "b": [float(run % 2)]})
        results.append(RunResult(Outcome(outcome), reason, figures))
    return Study(tuple(variations), tuple(results))


def test_the_table_and_the_summary():
    study = made()
    assert study.table() == {
        "run": [0, 1, 2, 3],
        "a": [0, 0, 1, 1],
        "b": [[0.0], [1.0], [0.0], [1.0]],
        "outcome": ["finished", "failed", "finished", "refused"],
        "reason": ["", "it cannot go on", "", "it cannot go on"],
        "largest error of z [m]": [0.0, 0.1, 0.2, None],
        "steps": [7.0, 7.0, 7.0, None],
    }
    text = str(study)
    assert text.startswith("4 runs: 2 finished, 1 failed, 1 refused\n")
    assert "run 1, a=0, b=[1.0]: failed: it cannot go on\n" in text
    assert "run 3, a=1, b=[1.0]: refused: it cannot go on\n" in text
    row = next(line.split() for line in text.splitlines() if line.startswith("largest error"))
    assert row[-5:] == ["0", "0", "0.1", "0.2", "2"]
    assert repr(study) == "Study(4 runs: 2 finished, 1 failed, 1 refused)"
    np.testing.assert_array_equal(study.values("steps"), [7.0, 7.0, 7.0, np.nan])
    with pytest.raises(ModelError, match=r"'step'.*'steps'"):
        study.values("step")


def test_it_leaves_its_files(tmp_path):
    written = made().save(tmp_path / "new")
    assert [path.name for path in written] == list(FILES)
    assert written[1].read_bytes().startswith(b"\x89PNG")
    with open(written[0], newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert (rows[3]["b"], rows[3]["largest error of z [m]"], rows[3]["outcome"]) == (
        "[1.0]", "", "refused",
    )  # fmt: skip


def test_the_plot_has_each_figure_that_varies_over_the_first_key_that_does():
    (axis,) = made().plot().axes
    assert (axis.get_title(), axis.get_xlabel()) == ("largest error of z [m]", "a")
    points, crosses = axis.lines
    np.testing.assert_array_equal(points.get_xydata()[:3], [[0.0, 0.0], [0.0, 0.1], [1.0, 0.2]])
    np.testing.assert_array_equal(crosses.get_xdata(), [0.0, 1.0])
    assert made(("refused", "refused")).plot().axes == []
