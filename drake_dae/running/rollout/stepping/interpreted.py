"""A closed loop stepped without a compiler: a step, or many, are one call of CasADi."""

from bisect import bisect_left
from collections.abc import Callable, Iterator
from math import isfinite, sqrt

import numpy as np

from drake_dae.arrays import FloatArray
from drake_dae.running.rollout.run import Run, RunEnding, RunProblem, Settings, Tableau
from drake_dae.running.rollout.stepping.course import (
    REACHED,
    Dop853Step,
    RecordRows,
    RunEnded,
    RunStepper,
)
from drake_dae.running.rollout.stepping.fused import CHUNK, DiagramFunctions

SHORTEST = 1e-12
"""A step that is shorter than this, relative to the time, is none."""

MOST_FAILURES = 100
"""So many trials of a step may fail for another reason than its error."""


def runner(fused: DiagramFunctions, settings: Settings) -> Callable[[RunProblem], Run]:
    """What runs a closed loop.

    Args:
        fused: The closed loop.
        settings: How to step.
    """
    steps = None
    if settings.tableau is not None:
        steps = _FixedSteps(fused, settings.tableau, settings)

    def run(problem: RunProblem) -> Run:
        start = float(problem.times[0])
        course = RunStepper(
            fused, problem, start, problem.state, problem.held, before=start, mark=start
        )
        try:
            if steps is None:
                _control(course, settings)
            else:
                steps.run(course)
        except RunEnded as ended:
            return course.finish(ended.ending)
        return course.finish(RunEnding.DONE)

    return run


def _control(course: RunStepper, settings: Settings) -> None:
    """Error control by DOP853 as in stepper.c; rows between steps from its interpolant, on N*."""
    times, row, tried = course.problem.times, 1, 0.0
    moments = times.tolist()
    rate: FloatArray | None = None
    course.write(course.time, course.state)
    while course.time < moments[-1]:
        if settings.look(course.so_far, course.problem.context):
            raise RunEnded(RunEnding.PAUSED)
        if course.update(is_on=rate is not None):
            rate = None
        if rate is None:
            rate = course.accepted_rate()
        course.look()
        limit = course.boundary()
        tried = tried or _first_step(course, rate, settings)
        step = _controlled(course, settings, rate, min(tried, settings.longest), limit)
        course.check(step.end, step.reached)
        stop = min(bisect_left(moments, step.end, row), times.size - 1)
        if row < stop:
            course.write_between(step, times[row:stop])
        row = stop
        course.accept(step.end, step.reached)
        rate = step.rate if step.is_on else None
        if row < times.size - 1 and moments[row] == course.time:
            if not step.is_on:
                course.state = course.projected(course.time, course.state)
            course.write(course.time, course.state)
            row += 1
        # A step that only ended early, at a sample, says nothing against longer ones.
        shortened = step.size < tried and not step.rejected
        tried = max(step.following, tried if shortened else 0.0)
    course.update(is_on=rate is not None)
    course.write(course.time, course.state)


def _controlled(
    course: RunStepper, settings: Settings, rate: FloatArray, size: float, limit: float
) -> Dop853Step:
    """An accepted step from where a course is, at most to a limit in s."""
    problem, failures, rejected = course.problem, 0, False
    while True:
        end = course.time + size
        if end >= limit - SHORTEST * abs(limit):
            end = limit
        size = end - course.time
        if not size > SHORTEST * abs(course.time) or failures > MOST_FAILURES:
            raise RunEnded(RunEnding.STUCK)
        reached, last, checks, stages = course.fused.controlled(
            course.time,
            course.state,
            course.held,
            problem.parameters,
            rate,
            size,
            settings.absolute,
            settings.relative,
        )
        fifth, third, finite, left, valid = checks.tolist()
        is_on, good = left <= REACHED, isfinite(finite)
        error = size * fifth / sqrt((fifth + 0.01 * third) * rate.size) if fifth else 0.0
        factor = 10.0 if error == 0.0 else min(10.0, max(0.2, 0.9 * error**-0.125))
        if not good:
            course.note_stages(rate, size)
        elif error < 1.0 and is_on and not isfinite(valid):
            course.rate(end, reached)
            good = False
        elif error < 1.0:
            following = size * (min(1.0, factor) if rejected else factor)
            values = reached.copy(), last.copy(), stages
            return Dop853Step(end, size, *values, is_on, following, rejected)
        failures += not good
        size *= factor if good else 0.2
        rejected = True


