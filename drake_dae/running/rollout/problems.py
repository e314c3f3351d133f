"""What a rollout runs, from the arguments that it was given."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from threading import Lock
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from pydrake.systems.framework import Context, Diagram

from drake_dae.arguments import checked
from drake_dae.arrays import FloatArray, brief, numbers
from drake_dae.compiler.compiled import CompiledDiagram
from drake_dae.diagrams.closed_loop import ClosedLoop
from drake_dae.errors import ModelError
from drake_dae.running.rollout.events import Events, Seed, events_of, noise_of
from drake_dae.running.rollout.program import RolloutProgram, program_of
from drake_dae.running.rollout.run import RunProblem
from drake_dae.systems.blocks.traced import Block


@checked(ModelError)
def start_values(loop: ClosedLoop | Diagram, context: Context) -> tuple[FloatArray, FloatArray]:
    """Start and parameters of a closed loop, or of any diagram, as `rollout` takes them.

    Args:
        loop: The closed loop or the diagram.
        context: Its context.

    Returns:
        The continuous states of all blocks in the order of Drake's, and then what blocks hold, such
        as a sensor that samples, shape (n,); and their numeric parameters, of a closed loop those
        of the plant, then the model's of the law and its gains, shape (m,).

    Raises:
        ModelError: Something in it cannot be traced; its name and why.
    """
    program = program_of(loop)
    state, held = program.compiled.start(context)
    values = program.compiled.values(context)
    if program.compiled.changes and np.isnan(held).any():
        # What a block shows before it has begun is no expression.
        own = context.Clone()
        own.SetAccuracy(1e-9)
        program.compiled.diagram.ExecuteInitializationEvents(own)
        held = np.where(np.isnan(held), program.compiled.start(own)[1], held)
    held = program.compiled.initialized(context.get_time(), state, held, values)
    return np.concatenate([state, held[program.kept_places]]), values


def checked_times(times: ArrayLike) -> FloatArray:
    """The times of a record.

    Raises:
        ModelError: They are not two or more finite numbers that increase.
    """
    found = numbers("times", times)
    if found.ndim != 1 or found.size < 2 or not np.isfinite(found).all():
        raise ModelError(f"times must be two or more finite numbers, shape (j,), got {times!r}")
    if not (found[1:] > found[:-1]).all():
        raise ModelError("times must be strictly increasing")
    return found


def _table(what: str, given: ArrayLike, size: int, hint: str) -> FloatArray:
    found = np.atleast_2d(numbers(what, given))
    if found.ndim != 2 or found.shape[1] != size:
        raise ModelError(
            f"{what} must have shape ({size},), or (k, {size}) for k runs, got "
            f"{np.shape(given)}: {hint}"
        )
    if not np.isfinite(found).all():
        raise ModelError(f"{what} must be finite")
    return found


@dataclass(frozen=True, eq=False)
class Problems:
    """Many runs of one diagram over the same times.

    Attributes:
        compiled: The diagram.
        times: When rows are written, in s, shape (j,).
        states, held: Where runs start, shapes (k, n) and (k, m).
        parameters: Their parameters, shape (k, p), or (1, p) for all.
        events, due: When there are updates, in s, and which rates are due, as bits.
        noise: The random numbers of each update, shape (k, len(events), q), or one for all.
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
        row = self._row(self.parameters, index)
        return RunProblem(
            self.times,
            self.states[index],
            self.held[index],
            row,
            self.events,
            self.due,
            self._row(self.noise, index),
            partial(_project, self.compiled, self._lock, row),
        )

    def with_twins(self) -> np.ndarray:
        """In which runs plants and laws that have one model have the same numbers, shape (k,)."""
        return np.broadcast_to(self.compiled.have_twins(self.parameters), len(self))

    def chosen(self, places: np.ndarray) -> "Problems":
        """Some of them."""
        if len(places) == len(self):
            return self
        parameters, noise = (
            each if len(each) == 1 else each[places] for each in (self.parameters, self.noise)
        )
        own = {"states": self.states[places], "held": self.held[places]}
        return replace(self, **own, parameters=parameters, noise=noise)

    def check(self) -> None:
        """Refuses starts off N*.

        Raises:
            InconsistentStateError: A start is not on N*.
        """
        time = float(self.times[0])
        for index in range(len(self)):
            state, held = self.states[index], self.held[index]
            row = self._row(self.parameters, index)
            for part, now, block in _plants(self.compiled, time, state, held, row):
                assert block.check_start is not None
                block.check_start(state[part], now)

    @staticmethod
    def _row(table: FloatArray, index: int) -> FloatArray:
        found: FloatArray = table[index if len(table) > 1 else 0]
        return found


