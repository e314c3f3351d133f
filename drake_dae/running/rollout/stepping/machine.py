"""A diagram as one library of machine code, which steps it without calls of Python."""

import ctypes
import time
from pathlib import Path
from string import Template
from typing import Any

import numpy as np
from scipy.integrate import DOP853

from drake_dae.arrays import FloatArray
from drake_dae.compiler.rates import UpdateRate
from drake_dae.errors import InconsistentStateError
from drake_dae.running.rollout.program import RolloutProgram
from drake_dae.running.rollout.run import Run, RunEnding, RunProblem, Settings
from drake_dae.trace.compiled import Compiled, generate, library, renamed, without_branches

SOURCE = Path(__file__).parent / "stepper.c"

RUN = Path(__file__).parent / "run.h"
"""The state of a run in C."""

Library = ctypes.CDLL

_PROJECTION, _ALL = 2, 7
"""Bits of `RunState.pending`, as in run.h."""

FIRST, PAUSE = 500, 0.1
"""The steps before Python first checks a run; then the time between checks, in s."""


class RunState(ctypes.Structure):
    """The Run of run.h."""

    _fields_ = (
        *((name, ctypes.c_double) for name in ("time", "step", "start", "mark", "before")),
        *((name, ctypes.c_double) for name in ("begin", "next", "trial")),
        *((name, ctypes.c_longlong) for name in ("row", "event", "steps", "number", "index")),
        *((name, ctypes.c_longlong) for name in ("failures", "pending")),
    )


DOP_TABLES = {
    "dop_a": DOP853.A,
    "dop_b": DOP853.B,
    "dop_c": DOP853.C,
    "dop_e3": DOP853.E3,
    "dop_e5": DOP853.E5,
    "dop_d": DOP853.D,
    "dop_a_more": DOP853.A_EXTRA,
    "dop_c_more": DOP853.C_EXTRA,
}
"""The tables of DOP853, by their names in the C sources."""


def load(program: RolloutProgram, compiled: Compiled, make: bool) -> Library | None:
    """Returns the library of a diagram; None if there is none.

    Args:
        program: The diagram.
        compiled: The choice, True or "auto".
        make: Whether to make it if it is not in the cache.

    Warns:
        MachineCodeWarning: It cannot be made.
    """
    path = library(_source(program), program.num_operations, compiled, make)
    return None if path is None else ctypes.CDLL(str(path))


def run(code: Library, program: RolloutProgram, problem: RunProblem, settings: Settings) -> Run:
    """Runs a diagram until its end, or until machine code cannot continue.

    Args:
        code: The machine code of the diagram.
        program: The diagram.
        problem: The run.
        settings: How to step.
    """
    start = float(problem.times[0])
    run_state = RunState(time=start, start=start, mark=start, pending=_ALL)
    state, held = problem.state.copy(), problem.held.copy()
    rows = np.empty((problem.times.size, program.width))
    return go_on(code, problem, settings, run_state, state, held, rows)


def go_on(
    code: Library,
    problem: RunProblem,
    settings: Settings,
    run_state: RunState,
    state: FloatArray,
    held: FloatArray,
    rows: FloatArray,
) -> Run:
    """Continues a run until its end, or until machine code cannot continue.

    Args:
        code: The machine code of the diagram.
        problem: The run.
        settings: How to step.
        run_state: The progress of the run; overwritten.
        state, held: The accepted state and the held values; overwritten.
        rows: The rows of its record, shape (k, width), of which the first ones are written.
    """
    trial = np.full_like(problem.state, np.nan)
    step, tables = code.run_controlled, [settings.longest, settings.absolute, settings.relative]
    if settings.tableau is not None:
        a, b, c = settings.tableau
        step, tables = code.run_fixed, [settings.longest, b.size, a, b, c]
    values = [state, held, problem.parameters, trial, problem.times.size, problem.times, rows]
    values += [problem.events.size, problem.events, problem.due, problem.noise, *tables]
    arguments = [_argument(value) for value in values]
    ending, budget = RunEnding.PAUSED, FIRST
    while ending is RunEnding.PAUSED and not settings.look(lambda: rows[: run_state.row]):
        began = time.perf_counter()
        ending = RunEnding(step(ctypes.byref(run_state), *arguments, _argument(budget)))
        passed = time.perf_counter() - began
        budget = max(1, int(budget * min(4.0, PAUSE / max(passed, 1e-9))))
        if ending is RunEnding.OFF_MANIFOLD:
            try:
                state[:] = problem.project(run_state.time, state, held)
            except InconsistentStateError:
                break
            run_state.pending &= ~_PROJECTION
            ending = RunEnding.PAUSED
    return Run(
        rows[: run_state.row],
        ending,
        run_state.time,
        state,
        held,
        run_state.event,
        run_state.steps,
        run_state.before,
        run_state.next,
        run_state.trial,
        trial,
    )


