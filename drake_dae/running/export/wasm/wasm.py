"""A controller, its plant and their loop as WebAssembly, for a page in a browser."""

import json
from collections.abc import Mapping, Sequence
from importlib.metadata import version
from pathlib import Path
from string import Template
from typing import Any

import casadi as ca
from pydrake.systems.analysis import SimulatorConfig
from pydrake.systems.framework import Context, Diagram

from drake_dae.arguments import checked
from drake_dae.diagrams.closed_loop import ClosedLoop
from drake_dae.errors import ModelError
from drake_dae.running.export.pieces import in_pieces
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

    It needs no imports. name.mjs loads it in a page or in Node: parts are created, parameters set,
    steps made by `step(dt)`, outputs and state read by their names. The sources in C99 stand beside
    it. A part that cannot be exported is left out.

    Args:
        loop: The closed loop, or any diagram with one `Plant`.
        context: Its context at the start; not changed.
        name: What the files are called.
        folder: Where to write; made if there is none.
        config: Drake's settings, whose fixed steps plant and loop take; where they have error
            control, and for None, steps of at most 1 ms by `runge_kutta5`.

    Raises:
        ModelError: No part can be exported, or the fixed steps are of an implicit method.
        MachineCodeError: There is no zig, as of `pip install 'drake_dae[compiler]'`, or it fails.
        OSError: A file cannot be written.
    """
    parts, left_out = parts_of_loop(loop, context, (LOOP, PLANT, CONTROLLER))
    found = [
        write_controller(part, context, name, folder)
        if kind == CONTROLLER
        else write_integrated(part, kind, context, name, folder, config)
        for kind, part in parts.items()
    ]
    files = write_module(found, name, folder)
    sources = [path for each in found for path in each.files]
    return Export([*files, *sources], left_out)


def write_module(
    found: Sequence[WrittenPart],
    name: str,
    folder: str | Path,
    further: Mapping[str, ca.Function] | None = None,
) -> list[Path]:
    """Compiles parts that are written as C to name.wasm, and writes name.mjs.

    Args:
        found: The parts.
        name, folder: As of `export_wasm`.
        further: Name -> a function of all outputs and all parameters of the first part, which the
            module shows beside it; read by `part.view(name, 0, size)`.

    Returns:
        name.wasm, name.mjs, and the C source of what the module shows.

    Raises:
        MachineCodeError, OSError: As of `export_wasm`.
    """
    prefix, file = prefix_of(name), file_of(name)
    words = {
        "title": comment(name),
        "name": file,
        "version": version("drake_dae"),
        "prefix": prefix,
        "guard": prefix.upper(),
    }
    sources = [each.files[1] for each in found]
    shown = ""
    for key, function in (further or {}).items():
        symbol = f"{prefix}_{key}"
        own = {"symbol": symbol, "key": key, "kind": found[0].kind, "prefix": prefix}
        own |= {
            "size": str(function.numel_out(0)),
            "given": str(function.sz_arg()),
            "results": str(function.sz_res()),
            "generated": without_branches(generated({f"{symbol}_traced": function})),
        }
        sources += written(TEMPLATES, folder, {"further.c": f"{file}_{key}.c"}, own)
        shown += Template((TEMPLATES / "shown.c").read_text(encoding="utf-8")).substitute(own)
    glue = words | {
        "includes": "".join(f'#include "{each.files[0].name}"\n' for each in found),
        "parts": "".join(_glue(each, words) for each in found) + shown,
    }
    (source,) = written(TEMPLATES, folder, {"exports.c": f"{file}_exports.c"}, glue)
    described = {each.kind: _described(each) for each in found}
    first = found[0].kind
    steps = "$.step(0)" if first == CONTROLLER else "$.step(0.01);"
    words |= {
        "parts": json.dumps(described, indent=1),
        "first": first,
        "example": steps.replace("$", first) + f"  {first}.outputs",
    }
    (module,) = written(TEMPLATES, folder, {"module.mjs": f"{file}.mjs"}, words)
    target = module.with_suffix(".wasm")
    target.unlink(missing_ok=True)
    for path in sources:
        text = path.read_text(encoding="utf-8")
        path.write_text(in_pieces(text), encoding="utf-8")
    compile_webassembly([source, *sources], target)
    return [target, module, source]


def _glue(each: WrittenPart, words: dict[str, str]) -> str:
    """What the module shows of a part, in C."""
    template = "controller.c" if each.kind == CONTROLLER else "integrated.c"
    text = Template((TEMPLATES / template).read_text(encoding="utf-8"))
    return text.substitute(words, kind=each.kind, KIND=each.kind.upper())


def _described(each: WrittenPart) -> dict[str, Any]:
    """What name.mjs says of a part."""
    found: dict[str, Any] = {
        "parameters": [
            {"name": signal.name, "unit": signal.unit, "default": value}
            for signal, value in zip(each.parameters, each.values.tolist(), strict=True)
        ]
    }
    for key, vectors in (("inputs", each.part.inputs), ("outputs", each.part.outputs)):
        found[key] = {
            name: [{"name": signal.name, "unit": signal.unit} for signal in signals]
            for name, signals in identifiers(dict(vectors)).items()
        }
    if each.kind == CONTROLLER:
        return found | {"period": each.part.ticks.period}
    return found | {"state": [{"name": s.name, "unit": s.unit} for s in each.states]}