def problems_of(
    program: RolloutProgram,
    starts: ArrayLike,
    parameters: ArrayLike | None,
    times: FloatArray,
    seeds: Sequence[Seed] | None,
) -> Problems:
    """The runs that `rollout` was asked for, whose arguments these are.

    Raises:
        ModelError: They have wrong shapes.
        InconsistentStateError: A start is not on N*.
    """
    compiled, size = program.compiled, program.size
    events = events_of(compiled, times)
    if not program.ends_updated:
        is_before = events.times < times[-1]
        events = Events(events.times[is_before], events.due[is_before])
    if parameters is None:
        parameters = compiled.values(compiled.context)
    hint = "see start_values"
    states = _table("starts", starts, size + program.kept_places.size, hint)
    given = _table("parameters", parameters, compiled.sizes["parameters"], hint)
    count = max(len(states), len(given), len(seeds or ()))
    if len(states) == 1:
        states = np.repeat(states, count, axis=0)
    count = len(states)
    if len(given) not in (1, count):
        raise ModelError(f"{len(given)} rows of parameters for {count} starts")
    if seeds is not None and len(seeds) != count:
        raise ModelError(f"{len(seeds)} seeds for {count} starts")
    numbers_of = [[s] if isinstance(s, int) else list(s.values()) for s in seeds or ()]
    bad = [seed for each in numbers_of for seed in each if not 0 <= seed < 2**32]
    if bad:
        raise ModelError(f"a seed is a number from 0 to 2^32 - 1, got {brief(bad[0])}")
    # Without noise, or without seeds, it is the same in all runs.
    own_seeds: Sequence[Seed | None] = seeds if seeds and compiled.noise else [None]
    noise = np.array([noise_of(compiled, events, times[0], seed) for seed in own_seeds])
    held = np.zeros((count, compiled.sizes["held"]))
    held[:, program.kept_places] = states[:, size:]
    drawn = dict(compiled.noise)
    for system, part in compiled.held:
        if system in drawn:
            held[:, part] = noise[:, 0, drawn[system]]
    found = Problems(
        compiled,
        times,
        np.ascontiguousarray(states[:, :size]),
        held,
        np.ascontiguousarray(given),
        events.times,
        events.due,
        np.ascontiguousarray(noise[:, 1:]),
    )
    found.check()
    return found


def _plants(
    compiled: CompiledDiagram, time: float, state: FloatArray, held: FloatArray, row: FloatArray
) -> list[tuple[slice, FloatArray, Block]]:
    """The blocks with a manifold: where the state of each stands, and its parameters now."""
    states, parameters = dict(compiled.states), dict(compiled.parameters)
    found = []
    for system, block in compiled.blocks.items():
        if block.check_start is None:
            continue
        now = row[parameters.get(system, slice(0, 0))]
        if system in compiled.moved_parameters:
            now = compiled.moved_parameters[system](time, state, held, row).full()[:, 0]
        found.append((states[system], now, block))
    return found


def _project(
    compiled: CompiledDiagram,
    lock: Any,
    row: FloatArray,
    time: float,
    state: FloatArray,
    held: FloatArray,
) -> FloatArray:
    """The state on N* next to one; by one thread at a time."""
    found, parts = state.copy(), dict(compiled.held)
    with lock:
        for part, now, block in _plants(compiled, time, state, held, row):
            if block.projection is not None:
                own = held[parts.get(block.system, slice(0, 0))]
                found[part] = block.projection.project(state[part], now, own)
    return found
