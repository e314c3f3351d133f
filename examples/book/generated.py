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

ROOT = BOOK.parents[1]
sys.path.append(str(ROOT / "tests" / "support"))

TOPICS = {
    "dae": "Systems, laws and theory",
    "analysis": "Analysis",
    "robots": "Robots",
    "blocks": "Blocks",
    "systems": "Blocks of a diagram",
    "diagrams": "Closed loops and records",
    "running": "Runs, rollouts and exports",
    "compiler": "Diagrams as functions",
    "scenario": "Scenarios",
    "studies": "Studies",
    "scene": "The view in Meshcat",
    "pictures": "Pictures",
    "errors": "Errors",
}
"""Folder of the library -> title of the section with its public names."""


def generated_pages() -> dict[str, str]:
    """Returns path relative to the book's folder -> text of the page."""
    return {
        "reference/names.md": names_page(),
        "reference/keys.md": keys_page(),
        "reference/commands.md": commands_page(),
        "reference/equations.md": equations_page(),
    }


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
    """Returns a page of all public names by topic: signature, docstring, and pages that use it."""
    modules, users, by_topic = public_names(), uses(), defaultdict(list)
    for name, module in modules.items():
        by_topic[module.split(".")[1]].append(name)
    lines = ["# Public names", "", "Each is a name of `drake_dae`: `import drake_dae as dd`."]
    for topic, title in TOPICS.items():
        lines += ["", f"## {title}", ""]
        for name in sorted(by_topic[topic], key=str.lower):
            lines += _entry(name, modules[name], users.get(name, []))
    return "\n".join(lines) + "\n"


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
