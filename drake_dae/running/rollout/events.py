"""When a diagram's discrete states change, and the random numbers that they take then."""

from typing import NamedTuple

import numpy as np
from pydrake.common import RandomGenerator
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import System

from drake_dae.arrays import FloatArray
from drake_dae.compiler.compile import CompiledDiagram

SAME = 1e-9
"""Times that differ by less than this, in periods, are one."""


class Events(NamedTuple):
    """The updates of a run.

    Attributes:
        times: When there is one, in s, increasing, shape (k,).
        due: Which rates of the diagram are due then, as bits, shape (k,).
    """

    times: FloatArray
    due: np.ndarray


def events_of(compiled: CompiledDiagram, times: FloatArray) -> Events:
    """The updates of a diagram.

    Args:
        compiled: The diagram.
        times: When rows are written, in s: an update at the time of a row makes no step of its own.
    """
    found: list[tuple[float, int]] = []
    for number, rate in enumerate(compiled.rates):
        first = int(np.ceil((times[0] - rate.offset) / rate.period - SAME))
        last = int(np.floor((times[-1] - rate.offset) / rate.period + SAME))
        moments = rate.offset + rate.period * np.arange(max(first, 0), last + 1.0)
        near = np.clip(np.searchsorted(times, moments), 1, times.size - 1)
        for candidate in (times[near - 1], times[near]):
            is_near = np.abs(candidate - moments) <= SAME * rate.period
            moments[is_near] = candidate[is_near]
        found += [(moment, 1 << number) for moment in moments.tolist()]
    found.sort()
    shortest = min((rate.period for rate in compiled.rates), default=0.0)
    merged: list[list[float | int]] = []
    for moment, bit in found:
        if merged and moment - merged[-1][0] <= SAME * shortest:
            merged[-1][1] = int(merged[-1][1]) | bit
        else:
            merged.append([moment, bit])
    return Events(
        np.array([moment for moment, _ in merged], dtype=float),
        np.array([bits for _, bits in merged], dtype=np.int64),
    )


def noise_of(
    compiled: CompiledDiagram, events: Events, start: float, seed: int | None
) -> FloatArray:
    """The random numbers at the start and from each update on, shape (k + 1, number of entries).

    They are those of Drake's RandomSource.

    Args:
        compiled: The diagram.
        events: Its updates.
        start: When the run begins, in s.
        seed: The seed; that of every run without one if None. A second source has another.
    """
    found = np.zeros((events.times.size + 1, compiled.sizes["noise"]))
    for number, (source, part) in enumerate(compiled.noise):
        (update,) = compiled.blocks[source].updates
        key = update.period, update.offset, update.is_unrestricted
        keys = [(rate.period, rate.offset, rate.is_unrestricted) for rate in compiled.rates]
        own = np.flatnonzero(events.due & (1 << keys.index(key)))
        chosen = None if seed is None else (seed + number * 2**31) % 2**32
        found[[0, *(own + 1)], part] = _drawn(source, start, events.times[own], key[0], chosen)
    return found


def _drawn(
    source: System, start: float, times: FloatArray, period: float, seed: int | None
) -> FloatArray:
    """What a source shows at the start, and after each of its updates."""
    own = source.Clone()
    context = own.CreateDefaultContext()
    context.SetTime(start)
    if seed is not None:
        own.SetRandomContext(context, RandomGenerator(seed))
    simulator, port = Simulator(own, context), own.get_output_port()
    values = [port.Eval(context).copy()]
    for moment in times:
        simulator.AdvanceTo(moment + 0.5 * period)
        values.append(port.Eval(context).copy())
    return np.array(values)
