"""The data of a run: its problem, its settings, its ending; with machine code and without."""

import os
from collections.abc import Callable
from dataclasses import dataclass
from enum import IntEnum
from typing import NamedTuple, Self

import numpy as np
from pydrake.systems.analysis import SimulatorConfig
from scipy.integrate import RK23, RK45

from drake_dae.arrays import FloatArray
from drake_dae.errors import ModelError, SimulationError

Look = Callable[[Callable[[], FloatArray]], bool]

SHARE = 1e-3
"""The error of a step over the accuracy: rows between long steps are then as accurate as these."""

SMALLEST = 1e-13
"""The least relative error of a step: below it is round-off."""


LOOKED = 64
"""The number of fixed steps or samples after which a run checks for Ctrl-C and divergence."""


def num_cores() -> int:
    """Returns the number of cores that this process may use."""
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
    """How the stepping ended; stepper.c has the same list."""

    DONE = 0
    PAUSED = 1
    INVALID = 2
    OFF_MANIFOLD = 3
    STUCK = 4
    SPOILT = 5
    SLOW = 6


@dataclass(frozen=True, eq=False)
class Settings:
    """How to step.

    Attributes:
        longest: The longest step, or the fixed one, in s.
        tableau: The method of fixed steps; None for error control by DOP853.
        absolute: The absolute tolerance of a step for each state, shape (n,).
        relative: The relative tolerance.
        look: Called from time to time with a function that returns the rows up to then; returns
            whether to stop.
    """

    longest: float
    tableau: Tableau | None
    absolute: FloatArray
    relative: float
    look: Look

    @classmethod
    def of(cls, config: SimulatorConfig, scale: FloatArray, look: Look) -> Self:
        """Makes the settings from Drake's.

        Args:
            config: Drake's settings.
            scale: The sizes of the states, shape (n,).
            look: As the attribute.

        Raises:
            ModelError: The steps are fixed, and the scheme is implicit.
        """
        tableau, scheme = None, config.integration_scheme
        if not config.use_error_control:
            if scheme not in FIXED:
                raise ModelError(
                    f"integration_scheme: a rollout takes no fixed steps of {scheme}; choose "
                    f"{', '.join(FIXED)}, or use_error_control"
                )
            tableau = FIXED[scheme]
        elif not scale.size:  # Without a state, there is no error to control.
            tableau = FIXED["explicit_euler"]
        relative = max(SHARE * config.accuracy, SMALLEST)
        return cls(config.max_step_size, tableau, relative * scale, relative, look)


@dataclass(frozen=True, eq=False)
class RunProblem:
    """One run.

    Attributes:
        times: The times of the rows in s, from the start to the end, shape (k,).
        state: The continuous state at the start, shape (n,).
        held: The discrete states at the start, and random numbers, shape (m,).
        parameters: All parameters.
        events: The times of updates in s.
        due: The rates that are due at each update, as bits.
        noise: The random numbers of each update, shape (len(events), number of entries).
        project: (time, state, held) -> the state on N*; raises InconsistentStateError.
    """

    times: FloatArray
    state: FloatArray
    held: FloatArray
    parameters: FloatArray
    events: FloatArray
    due: np.ndarray
    noise: FloatArray
    project: Callable[[float, FloatArray, FloatArray], FloatArray]


@dataclass(frozen=True, eq=False)
class Run:
    """The result of a run.

    Attributes:
        rows: The rows of the record up to its end.
        ending: How it ended.
        time: The time of the last accepted state, in s.
        state, held: The last accepted state, and the held values there.
        event: The number of updates made.
        steps: The number of accepted steps.
        mark: The time a thousand steps ago, in s.
        next: The end of a step that was not accepted, in s.
        trial_time, trial: The earliest trial after `time` that failed; not finite if none did.
        error: An exception that a block raised.
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
    error: SimulationError | None = None
