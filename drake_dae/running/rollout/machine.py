"""A closed loop as one library of machine code, which steps it without Python in between."""

import ctypes
from pathlib import Path
from string import Template
from typing import Any

import casadi as ca
import numpy as np
from scipy.integrate import DOP853

from drake_dae.arrays import FloatArray
from drake_dae.errors import InconsistentStateError
from drake_dae.running.rollout.functions import LoopFunctions
from drake_dae.running.rollout.run import Ending, Problem, Run, Settings
from drake_dae.trace.compiled import Compiled, generate, library, without_branches

SOURCE = Path(__file__).parent / "stepper.c"

Library = ctypes.CDLL

BUDGET = 20_000
"""So many steps are taken before Python looks for Ctrl-C: at most some tenths of a second."""


class _Run(ctypes.Structure):
    """The Run of stepper.c."""

    _fields_ = (
        *((name, ctypes.c_double) for name in ("time", "step", "start", "mark", "before")),
        *((name, ctypes.c_double) for name in ("begin", "next", "trial")),
        *(
            (name, ctypes.c_longlong)
            for name in ("row", "event", "steps", "number", "index", "failures", "pending")
        ),
    )


def load(functions: LoopFunctions, compiled: Compiled, make: bool) -> Library | None:
    """The library of a closed loop; None if there is none.

    Args:
        functions: The closed loop.
        compiled: The choice, True or "auto".
        make: Whether to make it where the cache has none.

    Warns:
        MachineCodeWarning: It should be made and cannot be.
    """
    path = library(_source(functions), functions.num_operations, compiled, make)
    return None if path is None else ctypes.CDLL(str(path))


def run(code: Library, functions: LoopFunctions, problem: Problem, settings: Settings) -> Run:
    """Runs a closed loop until its end, or to where it cannot go on by machine code alone.

    Args:
        code: What `load` returned.
        functions: The closed loop.
        problem: What to run.
        settings: How to step.
    """
    own = _Run(time=problem.times[0], start=problem.times[0], mark=problem.times[0], pending=1)
    state, hold, trial = (
        problem.state.copy(),
        problem.hold.copy(),
        np.full_like(problem.state, np.nan),
    )
    width = sum(map(len, functions.columns.values()))
    rows = np.empty((problem.times.size, width))
    arrays = [problem.plant, problem.law, trial]
    step, tables = code.run_controlled, [settings.longest, settings.absolute, settings.relative]
    if settings.tableau is not None:
        a, b, c = settings.tableau
        step, tables = code.run_fixed, [settings.longest, b.size, a, b, c]
    given = [state, hold, *arrays, problem.times.size, problem.times, rows]
    given += [problem.events.size, problem.events, problem.noise, *tables]
    arguments = [_argument(value) for value in given]
    ending = Ending.PAUSED
    while ending is Ending.PAUSED and not settings.stop():
        ending = Ending(step(ctypes.byref(own), *arguments, _argument(BUDGET)))
        if ending is Ending.OFF_MANIFOLD:
            try:
                found = problem.project(own.time, state)
            except InconsistentStateError:
                break
            state[: found.size] = found
            own.pending = 2
            ending = Ending.PAUSED
    return Run(
        rows[: own.row],
        ending,
        own.time,
        state,
        own.steps,
        own.before,
        own.next,
        own.trial,
        trial,
    )


def _argument(value: Any) -> Any:
    if isinstance(value, np.ndarray):
        return ctypes.c_void_p(value.ctypes.data)
    return ctypes.c_double(value) if isinstance(value, float) else ctypes.c_longlong(value)


def _source(functions: LoopFunctions) -> str:
    loop = functions.loop
    plant, sensor = loop.plant, loop.sensor
    dae = plant.dae
    calls = functions.generated
    columns = functions.columns
    moving = [len(block.exogenous_places) for block in (plant, loop.controller)]
    if loop.exogenous is None:
        moving = [0, 0]
    sizes: dict[str, int] = {
        "NUM_STATES": dae.num_states,
        "NUM_LAGS": functions.num_lags,
        "SIZE": functions.size,
        "NUM_FORCES": dae.num_constraints,
        "NUM_REFERENCES": len(columns["reference"]),
        "NUM_PLANT_MOVING": moving[0],
        "NUM_LAW_MOVING": moving[1],
        "NUM_PLANT": functions.plant.sizes[-1],
        "NUM_LAW": functions.law.sizes[-1],
        "WIDTH": sum(map(len, columns.values())),
        "SAMPLES": int(bool(sensor and sensor.sample_period)),
        "PROJECTS": int(plant.projects),
    }
    for name, function in calls.items():
        # At least as many as the initializers in stepper.c.
        sizes[f"{name.upper()}_ARG"] = function.sz_arg()
        sizes[f"{name.upper()}_RES"] = max(5, function.sz_res())
    zeros = np.zeros(dae.num_constraints)
    places = [plant.exogenous_places, loop.controller.exogenous_places]
    tables = {
        "bias": sensor.bias if sensor else zeros,
        "deviation": sensor.noise_deviation if sensor else zeros,
        "dop_a": DOP853.A,
        "dop_b": DOP853.B,
        "dop_c": DOP853.C,
        "dop_e3": DOP853.E3,
        "dop_e5": DOP853.E5,
        "dop_d": DOP853.D,
        "dop_a_more": DOP853.A_EXTRA,
        "dop_c_more": DOP853.C_EXTRA,
    }
    lines = [f"enum {{ {name} = {size} }};" for name, size in sizes.items()]
    for name, chosen, count in zip(("plant", "law"), places, moving, strict=True):
        listed = ", ".join(map(str, [*chosen[:count], 0]))
        lines.append(f"static const int {name}_places[] = {{{listed}}};")
    lines += [_table(name, np.asarray(values)) for name, values in tables.items()]
    words = {
        "generated": without_branches(
            generate(*(_renamed(each, f"dae_{name}") for name, each in calls.items()))
        ),
        "constants": "\n".join([*lines, ""]),
    }
    return Template(SOURCE.read_text(encoding="utf-8")).substitute(words)


def _table(name: str, values: FloatArray) -> str:
    if values.ndim == 1:
        return (
            f"static const double {name}[] = {{{', '.join(map(repr, [*values.tolist(), 0.0]))}}};"
        )
    rows = ",\n".join(f"{{{', '.join(map(repr, row))}}}" for row in values.tolist())
    return f"static const double {name}[{values.shape[0]}][{values.shape[1]}] = {{\n{rows}}};"


def _renamed(function: ca.Function, name: str) -> ca.Function:
    """The same function under a name of C."""
    inputs = function.sx_in()
    return ca.Function(name, inputs, function.call(inputs), {"cse": False})
