"""Exports a controller, its plant and their loop as WebAssembly, for a page in a browser."""

import json
import re
from collections.abc import Mapping, Sequence
from importlib.metadata import version
from pathlib import Path
from string import Template
from typing import Any

import casadi as ca
from pydrake.systems.analysis import SimulatorConfig
from pydrake.systems.framework import Context, Diagram

from drake_dae.arguments import checked
from drake_dae.dae import Signal
from drake_dae.diagrams.closed_loop import ClosedLoop
from drake_dae.errors import ModelError
from drake_dae.running.export.steps.controller import write_controller
from drake_dae.running.export.steps.integrated import write_integrated
from drake_dae.running.export.steps.parts import (
    CONTROLLER,
    LOOP,
    PLANT,
    Export,
    WrittenPart,
    parts_of_loop,
)
from drake_dae.running.export.steps.words import file_of, identifiers, prefix_of
from drake_dae.running.export.text import comment, generated, written
from drake_dae.trace.compiled import without_branches
from drake_dae.trace.compiler import compile_webassembly

TEMPLATES = Path(__file__).parent / "js"


@checked(ModelError)
def export_wasm(
    loop: ClosedLoop | Diagram,
    context: Context,
    name: str,
    folder: str | Path,
    config: SimulatorConfig | None = None,
) -> Export:
    """Writes controller, plant and loop as one WebAssembly module, name.wasm.

    The module has no imports. name.mjs loads it in a page or in Node. The caller creates parts,
    sets parameters, simulates with `step(dt)`, and reads outputs and state by their names. The
    folder also contains the sources in C99. The export omits parts that cannot be exported.

    Args:
        loop: The closed loop, or any diagram with one `Plant`.
        context: Its initial context, which is not changed.
        name: The name of the files.
        folder: The folder of the files, which is created if necessary.
        config: Drake's settings, of which the fixed steps apply to plant and loop; with error
            control, or for None, steps of at most 1 ms by `runge_kutta5`.

    Raises:
        ModelError: No part can be exported, or the fixed steps are those of an implicit method.
        MachineCodeError: zig is not installed (`pip install 'drake_dae[compiler]'` adds it), or it
            fails.
        OSError: A file cannot be written.
    """
    parts, left_out = parts_of_loop(loop, context, (LOOP, PLANT, CONTROLLER))
    written_parts = [
        write_controller(part, context, name, folder)
        if kind == CONTROLLER
        else write_integrated(part, kind, context, name, folder, config)
        for kind, part in parts.items()
    ]
    files = write_module(written_parts, name, folder)
    sources = [path for part in written_parts for path in part.files]
    return Export([*files, *sources], left_out)


def write_module(
    parts: Sequence[WrittenPart],
    name: str,
    folder: str | Path,
    further: Mapping[str, ca.Function] | None = None,
) -> list[Path]:
    """Compiles the C sources of parts to name.wasm, and writes name.mjs.

    Args:
        parts: The parts.
        name, folder: See `export_wasm`.
        further: Name -> a further function of all outputs and all parameters of the first part,
            which `part.view(name, 0, size)` reads.

    Returns:
        The paths of name.wasm, name.mjs, and the C source of the module's exported functions.

    Raises:
        MachineCodeError, OSError: See `export_wasm`.
    """
    prefix, file = prefix_of(name), file_of(name)
    words = {
        "title": comment(name),
        "name": file,
        "version": version("drake_dae"),
        "prefix": prefix,
        "guard": prefix.upper(),
    }
    sources = [part.files[1] for part in parts]
    shown = ""
    for key, function in (further or {}).items():
        symbol = f"{prefix}_{key}"
        function_words = {
            "symbol": symbol,
            "key": key,
            "kind": parts[0].kind,
            "prefix": prefix,
            "size": str(function.numel_out(0)),
            "arguments": str(function.sz_arg()),
            "results": str(function.sz_res()),
            "generated": without_branches(generated({f"{symbol}_traced": function})),
        }
        sources += written(TEMPLATES, folder, {"further.c": f"{file}_{key}.c"}, function_words)
        template = Template((TEMPLATES / "shown.c").read_text(encoding="utf-8"))
        shown += template.substitute(function_words)
    glue = words | {
        "includes": "".join(f'#include "{part.files[0].name}"\n' for part in parts),
        "parts": "".join(_exports_of(part, words) for part in parts) + shown,
    }
    (source,) = written(TEMPLATES, folder, {"exports.c": f"{file}_exports.c"}, glue)
    descriptions = {part.kind: _description(part) for part in parts}
    first = parts[0].kind
    step = f"{first}.step(0)" if first == CONTROLLER else f"{first}.step(0.01);"
    words |= {
        "parts": json.dumps(descriptions, indent=1),
        "first": first,
        "example": f"{step}  {first}.outputs",
    }
    (module,) = written(TEMPLATES, folder, {"module.mjs": f"{file}.mjs"}, words)
    target = module.with_suffix(".wasm")
    target.unlink(missing_ok=True)
    for path in sources:
        text = path.read_text(encoding="utf-8")
        path.write_text(in_pieces(text), encoding="utf-8")
    compile_webassembly([source, *sources], target)
    return [target, module, source]


def _exports_of(part: WrittenPart, words: dict[str, str]) -> str:
    """Returns the C source of the functions that the module exports for a part."""
    template = "controller.c" if part.kind == CONTROLLER else "integrated.c"
    text = Template((TEMPLATES / template).read_text(encoding="utf-8"))
    return text.substitute(words, kind=part.kind, KIND=part.kind.upper())


def _description(written_part: WrittenPart) -> dict[str, Any]:
    """Returns the description of a part in name.mjs."""
    part, values = written_part.part, written_part.values.tolist()
    description: dict[str, Any] = {
        "parameters": [
            {**_named(signal), "default": value}
            for signal, value in zip(written_part.parameters, values, strict=True)
        ]
    }
    for key, vectors in (("inputs", part.inputs), ("outputs", part.outputs)):
        description[key] = {
            name: [_named(signal) for signal in signals]
            for name, signals in identifiers(dict(vectors)).items()
        }
    if written_part.kind == CONTROLLER:
        return description | {"period": part.ticks.period}
    return description | {"state": [_named(signal) for signal in written_part.states]}


def _named(signal: Signal) -> dict[str, str]:
    return {"name": signal.name, "unit": signal.unit}


LONGEST = 2000
"""The largest number of assignments in a function. For 60,000 assignments, clang needs 180 s of CPU
in one function, and 9 s in pieces of 2,000, whose code is 40 % larger."""

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
    """Splits the long functions of a C source into pieces, which the function calls in turn.

    The array `shared` passes values of a piece to later pieces.

    Args:
        source: A C source from CasADi, for a compiler that supports __attribute__((noinline)).
        longest: The largest number of assignments in a piece.

    Returns:
        The new source.
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
