"""Many runs side by side: the arguments and results of lanes.c."""

import ctypes
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
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

ENDLESS = 1 << 62
"""More steps than a run takes."""


class _Batch(ctypes.Structure):
    """The Batch of lanes.c."""

    _fields_ = (
        *((name, ctypes.c_longlong) for name in ("num_runs", "most")),
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
    batch = RunBatch(program, problems, settings, ENDLESS, lanes.constants)
    structure, count = batch.structure(), len(problems)
    threads = max(1, min(num_cores(), count // 8))
    with ThreadPoolExecutor(threads) as pool:
        try:  # Machine code releases Python's lock; Ctrl-C ends it.
            run = lanes.code.run_lanes
            calls = [pool.submit(run, ctypes.byref(structure)) for _ in range(threads)]
            for call in calls:
                call.result()
        except BaseException:
            batch.arrays["next"][0] = STOPPED
            raise
    return batch.ended(partial(go_on, code), num_cores())


class RunBatch:
    """Runs that go side by side.

    Args:
        program: The diagram.
        problems: The runs.
        settings: How to step.
        most: The number of steps after which a run has to continue elsewhere.
        constants: The constants of the functions.

    Attributes:
        arrays: The arrays that C reads and writes, by their names in lanes.c. Of each run: "runs",
            its `RunState`; "endings", whether it has to continue elsewhere; "states", "held" and
            "rows", shape (k, j, width).
    """

    def __init__(
        self,
        program: RolloutProgram,
        problems: Problems,
        settings: Settings,
        most: int,
        constants: FloatArray,
    ) -> None:
        self._problems, self._settings, self._most = problems, settings, most
        count = len(problems)
        a, b, c = settings.tableau or (np.zeros((0, 0)), np.zeros(0), np.zeros(0))
        self.arrays: dict[str, Any] = {
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
            "constants": constants,
            "runs": np.zeros((count, ctypes.sizeof(RunState)), dtype=np.uint8),
            "endings": np.zeros(count, dtype=np.intc),
            "next": np.zeros(1, dtype=np.longlong),
        }

    def structure(self) -> ctypes.Structure:
        """Returns the Batch of lanes.c, with the addresses of all arrays."""
        problems, settings = self._problems, self._settings
        return _Batch(
            num_runs=len(problems),
            most=self._most,
            parameter_step=_row(problems.parameters),
            noise_step=_row(problems.noise),
            num_rows=problems.times.size,
            num_events=problems.events.size,
            stages=self.arrays["b"].size,
            longest=settings.longest,
            relative=settings.relative,
            **{name: array.ctypes.data for name, array in self.arrays.items()},
        )

    def done(self, index: int) -> Run:
        """Returns a run that has reached its end."""
        at, arrays = RunState.from_buffer(self.arrays["runs"][index]), self.arrays
        values = at.time, arrays["states"][index], arrays["held"][index]
        counts = at.event, at.steps, at.before, at.next
        return Run(arrays["rows"][index], RunEnding.DONE, *values, *counts, np.inf, np.zeros(0))

    def ended(self, go_on: Callable[..., Run], threads: int) -> list[Run]:
        """Returns all runs; those that have to continue elsewhere do so first.

        Args:
            go_on: (problem, settings, run state, state, held, rows) -> the run.
            threads: The number of runs that continue at once.
        """

        def other(index: int) -> Run:
            at = RunState.from_buffer(self.arrays["runs"][index])
            values = (self.arrays[name][index] for name in ("states", "held", "rows"))
            return go_on(self._problems[index], self._settings, at, *values)

        others = np.flatnonzero(self.arrays["endings"]).tolist()
        with ThreadPoolExecutor(threads) as pool:
            continued = dict(zip(others, pool.map(other, others), strict=True))
        return [continued.get(index) or self.done(index) for index in range(len(self._problems))]


def _row(table: FloatArray) -> int:
    """The distance between the rows of two runs, in numbers; 0 if all runs have the same."""
    return 0 if len(table) == 1 else int(np.prod(table.shape[1:]))
