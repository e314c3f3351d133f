"""Pages of the book: Markdown files whose code blocks run in order.

The kinds of blocks:

- ```python runs in the page's namespace. A ```text block right after it is its expected output.
- ```console: lines that begin with "$ " are commands; the lines after a command are its expected
  output.
- ```yaml, ```xml and others whose first line is a comment with a file name write that file.
- All others, such as ```sh, do not run.

The output must agree with the page: words and integers exactly, apart from white space; other
numbers within one unit of the last digit on the page; "..." matches any text. If "..." can match in
several ways, the shortest match counts.
"""

import contextlib
import io
import os
import re
import shlex
import subprocess
import sys
import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import zip_longest
from pathlib import Path
from typing import Any

from drake_dae.cli import main
from drake_dae.commands.writing import program

BOOK = Path(__file__).parent

KINDS = ("tutorials", "how_to", "explanations", "reference")

_FENCE = re.compile(r"^```(\w*)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
_FILE = re.compile(r"^(?:#|//|<!--)\s+([\w.-]+\.\w+)(?:\s+-->)?\n")
_NUMBER = re.compile(r"-?\d+(?:\.\d+)?(?:[eE][-+]?\d+)?")
_PART = re.compile(rf"\.\.\.|(?<![\w.]){_NUMBER.pattern}|\s+")

_BARE = " --set write.plots=false --set write.animation=false"


class PageError(Exception):
    """A block fails, or its output differs from the page."""


@dataclass(frozen=True)
class Block:
    """A fenced block.

    Attributes:
        language: The word after the fence, as "python".
        text: The lines between the fences.
        line: The number of its first line in the file.
        follows: Whether only white space separates it from the block before.
    """

    language: str
    text: str
    line: int
    follows: bool


def pages() -> list[Path]:
    """Returns all pages that can run."""
    return [
        *sorted(BOOK.glob("*.md")),  # index.md is the first.
        *(path for kind in KINDS for path in sorted((BOOK / kind).glob("*.md"))),
    ]


def blocks(page: Path) -> list[Block]:
    """Returns the fenced blocks of a page, in order."""
    text = page.read_text("utf-8")
    fenced, end = [], 0
    for match in _FENCE.finditer(text):
        line = text.count("\n", 0, match.start()) + 2
        follows = not text[end : match.start()].strip()
        fenced.append(Block(match[1], match[2], line, follows))
        end = match.end()
    return fenced


def file_of(block: Block) -> tuple[str, str]:
    """Returns name and text of the file that a block writes; both are empty if it writes none."""
    match = _FILE.match(block.text)
    return (match[1], block.text[match.end() :]) if match else ("", "")


def run_page(page: Path, folder: Path, pictures: bool = True) -> None:
    """Runs the blocks of a page in a folder.

    Args:
        page: The page.
        folder: The working folder of its code.
        pictures: Whether runs write plots and animations, which take a fifth of the time.

    Raises:
        PageError: A block fails, or its output differs; the message has the block's line.
    """
    namespace: dict[str, Any] = {"__name__": "__main__"}
    folder.mkdir(parents=True, exist_ok=True)
    all_blocks = blocks(page)
    with contextlib.chdir(folder):
        for block, following in zip_longest(all_blocks, all_blocks[1:]):
            try:
                if block.language == "python":
                    printed = _run_python(block, page, namespace)
                    if following and following.language == "text" and following.follows:
                        compare(following.text, printed)
                elif block.language == "console":
                    _run_commands(block, "" if pictures else _BARE)
                else:
                    name, text = file_of(block)
                    if name:
                        Path(name).write_text(text, "utf-8")
            except Exception as error:
                raise PageError(f"{page.relative_to(BOOK)}, line {block.line}: {error}") from error


def compare(shown: str, printed: str) -> None:
    """Checks that the printed output agrees with the output that a page shows.

    Raises:
        PageError: They differ.
    """
    pattern, numbers, end = "", [], 0
    for part in _PART.finditer(shown.strip()):
        pattern += re.escape(shown.strip()[end : part.start()])
        if part[0] == "...":
            pattern += r".*?"
        elif part[0].isspace():
            pattern += r"\s+"
        elif part[0].lstrip("-").isdigit():
            pattern += rf"{re.escape(part[0])}(?!\.?\d)"
        else:
            pattern += f"({_NUMBER.pattern})"
            numbers.append(part[0])
        end = part.end()
    pattern += re.escape(shown.strip()[end:])
    match = re.fullmatch(pattern, printed.strip(), re.DOTALL)
    if match is None:
        raise PageError(f"the page shows\n{shown}\nbut this was printed:\n{printed}")
    for number, output in zip(numbers, match.groups(), strict=True):
        if abs(float(output) - float(number)) > 1.0000001 * _unit(number):
            raise PageError(f"the page shows {number}, but {output} was printed in\n{printed}")


def _unit(number: str) -> float:
    """Returns one unit of the last digit of a number."""
    digits, _, exponent = number.lower().partition("e")
    return 10.0 ** (int(exponent or 0) - len(digits.partition(".")[2]))


def _run_python(block: Block, page: Path, namespace: dict[str, Any]) -> str:
    # Empty lines before the code give a traceback the line numbers of the page.
    code = compile("\n" * (block.line - 1) + block.text, str(page), "exec")
    with _printed() as printed:
        exec(code, namespace)
    return printed.getvalue()


def _run_commands(block: Block, more: str) -> None:
    """Runs commands, `drake-dae simulate` with `more` appended, and checks their output."""
    for part in re.split(r"^\$ ", block.text, flags=re.MULTILINE)[1:]:
        lines = part.splitlines()
        last = next(i for i, line in enumerate(lines) if not line.endswith("\\"))
        command = " ".join(line.removesuffix("\\") for line in lines[: last + 1])
        if command.startswith("drake-dae simulate "):
            command += more
        code, printed = _run_command(command)
        if shown := "\n".join(lines[last + 1 :]).strip():
            compare(shown, printed)
        elif code:
            raise PageError(f"{command} ended with exit code {code}:\n{printed}")


def _run_command(command: str) -> tuple[int, str]:
    """Returns the exit code and the output of a command; `drake-dae` runs in this process."""
    words = shlex.split(command)
    if words[0] == "drake-dae" and not set("|<>&;*$") & set(command):
        with _printed() as printed, warnings.catch_warnings():
            warnings.simplefilter("default")  # A page may show warnings, as on a command line.
            return main(words[1:]), printed.getvalue().replace(program(), "drake-dae")
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    finished = subprocess.run(
        ["bash", "-c", command],
        env={**os.environ, "PATH": path},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )
    return finished.returncode, finished.stdout


@contextlib.contextmanager
def _printed() -> Iterator[io.StringIO]:
    text = io.StringIO()
    with contextlib.redirect_stdout(text), contextlib.redirect_stderr(text):
        yield text
