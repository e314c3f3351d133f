"""Many runs side by side: the arguments and results of lanes.c."""

import ctypes
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np

from drake_dae.arrays import FloatArray
from drake_dae.running.rollout.lanes.library import Lanes
from drake_dae.running.rollout.problems import Problems
from drake_dae.running.rollout.program import RolloutProgram
from drake_dae.running.rollout.run import Run, RunEnding, Settings, num_cores
from drake_dae.running.rollout.stepping.machine import Library, RunState, go_on

STOPPED = 1 << 62
"""A value of "next" with which no more runs start, and all others end; lanes.c has the same."""


class _Batch(ctypes.Structure):
    """The Batch of lanes.c."""

    _fields_ = (
        ("num_runs", ctypes.c_longlong),
        *((name, ctypes.c_void_p) for name in ("states", "held", "parameters", "noise")),
        *((name, ctypes.c_longlong) for name in ("parameter_step", "noise_step")),
        *((name, ctypes.c_longlong) for name in ("num_rows", "num_events", "stages")),
        *((name, ctypes.c_void_p) for name in ("times", "events", "due", "rows")),
        *((name, ctypes.c_double) for name in ("longest", "relative")),
        *((name, ctypes.c_void_p) for name in ("a", "b", "c", "absolute", "constants")),
        *((name, ctypes.c_void_p) for name in ("runs", "endings", "next")),
    )


def run_many(
    lanes: Lanes, code: Library, program: RolloutProgram, problems: Problems, settings: Settings
) -> list[Run]:
    """Runs a diagram many times, on all cores.

    Args:
        lanes: The machine code of runs side by side, as `library.load` returns it.
        code: The machine code of one run, which continues runs that need it.
        program: The diagram.
        problems: The runs.
        settings: How to step; its `look` is not called.
    """
    count = len(problems)
    a, b, c = settings.tableau or (np.zeros((0, 0)), np.zeros(0), np.zeros(0))
    arrays: dict[str, Any] = {  # By their names in lanes.c.
        "states": problems.states.copy(),
        "held": problems.held.copy(),
        "parameters": problems.parameters,
        "noise": problems.noise,
        "times": problems.times,
        "events": problems.events,
        "due": problems.due,
        "rows": np.empty((count, problems.times.size, program.width)),
        "a": a,
        "b": b,
        "c": c,
        "absolute": settings.absolute,
        "constants": lanes.constants,
        "runs": np.zeros((count, ctypes.sizeof(RunState)), dtype=np.uint8),
        "endings": np.zeros(count, dtype=np.intc),  # Whether a run has to continue alone.
        "next": np.zeros(1, dtype=np.longlong),
    }
    batch = _Batch(
        num_runs=count,
        parameter_step=_row(problems.parameters),
        noise_step=_row(problems.noise),
        num_rows=problems.times.size,
        num_events=problems.events.size,
        stages=b.size,
        longest=settings.longest,
        relative=settings.relative,
        **{name: array.ctypes.data for name, array in arrays.items()},
    )
    threads = max(1, min(num_cores(), count // 8))
    with ThreadPoolExecutor(threads) as pool:
        try:  # Machine code releases Python's lock; Ctrl-C ends it.
            run = lanes.code.run_lanes
            calls = [pool.submit(run, ctypes.byref(batch)) for _ in range(threads)]
            for call in calls:
                call.result()
        except BaseException:
            arrays["next"][0] = STOPPED
            raise
    states, held, rows = (arrays[name] for name in ("states", "held", "rows"))

    def alone(index: int) -> Run:
        at = RunState.from_buffer(arrays["runs"][index])
        return go_on(code, problems[index], settings, at, states[index], held[index], rows[index])

    def done(index: int) -> Run:
        at = RunState.from_buffer(arrays["runs"][index])
        values = at.time, states[index], held[index], at.event, at.steps, at.before, at.next
        return Run(rows[index], RunEnding.DONE, *values, np.inf, np.zeros(0))

    others = np.flatnonzero(arrays["endings"]).tolist()
    with ThreadPoolExecutor(num_cores()) as pool:
        continued = dict(zip(others, pool.map(alone, others), strict=True))
    return [continued.get(index) or done(index) for index in range(count)]


def _row(table: FloatArray) -> int:
    """The distance between the rows of two runs, in numbers; 0 if all runs have the same."""
    return 0 if len(table) == 1 else int(np.prod(table.shape[1:]))
