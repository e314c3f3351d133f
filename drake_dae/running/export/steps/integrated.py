"""Integration of a plant or of a whole loop with fixed steps, in C99."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
from pydrake.systems.analysis import SimulatorConfig
from pydrake.systems.framework import Context

from drake_dae.arrays import FloatArray
from drake_dae.errors import ModelError
from drake_dae.running.export.steps.boundary import ExportedPart
from drake_dae.running.export.steps.parts import PLANT, WrittenPart, defaults
from drake_dae.running.export.steps.words import (
    GeneratedFunctions,
    common_words,
    file_of,
    named,
    numbers,
    parameter_signals,
    prefix_of,
    updates,
)
from drake_dae.running.export.text import written
from drake_dae.running.export.whole import signals_of
from drake_dae.running.rollout.events import SAME
from drake_dae.running.rollout.run import FIXED

TEMPLATES = Path(__file__).parent / "c99"

NOT_PROJECTED = "  (void)own, (void)time, (void)REACHED, (void)CLOSE;\n  return 1;\n"
"""The body of the projection of a state without constraints."""

SCHEME, LONGEST = "runge_kutta5", 1e-3
"""The method and its longest step in s for settings with error control, which no export has."""


def write_integrated(
    part: ExportedPart,
    kind: str,
    context: Context,
    name: str,
    folder: str | Path,
    config: SimulatorConfig | None,
) -> WrittenPart:
    """Writes a plant or a loop as name_kind.h and name_kind.c, which integrate it.

    Args:
        part: The part, from `plant_part` or `loop_part`.
        kind: "plant" or "loop".
        context: The context of the diagram at the start.
        name: The name of the files.
        folder: The folder to write to; created if it does not exist.
        config: Drake's settings with fixed steps. If they have error control, or for None, the
            steps are at most 1 ms by `runge_kutta5`.

    Raises:
        ModelError: The fixed steps are of an implicit method.
        OSError: A file cannot be written.
    """
    scheme, longest = fixed_steps(config)
    compiled, prefix, file = part.compiled, prefix_of(name), file_of(name)
    start, held = compiled.start(context)
    keys = ["given", "rate", "row", *(["newton"] if compiled.projects else [])]
    functions = GeneratedFunctions.of(compiled, keys, held, f"{prefix}_traced_{kind}")

    def call(key: str, state: str, held: str, results: list[str]) -> str:
        arguments = ["&time", state, held, "own->parameters", "own->given"]
        return functions.call(key, arguments, results)

    begin = ""
    if "begin" in functions.functions:
        begin = f"""  {{
    double held[HELD + 1];
    memcpy(held, own->held, sizeof(held));
{call("begin", "own->state", "held", ["own->held"])}  }}
"""
    parameters = parameter_signals(compiled)
    states = signals_of(compiled, compiled.states, compiled.sizes["state"], "state")
    signals = {
        "parameter": parameters,
        "state": states,
        "input": [signal for signals in part.inputs.values() for signal in signals],
        "output": [signal for signals in part.outputs.values() for signal in signals],
    }
    values, inputs = defaults(part, context)
    tableau, rates = FIXED[scheme], compiled.rates
    time = context.get_time()
    words = common_words(name) | {
        "kind": kind,
        "KIND": kind.upper(),
        "what": "plant with its sensors" if kind == PLANT else "loop",
        "scheme": scheme,
        "longest": repr(longest),
        "start": repr(time),
        "num_states": str(start.size),
        "num_state": str(start.size + 1),
        "num_parameters": str(len(parameters)),
        "num_inputs": str(len(signals["input"])),
        "num_outputs": str(len(signals["output"])),
        "num_held": str(held.size + 1),
        "num_given": str(functions.functions["given"].numel_out(0) + 1),
        "num_rates": str(len(rates) + 1),
        "count_held": str(held.size),
        "count_rates": str(len(rates)),
        "stages": str(tableau.b.size),
        "method_a": _rows(tableau.a),
        "method_b": numbers(tableau.b, spare=False),
        "method_c": numbers(tableau.c, spare=False),
        "periods": numbers(np.array([rate.period for rate in rates])),
        "offsets": numbers(np.array([rate.offset for rate in rates])),
        "near": repr(SAME * min((rate.period for rate in rates), default=0.0)),
        "generated": functions.code(),
        "names": "".join(named(f"{prefix}_{kind}", *item) for item in signals.items()),
        "parameters": numbers(np.concatenate([values, inputs])),
        "state": numbers(start),
        "held": numbers(held),
        "given": functions.call("given", ["&time", "own->parameters"], ["own->given"]),
        "rate": call("rate", "x", "own->held", ["rate", "&valid"]),
        "row": call("row", "own->state", "own->held", ["own->row", "&valid"]),
        "begin": begin,
        "project": _project(call) if compiled.projects else NOT_PROJECTED,
        **updates(
            compiled.rates,
            "Own *own",
            lambda i: call(f"update_{i}", "own->state", "before", ["values", "&valid"]),
            lambda i: f"due[{i}]",
        ),
    }
    names = {f"integrated.{suffix}": f"{file}_{kind}.{suffix}" for suffix in ("h", "c")}
    files = tuple(written(TEMPLATES, folder, names, words))
    return WrittenPart(part, kind, parameters, values, inputs, files, time, states, start, longest)


def fixed_steps(config: SimulatorConfig | None) -> tuple[str, float]:
    """Returns the method of fixed steps and the longest step in s.

    Raises:
        ModelError: The method is implicit.
    """
    if config is None or config.use_error_control:
        longest = LONGEST if config is None else min(LONGEST, config.max_step_size)
        return SCHEME, longest
    if config.integration_scheme not in FIXED:
        raise ModelError(
            f"integration_scheme: an export takes no fixed steps of {config.integration_scheme}; "
            f"choose {', '.join(FIXED)}, or use_error_control"
        )
    return config.integration_scheme, config.max_step_size


def _project(call: Callable[[str, str, str, list[str]], str]) -> str:
    newton = call("newton", "at", "own->held", ["found", "&left"])
    return f"""  double at[SIZE + 1], found[SIZE + 1], left = 0.0;
  int attempt;
  set_time(own, time);
  memcpy(at, own->state, sizeof(double) * SIZE);
  for (attempt = 0; attempt < 8; attempt++) {{
{newton}    if (left <= REACHED) {{
      memcpy(own->state, found, sizeof(double) * SIZE);
      return 1;
    }}
    if (attempt && !(left <= CLOSE)) return 0;
    memcpy(at, found, sizeof(double) * SIZE);
  }}
  return 0;
"""


def _rows(table: FloatArray) -> str:
    return "{" + ",\n  ".join(numbers(row, spare=False) for row in table) + "}"
