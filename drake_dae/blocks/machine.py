"""A block as machine code that steps it without calls of Python: one run, or several at once."""

import ctypes
import os
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from drake_dae.arrays import FloatArray
from drake_dae.blocks.emitter import can_be_emitted, emitted
from drake_dae.blocks.stepping import (
    Run,
    RunEnding,
    RunProblem,
    StepFunctions,
    StepSettings,
    dop853_tables,
    tableau_of,
)
from drake_dae.errors import InconsistentStateError
from drake_dae.trace.compiled import Compiled, generate, library, renamed, without_branches

FOLDER = Path(__file__).parent

FIRST, PAUSE = 500, 0.1
"""The steps before Python first checks a run; then the time between checks, in s."""

STOPPED = 1 << 62
"""A value of "next" with which no more runs start, and all others end; stepper.c has the same."""

LANES_OPTIONS = ("-O2", "-ffp-contract=fast")
"""Fused multiply-add where the processor has it; with -O2, runs take a tenth less time."""

SLOWER = 4
"""The compile time of an operation on registers over that of an operation on numbers."""


class Stepper(NamedTuple):
    """The machine code of a block; for several runs, of all that differ in constants alone."""

    code: ctypes.CDLL
    constants: FloatArray
    functions: StepFunctions


class _Run(ctypes.Structure):
    """The Run of stepper.c."""

    _fields_ = (
        *((name, ctypes.c_double) for name in ("time", "step", "start", "mark", "begin")),
        *((name, ctypes.c_longlong) for name in ("row", "event", "steps", "number", "index")),
        *((name, ctypes.c_longlong) for name in ("on", "ending")),
    )


class _Batch(ctypes.Structure):
    """The Batch of stepper.c."""

    _fields_ = (
        ("num_runs", ctypes.c_longlong),
        *((name, ctypes.c_void_p) for name in ("states", "held", "parameters", "noise")),
        *((name, ctypes.c_longlong) for name in ("parameter_step", "noise_step")),
        *((name, ctypes.c_longlong) for name in ("num_rows", "num_events")),
        *((name, ctypes.c_void_p) for name in ("times", "events", "due", "rows")),
        *((name, ctypes.c_double) for name in ("longest", "relative")),
        ("absolute", ctypes.c_void_p),
        ("stages", ctypes.c_longlong),
        *((name, ctypes.c_void_p) for name in ("a", "b", "c", "e3", "e5", "d")),
        *((name, ctypes.c_void_p) for name in ("a_more", "c_more", "constants", "runs")),
        ("budget", ctypes.c_longlong),
        ("next", ctypes.c_void_p),
    )


def can_run_several(functions: StepFunctions) -> bool:
    """Whether runs can go side by side: lanes support all operations."""
    return all(can_be_emitted(each) for each in functions.functions.values())


def load(
    functions: StepFunctions, compiled: Compiled, make: bool, several: bool = False
) -> Stepper | None:
    """The machine code of a block, of one run or of several side by side; None if there is none."""
    constants: list[float] = []
    operations = functions.num_operations
    options: tuple[str, ...] = ()
    if several:
        operations *= SLOWER if compiled is True else 1
        options = LANES_OPTIONS
    path = library(source(functions, constants, several), operations, compiled, make, options)
    if path is None:
        return None
    return Stepper(ctypes.CDLL(str(path)), np.array([*constants, 0.0]), functions)


