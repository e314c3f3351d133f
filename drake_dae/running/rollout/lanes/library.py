"""Machine code that runs a diagram many times, side by side in vector registers."""

import ctypes
from pathlib import Path
from string import Template
from typing import Any, NamedTuple

import numpy as np

from drake_dae.arrays import FloatArray
from drake_dae.running.rollout.lanes.emitter import can_be_emitted, emitted
from drake_dae.running.rollout.program import RolloutProgram
from drake_dae.running.rollout.stepping.machine import DOP_TABLES, RUN, c_places, c_table
from drake_dae.trace.compiled import Compiled, library
from drake_dae.trace.compiler import gcc_options

FOLDER = Path(__file__).parent

OPTIONS = ("-O2", "-ffp-contract=fast")
"""Fused multiply-add where the processor has it; with -O2, runs take a tenth less time."""

OF_GCC = ("--param", "lra-max-considered-reload-pseudos=50")
"""GCC then tries fewer ways to free a register: compiling takes two thirds to four fifths of the
time, and runs one per cent more."""

SLOWER = 4
"""The compile time of an operation on registers over that of an operation on numbers."""


def can_run(program: RolloutProgram) -> bool:
    """Whether runs can go side by side: no block changes at guards, and Drake steps none."""
    compiled = program.compiled
    if compiled.has_stepped:
        return False
    return all(can_be_emitted(each) for each in compiled.staged.values())


class Lanes(NamedTuple):
    """The machine code of a diagram for runs side by side.

    Attributes:
        code: The library, which diagrams share that differ in constants alone.
        constants: The constants of this diagram.
    """

    code: ctypes.CDLL
    constants: FloatArray


def load(program: RolloutProgram, compiled: Compiled, make: bool) -> Lanes | None:
    """Returns the machine code of a diagram; None if there is none.

    Args:
        program: The diagram.
        compiled: The choice, True or "auto".
        make: Whether to make it if it is not in the cache.

    Warns:
        MachineCodeWarning: It cannot be made.
    """
    operations = program.num_operations * (SLOWER if compiled is True else 1)
    constants: list[float] = []
    options = (*OPTIONS, *gcc_options(*OF_GCC))
    path = library(source(program, constants), operations, compiled, make, options)
    return None if path is None else Lanes(ctypes.CDLL(str(path)), np.array(constants))


def source(program: RolloutProgram, constants: list[float]) -> str:
    """Returns the C source of a diagram.

    Args:
        program: The diagram.
        constants: A list to which its constants are appended, which the code reads from the batch.
    """
    compiled = program.compiled
    functions = compiled.staged.items()
    texts = [emitted(function, f"dae_{name}", constants) for name, function in functions]
    parts: dict[str, Any] = {
        "header": _text("lanes.h"),
        "functions": "\n".join(texts),
        "constants": _sizes(program),
        "run": RUN.read_text(encoding="utf-8"),
        "updates": "\n".join(
            _updated(number, len(rate.places), rate.is_unrestricted)
            for number, rate in enumerate(compiled.rates)
        ),
        "fixed": _text("fixed.c"),
        "controlled": _text("controlled.c"),
    }
    return Template(_text("lanes.c")).substitute(parts)


def _text(name: str) -> str:
    return (FOLDER / name).read_text(encoding="utf-8")


def _sizes(program: RolloutProgram) -> str:
    compiled = program.compiled
    sizes = {
        "SIZE": program.size,
        "HELD": compiled.sizes["held"],
        "PARAMETERS": compiled.sizes["parameters"],
        "NOISE": compiled.sizes["noise"],
        "WIDTH": program.width,
        "GIVEN": compiled.staged["given"].numel_out(0),
        "PROJECTS": int(compiled.projects),
        "RATES": len(compiled.rates),
    }
    lines = [f"enum {{ {name} = {size} }};" for name, size in sizes.items()]
    for number, rate in enumerate(compiled.rates):
        lines.append(c_places(number, rate))
    lines += [c_table(name, np.asarray(values)) for name, values in DOP_TABLES.items()]
    return "\n".join([*lines, ""])


def _updated(number: int, count: int, is_unrestricted: bool) -> str:
    """Returns the C of an update of the runs in which it is due."""
    return f"""  if (unrestricted == {int(is_unrestricted)}) {{
    const mask own = due(b, l, now, {number});
    if (any(own)) {{
      real values[{count + 1}], valid;
      const mask far = dae_update_{number}(l->constants, &time, l->x, l->held, l->parameters,
                                           l->given, noise, values, &valid) | l->far;
      good &= (is_number(valid) & ~far) | ~own;
      for (i = 0; i < {count}; i++) {{
        fresh[places_{number}[i]] = CHOOSE(own, values[i], fresh[places_{number}[i]]);
      }}
    }}
  }}"""
