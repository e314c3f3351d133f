"""A diagram stepped without a compiler, in the order of stepper.c."""

from bisect import bisect_left
from itertools import pairwise
from math import ceil, isfinite, sqrt

import numpy as np
from scipy.integrate import DOP853

from drake_dae.arrays import FloatArray
from drake_dae.running.rollout.run import LOOKED, Run, RunEnding, RunProblem, Settings, Tableau
from drake_dae.running.rollout.stepping.course import (
    DOP,
    Dop853Step,
    RunEnded,
    RunStepper,
)
from drake_dae.running.rollout.stepping.functions import DiagramFunctions

SHORTEST = 1e-12
"""The run ends where a step becomes shorter than this, relative to the time."""

MOST_FAILURES = 100
"""The number of trials of one step that may fail for another reason than their error."""


def run(functions: DiagramFunctions, settings: Settings, problem: RunProblem) -> Run:
    """Runs a diagram until its end, or to where it cannot go on."""
    course = RunStepper(functions, problem, settings.tableau or DOP)
    try:
        if settings.tableau is None:
            _run_controlled(course, settings)
        else:
            _run_fixed(course, settings, settings.tableau)
    except RunEnded as ended:
        return course.finish(ended.ending)
    return course.finish(RunEnding.DONE)


def _run_controlled(course: RunStepper, settings: Settings) -> None:
    """Error control by DOP853; rows between steps from its interpolant, on N*."""
    times, row, tried = course.problem.times, 1, 0.0
    moments = times.tolist()
    rate: FloatArray | None = None
    course.write()
    while course.time < moments[-1]:
        if settings.look(course.so_far):
            raise RunEnded(RunEnding.PAUSED)
        if course.update(is_on=rate is not None):
            rate = None
        if rate is None:
            rate = course.accepted_rate()
        tried = tried or _first_step(course, rate, settings)
        step = _controlled_step(course, settings, rate, min(tried, settings.longest))
        stop = min(bisect_left(moments, step.end, row), times.size - 1)
        if row < stop:
            course.write_between(step, times[row:stop])
        row = stop
        course.accept(step.end, step.reached)
        rate = step.rates[-1] if step.is_on else None
        if row < times.size - 1 and moments[row] == course.time:
            if not step.is_on:
                course.state = course.projected(course.time, course.state)
            course.write()
            row += 1
        # A step that only ended early, at a sample, says nothing against longer ones.
        shortened = step.size < tried and not step.rejected
        tried = max(step.following, tried if shortened else 0.0)
    course.update(is_on=rate is not None)
    course.write()


def _controlled_step(
    course: RunStepper, settings: Settings, first: FloatArray, size: float
) -> Dop853Step:
    """Returns an accepted step, at most to the next event.

    Args:
        course: The run.
        settings: How to step.
        first: The derivative at its state.
        size: The step to try, in s.
    """
    failures, rejected, limit = 0, False, course.boundary()
    while True:
        end = course.time + size
        if end >= limit - SHORTEST * abs(limit):
            end = limit
        size = end - course.time
        if not size > SHORTEST * abs(course.time) or failures > MOST_FAILURES:
            raise RunEnded(RunEnding.STUCK)
        rates = course.stages(size, first)
        reached = course.state + size * (DOP.b @ rates)
        larger = np.maximum(np.abs(course.state), np.abs(reached))
        unit = settings.absolute + larger * settings.relative
        fifth, third = (
            float(np.sum(np.square((e[:-1] @ rates) / unit))) for e in (DOP853.E5, DOP853.E3)
        )
        error = size * fifth / sqrt((fifth + 0.01 * third) * first.size) if fifth else 0.0
        factor = 10.0 if error == 0.0 else min(10.0, max(0.2, 0.9 * error**-0.125))
        is_good = isfinite(error)
        if error < 1.0:
            reached, is_on = course.nearly_projected(end, reached)
            last = course.rate(end, reached)
            is_good = not np.isnan(last[0])
            if is_good:
                following = size * (min(1.0, factor) if rejected else factor)
                rates = np.vstack([rates, last])
                return Dop853Step(end, size, reached, rates, is_on, following, rejected)
        failures += not is_good
        size *= factor if is_good else 0.2
        rejected = True


def _first_step(course: RunStepper, rate: FloatArray, settings: Settings) -> float:
    """Returns a first step, as SciPy finds it (Hairer, Norsett and Wanner, section II.4)."""
    state, longest = course.state, settings.longest
    unit = settings.absolute + np.abs(state) * settings.relative

    def weighted(vector: FloatArray) -> float:
        return float(np.sqrt(np.mean(np.square(vector / unit))))

    d0, d1 = weighted(state), weighted(rate)
    h0 = min(1e-6 if d0 < 1e-5 or d1 < 1e-5 else 0.01 * d0 / d1, longest)
    other = course.rate(course.time + h0, state + h0 * rate)
    if np.isnan(other[0]):
        return h0
    d2 = weighted(other - rate) / h0
    still = d1 <= 1e-15 and d2 <= 1e-15
    h1 = max(1e-6, h0 * 1e-3) if still else (0.01 / max(d1, d2)) ** 0.125
    return min(100.0 * h0, h1, longest)


def fixed_steps(problem: RunProblem, longest: float) -> list[tuple[float, float, bool]]:
    """Returns the fixed steps of a run: begin and end in s, and whether a row is at the end.

    Their number divides the time between two rows or events.
    """
    times = problem.times
    inside = problem.events[(problem.events > times[0]) & (problem.events < times[-1])]
    ends = np.union1d(times, inside)
    is_row = np.isin(ends, times).tolist()
    steps: list[tuple[float, float, bool]] = []
    for index, (first, last) in enumerate(pairwise(ends.tolist()), start=1):
        count = max(1, ceil((last - first) / longest - 0.01))
        inner = [first + (last - first) * (i / count) for i in range(count)]
        steps += [(*step, False) for step in pairwise(inner)]
        steps.append((inner[-1], last, is_row[index]))
    return steps


def _run_fixed(course: RunStepper, settings: Settings, tableau: Tableau) -> None:
    times = course.problem.times
    course.write()
    for start, end, is_row in fixed_steps(course.problem, settings.longest):
        if course.steps % LOOKED == 0 and settings.look(course.so_far):
            raise RunEnded(RunEnding.PAUSED)
        course.update()
        rates = course.stages(end - start, course.accepted_rate())
        state = course.state + (end - start) * (tableau.b @ rates)
        course.next = end
        if not np.isfinite(state).all():
            raise RunEnded(RunEnding.SPOILT)
        course.accept(end, state)
        if is_row and end < times[-1]:
            course.write()
    course.update()  # The last row comes after the updates of its time.
    course.write()
