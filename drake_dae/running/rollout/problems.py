"""The runs of a rollout, from its arguments."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from numbers import Integral
from threading import Lock
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from pydrake.systems.framework import Context, Diagram

from drake_dae.arguments import checked
from drake_dae.arrays import FloatArray, brief, numbers
from drake_dae.blocks.computations import Computations
from drake_dae.compiler.compiled import CompiledDiagram
from drake_dae.diagrams.closed_loop import ClosedLoop
from drake_dae.errors import ModelError
from drake_dae.running.rollout.events import Events, Seed, events_of, noise_of
from drake_dae.running.rollout.program import RolloutProgram, program_of
from drake_dae.running.rollout.run import RunProblem


@checked(ModelError)
def start_values(loop: ClosedLoop | Diagram, context: Context) -> tuple[FloatArray, FloatArray]:
    """Returns start and parameters of a closed loop, or of any diagram, for `rollout`.

    Args:
        loop: The closed loop or the diagram.
        context: Its context.

    Returns:
        The start, shape (n,): the continuous states of all blocks in Drake's order, and then their
        discrete states, such as the last value of a sensor that samples. The numeric parameters,
        shape (m,): in a closed loop those of the plant, then of the law's model, and its gains.

    Raises:
        ModelError: A block cannot be traced; the message has its name and the reason.
    """
    program = program_of(loop)
    state, held = program.compiled.start(context)
    values = program.compiled.values(context)
    held = program.compiled.initialized(context.get_time(), state, held, values)
    return np.concatenate([state, held[program.kept_places]]), values


def checked_times(times: ArrayLike) -> FloatArray:
    """Returns the times of a record as an array.

    Raises:
        ModelError: They are not two or more finite numbers that increase.
    """
    moments = numbers("times", times)
    if moments.ndim != 1 or moments.size < 2 or not np.isfinite(moments).all():
        raise ModelError(f"times must be two or more finite numbers, shape (j,), got {times!r}")
    if not (moments[1:] > moments[:-1]).all():
        raise ModelError("times must be strictly increasing")
    return moments


def _table(what: str, given: ArrayLike, size: int) -> FloatArray:
    table = np.atleast_2d(numbers(what, given))
    if table.ndim != 2 or table.shape[1] != size:
        raise ModelError(
            f"{what} must have shape ({size},), or (k, {size}) for k runs, got "
            f"{np.shape(given)}: see start_values"
        )
    if not np.isfinite(table).all():
        raise ModelError(f"{what} must be finite")
    return table


@dataclass(frozen=True, eq=False)
class Problems:
    """Many runs of one diagram over the same times.

    Attributes:
        compiled: The diagram.
        times: The times of the rows in s, shape (j,).
        states, held: The states and held values at the start, shapes (k, n) and (k, m).
        parameters: The parameters, shape (k, p), or (1, p) for all runs.
        events, due: The times of updates in s, and which rates are due then, as bits.
        noise: The random numbers of each update, shape (k, len(events), q), or one for all runs.
    """

    compiled: CompiledDiagram
    times: FloatArray
    states: FloatArray
    held: FloatArray
    parameters: FloatArray
    events: FloatArray
    due: np.ndarray
    noise: FloatArray
    _lock: Any = field(default_factory=Lock, repr=False)

    def __len__(self) -> int:
        return len(self.states)

    def __getitem__(self, index: int) -> RunProblem:
        parameters, noise = (
            table[index if len(table) > 1 else 0] for table in (self.parameters, self.noise)
        )
        return RunProblem(
            self.times,
            self.states[index],
            self.held[index],
            parameters,
            self.events,
            self.due,
            noise,
            partial(_project, self.compiled, self._lock, parameters),
        )

    def with_twins(self) -> np.ndarray:
        """Returns in which runs the plant and the law of a model have equal numbers, shape (k,)."""
        return np.broadcast_to(self.compiled.have_twins(self.parameters), len(self))

    def chosen(self, indices: np.ndarray) -> "Problems":
        """Returns some of the runs."""
        if len(indices) == len(self):
            return self
        parameters, noise = (
            table if len(table) == 1 else table[indices] for table in (self.parameters, self.noise)
        )
        states, held = self.states[indices], self.held[indices]
        return replace(self, states=states, held=held, parameters=parameters, noise=noise)

    def check(self) -> None:
        """Checks that all starts are on N*.

        Raises:
            InconsistentStateError: A start is not.
        """
        for index in range(len(self)):
            problem = self[index]
            start = float(self.times[0]), problem.state, problem.held, problem.parameters
            for part, values, block in _plants(self.compiled, *start):
                assert block.check_start is not None
                block.check_start(problem.state[part], values)


def problems_of(
    program: RolloutProgram,
    starts: ArrayLike,
    parameters: ArrayLike | None,
    times: FloatArray,
    seeds: Sequence[Seed] | None,
) -> Problems:
    """Makes the runs of `rollout` from its arguments.

    Args:
        program: The diagram.
        starts, parameters, times, seeds: The arguments of `rollout`.

    Raises:
        ModelError: The arguments have wrong shapes.
        InconsistentStateError: A start is not on N*.
    """
    compiled, size = program.compiled, program.size
    events = events_of(compiled, times)
    if not program.ends_updated:
        is_before = events.times < times[-1]
        events = Events(events.times[is_before], events.due[is_before])
    if parameters is None:
        parameters = compiled.values(compiled.context)
    if seeds is not None:
        seeds = [int(seed) if isinstance(seed, Integral) else seed for seed in seeds]
    states = _table("starts", starts, size + program.kept_places.size)
    rows = _table("parameters", parameters, compiled.sizes["parameters"])
    count = max(len(states), len(rows), len(seeds or ()))
    if len(states) == 1:
        states = np.repeat(states, count, axis=0)
    count = len(states)
    if len(rows) not in (1, count):
        raise ModelError(f"{len(rows)} rows of parameters for {count} starts")
    if seeds is not None and len(seeds) != count:
        raise ModelError(f"{len(seeds)} seeds for {count} starts")
    for seed in seeds or ():
        for value in [seed] if isinstance(seed, int) else seed.values():
            if not 0 <= value < 2**32:
                raise ModelError(f"a seed is a number from 0 to 2^32 - 1, got {brief(value)}")
    # Without noise, or without seeds, it is the same in all runs.
    different: Sequence[Seed | None] = seeds if seeds and compiled.noise else [None]
    noise = np.array([noise_of(compiled, events, times[0], seed) for seed in different])
    held = np.zeros((count, compiled.sizes["held"]))
    held[:, program.kept_places] = states[:, size:]
    drawn = dict(compiled.noise)
    for system, part in compiled.held:
        if system in drawn:
            held[:, part] = noise[:, 0, drawn[system]]
    problems = Problems(
        compiled,
        times,
        np.ascontiguousarray(states[:, :size]),
        held,
        np.ascontiguousarray(rows),
        events.times,
        events.due,
        np.ascontiguousarray(noise[:, 1:]),
    )
    problems.check()
    return problems


def _plants(
    compiled: CompiledDiagram,
    time: float,
    state: FloatArray,
    held: FloatArray,
    parameters: FloatArray,
) -> list[tuple[slice, FloatArray, Computations]]:
    """Returns the blocks with a manifold: the place of their states, their present parameters."""
    states, places = dict(compiled.states), dict(compiled.parameters)
    plants = []
    for system, block in compiled.blocks.items():
        if block.check_start is None:
            continue
        values = parameters[places.get(system, slice(0, 0))]
        if system in compiled.moved_parameters:
            moved = compiled.moved_parameters[system]
            values = moved(time, state, held, parameters).full()[:, 0]
        plants.append((states[system], values, block))
    return plants


def _project(
    compiled: CompiledDiagram,
    lock: Any,
    parameters: FloatArray,
    time: float,
    state: FloatArray,
    held: FloatArray,
) -> FloatArray:
    """Returns the projection of a state onto N*, by one thread at a time."""
    projected = state.copy()
    with lock:
        for part, values, block in _plants(compiled, time, state, held, parameters):
            if block.projection is not None:
                projected[part] = block.projection.project(state[part], values)
    return projected
