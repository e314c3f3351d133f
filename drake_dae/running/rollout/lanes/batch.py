"""Many runs side by side: what C is given, and what comes back."""

import ctypes
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np

from drake_dae.arrays import FloatArray
from drake_dae.running.rollout.problems import Problems
from drake_dae.running.rollout.program import Program
from drake_dae.running.rollout.run import Ending, Run, Settings, num_cores
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
    lanes: Library, code: Library, program: Program, problems: Problems, settings: Settings
) -> list[Run]:
    """Runs a diagram many times, on all cores.

    Args:
        lanes: What `library.load` returned.
        code: The diagram as machine code, which goes on with runs that are handed over to it.
        program: The diagram.
        problems: What to run.
        settings: How to step; nothing looks at these runs while they go on.
    """
    many = _Many(lanes, program, problems, settings, ENDLESS)

    def go_on_with(index: int) -> Run:
        own, rows = many.runs[index], many.rows[index]
        states, held = many.states[index], many.held[index]
        return go_on(code, problems[index], settings, own, states, held, rows)

    others = np.flatnonzero(many.endings).tolist()
    found = {}
    if others:
        with ThreadPoolExecutor(num_cores()) as pool:
            found = dict(zip(others, pool.map(go_on_with, others), strict=True))
    return [found.get(index) or many.done(index) for index in range(len(problems))]


def run_briefly(
    lanes: Library, program: Program, problems: Problems, settings: Settings, most: int
) -> list[Run | None]:
    """The same of runs that come to their end side by side; None for the others.

    Args:
        lanes, program, problems, settings: As of `run_many`.
        most: A run that takes more steps is none of them.
    """
    many = _Many(lanes, program, problems, settings, most)
    return [
        None if ending else many.done(index) for index, ending in enumerate(many.endings.tolist())
    ]


class _Many:
    """Runs that went side by side.

    Attributes:
        runs, endings: Where each ended, and whether it is to go on elsewhere, as lanes.c has it.
        states, held: What it came to.
        rows: The rows of its record, shape (k, j, width).
    """

    def __init__(
        self,
        lanes: Library,
        program: Program,
        problems: Problems,
        settings: Settings,
        most: int,
    ) -> None:
        count, num_rows = len(problems), problems.times.size
        self.states, self.held = problems.states.copy(), problems.held.copy()
        self.rows = np.empty((count, num_rows, program.width))
        self.runs, self.endings = (RunState * count)(), np.zeros(count, dtype=np.intc)
        following = np.zeros(1, dtype=np.longlong)
        a, b, c = settings.tableau or (np.zeros((0, 0)), np.zeros(0), np.zeros(0))
        arrays: dict[str, Any] = {
            "states": self.states,
            "held": self.held,
            "parameters": problems.parameters,
            "noise": problems.noise,
            "times": problems.times,
            "events": problems.events,
            "due": problems.due,
            "rows": self.rows,
            "a": a,
            "b": b,
            "c": c,
            "absolute": settings.absolute,
            "endings": self.endings,
            "next": following,
        }
        batch = _Batch(
            num_runs=count,
            most=most,
            parameter_step=_row(problems.parameters),
            noise_step=_row(problems.noise),
            num_rows=num_rows,
            num_events=problems.events.size,
            stages=b.size,
            longest=settings.longest,
            relative=settings.relative,
            runs=ctypes.addressof(self.runs),
            **{name: array.ctypes.data for name, array in arrays.items()},
        )
        _run(lanes, batch, following)

    def done(self, index: int) -> Run:
        """A run that has come to its end."""
        own = self.runs[index]
        given = own.time, self.states[index], self.held[index], own.event, own.steps, own.before
        return Run(self.rows[index], Ending.DONE, *given, own.next, np.inf, _NOWHERE)


_NOWHERE = np.zeros(0)


def _run(lanes: Library, batch: _Batch, following: np.ndarray) -> None:
    """Runs all in threads, which need no lock of Python's; Ctrl-C ends them."""
    threads = max(1, min(num_cores(), batch.num_runs // 8))
    with ThreadPoolExecutor(threads) as pool:
        try:
            for done in [pool.submit(lanes.run_lanes, ctypes.byref(batch)) for _ in range(threads)]:
                done.result()
        except BaseException:
            following[0] = STOPPED
            raise


def _row(table: FloatArray) -> int:
    """How many numbers lead from a run to the next one."""
    return 0 if len(table) == 1 else int(np.prod(table.shape[1:]))
