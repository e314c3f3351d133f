"""A loop in C as WebAssembly; long functions are compiled in pieces."""

import re
from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path

from drake_dae.errors import MachineCodeError
from drake_dae.trace.compiler import compile_webassembly


def check_compiler() -> None:
    """Refuses a page where there is no compiler of WebAssembly."""
    if find_spec("ziglang") is None:
        raise MachineCodeError(
            "a page is compiled to WebAssembly by zig, which is not installed: pip install ziglang"
        )


def compiled_loop(source: Path) -> bytes:
    """A loop in C, of `write_loop`, as WebAssembly that imports nothing."""
    source.write_text(in_pieces(source.read_text("utf-8")), "utf-8")
    target = source.with_suffix(".wasm")
    compile_webassembly(source, target)
    return target.read_bytes()


# The largest number of assignments in a function. For 60,000 assignments, clang needs 180 s of CPU
# in one function, and 9 s in pieces of 2,000, whose code is 40 % larger.
LONGEST = 2000

_NAME = re.compile(r"\ba\d+\b")
_FUNCTION = re.compile(
    r"(?P<head>static int (?P<name>casadi_f\d+)\([^\n]*\{)\n(?P<body>(?:  [^\n]*\n)*)\}"
)
_DECLARATION = "  casadi_real a"
_ARGUMENTS = (
    "const casadi_real** arg, casadi_real** res, casadi_int* iw, casadi_real* w, "
    "casadi_real* shared"
)


def in_pieces(source: str, longest: int = LONGEST) -> str:
    """Splits the long functions of a C source of CasADi into pieces, which each calls in turn.

    The array `shared` passes values of a piece to later pieces.
    """
    return _FUNCTION.sub(lambda function: _split(function, longest), source)


def _split(function: re.Match[str], longest: int) -> str:
    rows = [
        row
        for row in function["body"].splitlines()
        if not row.startswith(_DECLARATION) and row.strip() != "return 0;"
    ]
    if len(rows) <= longest:
        return function[0]
    pieces = [rows[i : i + longest] for i in range(0, len(rows), longest)]
    uses = [_uses(piece) for piece in pieces]
    # needed[k]: the variables that piece k or a later one reads before a new assignment.
    needed = [set[str]()]
    for read, assigned in reversed(uses):
        needed.insert(0, read | (needed[0] - assigned))
    index = {variable: i for i, variable in enumerate(sorted(set().union(*needed)))}
    name, text, calls = function["name"], "", ""
    for k, (piece, (read, assigned)) in enumerate(zip(pieces, uses, strict=True)):
        begin = [
            f"  casadi_real {a}{f' = shared[{index[a]}]' if a in read else ''};"
            for a in sorted(read | assigned)
        ]
        end = [f"  shared[{index[a]}] = {a};" for a in sorted(assigned & needed[k + 1])]
        head = f"static int __attribute__((noinline)) {name}_{k}({_ARGUMENTS}) {{"
        text += "\n".join([head, *begin, *piece, *end, "  return 0;", "}", "", ""])
        calls += f"  if ({name}_{k}(arg, res, iw, w, shared)) return 1;\n"
    shared = f"  casadi_real shared[{len(index) + 1}];\n"
    return f"{text}{function['head']}\n{shared}{calls}  return 0;\n}}"


def _uses(rows: Sequence[str]) -> tuple[set[str], set[str]]:
    """Returns the variables that rows read before they assign them, and those that they assign."""
    read, assigned = set[str](), set[str]()
    for row in rows:
        target, _, value = row.partition("=")
        variable = target.strip()
        is_assignment = _NAME.fullmatch(variable)  # Otherwise it is a result, or a condition.
        read |= set(_NAME.findall(value if is_assignment else row)) - assigned
        if is_assignment:
            assigned.add(variable)
    return read, assigned
