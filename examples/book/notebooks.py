"""Pages of the book as Jupyter notebooks: what a page runs, in cells."""

import json
import re
from pathlib import Path
from typing import Any

from book.pages import Block, blocks, file_of

_PICTURE = re.compile(r"!\[[^\]]*\]\([^)]*\)")
_LINK = re.compile(r"(?<!!)\[([^\]]*)\]\((?!https?:)[^)]*\)")
_IFRAME = re.compile(r"<iframe.*?</iframe>", re.DOTALL)


def has_code(page: Path) -> bool:
    """Whether a page has Python code, so that a notebook of it is of use."""
    return any(block.language == "python" for block in blocks(page))


def notebook(page: Path) -> str:
    """A page as a notebook, JSON of format 4.5; what it prints comes when it is run."""
    text, end, cells = page.read_text("utf-8"), 0, []
    lines = text.splitlines(keepends=True)
    for block in blocks(page):
        begin = sum(map(len, lines[: block.line - 2]))
        cells.append(_cell("markdown", _prose(text[end:begin])))
        end = text.index("```\n", begin + len(block.text)) + len("```\n")
        if source := _source(block):
            cells.append(_cell("code", source))
        elif not (block.language == "text" and block.follows):
            cells.append(_cell("markdown", f"```{block.language}\n{block.text}```"))
    cells.append(_cell("markdown", _prose(text[end:])))
    kept = [cell for cell in cells if cell["source"]]
    for number, cell in enumerate(kept):
        cell["id"] = f"cell{number}"
    kernel = {"display_name": "Python 3", "language": "python", "name": "python3"}
    about = {"kernelspec": kernel, "language_info": {"name": "python"}}
    return json.dumps(
        {"cells": kept, "metadata": about, "nbformat": 4, "nbformat_minor": 5}, indent=1
    )


def _source(block: Block) -> str:
    """The code of a cell; empty for a block that only is shown."""
    if block.language == "python":
        return block.text.rstrip("\n")
    if block.language == "console":
        commands = re.findall(r"^\$ ((?:.*\\\n)*.*)$", block.text, re.MULTILINE)
        return "\n".join(f"!{command}" for command in commands)
    name, text = file_of(block)
    return f"%%writefile {name}\n{text}".rstrip("\n") if name else ""


def _prose(text: str) -> str:
    """Links to pages and live figures lead nowhere from a notebook; commands make pictures."""
    return _LINK.sub(r"\1", _PICTURE.sub("", _IFRAME.sub("", text))).strip()


def _cell(kind: str, source: str) -> dict[str, Any]:
    code = {"execution_count": None, "outputs": []} if kind == "code" else {}
    return {"cell_type": kind, "metadata": {}, "source": source, **code}
