"""The tasks in examples/tasks: short files, written from the documentation alone, that run well."""

import json
import sysconfig
import warnings
from pathlib import Path

import pytest
from command_line import QUICK

from drake_dae.cli import main
from drake_dae.errors import GeometryWarning

TASKS = sorted((Path(__file__).parents[2] / "examples" / "tasks").glob("*.yaml"))
SHARE = Path(sysconfig.get_path("purelib"), "cmeel.prefix/share")


def find_vendors(task, monkeypatch):
    """Lets a task find the robots of the package example-robot-data, or skips the test."""
    if "example-robot-data" in task.read_text("utf-8"):
        if not SHARE.is_dir():
            pytest.skip("pip install example-robot-data")
        monkeypatch.setenv("ROS_PACKAGE_PATH", str(SHARE))


def test_tasks_are_short():
    assert TASKS
    lengths = {task.stem: len(task.read_text("utf-8").splitlines()) for task in TASKS}
    assert lengths.pop("quadruped") <= 24  # Each of its four feet takes a line.
    assert max(lengths.values()) <= 20


@pytest.mark.slow
@pytest.mark.parametrize(
    "task",
    [
        pytest.param(task, marks=[pytest.mark.thorough] * (task.stem == "quadruped"))
        for task in TASKS
    ],
    ids=lambda task: task.stem,
)
def test_task_is_tracked_as_predicted(task, tmp_path, monkeypatch, capsys):
    """Also where the verdict has the integrator's default accuracy, 1e-6."""
    arguments = ["simulate", str(task), "--json", "--out", str(tmp_path / "run"), *QUICK]
    find_vendors(task, monkeypatch)
    with warnings.catch_warnings(action="ignore", category=GeometryWarning):
        assert main(arguments) == 0
    found = json.loads(capsys.readouterr().out)
    assert "prediction" not in [one["kind"] for one in found["findings"]]
