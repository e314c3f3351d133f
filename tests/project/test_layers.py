"""Imports run one way, and only to what pyproject.toml declares; see tests/support/house.py."""

import re
import subprocess
import sys
from collections.abc import Collection
from pathlib import Path

import pytest
from draw_house import draw
from house import (
    LONG,
    PAPER,
    ROOMS,
    ROOT,
    WITHOUT_DRAKE,
    borrowed,
    circle,
    crowded,
    folder_imports,
    folders,
    imported_modules,
    imports,
    may_import,
    modules,
    room,
    shared_names,
    too_long,
    violations,
)


def test_every_import_points_down() -> None:
    found = imports()
    assert {"drake_dae.__init__", "drake_dae.errors", "drake_dae.diagrams.__init__"} <= set(found)
    wrong = [line for module, imported in found.items() for line in violations(module, imported)]
    assert not wrong, "\n".join(wrong)


@pytest.mark.slow
def test_no_imports_go_round() -> None:
    assert circle(imports()) == []
    assert circle({"a": {"b"}, "b": {"c"}, "c": {"d"}}) == []
    assert circle({"a": {"b"}, "b": {"c", "d"}, "c": {"b"}}) == ["b", "c"]


@pytest.mark.slow
def test_no_imports_go_round_between_folders() -> None:
    found = imports()
    for folder in folders(found):
        assert circle(folder_imports(found, folder)) == [], folder
    around = {"a.b.x": {"a.c.y"}, "a.c.z": {"a.b.w"}, "a.d": {"a.b.x"}}
    assert circle(around) == []
    assert circle(folder_imports(around, "a")) == ["b", "c"]


def test_no_folder_is_crowded() -> None:
    found = modules()
    assert crowded(found) == []
    names = [f"drake_dae.more.file{i}" for i in range(13)]
    assert len(crowded([*names[1:], "drake_dae.more.__init__"])) == 0
    assert len(crowded(names)) == 1


def test_long_files_have_a_reason() -> None:
    lines = {name: path.read_text().count("\n") for name, path in modules().items()}
    assert too_long(lines) == []
    assert len(too_long({**lines, "drake_dae.long": 351})) == 1
    assert len(too_long(dict.fromkeys(LONG, 350))) == len(LONG)


def test_no_two_classes_have_one_name() -> None:
    assert shared_names({name: path.read_text() for name, path in modules().items()}) == []
    assert len(shared_names({"a": "class A:\n", "b": "x = 1\nclass A(B):\n"})) == 1


def test_tests_borrow_from_support_alone(tmp_path: Path) -> None:
    assert borrowed(ROOT / "tests") == []
    for name in ("a/test_one.py", "b/test_two.py"):
        (tmp_path / name).parent.mkdir()
        (tmp_path / name).write_text("from test_one import one\n")
    (wrong,) = borrowed(tmp_path)
    assert "test_two.py imports test_one" in wrong


EXISTING = {
    "drake_dae.__init__",
    "drake_dae.errors",
    "drake_dae.analysis.analyze",
    "drake_dae.dae.__init__",
    "drake_dae.dae.tracking.gains",
    "drake_dae.dae.states.__init__",
    "drake_dae.dae.states.samples",
    "drake_dae.dae.structure.structure",
    "drake_dae.dae.system.system",
    "drake_dae.robots.__init__",
    "drake_dae.robots.model",
    "drake_dae.symbolic",
    "drake_dae.diagrams.__init__",
    "drake_dae.cli",
}


