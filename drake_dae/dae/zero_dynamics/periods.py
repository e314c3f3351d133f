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
    """Returns the smallest period of a reference that repeats itself in an interval.

    Args:
        reference: The function t -> R(t); it is evaluated only inside the interval.
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
    # The period may be between two lags: then the difference is as large as that of neighbours.
    near = 2.0 * off[1] + REPEATED
    is_least = np.r_[False, (off[1:-1] <= off[:-2]) & (off[1:-1] <= off[2:]), True]
    for lag in np.flatnonzero(is_least & (off < near)):
        guess = float(lag * ((end - begin) / SAMPLES))
        period = _refined(reference, moving, width, begin, end, guess)
        if period is not None:
            return period
    return None


def _refined(
    reference: Reference,
    moving: Booleans,
    width: FloatArray,
    begin: float,
    end: float,
    period: float,
) -> float | None:
    """Refines a period by the Gauss-Newton method; None if there is none."""
    step = (end - begin) / SAMPLES
    # Not at round parts of the period, where references have their breaks.
    shares = (np.arange(1, 41) * 0.6180339887) % 1.0
    times = begin + shares * (end - begin - min(period + step, 0.5 * (end - begin)))

    def off(shift: float) -> FloatArray:
        pairs = [(reference(float(t + shift)), reference(float(t))) for t in times]
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