def _first_step(course: RunStepper, rate: FloatArray, settings: Settings) -> float:
    """A first step, as SciPy finds it (Hairer, Norsett and Wanner, section II.4)."""
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


def fixed_steps(problem: RunProblem, longest: float) -> Iterator[FloatArray]:
    """Times of steps between samples: where each begins, where it ends, and what is a row."""
    times = problem.times
    inside = problem.events[(problem.events > times[0]) & (problem.events < times[-1])]
    ends = np.union1d(times, inside)
    lengths = np.diff(ends)
    numbers = np.maximum(1, np.ceil(lengths / longest - 0.01)).astype(int)
    # The last steps of all intervals, then the place of each step in its own one.
    last = np.cumsum(numbers)
    own = np.repeat(np.arange(len(numbers)), numbers)
    place = np.arange(last[-1]) - (last - numbers)[own]
    shares = np.array([place, place + 1]) / numbers[own]
    first, after = ends[own] + lengths[own] * shares
    after[last - 1] = ends[1:]
    is_row = np.zeros(last[-1])
    is_row[last - 1] = np.isin(ends[1:], times)
    block = np.column_stack([first, after, is_row])
    yield from np.split(block, last[np.flatnonzero(np.isin(ends[1:-1], inside))])


class _FixedSteps:
    """Fixed steps, many in one call of CasADi."""

    def __init__(self, fused: DiagramFunctions, tableau: Tableau, settings: Settings) -> None:
        self._tableau, self._longest, self._look = tableau, settings.longest, settings.look
        self._one, self._many = fused.steps(tableau)

    def run(self, course: RunStepper) -> None:
        """Runs to the end of the record."""
        times = course.problem.times
        course.write(course.time, course.state)
        for block in fixed_steps(course.problem, self._longest):
            course.update()
            done = 0
            while done < len(block):
                if self._look(course.so_far, course.problem.context):
                    raise RunEnded(RunEnding.PAUSED)
                done += self._advance(course, block[done : done + CHUNK])
        course.rows[-1] = course.rows[-1].without_last()
        course.update()
        course.write(times[-1], course.state)

    def _advance(self, course: RunStepper, block: FloatArray) -> int:
        """Takes some steps, and says how many."""
        problem = course.problem
        step, is_guarded = self._many, bool(course.fused.program.compiled.guards)
        if len(block) < CHUNK or is_guarded:
            step, block = self._one, block[:1]
        if is_guarded:
            course.state = course.projected(course.time, course.state)
            course.look()
        starts, ends, is_row = block.T
        given = (starts[:, None], (ends - starts)[:, None], course.held, problem.parameters)
        states, checks = (
            values.copy().reshape(len(block), -1) for values in step(course.state, *given)
        )
        # The first number is not finite where a step has no value, the second is a Newton step.
        good = np.isfinite(checks[:, 0]) & (checks[:, 1] <= REACHED)
        count = int(np.argmin(np.append(good, False)))
        for end, state in zip(ends[:count].tolist(), states, strict=False):
            course.check(end, state)
            course.accept(end, state)
        chosen = np.flatnonzero(is_row[:count])
        course.rows.append(RecordRows(ends[chosen], states[chosen], course.held, False))
        if count == len(block):
            return count
        self._advance_slowly(course, *block[count])
        return count + 1

    def _advance_slowly(self, course: RunStepper, start: float, end: float, is_row: float) -> None:
        """A step where two Newton steps do not reach N*, or where something has no value."""
        course.state = course.projected(start, course.state)
        a, b, c = self._tableau
        step, rates = end - start, [course.accepted_rate()]
        for row, part in zip(a[1:], c[1:], strict=True):
            change = sum(weight * rate for weight, rate in zip(row, rates, strict=False))
            rates.append(course.rate(start + part * step, course.state + step * change))
        state = course.state + step * (b @ np.array(rates))
        course.next = end
        if not np.isfinite(state).all():
            raise RunEnded(RunEnding.SPOILT)
        course.check(end, state)
        course.accept(end, state)
        if is_row:
            course.write(end, state)
