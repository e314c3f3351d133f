"""Imports run one way, and only to what pyproject.toml declares."""

import ast
import os
import re
import sys
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "drake_dae"

# A module imports from its own layer and from layers before it; "" is drake_dae/__init__.py, which
# gathers the public names, so that nothing but the command may import it.
LAYERS = (
    "errors",
    "arrays",
    "trace",
    "dae",
    "analysis",
    "robots",
    "symbolic",
    "systems",
    "simulation",
    "diagrams",
    "",
    "cli",
    "__main__",
)

# Distributions whose modules bear another name.
IMPORT_NAMES = {"drake": "pydrake", "pyyaml": "yaml"}


def declared_modules() -> set[str]:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    names = [re.split(r"[^\w.-]", requirement)[0] for requirement in project["dependencies"]]
    return {IMPORT_NAMES.get(name, name.replace("-", "_")) for name in names}


def modules() -> dict[str, Path]:
    """Every module of the package; os.walk, since rglob does not follow the link to diagrams."""
    found = {}
    for folder, _, files in os.walk(PACKAGE, followlinks=True):
        for path in (Path(folder, file) for file in files if file.endswith(".py")):
            parts = ("drake_dae", *path.relative_to(PACKAGE).with_suffix("").parts)
            found[".".join(parts)] = path
    return found


def imported_modules(module: str, source: str, existing: set[str]) -> set[str]:
    """Absolute names of the modules that a module imports, wherever in its text."""
    found = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            base = module.split(".")[: -node.level] if node.level else []
            base += (node.module or "").split(".") if node.module else []
            for alias in node.names:
                member = ".".join([*base, alias.name])
                is_module = member in existing or f"{member}.__init__" in existing
                found.add(member if is_module else ".".join(base))
    return found


def layer(module: str) -> str:
    parts = module.removesuffix(".__init__").split(".")
    return parts[1] if len(parts) > 1 else ""


def violations(module: str, source: str, existing: set[str]) -> list[str]:
    own = layer(module)
    if own not in LAYERS:
        return [f"{module} stands in no layer"]
    found = []
    for imported in sorted(imported_modules(module, source, existing)):
        top = imported.split(".")[0]
        if top == "drake_dae":
            other = layer(imported)
            if other not in LAYERS or LAYERS.index(other) > LAYERS.index(own):
                found.append(f"{module} imports {imported}, which stands above it")
        elif own == "dae" and top == "pydrake":
            found.append(f"{module} imports {imported}: drake_dae.dae is free of Drake")
        elif top not in sys.stdlib_module_names | declared_modules():
            found.append(f"{module} imports {imported}, which pyproject.toml does not declare")
    return found


def test_every_import_points_down() -> None:
    paths = modules()
    assert {"drake_dae.__init__", "drake_dae.errors", "drake_dae.diagrams.__init__"} <= set(paths)
    found = [
        violation
        for module, path in paths.items()
        for violation in violations(module, path.read_text(), set(paths))
    ]
    assert not found, "\n".join(found)


EXISTING = {
    "drake_dae.__init__",
    "drake_dae.errors",
    "drake_dae.dae.__init__",
    "drake_dae.dae.system",
    "drake_dae.robots.__init__",
    "drake_dae.robots.model",
    "drake_dae.diagrams.__init__",
    "drake_dae.cli",
}


@pytest.mark.parametrize(
    ("module", "source"),
    [
        ("drake_dae.dae.system", "from drake_dae.robots.model import RobotModel"),
        ("drake_dae.dae.system", "from drake_dae.robots import model"),
        ("drake_dae.dae.system", "from drake_dae import robots"),
        ("drake_dae.dae.system", "from ..robots import model"),
        ("drake_dae.dae.__init__", "from ..robots import model"),
        ("drake_dae.dae.system", "import drake_dae.robots.model as m"),
        ("drake_dae.dae.system", "def f():\n    import drake_dae.robots"),
        ("drake_dae.dae.system", "if TYPE_CHECKING:\n    from drake_dae.robots import RobotModel"),
        ("drake_dae.dae.system", "from drake_dae import RobotModel"),
        ("drake_dae.dae.system", "import pydrake.math"),
        ("drake_dae.dae.system", "from pydrake.all import RigidTransform"),
        ("drake_dae.errors", "from .dae import system"),
        ("drake_dae.robots.model", "import drake_dae.cli"),
        ("drake_dae.robots.model", "import torch"),
        ("drake_dae.systems.plant", "from drake_dae.simulation.record import Record"),
        ("drake_dae.diagrams.__init__", "import pytest"),
        ("drake_dae.__init__", "from drake_dae.cli import main"),
        ("drake_dae.helpers", "import math"),
    ],
)
def test_a_violation_is_found(module: str, source: str) -> None:
    assert len(violations(module, source, EXISTING)) == 1


@pytest.mark.parametrize(
    ("module", "source"),
    [
        ("drake_dae.dae.system", "from drake_dae.errors import ModelError\nimport casadi, math"),
        ("drake_dae.dae.system", "from .. import errors"),
        ("drake_dae.robots.model", "from drake_dae.dae import system\nimport pydrake.math"),
        ("drake_dae.diagrams.__init__", "from drake_dae.simulation import record"),
        ("drake_dae.__init__", "from drake_dae.diagrams import scenario\nfrom .dae import system"),
        ("drake_dae.cli", "from drake_dae import __version__"),
        ("drake_dae.__main__", "from drake_dae.cli import main"),
    ],
)
def test_an_import_that_points_down_passes(module: str, source: str) -> None:
    assert violations(module, source, EXISTING) == []