def _argument(value: Any) -> Any:
    if isinstance(value, np.ndarray):
        return ctypes.c_void_p(value.ctypes.data)
    return ctypes.c_double(value) if isinstance(value, float) else ctypes.c_longlong(value)


def _source(program: RolloutProgram) -> str:
    compiled, calls = program.compiled, program.compiled.staged
    sizes: dict[str, int] = {
        "SIZE": max(1, program.size),  # An array has one entry at least.
        "HELD": compiled.sizes["held"],
        "NOISE": compiled.sizes["noise"],
        "WIDTH": program.width,
        "GIVEN": calls["given"].numel_out(0),
        "PROJECTS": int(compiled.projects),
    }
    for name, function in calls.items():
        # At least as many as the initializers in stepper.c.
        sizes[f"{name.upper()}_ARG"] = max(6, function.sz_arg())
        sizes[f"{name.upper()}_RES"] = max(4, function.sz_res())
    lines = [f"enum {{ {name} = {size} }};" for name, size in sizes.items()]
    for number, rate in enumerate(compiled.rates):
        lines.append(c_places(number, rate))
    lines += [c_table(name, np.asarray(values)) for name, values in DOP_TABLES.items()]
    words = {
        "run": RUN.read_text(encoding="utf-8"),
        "generated": without_branches(
            generate(*(renamed(each, f"dae_{name}") for name, each in calls.items()))
        ),
        "constants": "\n".join([*lines, ""]),
        "updates": "\n".join(
            _updated(*item) for item in enumerate(compiled.rates) if item[1].stepped is None
        ),
        "sample": _sampled(len(compiled.rates) - 1) if compiled.has_stepped else "",
    }
    return Template(SOURCE.read_text(encoding="utf-8")).substitute(words)


def _updated(number: int, rate: UpdateRate) -> str:
    """Returns the C of an update that is due."""
    count = len(rate.places)
    return f"""  if (due >> {number} & 1 && unrestricted == {int(rate.is_unrestricted)}) {{
    double values[{count + 1}], valid;
    const double *arg[UPDATE_{number}_ARG] = {{&time, x, held, g->parameters, g->given, noise}};
    double *res[UPDATE_{number}_RES] = {{values, &valid}};
    int i;
    dae_update_{number}(arg, res, 0, 0, 0);
    good &= isfinite(valid) != 0;
    for (i = 0; i < {count}; i++) fresh[places_{number}[i]] = values[i];
  }}"""


def _sampled(number: int) -> str:
    """Returns the C function of a sample, for a diagram with a block that Drake steps."""
    return f"""
/* The input of Drake's step and the unrestricted updates; or, after it, the discrete ones. */
__attribute__((visibility("default"))) int sample(
    double time, double *held, const double *parameters, const double *noise, long long due,
    int unrestricted, double *input) {{
  Given g;
  double x[SIZE] = {{0.0}}, valid = 0.0;
  const double *arg[UPDATE_{number}_ARG] = {{&time, x, held, parameters, g.given, noise}};
  double *res[UPDATE_{number}_RES] = {{input, &valid}};
  g.held = held;
  g.parameters = parameters;
  g.time = NAN;
  set_time(time, &g);
  if (unrestricted) dae_update_{number}(arg, res, 0, 0, 0);
  if (!isfinite(valid)) return INVALID;
  return apply(time, x, held, &g, noise, due, unrestricted) ? DONE : INVALID;
}}
"""


def c_places(number: int, rate: UpdateRate) -> str:
    """Returns the places of an update among the held values as an array of C."""
    return f"static const int places_{number}[] = {{{', '.join(map(str, [*rate.places, 0]))}}};"


def c_table(name: str, values: FloatArray) -> str:
    """Returns a vector or a matrix as an array of C."""
    if values.ndim == 1:
        listed = ", ".join(map(repr, [*values.tolist(), 0.0]))
        return f"static const double {name}[] = {{{listed}}};"
    rows = ",\n".join(f"{{{', '.join(map(repr, row))}}}" for row in values.tolist())
    return f"static const double {name}[{values.shape[0]}][{values.shape[1]}] = {{\n{rows}}};"
