"""The README's Python blocks run as printed, and its files exist."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")
BLOCKS = re.findall(r"```python\n(.*?)```", README, flags=re.DOTALL)


@pytest.mark.parametrize("number", range(len(BLOCKS)))
def test_block_runs(number):
    printed = subprocess.run(
        [sys.executable, "-W", "error", "-c", BLOCKS[number]],
        cwd=ROOT,
        check=True,
        capture_output=True,
        text=True,
    ).stdout
    assert printed.strip()
    for promised in re.findall(r"print\(.*\)  # (.*)", BLOCKS[number]):
        assert printed.strip().splitlines()[-1] == promised


def test_named_files_exist():
    names = re.findall(r"\]\((?!http)([^)]+)\)|`(drake_dae/[\w/]+\.py)`", README)
    for name in (a or b for a, b in names):
        assert (ROOT / name).exists(), name
