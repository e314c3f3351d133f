"""What Python writes in C: vectors, calls, lists, strings and comments."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from string import Template

import casadi as ca

from drake_dae.arrays import FloatArray
from drake_dae.dae.system.signals import Signal
from drake_dae.trace.compiled import generate, renamed
from drake_dae.trace.functions import TracedFunction


@dataclass(frozen=True, eq=False)
class Vector:
    """A vector of the C code.

    Attributes:
        what: What it is, in words.
        signals: Names and units of its entries.
        default: What it is where nobody says otherwise, shape (k,); None if there is no such thing.
    """

    what: str
    signals: Sequence[Signal]
    default: FloatArray | None = None


@dataclass(frozen=True, eq=False)
class CFunction:
    """A function of the C code.

    Attributes:
        function: What it computes.
        inputs, outputs: What its arguments are called in C, in the order of the function's.
    """

    function: TracedFunction
    inputs: Sequence[str]
    outputs: Sequence[str]

    @property
    def signature(self) -> str:
        """The arguments as C declares them."""
        inputs = [f"const double *{name}" for name in self.inputs]
        return ", ".join([*inputs, *(f"double *{name}" for name in self.outputs)])


def generated(functions: Mapping[str, ca.Function]) -> str:
    """The C of functions as static ones, of which several files may be linked together.

    Args:
        functions: What each is called -> the function.
    """
    source = generate(*(renamed(each, symbol) for symbol, each in functions.items()))
    kept, is_left_out = list[str](), False
    for line in source.splitlines():
        is_helper = (
            line.startswith("CASADI_SYMBOL_EXPORT") and "(const casadi_real** arg" not in line
        )
        if not (is_helper or is_left_out or line.startswith("static const casadi_int casadi_s")):
            kept.append(line)
        # A helper ends in its line, or at the first brace that begins one.
        is_left_out = (is_helper and not line.endswith("}")) or (is_left_out and line != "}")
    text = "\n".join([*kept, ""]).replace("CASADI_SYMBOL_EXPORT int", "static int")
    text = re.sub(r"^casadi_real casadi_", "static casadi_real casadi_", text, flags=re.MULTILINE)
    return re.sub(r"\n{3,}", "\n\n", text)


def braced(items: Sequence[str]) -> str:
    """A list of C, in lines that are not long."""
    lines, last = [], ""
    for item in items:
        if last and len(last) + len(item) > 96:
            lines.append(last.rstrip())
            last = ""
        last += f"{item}, "
    text = "\n  ".join([*lines, last]).rstrip(", ")
    return f"{{{text}}}"


def comment(text: str) -> str:
    """Text in a comment of C, in which nothing ends it."""
    return re.sub(r"[^\w .,:;()\[\]'/^+-]|/(?=[/*])", "_", text, flags=re.ASCII)


def string(text: str) -> str:
    """A string of C: bytes that are no plain letters, and what makes trigraphs, are numbers."""
    plain = (
        chr(byte) if 32 <= byte < 127 and chr(byte) not in '"?\\' else f"\\{byte:03o}"
        for byte in text.encode()
    )
    return f'"{"".join(plain)}"'


def written(
    templates: Path, folder: str | Path, names: Mapping[str, str], words: Mapping[str, str]
) -> list[Path]:
    """Writes files from templates; returns them.

    Args:
        templates: The folder of the templates.
        folder: Where to write; made if there is none.
        names: Name of a template -> that of the file.
        words: What stands for its names in the templates.

    Raises:
        OSError: A file cannot be written.
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    for template, target in names.items():
        text = Template((templates / template).read_text(encoding="utf-8")).substitute(words)
        (folder / target).write_text(text, encoding="utf-8")
    return [folder / target for target in names.values()]
