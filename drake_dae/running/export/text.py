"""C code from Python: vectors, functions, lists, strings, comments and files from templates."""

import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from string import Template

import casadi as ca

from drake_dae.arrays import FloatArray
from drake_dae.dae import Signal
from drake_dae.trace.compiled import generate, renamed
from drake_dae.trace.functions import TracedFunction


@dataclass(frozen=True, eq=False)
class Vector:
    """A vector of the C code.

    Attributes:
        what: The meaning of the vector, in words.
        signals: Names and units of its entries.
        default: The default values, shape (k,); None for none.
    """

    what: str
    signals: Sequence[Signal]
    default: FloatArray | None = None


@dataclass(frozen=True, eq=False)
class CFunction:
    """A function of the C code.

    Attributes:
        function: The traced function.
        inputs, outputs: The C names of its arguments and results, in order.
    """

    function: TracedFunction
    inputs: Sequence[str]
    outputs: Sequence[str]

    @property
    def signature(self) -> str:
        """The list of parameters in the C declaration."""
        inputs = [f"const double *{name}" for name in self.inputs]
        return ", ".join([*inputs, *(f"double *{name}" for name in self.outputs)])


def generated(functions: Mapping[str, ca.Function]) -> str:
    """Returns C code of functions, all static, so that several such files can be linked together.

    Args:
        functions: C name -> function.
    """
    source = generate(*(renamed(function, symbol) for symbol, function in functions.items()))
    kept, is_left_out = list[str](), False
    for line in source.splitlines():
        is_helper = (
            line.startswith("CASADI_SYMBOL_EXPORT") and "(const casadi_real** arg" not in line
        )
        if not (is_helper or is_left_out):
            kept.append(line)
        # A helper ends on its first line, or at the next line that is "}".
        is_left_out = (is_helper and not line.endswith("}")) or (is_left_out and line != "}")
    text = "\n".join([*kept, ""]).replace("CASADI_SYMBOL_EXPORT int", "static int")
    text = re.sub(r"^(\w+ casadi_\w+\()", r"static \1", text, flags=re.MULTILINE)
    # Integer arrays that only helpers read; one that is read occurs three times.
    used = Counter(re.findall(r"\bcasadi_s\d+\b", text))
    integers = re.compile(r"^static const casadi_int (casadi_s\d+)\[.*\n", re.MULTILINE)
    text = integers.sub(lambda found: found[0] if used[found[1]] > 2 else "", text)
    return re.sub(r"\n{3,}", "\n\n", text)


def braced(items: Sequence[str]) -> str:
    """A C initializer list, wrapped to short lines."""
    lines, last = [], ""
    for item in items:
        if last and len(last) + len(item) > 96:
            lines.append(last.rstrip())
            last = ""
        last += f"{item}, "
    text = "\n  ".join([*lines, last]).rstrip(", ")
    return f"{{{text}}}"


def entry_lines(signals: Sequence[Signal]) -> list[str]:
    """For each entry of a vector a line for a C comment: index, name and unit."""
    width = max((len(comment(signal.name)) for signal in signals), default=0)
    return [
        f"{i:3d}  {comment(signal.name).ljust(width)}  {comment(signal.unit)}".rstrip()
        for i, signal in enumerate(signals)
    ]


def comment(text: str) -> str:
    """Text for a C comment, without characters that could end the comment."""
    return re.sub(r"[^\w .,:;()\[\]'/^+-]|/(?=[/*])", "_", text, flags=re.ASCII)


def string(text: str) -> str:
    """A C string literal; special characters, and "?" because of trigraphs, are octal escapes."""
    plain = (
        chr(byte) if 32 <= byte < 127 and chr(byte) not in '"?\\' else f"\\{byte:03o}"
        for byte in text.encode()
    )
    return f'"{"".join(plain)}"'


def written(
    templates: Path, folder: str | Path, names: Mapping[str, str], words: Mapping[str, str]
) -> list[Path]:
    """Writes files from templates, and returns their paths.

    Args:
        templates: The folder of the templates.
        folder: The folder to write to; created if it does not exist.
        names: Name of a template -> name of the file.
        words: Name of a placeholder in the templates -> its text.

    Raises:
        OSError: A file cannot be written.
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    for template, target in names.items():
        text = Template((templates / template).read_text(encoding="utf-8")).substitute(words)
        (folder / target).write_text(text, encoding="utf-8")
    return [folder / target for target in names.values()]
