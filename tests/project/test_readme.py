"""The README's Python blocks run as printed, and its files exist."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from drake_dae.cli import main

ROOT = Path(__file__).parents[2]
README = (ROOT / "README.md").read_text(encoding="utf-8")
BLOCKS = re.findall(r"```python\n(.*?)```", README, flags=re.DOTALL)


@pytest.mark.slow
@pytest.mark.parametrize("number", range(len(BLOCKS)))
def test_block_runs(number, tmp_path):
    """In any folder, as after `pip install`."""
    printed = subprocess.run(
        [sys.executable, "-W", "error", "-c", BLOCKS[number]],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        check=True,
        capture_output=True,
        text=True,
    ).stdout
    assert printed.strip()
    for promised in re.findall(r"print\(.*\)  # (.*)", BLOCKS[number]):
        assert printed.strip().splitlines()[-1] == promised


@pytest.mark.slow
def test_the_first_scenario_runs_as_printed(tmp_path, capsys):
    (scenario, *_) = re.findall(r"```yaml\n(.*?)```", README, flags=re.DOTALL)
    assert len(scenario.splitlines()) <= 15
    (tmp_path / "my_arm.yaml").write_text(scenario, "utf-8")
    arm = ROOT / "examples" / "tasks" / "six_joint_arm.urdf"
    (tmp_path / "my_arm.urdf").write_text(arm.read_text("utf-8"), "utf-8")
    out = ["--out", str(tmp_path / "run"), "--set", "write.animation=false"]
    assert main(["simulate", str(tmp_path / "my_arm.yaml"), *out]) == 0
    assert "\nGOOD" in capsys.readouterr().out


def test_it_is_read_to_its_end():
    assert len(README.splitlines()) <= 110


def test_named_files_exist():
    names = re.findall(r"\]\((?!http)([^)]+)\)|`(drake_dae/[\w/]+\.py)`", README)
    for name in (a or b for a, b in names):
        assert (ROOT / name).exists(), name