def source(functions: StepFunctions, constants: list[float], several: bool = False) -> str:
    """The C source that steps a block; for several runs its constants are appended to a list."""
    sizes = dict(zip(["SIZE", "HELD", "PARAMETERS", "NOISE"], functions.sizes[1:], strict=True))
    sizes |= {"WIDTH": functions.row.numel_out(0), "RATES": len(functions.rates)}
    sizes["PROJECTS"] = int(functions.projects)
    lines = [f"enum {{ {name} = {size} }};" for name, size in sizes.items()]
    rates = functions.rates
    counts = [len(rate.places) for rate in rates]
    lines += [
        _ints("is_unrestricted", [rate.is_unrestricted for rate in rates]),
        _ints("counts", counts),
        *(_ints(f"places_{i}", rate.places) for i, rate in enumerate(rates)),
        "static const int *const places[] = "
        f"{{{', '.join([*(f'places_{i}' for i in range(len(rates))), '0'])}}};",
        "static mask update_rate(int number, const double *c, const real *t, const real *x,",
        "    const real *held, const real *parameters, const real *noise, real *values) {",
        "  (void)c, (void)t, (void)x, (void)held, (void)parameters, (void)noise, (void)values;",
        "  switch (number) {",
        *(
            f"  case {i}: return dae_update_{i}(c, t, x, held, parameters, noise, values);"
            for i in range(len(rates))
        ),
        "  }\n  return none();\n}\n",
    ]
    calls = [(f"dae_{name}", function) for name, function in functions.functions.items()]
    if several:
        texts = [emitted(function, name, constants) for name, function in calls]
    else:
        scalar = without_branches(generate(*(renamed(f, f"{name}_") for name, f in calls)))
        texts = [scalar, *(_called(name, function) for name, function in calls)]
    return "\n".join(
        [
            "#ifdef __FAST_MATH__",
            '#error "not with -ffast-math: nan would pass for a number"',
            "#endif",
            "" if several else "#define LANES 1",
            "#define CASADI_SYMBOL_EXPORT static",
            '#define EXPORTED __attribute__((visibility("default")))',
            (FOLDER / "real.h").read_text(encoding="utf-8"),
            *texts,
            *lines,
            (FOLDER / "stepper.c").read_text(encoding="utf-8"),
        ]
    )


def _ints(name: str, values: Sequence[int]) -> str:
    return f"static const int {name}[] = {{{', '.join(str(int(v)) for v in [*values, 0])}}};"


def _called(name: str, function: ca.Function) -> str:
    """A function that CasADi generated, called as those of several runs are."""
    inputs, outputs = range(function.n_in()), range(function.n_out())
    declared = [*(f"const real *a{i}" for i in inputs), *(f"real *r{i}" for i in outputs)]
    arguments = ", ".join(f"a{i}" for i in inputs)
    results = ", ".join(f"r{i}" for i in outputs)
    return (
        f"static mask {name}(const double *c, {', '.join(declared)}) {{\n"
        f"  const double *arg[{max(function.n_in(), function.sz_arg())}] = {{{arguments}}};\n"
        f"  double *res[{max(function.n_out(), function.sz_res())}] = {{{results}}};\n"
        f"  (void)c;\n  {name}_(arg, res, 0, 0, 0);\n  return 0;\n}}\n"
    )


def num_cores() -> int:
    """The number of cores that this process may use."""
    allowed = getattr(os, "sched_getaffinity", None)  # macOS has none.
    return len(allowed(0)) if allowed else os.cpu_count() or 1


def run_alone(stepper: Stepper, problems: RunProblem, settings: StepSettings) -> list[Run]:
    """Makes runs one by one, on all cores."""
    call, count = _Call(stepper, problems, settings), len(problems.state)
    if count == 1:
        return [call.alone(0)]
    # Machine code releases Python's lock: threads are enough for all cores.
    with ThreadPoolExecutor(num_cores()) as pool:
        return list(pool.map(call.alone, range(count)))


