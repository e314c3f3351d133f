"""The period of a reference, read off its values."""

import numpy as np

from drake_dae.arrays import Booleans, FloatArray
from drake_dae.dae.zero_dynamics.pursuit import Reference

SAMPLES = 2000
"""The number of times at which a reference is sampled."""

REPEATED = 1e-6
"""A reference has a period if it repeats itself to this, relative to its range."""

STILL = 1e-9
"""An entry that changes by less than this, relative to its size, is constant."""


def find_period(reference: Reference, begin: float, end: float) -> float | None:
    """The smallest period of a reference that repeats itself in an interval at least once.

    Args:
        reference: The function t -> R(t); it is asked inside the interval alone.
        begin, end: The interval in s.

    Returns:
        The period in s; 0 if the reference is constant, None if it has no period. One of less
        than a few thousandths of the interval may be missed.
    """
    times = np.linspace(begin, end, SAMPLES + 1)
    values = np.array([reference(float(time)) for time in times]).reshape(times.size, -1)
    width = np.ptp(values, axis=0)
    moving = width > STILL * np.max(np.abs(values), axis=0)
    if not np.any(moving):
        return 0.0
    scaled = values[:, moving] / width[moving]
    half = SAMPLES // 2
    off = np.array(
        [np.max(np.abs(scaled[lag : lag + half] - scaled[:half])) for lag in range(half + 1)]
    )
    # How much it changes from sample to sample is how near a lag between samples may come.
    near = 2.0 * off[1] + REPEATED
    is_least = np.r_[False, (off[1:-1] <= off[:-2]) & (off[1:-1] <= off[2:]), True]
    step = (end - begin) / SAMPLES
    for lag in np.flatnonzero(is_least & (off < near)):
        period = _refined(reference, moving, width, times, float(lag * step), step)
        if period is not None:
            return period
    return None


def _refined(
    reference: Reference,
    moving: Booleans,
    width: FloatArray,
    times: FloatArray,
    period: float,
    step: float,
) -> float | None:
    """A period near a guess, by Gauss's and Newton's method; None if there is none."""
    begin, end = times[0], times[-1]
    # Not at round parts of the period, where references have their breaks.
    shares = (np.arange(1, 41) * 0.6180339887) % 1.0
    tried = begin + shares * (end - begin - min(period + step, 0.5 * (end - begin)))

    def off(wanted: float) -> FloatArray:
        pairs = [(reference(float(t + wanted)), reference(float(t))) for t in tried]
        differences = np.array([np.ravel(a) - np.ravel(b) for a, b in pairs])
        return (differences[:, moving] / width[moving]).reshape(-1)

    for _ in range(8):
        h = 1e-4 * step
        inside = min(period, 0.5 * (end - begin) - h)
        slope = (off(inside + h) - off(inside - h)) / (2.0 * h)
        change = -float(slope @ off(inside)) / max(float(slope @ slope), 1e-300)
        period = inside + float(np.clip(change, -step, step))
        if abs(change) < 1e-12 * period:
            break
    period = min(period, 0.5 * (end - begin))
    if period < 0.5 * step:
        return None
    return period if np.max(np.abs(off(period))) < REPEATED else None
