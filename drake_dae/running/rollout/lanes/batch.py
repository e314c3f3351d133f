"""Many runs side by side: what C is given, and what comes back."""

import ctypes
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import Any

import numpy as np

from drake_dae.arrays import FloatArray
from drake_dae.running.rollout.problems import Problems
from drake_dae.running.rollout.program import RolloutProgram
from drake_dae.running.rollout.run import Run, RunEnding, Settings, num_cores
from drake_dae.running.rollout.stepping.machine import Library, RunState, go_on

STOPPED = 1 << 62
"""No more runs are taken, and those under way end; lanes.c has the same number."""

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
        *((name, ctypes.c_void_p) for name in ("a", "b", "c", "absolute")),
        *((name, ctypes.c_void_p) for name in ("runs", "endings", "next")),
    )


def run_many(
    lanes: Library, code: Library, program: RolloutProgram, problems: Problems, settings: Settings
) -> list[Run]:
    """Runs a diagram many times, on all cores.

    Args:
        lanes: What `library.load` returned.
        code: The diagram as machine code, which goes on with runs that are handed over to it.
        program: The diagram.
        problems: What to run.
        settings: How to step; nothing looks at these runs while they go on.
    """
    many = RunBatch(program, problems, settings, ENDLESS)
    _run(lanes, many)
    return many.ended(partial(go_on, code), num_cores())


def run_briefly(
    lanes: Library, program: RolloutProgram, problems: Problems, settings: Settings, most: int
) -> list[Run | None]:
    """The same on one core, of runs that come to their end side by side; None for the others.

    Args:
        lanes, program, problems, settings: As of `run_many`.
        most: A run that takes more steps is none of them.
    """
    many = RunBatch(program, problems, settings, most)
    lanes.run_lanes(ctypes.byref(many.here()))
    endings = many.arrays["endings"].tolist()
    return [None if ending else many.done(index) for index, ending in enumerate(endings)]


class RunBatch:
    """Runs that go side by side.

    Args:
        program: The diagram.
        problems: What to run.
        settings: How to step.
        most: A run that takes more steps is to go on elsewhere.

    Attributes:
        arrays: What C reads and writes, by the names that lanes.c has: of each run "runs", where it
            is, "endings", whether it is to go on elsewhere, "states", "held", and "rows", shape
            (k, j, width).
    """

    def __init__(
        self, program: RolloutProgram, problems: Problems, settings: Settings, most: int
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
            "runs": np.zeros((count, ctypes.sizeof(RunState)), dtype=np.uint8),
            "endings": np.zeros(count, dtype=np.intc),
            "next": np.zeros(1, dtype=np.longlong),
        }

    def batch(self, places: Mapping[str, int]) -> ctypes.Structure:
        """What C takes.

        Args:
            places: The addresses of `arrays`.
        """
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
            **places,
        )

    def here(self) -> ctypes.Structure:
        """The same with the arrays of this processor."""
        return self.batch({name: array.ctypes.data for name, array in self.arrays.items()})

    def done(self, index: int) -> Run:
        """A run that has come to its end."""
        own = RunState.from_buffer(self.arrays["runs"][index])
        state, held = self.arrays["states"][index], self.arrays["held"][index]
        given = own.time, state, held, own.event, own.steps, own.before, own.next
        return Run(self.arrays["rows"][index], RunEnding.DONE, *given, np.inf, _NOWHERE)

    def ended(self, go_on: Callable[..., Run], threads: int) -> list[Run]:
        """What all runs come to.

        Args:
            go_on: (problem, settings, where it is, state, held, rows) -> a run that goes on
                elsewhere.
            threads: How many of these go on at once.
        """

        def other(index: int) -> Run:
            own = RunState.from_buffer(self.arrays["runs"][index])
            given = (self.arrays[name][index] for name in ("states", "held", "rows"))
            return go_on(self._problems[index], self._settings, own, *given)

        others = np.flatnonzero(self.arrays["endings"]).tolist()
        found = {}
        if others:
            with ThreadPoolExecutor(threads) as pool:
                found = dict(zip(others, pool.map(other, others), strict=True))
        return [found.get(index) or self.done(index) for index in range(len(self._problems))]


_NOWHERE = np.zeros(0)


def _run(lanes: Library, many: RunBatch) -> None:
    """Runs all in threads, which need no lock of Python's; Ctrl-C ends them."""
    arrays, batch = many.arrays, many.here()
    threads = max(1, min(num_cores(), len(arrays["endings"]) // 8))
    with ThreadPoolExecutor(threads) as pool:
        try:
            for done in [pool.submit(lanes.run_lanes, ctypes.byref(batch)) for _ in range(threads)]:
                done.result()
        except BaseException:
            arrays["next"][0] = STOPPED
            raise


def _row(table: FloatArray) -> int:
    """How many numbers lead from a run to the next one."""
    return 0 if len(table) == 1 else int(np.prod(table.shape[1:]))
