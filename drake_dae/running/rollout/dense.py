"""What lies between the ends of steps of DOP853: the stages it lacks, of many steps at once."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.integrate import DOP853

from drake_dae.arrays import FloatArray
from drake_dae.running.rollout.many import Many


class Span(NamedTuple):
    """A step, and the times within it at which the state is wanted.

    Attributes:
        time, size: When it begins, and how long it is, in s.
        state, reached: The states at its ends, shape (n,).
        rates: The derivatives at its stages and at its end, shape (13, n).
        held: What is held.
        times: The times in s, shape (k,).
        found: Where the states are written, shape (k, n).
    """

    time: float
    size: float
    state: FloatArray
    reached: FloatArray
    rates: FloatArray
    held: FloatArray
    times: FloatArray
    found: FloatArray


def fill(spans: Sequence[Span], rate: Many, parameters: FloatArray) -> None:
    """Writes the states within steps, by the interpolant of seventh order as SciPy has it.

    Args:
        spans: The steps.
        rate: The derivative of the state, as a function of what all functions take.
        parameters: The parameters.
    """
    if not spans:
        return
    time, size = (np.array(each)[:, None] for each in list(zip(*spans, strict=True))[:2])
    state = np.array([span.state for span in spans])
    held = np.array([span.held for span in spans])
    rates = np.zeros((16, *state.shape))
    rates[:13] = np.stack([span.rates for span in spans], axis=1)
    tables = zip(DOP853.A_EXTRA, DOP853.C_EXTRA, strict=True)
    for number, (row, part) in enumerate(tables, start=13):
        stage = state + size * np.tensordot(row[:number], rates[:number], 1)
        rates[number] = rate(time + part * size, stage, held, parameters)[0]
    change = np.array([span.reached for span in spans]) - state
    parts = [
        change,
        size * rates[0] - change,
        2.0 * change - size * (rates[12] + rates[0]),
        *(size * np.tensordot(DOP853.D, rates, 1)),
    ]
    counts = [span.times.size for span in spans]
    own = np.repeat(np.arange(len(spans)), counts)
    share = (np.concatenate([span.times for span in spans])[:, None] - time[own]) / size[own]
    values = np.zeros((own.size, state.shape[1]))
    for j in reversed(range(len(parts))):
        values = (values + parts[j][own]) * (1.0 - share if j % 2 else share)
    found = np.split(values + state[own], np.cumsum(counts)[:-1])
    for span, states in zip(spans, found, strict=True):
        span.found[...] = states
