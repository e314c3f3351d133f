"""The house that design and tests speak of: its rooms, who may import whom, and who does.

A room is a folder or a file at the top of the package. Imports are read from the text with `ast`,
so that nothing is loaded, and those inside functions or under TYPE_CHECKING count too.
"""

import ast
import re
import sys
import tomllib
from collections.abc import Iterator
from functools import cache
from pathlib import Path

ROOT = Path(__file__).parents[2]
PACKAGE = ROOT / "drake_dae"

# From the ground up: a room imports from itself and from the floors below it, never from a
# neighbour. "drake_dae" is drake_dae/__init__.py, which gathers the public names, so that nothing
# but the command may import it.
FLOORS = (
    ("errors",),
    ("files",),
    ("arrays",),
    ("arguments",),
    ("trace",),
    ("dae",),
    ("references",),
    ("robots",),
    ("blocks",),
    ("systems",),
    ("scene",),
    ("diagrams",),
    ("analysis",),
    ("running",),
    ("pictures",),
    ("scenario",),
    ("studies",),
    ("drake_dae",),
    ("commands",),
    ("cli",),
    ("__main__",),
)
ROOMS = tuple(room for floor in FLOORS for room in floor)

# The mathematics can be read, tested and used without Drake.
WITHOUT_DRAKE = ("errors", "arrays", "files", "arguments", "trace", "dae", "references")

# The order of the paper: a file of dae imports only files (or folders) before it.
PAPER = (
    "signals",
    "contacts",
    "fields",
    "system",
    "manifold",
    "derivatives",
    "samples",
    "margins",
    "assumptions",
    "redundancy",
    "relative_degrees",
    "structure",
    "normal_form",
    "gains",
    "law_model",
    "tracking",
    "disturbance",
    "contact_gains",
    "one_direction",
    "advised_gains",
    "pinned_motion",
    "stability",
    "zero_dynamics",
    "extension",
)
# Distributions whose modules bear another name.
IMPORT_NAMES = {"drake": "pydrake", "pycollada": "collada", "pyyaml": "yaml"}


@cache
def declared_modules() -> set[str]:
    """What pyproject.toml says that the package needs or can use, as names to import."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    extras = project["optional-dependencies"]
    used = [needed for extra, names in extras.items() if extra != "dev" for needed in names]
    requirements = [*project["dependencies"], *used]
    names = [re.split(r"[^\w.-]", requirement)[0] for requirement in requirements]
    return {IMPORT_NAMES.get(name, name.replace("-", "_")) for name in names}


def modules() -> dict[str, Path]:
    """Every module of the package."""
    paths = {path: path.relative_to(PACKAGE.parent) for path in PACKAGE.rglob("*.py")}
    return {".".join(inside.with_suffix("").parts): path for path, inside in paths.items()}


def statements(node: ast.AST) -> Iterator[ast.AST]:
    """All statements below a node; a walk through their expressions takes ten times as long."""
    for name in ("body", "orelse", "finalbody", "handlers", "cases"):
        for child in getattr(node, name, ()):
            yield child
            yield from statements(child)


def imported_modules(module: str, source: str, existing: set[str]) -> set[str]:
    """Absolute names of the modules that a module imports, wherever in its text."""
    found = set()
    for node in statements(ast.parse(source)):
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


@cache
def imports() -> dict[str, set[str]]:
    """For each module of the package, what it imports."""
    paths = modules()
    return {
        module: imported_modules(module, path.read_text(), set(paths))
        for module, path in paths.items()
    }


def room(module: str) -> str:
    """The room that a module of the package stands in."""
    parts = module.removesuffix(".__init__").split(".")
    return parts[1] if len(parts) > 1 else "drake_dae"


def may_import(name: str) -> tuple[str, ...]:
    """The rooms on the floors below a room."""
    below = next(i for i, floor in enumerate(FLOORS) if name in floor)
    return tuple(other for floor in FLOORS[:below] for other in floor)


def place(module: str) -> str:
    """The file or the folder of dae that a module is or stands in; "" for dae itself."""
    parts = module.removesuffix(".__init__").split(".")
    return parts[2] if len(parts) > 2 else ""


def violations(module: str, imported: set[str]) -> list[str]:
    """What is wrong with the imports of a module, as sentences."""
    own = room(module)
    if own not in ROOMS:
        return [f"{module} stands in no room"]
    if own == "dae" and place(module) not in ("", *PAPER):
        return [f"{module} has no place in the order of the paper (tests/support/house.py, PAPER)"]
    found = []
    for other in sorted(imported):
        top = other.split(".")[0]
        if top == "drake_dae":
            if room(other) not in (own, *may_import(own)):
                found.append(f"{module} imports {other}, which does not stand below it")
            elif own == room(other) == "dae" and not _in_order(module, other):
                found.append(f"{module} imports {other}, which comes later in the paper")
        elif top == "pydrake" and own in WITHOUT_DRAKE:
            found.append(f"{module} imports {other}: drake_dae.{own} is free of Drake")
        elif top not in sys.stdlib_module_names | declared_modules():
            found.append(f"{module} imports {other}, which pyproject.toml does not declare")
    return found


def _in_order(module: str, other: str) -> bool:
    first, second = place(other), place(module)
    if first not in PAPER or second not in PAPER:
        # dae/__init__.py may gather; nothing in dae imports it.
        return first != ""
    return PAPER.index(first) <= PAPER.index(second)
