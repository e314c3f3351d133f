"""The reference pages generated from the code: public names, keys, commands, equations."""

import ast
import contextlib
import io
import re
import sys
from collections import defaultdict
from pathlib import Path
from unittest.mock import patch

import drake_dae
from book.keys import keys_page
from book.pages import BOOK, blocks, pages
from drake_dae.cli import main
from drake_dae.scenario.shipped import description, shipped_scenarios

ROOT = BOOK.parents[1]
sys.path.append(str(ROOT / "tests" / "support"))

ROOMS = {
    "dae": "Systems, laws and theory",
    "references": "References",
    "robots": "Robots",
    "blocks": "Blocks",
    "systems": "Blocks of a diagram",
    "diagrams": "Closed loops and records",
    "scene": "The view in Meshcat",
    "analysis": "Analysis",
    "running": "Runs, rollouts and exports",
    "pictures": "Pictures",
    "scenario": "Scenarios",
    "studies": "Studies",
}
"""Room of the library -> title of the page with its public names."""


def generated_pages() -> dict[str, str]:
    """Returns path relative to the book's folder -> text of the page."""
    return {
        "gallery.md": gallery_page(),
        "reference/names.md": names_page(),
        **{f"reference/names/{room}.md": room_page(room) for room in ROOMS},
        "reference/keys.md": keys_page(),
        "reference/commands.md": commands_page(),
        "reference/equations.md": equations_page(),
    }


def gallery_page() -> str:
    """Returns a page with a picture of a run of each shipped scenario."""
    lines = ["# Gallery", "", "The shipped scenarios: `drake-dae simulate NAME` runs one."]
    for name, path in shipped_scenarios().items():
        text = description(path)
        picture = f"![Moments of a run of {name}: {text}](gallery/{name}.png)"
        lines += ["", f"## {name}", "", text, "", picture]
    return "\n".join(lines) + "\n"


def public_names() -> dict[str, str]:
    """Returns public name -> its module."""
    stub = ast.parse(Path(drake_dae.__file__).with_suffix(".pyi").read_text("utf-8"))
    return {
        alias.asname or alias.name: f"drake_dae.{node.module}"
        for node in ast.walk(stub)
        if isinstance(node, ast.ImportFrom) and node.module
        for alias in node.names
    }


def uses() -> dict[str, list[Path]]:
    """Returns public name -> the pages and examples whose code uses it."""
    names, users = set(public_names()), defaultdict(list)
    sources = {page: "\n".join(b.text for b in blocks(page)) for page in pages()}
    for path in sorted(ROOT.glob("examples/*.py")):
        sources[path] = path.read_text("utf-8")
    for path, text in sources.items():
        for name in sorted(names & set(re.findall(r"\b[A-Za-z_]\w+\b", text))):
            users[name].append(path)
    return users


def names_page() -> str:
    """Returns a page that lists the public names by room, each with a link to its documentation."""
    lines = ["# Public names", "", "Each is a name of `drake_dae`: `import drake_dae as dd`.", ""]
    for room, title in ROOMS.items():
        names = [name for name, module in public_names().items() if _room(module) == room]
        names = [f"[`{name}`](#name-{name})" for name in names]
        lines += [f"**[{title}](names/{room}.md)**: {', '.join(names)}", ""]
    contents = "\n".join(f"names/{room}" for room in ROOMS)
    return "\n".join(lines) + f"\n```{{toctree}}\n:hidden:\n\n{contents}\n```\n"


def room_page(room: str) -> str:
    """Returns a page of the public names of a room: signature, docstring, and pages that use it."""
    users, lines = uses(), [f"# {ROOMS[room]}", ""]
    for name, module in public_names().items():
        if _room(module) == room:
            lines += _entry(name, module, users.get(name, []))
    return "\n".join(lines) + "\n"


def _room(module: str) -> str:
    return module.split(".")[1]


def _entry(name: str, module: str, users: list[Path]) -> list[str]:
    value = getattr(drake_dae, name)
    kind = "autoclass" if isinstance(value, type) else "autofunction"
    members = ["   :members:", "   :show-inheritance:"] if kind == "autoclass" else []
    links = ", ".join(_link(path) for path in users)
    return [
        f"(name-{name})=",
        "```{eval-rst}",
        f".. {kind}:: {module}.{name}",
        *members,
        "```",
        *([f"Used in: {links}", ""] if users else [""]),
    ]


def _link(path: Path) -> str:
    if path.suffix == ".md":
        title = path.read_text("utf-8").split("\n", 1)[0].removeprefix("# ")
        return f"[{title}](/{path.relative_to(BOOK)})"
    return f"`{path.relative_to(ROOT)}`"


def commands_page() -> str:
    """Returns a page with the help text of each command."""
    names = re.search(r"\{([\w,]+)\}", _help([]))
    assert names is not None
    lines = ["# Commands", "", "```text", _help([]).strip(), "```"]
    for name in names[1].split(","):
        lines += ["", f"## {name}", "", "```text", _help([name]).strip(), "```"]
    return "\n".join(lines) + "\n"


def _help(arguments: list[str]) -> str:
    printed = io.StringIO()
    with (
        patch.dict("os.environ", COLUMNS="88"),
        contextlib.redirect_stdout(printed),
        contextlib.suppress(SystemExit),
    ):
        main([*arguments, "--help"])
    return printed.getvalue()


def equations_page() -> str:
    """Returns a table of the paper's equations: the line that computes each, and its test."""
    from equations import table

    return (
        "# Equations\n\nFrom each equation of the paper to the line that computes it, and to the "
        f"test that proves it. `make table NAME=equations` prints the same.\n\n{table()}\n"
    )
