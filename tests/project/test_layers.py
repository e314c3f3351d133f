"""Imports run one way (tests/support/house.py); each equation (1)-(83) has its line and test."""

import re
import subprocess
import sys
from collections.abc import Collection
from pathlib import Path

import pytest
from equations import LAST, WITHOUT_LINE, lines, proofs, table
from house import FLOORS, ROOT, WITHOUT_DRAKE, imports, modules, room, violations


def test_every_import_points_down() -> None:
    found = imports()
    assert {"drake_dae.__init__", "drake_dae.errors", "drake_dae.diagrams.__init__"} <= set(found)
    wrong = [line for module, imported in found.items() for line in violations(module, imported)]
    assert not wrong, "\n".join(wrong)


def loaded_with(rooms: Collection[str]) -> set[str]:
    """All modules that a fresh interpreter holds after it has imported every file of some rooms."""
    names = sorted(m.removesuffix(".__init__") for m in modules() if room(m) in rooms)
    code = "import sys\n" + "".join(f"import {name}\n" for name in names) + "print(*sys.modules)"
    command = [sys.executable, "-W", "error", "-c", code]
    printed = subprocess.run(command, cwd=ROOT, check=True, capture_output=True, text=True).stdout
    assert set(names) <= set(printed.split())
    return set(printed.split())


@pytest.mark.slow
def test_the_mathematics_loads_no_drake() -> None:
    tops = {module.split(".")[0] for module in loaded_with(WITHOUT_DRAKE)}
    assert "casadi" in tops
    assert "pydrake" not in tops


@pytest.mark.slow
@pytest.mark.parametrize(
    "words", [["list"], ["print"], ["print", "--path"], ["--version"], ["--help"]]
)
def test_what_needs_no_robot_loads_none(words: list[str]) -> None:
    code = (
        "import sys\nfrom drake_dae.cli import main\n"
        f"try:\n    main({words})\nexcept SystemExit:\n    pass\n"
        "print(*sys.modules)"
    )
    command = [sys.executable, "-W", "error", "-c", code]
    printed = subprocess.run(command, cwd=ROOT, check=True, capture_output=True, text=True).stdout
    tops = {name.split(".")[0] for name in printed.splitlines()[-1].split()}
    assert "drake_dae" in tops
    assert tops.isdisjoint({"pydrake", "casadi", "scipy", "matplotlib", "pydantic", "tqdm"})


@pytest.mark.slow
def test_a_run_loads_nothing_that_draws(tmp_path: Path) -> None:
    """It would take as long as all else of a short run; `drake-dae plot RUN --all` draws."""
    words = ["simulate", "two_link_wall", "--set", "duration=0.05", "--out", str(tmp_path / "run")]
    code = f"import sys\nfrom drake_dae.cli import main\nmain({words})\nprint(*sys.modules)"
    command = [sys.executable, "-W", "error", "-c", code]
    printed = subprocess.run(command, cwd=ROOT, check=True, capture_output=True, text=True).stdout
    loaded = set(printed.splitlines()[-1].split())
    assert (tmp_path / "run" / "animation.html").exists()
    assert "pydrake" in loaded
    assert loaded.isdisjoint({"matplotlib", "PIL", "scipy.integrate", "scipy.optimize"})


@pytest.mark.slow
def test_traced_functions_load_no_system() -> None:
    loaded = {room(name) for name in loaded_with(["trace"]) if name.startswith("drake_dae.")}
    assert loaded == {"errors", "arrays", "arguments", "trace"}


GUIDE = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")


def test_the_guide_has_the_order_of_the_rooms() -> None:
    (order,) = re.findall(r"^    (errors <- .*\n.*)$", GUIDE, flags=re.MULTILINE)
    told = [tuple(floor.strip() for floor in part.split(",")) for part in order.split("<-")]
    told = [tuple(room.removesuffix("/__init__") for room in floor) for floor in told]
    assert told == [floor for floor in FLOORS if floor not in (("compiler",), ("__main__",))]


def test_files_that_the_guide_names_exist() -> None:
    names = re.findall(r"`(\w+/[\w/]+\.py)`|\]\(([\w/.]+)\)", GUIDE)
    assert len(names) > 30
    for name in (first or second for first, second in names):
        assert (ROOT / name).exists() or (ROOT / "drake_dae" / name).exists(), name


ALL = set(range(1, LAST + 1))


def test_each_equation_has_a_line_or_a_reason():
    places = set(lines())
    assert places | set(WITHOUT_LINE) == ALL
    assert not places & set(WITHOUT_LINE)


def test_each_equation_has_a_test():
    assert set(proofs()) == ALL


def test_the_table_has_a_row_for_each():
    assert table().count("\n") == LAST + 1
