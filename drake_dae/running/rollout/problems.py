"""What a rollout runs, from the arguments that it was given."""

from collections.abc import Sequence
from functools import partial
from threading import Lock

import numpy as np
from numpy.typing import ArrayLike
from pydrake.systems.framework import Context, Diagram

from drake_dae.arguments import checked
from drake_dae.arrays import FloatArray, brief, numbers
from drake_dae.compiler.compiled import CompiledDiagram
from drake_dae.diagrams.closed_loop import ClosedLoop
from drake_dae.errors import ModelError
from drake_dae.running.rollout.events import Events, Seed, events_of, noise_of
from drake_dae.running.rollout.program import Program, program_of
from drake_dae.running.rollout.run import Problem
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
    held = program.compiled.begun(context.get_time(), state, held, values)
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


def problems_of(
    program: Program,
    starts: ArrayLike,
    parameters: ArrayLike | None,
    times: FloatArray,
    seeds: Sequence[Seed] | None,
) -> list[Problem]:
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
    count = len(states)
    if len(given) not in (1, count):
        raise ModelError(f"{len(given)} rows of parameters for {count} starts")
    if seeds is not None and len(seeds) != count:
        raise ModelError(f"{len(seeds)} seeds for {count} starts")
    numbers_of = [[s] if isinstance(s, int) else list(s.values()) for s in seeds or ()]
    bad = [seed for each in numbers_of for seed in each if not 0 <= seed < 2**32]
    if bad:
        raise ModelError(f"a seed is a number from 0 to 2^32 - 1, got {brief(bad[0])}")
    problems, lock = [], Lock()
    for index, start in enumerate(states):
        row = given[min(index, len(given) - 1)].copy()
        noise = noise_of(compiled, events, times[0], None if seeds is None else seeds[index])
        held = np.zeros(compiled.sizes["held"])
        held[program.kept_places] = start[size:]
        drawn = dict(compiled.noise)
        for system, part in compiled.held:
            if system in drawn:
                held[part] = noise[0, drawn[system]]
        for part, now, block in _plants(compiled, times[0], start[:size], held, row):
            if block.check_start is not None:
                block.check_start(start[part], now)
        project = partial(_project, compiled, lock, row)
        problems.append(Problem(times, start[:size], held, row, *events, noise[1:], project))
    return problems


def _plants(
    compiled: CompiledDiagram, time: float, state: FloatArray, held: FloatArray, row: FloatArray
) -> list[tuple[slice, FloatArray, Block]]:
    """The blocks with a manifold: where the state of each stands, and its parameters now."""
    states, parameters = dict(compiled.states), dict(compiled.parameters)
    found = []
    for system, block in compiled.blocks.items():
        if block.check_start is None:
            continue
        now = row[parameters[system]]
        if system in compiled.moved_parameters:
            now = compiled.moved_parameters[system](time, state, held, row).full()[:, 0]
        found.append((states[system], now, block))
    return found


def _project(
    compiled: CompiledDiagram,
    lock: Lock,
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
