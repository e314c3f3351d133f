"""The tasks in examples/tasks: short files, written from the documentation alone, that run well."""

import warnings
from pathlib import Path

import pytest
from gallery.__main__ import robot_data

from drake_dae import Record
from drake_dae.cli import main
from drake_dae.errors import GeometryWarning

TASKS = sorted((Path(__file__).parents[2] / "examples" / "tasks").glob("*.yaml"))
BARE = ["--set", "write.plots=false", "--set", "write.animation=false"]


def test_tasks_are_short():
    assert len(TASKS) == 10
    lengths = {task.stem: len(task.read_text("utf-8").splitlines()) for task in TASKS}
    assert lengths.pop("quadruped") <= 24  # Each of its four feet takes a line.
    assert max(lengths.values()) <= 20


@pytest.mark.slow
@pytest.mark.parametrize("task", TASKS, ids=lambda task: task.stem)
def test_task_is_tracked_as_predicted(task, tmp_path, capsys):
    """Also where the verdict has the integrator's default accuracy, 1e-6."""
    arguments = ["simulate", str(task), "--out", str(tmp_path / "run"), *BARE]
    if "example-robot-data" in task.read_text("utf-8"):
        data = robot_data()
        if data is None:
            pytest.skip("pip install example-robot-data")
        arguments += ["--set", f"robot.packages={{example-robot-data: '{data}'}}"]
    with warnings.catch_warnings(action="ignore", category=GeometryWarning):
        assert main(arguments) == 0
    assert "\nTracked as predicted:" in capsys.readouterr().out


@pytest.mark.slow
@pytest.mark.parametrize("name", ["peg_in_hole", "deburring", "grinding"])
def test_ideal_contact_is_kept_to_a_nanometre(name, tmp_path):
    """With an integrator that is as accurate; a projection follows each of its steps."""
    (task,) = (task for task in TASKS if task.stem == name)
    accurate = ["--set", "integrator.accuracy=1.0e-9", "--set", "duration=2"]
    assert main(["simulate", str(task), "--out", str(tmp_path), *BARE, *accurate]) == 0
    record = Record.load(tmp_path / "record.npz")
    assert abs(record["constraint_residual"]).max() < 1e-9
