"""What a rollout steps, how, and how it ends; the same for machine code and without."""

import os
from collections.abc import Callable
from dataclasses import dataclass
from enum import IntEnum
from typing import NamedTuple, Self

import numpy as np
from pydrake.systems.analysis import SimulatorConfig
from pydrake.systems.framework import Context
from scipy.integrate import RK23, RK45

from drake_dae.arrays import FloatArray
from drake_dae.errors import ModelError, SimulationError

Look = Callable[[Callable[[], FloatArray], Context | None], bool]

SHARE = 1e-3
"""Of the accuracy that a step may use up: then what is read between long steps is as good."""

SMALLEST = 1e-13
"""Less than this, relative to the state, no step can promise."""


LOOKED = 64
"""The number of fixed steps or samples after which a run checks for Ctrl-C and divergence."""


def num_cores() -> int:
    """How many cores this process may use."""
    allowed = getattr(os, "sched_getaffinity", None)  # macOS has none.
    return len(allowed(0)) if allowed else os.cpu_count() or 1


class Tableau(NamedTuple):
    """An explicit Runge-Kutta method: A, shape (s, s), b and c, shape (s,)."""

    a: FloatArray
    b: FloatArray
    c: FloatArray


def _tableau(a: list[list[float]], b: list[float], c: list[float]) -> Tableau:
    square = np.zeros((len(b), len(b)))
    for row, values in enumerate(a):
        square[row, : len(values)] = values
    return Tableau(square, np.array(b, dtype=float), np.array(c, dtype=float))


FIXED = {
    "explicit_euler": _tableau([[]], [1.0], [0.0]),
    "runge_kutta2": _tableau([[], [1.0]], [0.5, 0.5], [0.0, 1.0]),
    "runge_kutta3": _tableau([[], [0.5], [-1.0, 2.0]], [1 / 6, 2 / 3, 1 / 6], [0.0, 0.5, 1.0]),
    "bogacki_shampine3": _tableau(RK23.A, RK23.B, RK23.C),
    "runge_kutta5": _tableau(RK45.A, RK45.B, RK45.C),
}
"""Drake's explicit schemes."""


class RunEnding(IntEnum):
    """How the stepping ended; stepper.c has the same list.

    At a CHANGE a block has to react before it goes on; a run is STOPPED by a block.
    """

    DONE = 0
    PAUSED = 1
    INVALID = 2
    OFF_MANIFOLD = 3
    STUCK = 4
    SPOILT = 5
    SLOW = 6
    CHANGE = 7
    STOPPED = 8


@dataclass(frozen=True, eq=False)
class Settings:
    """How to step.

    Attributes:
        longest: The longest step, or the fixed one, in s.
        tableau: The method of fixed steps; None for error control, by DOP853.
        absolute: The error that a step may make, for each state, shape (n,).
        relative: The same relative to the state.
        look: Called now and then with what returns the rows written up to then, and with the
            context of `RunProblem`; whether to stop where the run is.
    """

    longest: float
    tableau: Tableau | None
    absolute: FloatArray
    relative: float
    look: Look

    @classmethod
    def of(cls, config: SimulatorConfig, scale: FloatArray, look: Look) -> Self:
        """The settings of a scenario.

        Args:
            config: Drake's settings.
            scale: How large the states are, shape (n,).
            look: As the attribute.

        Raises:
            ModelError: Its scheme has fixed steps, and is implicit.
        """
        tableau, scheme = None, config.integration_scheme
        if not config.use_error_control:
            if scheme not in FIXED:
                raise ModelError(
                    f"integration_scheme: a rollout takes no fixed steps of {scheme}; choose "
                    f"{', '.join(FIXED)}, or use_error_control"
                )
            tableau = FIXED[scheme]
        elif not scale.size:  # Without a state there is no error.
            tableau = FIXED["explicit_euler"]
        relative = max(SHARE * config.accuracy, SMALLEST)
        return cls(config.max_step_size, tableau, relative * scale, relative, look)


@dataclass(frozen=True, eq=False)
class RunProblem:
    """One run.

    Attributes:
        times: When rows of the record are written, in s, from the start to the end, shape (k,).
        state: The continuous state at the start.
        held: What blocks hold at the start, random numbers included.
        parameters: All parameters.
        events: When there are updates, in s.
        due: Which rates are due at each of these, as bits.
        noise: The random numbers of each of these, shape (len(events), number of entries).
        project: (time, state, held) -> the state on N*; raises InconsistentStateError.
        has_reacted: Whether blocks have reacted to how the run begins.
        earlier: Where this is a piece of a run, the rows of those before; the first row of the
            piece is then none of the record's.
        context: A context of the diagram in which blocks changed so far, where they do.
    """

    times: FloatArray
    state: FloatArray
    held: FloatArray
    parameters: FloatArray
    events: FloatArray
    due: np.ndarray
    noise: FloatArray
    project: Callable[[float, FloatArray, FloatArray], FloatArray]
    has_reacted: bool = False
    earlier: tuple[FloatArray, ...] = ()
    context: Context | None = None

    def whole(self, rows: FloatArray) -> FloatArray:
        """All rows of a run, where a piece has some by now."""
        return np.concatenate([*self.earlier, rows[1:]]) if self.earlier else rows


@dataclass(frozen=True, eq=False)
class Run:
    """What a run came to.

    Attributes:
        rows: The rows of the record, up to where it came.
        ending: How it ended.
        time: The time of the last accepted state, in s.
        state, held: That state, and what is held.
        event: How many of the problem's events were made.
        steps: How many steps were accepted.
        mark: The time a thousand steps ago, in s.
        next: The time that a step led to that was no step, in s; at a change that is found before
            a step, the time of the state.
        trial_time, trial: The earliest trial that failed after it, not finite if none did.
        context: A context of the diagram after the run, where blocks reacted to what happened.
        error: What a block raised there.
    """

    rows: FloatArray
    ending: RunEnding
    time: float
    state: FloatArray
    held: FloatArray
    event: int
    steps: int
    mark: float
    next: float
    trial_time: float
    trial: FloatArray
    context: Context | None = None
    error: SimulationError | None = None
