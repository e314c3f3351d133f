"""The tasks in examples/tasks: short files, written from the documentation alone, that run well."""

from pathlib import Path

import pytest

from drake_dae.cli import main

TASKS = sorted((Path(__file__).parents[2] / "examples" / "tasks").glob("*.yaml"))
BARE = ["--set", "write.plots=false", "--set", "write.animation=false"]


def test_tasks_are_short():
    assert len(TASKS) == 6
    assert max(len(task.read_text("utf-8").splitlines()) for task in TASKS) <= 20


@pytest.mark.slow
@pytest.mark.parametrize("task", TASKS, ids=lambda task: task.stem)
def test_task_is_tracked_as_predicted(task, tmp_path, capsys):
    """Also where the verdict has the integrator's default accuracy, 1e-6."""
    arguments = ["simulate", str(task), "--out", str(tmp_path / "run"), *BARE]
    assert main(arguments) == 0
    assert "\nTracked as predicted:" in capsys.readouterr().out