@pytest.mark.parametrize(
    ("module", "source"),
    [
        ("drake_dae.dae.system.system", "from drake_dae.robots.model import RobotModel"),
        ("drake_dae.dae.system.system", "from drake_dae.robots import model"),
        ("drake_dae.dae.system.system", "from drake_dae import robots"),
        ("drake_dae.dae.derivatives", "from ..robots import model"),
        ("drake_dae.dae.__init__", "from ..robots import model"),
        ("drake_dae.dae.system.system", "import drake_dae.robots.model as m"),
        ("drake_dae.dae.system.system", "def f():\n    import drake_dae.robots"),
        (
            "drake_dae.dae.system.system",
            "if TYPE_CHECKING:\n    from drake_dae.robots import RobotModel",
        ),
        ("drake_dae.dae.system.system", "from drake_dae import RobotModel"),
        ("drake_dae.dae.system.system", "import pydrake.math"),
        ("drake_dae.dae.system.system", "from pydrake.all import RigidTransform"),
        ("drake_dae.dae.system.system", "from drake_dae.dae.structure.structure import Structure"),
        ("drake_dae.dae.derivatives", "from .states import samples"),
        ("drake_dae.dae.system.system", "from drake_dae.dae import find_structure"),
        ("drake_dae.dae.states.samples", "from ..structure import Structure"),
        ("drake_dae.dae.helpers", "import math"),
        ("drake_dae.trace.lie", "from drake_dae.dae.system.system import DaeSystem"),
        ("drake_dae.trace.lie", "import pydrake.symbolic"),
        ("drake_dae.analysis.analyze", "from drake_dae.robots.model import RobotModel"),
        ("drake_dae.analysis.analyze", "import pydrake.math"),
        ("drake_dae.robots.model", "from drake_dae.analysis.analyze import analyze"),
        ("drake_dae.robots.model", "from drake_dae.symbolic import from_symbolic"),
        ("drake_dae.errors", "from .dae import system"),
        ("drake_dae.robots.model", "import drake_dae.cli"),
        ("drake_dae.robots.model", "import torch"),
        (
            "drake_dae.systems.plants.dae_plant",
            "from drake_dae.simulation.records.record import Record",
        ),
        ("drake_dae.diagrams.__init__", "import pytest"),
        ("drake_dae.__init__", "from drake_dae.cli import main"),
        ("drake_dae.helpers", "import math"),
    ],
)
def test_a_violation_is_found(module: str, source: str) -> None:
    assert len(violations(module, imported_modules(module, source, EXISTING))) == 1


@pytest.mark.parametrize(
    ("module", "source"),
    [
        (
            "drake_dae.dae.system.system",
            "from drake_dae.errors import ModelError\nimport casadi, math",
        ),
        ("drake_dae.dae.derivatives", "from .. import errors"),
        (
            "drake_dae.dae.structure.structure",
            "from .system import DaeSystem\nfrom .states import samples",
        ),
        ("drake_dae.dae.states.region", "from drake_dae.dae.states import samples"),
        ("drake_dae.robots.model", "from drake_dae.dae import system\nimport pydrake.math"),
        ("drake_dae.diagrams.__init__", "from drake_dae.simulation import record"),
        ("drake_dae.__init__", "from drake_dae.scenario import build\nfrom .dae import system"),
        ("drake_dae.cli", "from drake_dae import __version__"),
        ("drake_dae.__main__", "from drake_dae.cli import main"),
    ],
)
def test_an_import_that_points_down_passes(module: str, source: str) -> None:
    assert violations(module, imported_modules(module, source, EXISTING)) == []


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
    "words",
    [["list"], ["print"], ["print", "--path"], ["--version"], ["--help"], ["simulate", "--help"]],
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
def test_what_most_runs_do_not_need_loads_when_it_is_used() -> None:
    loaded = loaded_with(["commands"])
    assert "pydrake" in loaded
    assert loaded.isdisjoint({"matplotlib", "scipy.integrate", "scipy.optimize"})


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
    assert loaded == {"errors", "arrays", "trace"}


GUIDE = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")


def test_the_guide_has_the_rules_of_this_file() -> None:
    """Its table has a row a room, from the roof down: whether Drake is in, and what it imports."""
    told = {}
    table = re.findall(r"^\| `([\w./]+)` \| .* \| (yes|no) \| (.*) \|$", GUIDE, flags=re.MULTILINE)
    for written, drake, cell in table:
        name = {"__init__.py": "drake_dae"}.get(written, re.sub(r"\.py$|/$", "", written))
        below = may_import(name) if cell == "all below" else re.findall(r"`(\w+)`", cell)
        told[name] = (drake == "no", set(below))
    ruled = {name: (name in WITHOUT_DRAKE, set(may_import(name))) for name in reversed(ROOMS)}
    assert list(told.items()) == list(ruled.items())


def test_the_guide_has_the_order_of_the_paper() -> None:
    (order,) = re.findall(r"^    (system/(?:\s+\w+/?)*)$", GUIDE, flags=re.MULTILINE)
    assert tuple(name.rstrip("/") for name in order.split()) == PAPER


@pytest.mark.slow
def test_the_house_is_drawn(tmp_path) -> None:
    draw(tmp_path / "house.png")
    assert (tmp_path / "house.png").stat().st_size > 50_000


def test_files_that_the_guide_names_exist() -> None:
    names = re.findall(r"`((?:robots|dae|tests)/[\w/]+\.py)`|\]\(([\w/.]+)\)", GUIDE)
    assert len(names) > 10
    for name in (first or second for first, second in names):
        assert (ROOT / name).exists() or (ROOT / "drake_dae" / name).exists(), name
