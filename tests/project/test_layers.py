"""Imports run one way (tests/support/house.py); each equation (1)-(83) has its line and test."""

import re
import subprocess
import sys
from pathlib import Path

import pytest
from equations import LAST, WITHOUT_LINE, lines, proofs
from house import ROOMS, ROOT, modules, room, upward_imports


def test_every_import_points_down() -> None:
    assert {"drake_dae.__init__", "drake_dae.errors", "drake_dae.diagrams.__init__"} <= {*modules()}
    assert upward_imports() == []


def loaded_by(code: str) -> set[str]:
    """All modules that a fresh interpreter holds after some code."""
    command = [sys.executable, "-W", "error", "-c", f"import sys\n{code}\nprint(*sys.modules)"]
    done = subprocess.run(command, cwd=ROOT, check=True, capture_output=True, text=True)
    return set(done.stdout.splitlines()[-1].split())


@pytest.mark.slow
def test_the_mathematics_loads_no_drake() -> None:
    free = ROOMS[: ROOMS.index("robots")]
    names = {name.removesuffix(".__init__") for name in modules() if room(name) in free}
    loaded = loaded_by("".join(f"import {name}\n" for name in sorted(names)))
    assert names <= loaded
    assert "casadi" in loaded
    assert "pydrake" not in loaded


@pytest.mark.slow
def test_what_needs_no_robot_loads_none() -> None:
    words = [["list"], ["print"], ["print", "--path"], ["--version"], ["--help"]]
    loaded = loaded_by(
        f"from drake_dae.cli import main\nfor words in {words}:\n"
        "    try:\n        main(words)\n    except SystemExit:\n        pass"
    )
    assert "drake_dae" in loaded
    assert loaded.isdisjoint({"pydrake", "casadi", "scipy", "matplotlib", "pydantic", "tqdm"})


@pytest.mark.slow
def test_a_run_loads_nothing_that_draws(tmp_path: Path) -> None:
    """It would take as long as all else of a short run; `drake-dae plot RUN --all` draws."""
    words = ["simulate", "two_link_wall", "--set", "duration=0.05", "--out", str(tmp_path / "run")]
    loaded = loaded_by(f"from drake_dae.cli import main\nmain({words})")
    assert (tmp_path / "run" / "animation.html").exists()
    assert "pydrake" in loaded
    assert loaded.isdisjoint({"matplotlib", "PIL", "scipy.integrate", "scipy.optimize"})


GUIDE = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")


def test_the_guide_has_the_order_of_the_rooms() -> None:
    (order,) = re.findall(r"^    (errors <- .*\n.*)$", GUIDE, flags=re.MULTILINE)
    told = [part.strip().removesuffix("/__init__") for part in order.split("<-")]
    assert told == [*ROOMS[:-1]]


def test_files_that_the_guide_names_exist() -> None:
    names = re.findall(r"`(\w+/[\w/]+\.py)`|\]\(([\w/.]+)\)", GUIDE)
    assert len(names) > 30
    for name in (first or second for first, second in names):
        assert (ROOT / name).exists() or (ROOT / "drake_dae" / name).exists(), name


def test_each_equation_has_a_test_and_a_line_or_a_reason():
    places, every = set(lines()), set(range(1, LAST + 1))
    assert places | set(WITHOUT_LINE) == every
    assert not places & set(WITHOUT_LINE)
    assert set(proofs()) == every