def run_several(
    stepper: Stepper, alone: Stepper, problems: RunProblem, settings: StepSettings
) -> list[Run]:
    """Makes runs side by side, on all cores; those that fail go on alone. `look` is not called."""
    together = _Call(stepper, problems, settings)
    count = len(problems.state)
    threads = max(1, min(num_cores(), count // 8))
    batch = together.batch(0, count)
    with ThreadPoolExecutor(threads) as pool:
        try:  # Ctrl-C ends it.
            run = stepper.code.make_runs
            for each in [pool.submit(run, ctypes.byref(batch)) for _ in range(threads)]:
                each.result()
        except BaseException:
            together.next[0] = STOPPED
            raise
    together.stepper = alone
    failed = [i for i, run in enumerate(together.runs) if run.ending != RunEnding.DONE]
    with ThreadPoolExecutor(num_cores()) as pool:
        continued = dict(zip(failed, pool.map(together.alone, failed), strict=True))
    return [continued.get(i) or together.ended(i) for i in range(count)]


class _Call:
    """The arrays of some runs, which C overwrites."""

    def __init__(self, stepper: Stepper, problems: RunProblem, settings: StepSettings) -> None:
        self.stepper, self._problems, self._settings = stepper, problems, settings
        count, functions = len(problems.state), stepper.functions
        self._states, self._held = problems.state.copy(), problems.held.copy()
        self._rows = np.empty((count, problems.times.size, functions.row.numel_out(0)))
        self.runs = (_Run * count)()
        start = float(problems.times[0])
        for run in self.runs:
            run.time = run.start = run.mark = start
            run.ending = RunEnding.PAUSED
        self.next = np.zeros(1, dtype=np.longlong)
        tables = settings.tableau or tableau_of("dop853")
        self._fixed: dict[str, Any] = {
            **dict(zip("abc", map(np.ascontiguousarray, tables), strict=True)),
            **dop853_tables(),
            "absolute": settings.absolute,
            "times": problems.times,
            "events": problems.events,
            "due": problems.due,
        }

    def batch(self, first: int, count: int, next_: np.ndarray | None = None) -> _Batch:
        """The arguments of some of the runs."""
        problems, settings = self._problems, self._settings
        arrays = {
            "states": self._states[first:],
            "held": self._held[first:],
            "parameters": problems.parameters[first if len(problems.parameters) > 1 else 0 :],
            "noise": problems.noise[first if len(problems.noise) > 1 else 0 :],
            "rows": self._rows[first:],
            "constants": self.stepper.constants,
            "next": self.next if next_ is None else next_,
            **self._fixed,
        }
        return _Batch(
            num_runs=count,
            parameter_step=_step(problems.parameters),
            noise_step=_step(problems.noise),
            num_rows=problems.times.size,
            num_events=problems.events.size,
            longest=settings.longest,
            relative=settings.relative,
            stages=0 if settings.tableau is None else settings.tableau.b.size,
            runs=ctypes.addressof(self.runs) + first * ctypes.sizeof(_Run),
            **{name: array.ctypes.data for name, array in arrays.items()},
        )

    def alone(self, i: int) -> Run:
        """Makes one run, or goes on with it, until its end, or to where it cannot go on."""
        at, state, held, rows = self.runs[i], self._states[i], self._held[i], self._rows[i]
        functions, next_ = self.stepper.functions, np.zeros(1, dtype=np.longlong)
        at.ending, budget = RunEnding.PAUSED, FIRST
        batch = self.batch(i, 1, next_)
        while at.ending == RunEnding.PAUSED and not self._settings.look(lambda: rows[: at.row]):
            batch.budget, next_[0] = budget, 0
            began = time.perf_counter()
            self.stepper.code.make_runs(ctypes.byref(batch))
            passed = time.perf_counter() - began
            budget = max(1, int(budget * min(4.0, PAUSE / max(passed, 1e-9))))
            if at.ending == RunEnding.OFF_MANIFOLD:
                parameters = self._problems.run(i).parameters
                try:
                    state[:] = functions.projected(at.time, state, held, parameters)
                except InconsistentStateError:
                    break
                at.on, at.ending = 1, RunEnding.PAUSED
        return self.ended(i)

    def ended(self, i: int) -> Run:
        """The result of a run."""
        at, rows = self.runs[i], self._rows[i]
        states = self._states[i], self._held[i]
        return Run(rows[: at.row], RunEnding(at.ending), at.time, *states, at.steps)


def _step(table: FloatArray) -> int:
    """The distance between the rows of two runs, in numbers; 0 if all runs have the same."""
    return 0 if len(table) == 1 else int(np.prod(table.shape[1:]))
