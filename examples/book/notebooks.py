"""Conversion of the book's pages to Jupyter notebooks."""

import json
import re
from pathlib import Path
from typing import Any

from book.pages import Block, blocks, file_of

_PICTURE = re.compile(r"!\[[^\]]*\]\([^)]*\)")
_LINK = re.compile(r"(?<!!)\[([^\]]*)\]\((?!https?:)[^)]*\)")
_IFRAME = re.compile(r"<iframe.*?</iframe>", re.DOTALL)


def has_code(page: Path) -> bool:
    """Whether a page has Python code; only such pages become notebooks."""
    return any(block.language == "python" for block in blocks(page))


def notebook(page: Path) -> str:
    """Returns a page as a notebook without outputs, JSON of format 4.5."""
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
    cells = [cell for cell in cells if cell["source"]]
    for number, cell in enumerate(cells):
        cell["id"] = f"cell{number}"
    kernel = {"display_name": "Python 3", "language": "python", "name": "python3"}
    metadata = {"kernelspec": kernel, "language_info": {"name": "python"}}
    return json.dumps(
        {"cells": cells, "metadata": metadata, "nbformat": 4, "nbformat_minor": 5}, indent=1
    )


def _source(block: Block) -> str:
    """Returns the code of a block's cell; empty for a block that does not run."""
    if block.language == "python":
        return block.text.rstrip("\n")
    if block.language == "console":
        commands = re.findall(r"^\$ ((?:.*\\\n)*.*)$", block.text, re.MULTILINE)
        return "\n".join(f"!{command}" for command in commands)
    name, text = file_of(block)
    return f"%%writefile {name}\n{text}".rstrip("\n") if name else ""


def _prose(text: str) -> str:
    """Returns text without links to pages, pictures and frames, which a notebook does not have."""
    return _LINK.sub(r"\1", _PICTURE.sub("", _IFRAME.sub("", text))).strip()


def _cell(kind: str, source: str) -> dict[str, Any]:
    code = {"execution_count": None, "outputs": []} if kind == "code" else {}
    return {"cell_type": kind, "metadata": {}, "source": source, **code}
