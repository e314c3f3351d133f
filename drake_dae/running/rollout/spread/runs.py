"""What noise does to the signals of a sampled loop, by runs with it."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from pydrake.systems.analysis import SimulatorConfig
from pydrake.systems.framework import Diagram

from drake_dae.arrays import FloatArray
from drake_dae.diagrams.closed_loop import ClosedLoop
from drake_dae.errors import ModelError
from drake_dae.running.rollout.program import program_of
from drake_dae.running.rollout.rollout import run_loop
from drake_dae.running.rollout.spread.noise import NoiseSpread

_SMALL, _PAIRS = -0.1, 2
"""The factor of a noise to which the response is linear, if it is to any; pairs of runs."""

_AT_ONCE = 8
"""So many runs are recorded at a time: each has all signals of all samples."""


@dataclass(frozen=True, eq=False)
class NoisyRuns:
    """Runs of a loop, each with other random numbers.

    Attributes:
        spread: The deviations of the signals from run to run.
        means: Name of a signal -> the mean of the runs, shape (k, entries).
    """

    spread: NoiseSpread
    means: dict[str, FloatArray]


def off_proportion(
    loop: ClosedLoop | Diagram,
    start: ArrayLike,
    parameters: ArrayLike | None,
    times: tuple[float, float],
    config: SimulatorConfig,
    name: str,
) -> tuple[FloatArray, FloatArray]:
    """How far the response of a signal to noise is from a linear one.

    With y(s) the signal of a run whose random numbers are s times as far from their means, and e(s)
    = (y(s) - y(0)) / s, a linear response has e(1) = e(-0.1). Both runs have the same random
    numbers, so that their scatter does not count.

    Args:
        loop: The loop.
        start, parameters, config: As for `rollout`, of one run.
        times: The first and the last time of the samples of interest, in s.
        name: The name of the signal.

    Returns:
        The rms of e(1) - e(-0.1) over that of e(1), of two seeds, shape (entries,); and the signal
        without noise, shape (samples, entries).

    Raises:
        ModelError: A run ends early.
    """
    seeds, scales = [0], [0.0]
    for seed in range(1, 1 + _PAIRS):
        seeds, scales = [*seeds, seed, seed], [*scales, 1.0, _SMALL]
    _, signals = _sampled(loop, start, parameters, times, config, (name,), seeds, scales)
    quiet, *noisy = signals[name]
    whole, small = (
        np.concatenate([each - quiet for each in noisy[k::2]]) / scales[1 + k] for k in (0, 1)
    )
    moved, off = np.linalg.norm(whole, axis=0), np.linalg.norm(whole - small, axis=0)
    return np.divide(off, moved, out=np.zeros_like(off), where=moved > 0.0), quiet


def noisy_runs(
    loop: ClosedLoop | Diagram,
    starts: ArrayLike,
    parameters: ArrayLike | None,
    times: tuple[float, float],
    config: SimulatorConfig,
    names: Sequence[str],
) -> NoisyRuns:
    """Runs a loop with the seeds 1, 2, ...

    Args:
        loop, times, config: As for `off_proportion`.
        starts: The starts of the runs, shape (k, n).
        parameters: Their parameters, shape (k, m), or those of all, shape (m,).
        names: The names of the signals of interest.

    Raises:
        ModelError: A run ends early.
    """
    seeds = list(range(1, 1 + len(np.atleast_2d(starts))))
    shown, signals = _sampled(loop, starts, parameters, times, config, names, seeds, 1.0)
    deviations, changes, means = (
        {name: what(values) for name, values in signals.items()}
        for what in (_deviation, lambda values: _deviation(np.diff(values, axis=1)), _mean)
    )
    return NoisyRuns(NoiseSpread(shown, deviations, changes), means)


def _deviation(values: FloatArray) -> FloatArray:
    deviation: FloatArray = np.std(values, axis=0, ddof=1)
    return deviation


def _mean(values: FloatArray) -> FloatArray:
    mean: FloatArray = np.mean(values, axis=0)
    return mean


def _sampled(
    loop: ClosedLoop | Diagram,
    start: ArrayLike,
    parameters: ArrayLike | None,
    times: tuple[float, float],
    config: SimulatorConfig,
    names: Sequence[str],
    seeds: Sequence[int],
    scales: ArrayLike,
) -> tuple[FloatArray, dict[str, FloatArray]]:
    """The times of the samples of interest; name -> values, shape (runs, samples, entries)."""
    begun, period = config.start_time, max(r.period for r in program_of(loop).compiled.rates)
    first, last = (max(round((time - begun) / period), 1) for time in times)
    shown = begun + period * np.arange(first, last + 1)
    rows = np.append(begun, shown)
    lasting, factors = len(seeds) * float(np.ptp(rows)), np.broadcast_to(scales, len(seeds))
    found: dict[str, list[FloatArray]] = {name: [] for name in names}
    for begin in range(0, len(seeds), _AT_ONCE):
        part = slice(begin, begin + _AT_ONCE)
        runs = run_loop(
            loop,
            start if np.ndim(start) < 2 else np.asarray(start)[part],
            parameters
            if parameters is None or np.ndim(parameters) < 2
            else np.asarray(parameters)[part],
            rows,
            config=config,
            seeds=seeds[part],
            scales=factors[part],
            lasting=lasting,
        )
        for seed, run in zip(seeds[part], runs, strict=True):
            if run.failure is not None:
                text = f"a run with noise, with the seed {seed}, ended early: {run.failure}"
                raise ModelError(text)
            for name in names:
                found[name].append(run.record[name][1:].copy())
    return shown, {name: np.array(values) for name, values in found.items()}
