"""The updates of a rollout, and the random numbers that they read."""

from collections.abc import Mapping, Sequence

import numpy as np
from pydrake.common import RandomDistribution, RandomGenerator
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Context, EventStatus
from pydrake.systems.primitives import RandomSource

from drake_dae.arrays import FloatArray

# The seed of the noise of a run: one number, or name of a RandomSource -> number.
Seed = int | Mapping[str, int]
SAME = 1e-9  # Times that differ by less than this, in periods, are equal.


def events_within(
    rates: Sequence[tuple[float, float]], times: FloatArray, with_end: bool = True
) -> tuple[FloatArray, np.ndarray]:
    """The times of updates in s, and which rates are due at each, as bits; shapes (k,).

    As in Drake, two updates are of one instant if their times offset + k period are the same to the
    last bit; those of times that differ by round-off follow each other. An update close to the time
    of a row is moved to it.
    """
    due: dict[float, int] = {}
    for number, (period, offset) in enumerate(rates):
        first = int(np.ceil((times[0] - offset) / period - SAME))
        last = int(np.floor((times[-1] - offset) / period + SAME))
        for k in range(max(first, 0), last + 1):
            moment = offset + k * period
            due[moment] = due.get(moment, 0) | 1 << number
    moments = np.array(sorted(due), dtype=float)
    bits = np.array([due[moment] for moment in moments.tolist()], dtype=np.int64)
    if moments.size:
        shortest = min(period for period, _ in rates)
        near = np.clip(np.searchsorted(times, moments), 1, times.size - 1)
        for candidate in (times[near - 1], times[near]):
            is_near = np.abs(candidate - moments) <= SAME * shortest
            moments[is_near] = candidate[is_near]
    if not with_end:
        is_before = moments < times[-1]
        moments, bits = moments[is_before], bits[is_before]
    return moments, bits


def source_period(source: RandomSource) -> float:
    """The time between two draws in s, which is the time of the first event after t = 0."""
    simulator, times = Simulator(source), list[float]()

    def stop(context: Context) -> EventStatus:
        times.append(context.get_time())
        if len(times) < 3:
            return EventStatus.DidNothing()
        return EventStatus.ReachedTermination(source, "seen")

    simulator.set_monitor(stop)
    simulator.AdvanceTo(1e9)
    return next(time for time in times if time > 0.0)


def drawn_noise(
    source: RandomSource, start: float, times: FloatArray, period: float, seed: int | None
) -> FloatArray:
    """The output of Drake's source at the start and after each of its updates; shape (k + 1, q)."""
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
    """The numbers with which a source of this size starts."""
    source = RandomSource(distribution, size, 1.0)
    context = source.AllocateContext()
    source.SetRandomContext(context, RandomGenerator(seed))
    return source.get_output_port().Eval(context)
