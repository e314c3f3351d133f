"""The times at which discrete states of a diagram change, and their random numbers."""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from pydrake.common import RandomDistribution, RandomGenerator
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import System
from pydrake.systems.primitives import RandomSource

from drake_dae.arrays import FloatArray
from drake_dae.compiler.compiled import CompiledDiagram

Seed = int | Mapping[str, int]
"""The seed of the noise of a run: one number, or name of a RandomSource -> number."""

SAME = 1e-9
"""Times that differ by less than this, in periods, are equal."""


class Events(NamedTuple):
    """The updates of a run.

    Attributes:
        times: Their times in s, increasing, shape (k,).
        due: The rates of the diagram that are due at each time, as bits, shape (k,).
    """

    times: FloatArray
    due: np.ndarray


def events_of(compiled: CompiledDiagram, times: FloatArray) -> Events:
    """Returns the updates of a diagram.

    Args:
        compiled: The diagram.
        times: The times of the rows in s; an update close to one of them is moved to it.
    """
    due: dict[float, int] = {}
    if not compiled.rates:
        return Events(np.empty(0), np.empty(0, dtype=np.int64))
    for number, rate in enumerate(compiled.rates):
        first = int(np.ceil((times[0] - rate.offset) / rate.period - SAME))
        last = int(np.floor((times[-1] - rate.offset) / rate.period + SAME))
        for k in range(max(first, 0), last + 1):
            moment = rate.offset + k * rate.period
            due[moment] = due.get(moment, 0) | 1 << number
    # As in Drake, two updates are of one instant if their times are the same to the last bit; those
    # of times that differ by round-off follow each other.
    moments = np.array(sorted(due), dtype=float)
    bits = np.array([due[moment] for moment in moments.tolist()], dtype=np.int64)
    shortest = min(rate.period for rate in compiled.rates)
    near = np.clip(np.searchsorted(times, moments), 1, times.size - 1)
    for candidate in (times[near - 1], times[near]):
        is_near = np.abs(candidate - moments) <= SAME * shortest
        moments[is_near] = candidate[is_near]
    return Events(moments, bits)


def noise_of(
    compiled: CompiledDiagram, events: Events, start: float, seed: Seed | None
) -> FloatArray:
    """Returns the random numbers of Drake's RandomSources, shape (k + 1, number of entries).

    The first row is that of the start, then there is one for each update.

    Args:
        compiled: The diagram.
        events: Its updates.
        start: The start of the run, in s.
        seed: The seed; for None, and for sources without a seed, the noise is the same in all runs.
            From one number, each source derives a seed of its own.
    """
    noise = np.zeros((events.times.size + 1, compiled.sizes["noise"]))
    for number, (source, part) in enumerate(compiled.noise):
        (update,) = compiled.blocks[source].updates
        key = update.period, update.offset, update.is_unrestricted
        keys = [(rate.period, rate.offset, rate.is_unrestricted) for rate in compiled.rates]
        rows = np.flatnonzero(events.due & (1 << keys.index(key)))
        chosen = (seed + number * 2**31) % 2**32 if isinstance(seed, int) else None
        if isinstance(seed, Mapping):
            chosen = seed.get(source.get_name())
        noise[[0, *(rows + 1)], part] = _drawn(source, start, events.times[rows], key[0], chosen)
    return noise


def _drawn(
    source: System, start: float, times: FloatArray, period: float, seed: int | None
) -> FloatArray:
    """Returns the output of a source at the start, and after each of its updates."""
    context = source.CreateDefaultContext()
    context.SetTime(start)
    if seed is not None:
        source.SetRandomContext(context, RandomGenerator(seed))
    simulator, port = Simulator(source, context), source.get_output_port()
    values = [port.Eval(context).copy()]
    if seed is not None:
        # A source with more outputs draws all numbers at once. Drake does not return the
        # distribution of a source, so that its first numbers decide.
        for distribution in RandomDistribution.__members__.values():
            if (_first(distribution, values[0].size, seed) == values[0]).all():
                numbers = _first(distribution, values[0].size * (times.size + 1), seed)
                return numbers.reshape(times.size + 1, -1)
    for moment in times:
        simulator.AdvanceTo(moment + 0.5 * period)
        values.append(port.Eval(context).copy())
    return np.array(values)


def _first(distribution: RandomDistribution, size: int, seed: int) -> FloatArray:
    """Returns the numbers with which a source of this size starts."""
    source = RandomSource(distribution, size, 1.0)
    context = source.AllocateContext()
    source.SetRandomContext(context, RandomGenerator(seed))
    return source.get_output_port().Eval(context)
