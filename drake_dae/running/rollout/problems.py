"""What a rollout runs, from the arguments that it was given."""

from collections.abc import Callable, Sequence
from functools import partial
from threading import Lock

import numpy as np
from numpy.typing import ArrayLike
from pydrake.systems.framework import Context

from drake_dae.arguments import checked
from drake_dae.arrays import FloatArray, brief, numbers
from drake_dae.diagrams.closed_loop import ClosedLoop
from drake_dae.errors import ModelError
from drake_dae.running.rollout.functions import LoopFunctions
from drake_dae.running.rollout.run import Problem
from drake_dae.running.rollout.samples import Samples
from drake_dae.systems.plants.dae_plant import DaePlant


@checked(ModelError)
def start_values(loop: ClosedLoop, context: Context) -> tuple[FloatArray, FloatArray]:
    """Start and parameters of a closed loop as `rollout` takes them.

    Args:
        loop: The closed loop.
        context: Its context.

    Returns:
        The state x, then of a force sensor its state, if it has a lag, the integrals of the law,
        and what the sensor holds, if it samples, shape (n,); and the parameters of the plant, then
        the model's of the law and its gains, shape (m,).
    """
    plant, sensor = loop.plant, loop.sensor
    own, law = (block.GetMyContextFromRoot(context) for block in (plant, loop.controller))
    felt = sensor.GetMyContextFromRoot(context) if sensor is not None else None
    parts = [plant.state(own)]
    for each in (felt, law):
        if each is not None:
            parts.append(each.get_continuous_state_vector().CopyToVector())
    if felt is not None and felt.num_discrete_state_groups():
        parts.append(felt.get_discrete_state(0).value())
    values = [block.get_numeric_parameter(0).value() for block in (own, law)]
    return np.concatenate(parts), np.concatenate(values)


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
    functions: LoopFunctions,
    starts: ArrayLike,
    parameters: ArrayLike | None,
    times: FloatArray,
    seeds: Sequence[int] | None,
) -> list[Problem]:
    """The runs that `rollout` was asked for, whose arguments these are.

    Raises:
        ModelError: They have wrong shapes.
        InconsistentStateError: A start is not on N*.
    """
    loop = functions.loop
    samples = Samples.of(loop, times)
    size, split = functions.size, functions.plant.sizes[-1]
    if parameters is None:
        parameters = start_values(loop, loop.diagram.CreateDefaultContext())[1]
    hint = "see start_values"
    states = _table("starts", starts, size + samples.holds * samples.size, hint)
    given = _table("parameters", parameters, split + functions.law.sizes[-1], hint)
    count = len(states)
    if len(given) not in (1, count):
        raise ModelError(f"{len(given)} rows of parameters for {count} starts")
    if seeds is not None and len(seeds) != count:
        raise ModelError(f"{len(seeds)} seeds for {count} starts")
    bad = [seed for seed in seeds or () if not 0 <= seed < 2**32]
    if bad:
        raise ModelError(f"a seed is a number from 0 to 2^32 - 1, got {brief(bad[0])}")
    problems, lock = [], Lock()
    for index, start in enumerate(states):
        row = given[min(index, len(given) - 1)]
        plant, law = row[:split].copy(), row[split:].copy()
        current = functions.plant_parameters(plant)
        loop.plant.check_start(start[: loop.plant.dae.num_states], current(times[0]))
        noise = samples.noise(None if seeds is None else seeds[index])
        hold = start[size:].copy() if samples.holds else noise[0].copy()
        project = partial(_project, loop.plant, current, lock)
        problems.append(
            Problem(times, start[:size], hold, plant, law, samples.events, noise[1:], project)
        )
    return problems


def _project(
    plant: DaePlant,
    parameters: Callable[[float], FloatArray],
    lock: Lock,
    time: float,
    state: FloatArray,
) -> FloatArray:
    """The state on N* next to one, that of a sensor left out; by one thread at a time."""
    with lock:
        return plant.structure.manifold.project(state[: plant.dae.num_states], parameters(time))
