"""The one rule of the house: imports run one way.

A room is a folder or a file at the top of the package. Imports are read from the text, so that
nothing is loaded, and those inside functions or under TYPE_CHECKING count too.
"""

import ast
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).parents[2]
PACKAGE = ROOT / "drake_dae"

# From the ground up. "drake_dae" is drake_dae/__init__.py, which gathers the public names.
ROOMS = (
    *("errors", "files", "arrays", "arguments", "trace", "dae", "references", "robots", "blocks"),
    *("systems", "scene", "diagrams", "analysis", "running", "pictures", "scenario", "studies"),
    *("drake_dae", "commands", "cli", "__main__"),
)

# The order of the paper: a file of dae imports only those before it; dae/__init__.py gathers.
PAPER = (
    *("signals", "contacts", "fields", "system", "manifold", "derivatives", "samples", "margins"),
    *("assumptions", "redundancy", "relative_degrees", "structure", "normal_form", "gains"),
    *("law_model", "tracking", "disturbance", "contact_gains", "one_direction", "advised_gains"),
    *("pinned_motion", "stability", "zero_dynamics", "extension", "__init__"),
)


def modules() -> dict[str, Path]:
    """Every module of the package."""
    paths = {path: path.relative_to(PACKAGE.parent) for path in PACKAGE.rglob("*.py")}
    return {".".join(inside.with_suffix("").parts): path for path, inside in paths.items()}


def room(module: str) -> str:
    """The room that a module of the package stands in."""
    parts = module.removesuffix(".__init__").split(".")
    return parts[1] if len(parts) > 1 else "drake_dae"


def height(module: str) -> tuple[int, int]:
    """Of its room in the house, and of a file of dae in the paper."""
    if room(module) != "dae":
        return ROOMS.index(room(module)), 0
    return ROOMS.index("dae"), PAPER.index([*module.split("."), "__init__"][2])


def imported(module: str, existing: dict[str, Path]) -> Iterator[str]:
    """Absolute names of the modules of the package that a module imports."""
    for node in ast.walk(ast.parse(existing[module].read_text("utf-8"))):
        if isinstance(node, ast.Import):
            yield from (a.name for a in node.names if a.name.split(".")[0] == "drake_dae")
        elif isinstance(node, ast.ImportFrom):
            base = module.split(".")[: -node.level] if node.level else []
            base += (node.module or "").split(".") if node.module else []
            if base[0] == "drake_dae":
                for alias in node.names:
                    member = ".".join([*base, alias.name])
                    known = member in existing or f"{member}.__init__" in existing
                    yield member if known else ".".join(base)


def upward_imports() -> list[str]:
    """What imports from above, as sentences."""
    known = modules()
    return [
        f"{module} imports {other}, which does not stand below it"
        for module in known
        for other in imported(module, known)
        if height(other) > height(module)
    ]
