"""A closed loop stepped without a compiler: a step, or many, are one call of CasADi."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from math import isfinite, sqrt
from typing import NamedTuple, Self

import numpy as np
from scipy.integrate import DOP853

from drake_dae.arrays import FloatArray
from drake_dae.diagrams.rollout.fused import CHUNK, Fused
from drake_dae.diagrams.rollout.run import Ending, Problem, Run, Settings, Tableau
from drake_dae.errors import InconsistentStateError
from drake_dae.systems.trials import SLOWEST, STEPS

REACHED = 1e-11
"""A Newton step longer than this, the second, says that N* was not reached in two."""

SHORTEST = 1e-12
"""A step that is shorter than this, relative to the time, is none."""

MOST_FAILURES = 100
"""So many trials of a step may fail for another reason than its error."""


class _Ended(Exception):
    """The run cannot go on."""

    def __init__(self, ending: Ending) -> None:
        self.ending = ending


class _Step(NamedTuple):
    """A step of DOP853.

    Attributes:
        end, size: Where it leads to, and how long it is, in s.
        reached: The state there.
        rate: Its derivative there.
        stages: The derivatives at its stages, shape (12, n), written over by the next step.
        is_on: Whether the state is on N*.
        following: The step to try next, in s.
        rejected: Whether a longer one was rejected.
    """

    end: float
    size: float
    reached: FloatArray
    rate: FloatArray
    stages: FloatArray
    is_on: bool
    following: float
    rejected: bool


class _Rows(NamedTuple):
    """Rows of a record to be.

    Attributes:
        times: Their times in s, shape (k,).
        states: The states, shape (k, n).
        hold: What the sensor holds in all of them.
        between: Whether an interpolant gave them, so that they are not on N*.
    """

    times: FloatArray
    states: FloatArray
    hold: FloatArray
    between: bool

    def without_last(self) -> Self:
        """The same without the last one."""
        return self._replace(times=self.times[:-1], states=self.states[:-1])


@dataclass(eq=False)
class _Course:
    """A run under way; see `Run` and `Problem`."""

    fused: Fused
    problem: Problem
    time: float
    state: FloatArray
    hold: FloatArray
    rows: list[_Rows] = field(default_factory=list)
    event: int = 0
    steps: int = 0
    before: float = 0.0
    mark: float = 0.0
    next: float = 0.0
    trial_time: float = np.inf
    trial: FloatArray = field(default_factory=lambda: np.full(1, np.nan))

    def rate(self, time: float, state: FloatArray) -> FloatArray:
        """The derivative; nan where it has no value, and the earliest such trial is kept."""
        values = self.fused.rate(time, state, self.hold, self.problem.plant, self.problem.law)
        if np.isnan(values[0]) and time < self.trial_time and np.isfinite(state).all():
            self.trial_time, self.trial = time, state.copy()
        return values

    def accepted_rate(self) -> FloatArray:
        """The derivative at the accepted state."""
        values = self.rate(self.time, self.state)
        if np.isnan(values[0]):
            raise _Ended(Ending.INVALID)
        return values

    def projected(self, time: float, state: FloatArray) -> FloatArray:
        """A state on N*."""
        if not self.fused.functions.loop.plant.projects:
            return state
        states, left = self.fused.projections(np.array([time]), state[None], self.problem.plant)
        if left[0] <= REACHED:
            return states[0]
        try:
            found = self.problem.project(time, state)
        except InconsistentStateError:
            raise _Ended(Ending.OFF_MANIFOLD) from None
        return np.concatenate([found, state[found.size :]])

    def note_stages(self, rate: FloatArray, size: float) -> None:
        """Evaluates the stages of a step of DOP853 one by one, to keep the trial that fails."""
        rates = [rate]
        for row, part in zip(DOP853.A[1:], DOP853.C[1:], strict=True):
            stage = self.state + size * (row[: len(rates)] @ np.array(rates))
            rates.append(self.rate(self.time + part * size, stage))

    def update(self, *, is_on: bool = False) -> bool:
        """What happens at the start of a step: the projection, then samples; whether there are any.

        Args:
            is_on: Whether the state is on N* already.
        """
        if not is_on:
            self.state = self.projected(self.time, self.state)
        problem, before = self.problem, self.event
        while self.event < problem.events.size and problem.events[self.event] <= self.time:
            noise = problem.noise[self.event]
            self.hold = self.fused.sample(
                self.time, self.state, self.hold, noise, problem.plant, problem.law
            )
            if not np.isfinite(self.hold).all():
                raise _Ended(Ending.INVALID)
            self.event += 1
        return self.event > before

    def accept(self, time: float, state: FloatArray) -> None:
        """Takes over a step; refuses one in a thousand that hardly led on."""
        self.time, self.state = time, state
        self.steps += 1
        self.trial_time = np.inf
        if self.steps % STEPS == 0:
            self.before, self.mark = self.mark, time
            if time - self.before < SLOWEST * (time - self.problem.times[0]):
                raise _Ended(Ending.SLOW)

    def write(self, time: float, state: FloatArray) -> None:
        """Keeps a row of the record."""
        self.rows.append(_Rows(np.array([time]), state[None], self.hold, False))

    def write_between(self, step: "_Step", times: FloatArray) -> None:
        """Keeps rows that lie within a step, from its interpolant."""
        problem = self.problem
        start = self.time, self.state, self.hold, problem.plant, problem.law
        (parts,) = self.fused.between(*start, step.size, step.stages, step.reached, step.rate)
        share = ((times - self.time) / step.size)[:, None]
        values = np.zeros((times.size, self.state.size))
        for j in reversed(range(len(parts))):
            values = (values + parts[j]) * (1.0 - share if j % 2 else share)
        self.rows.append(_Rows(times, values + self.state, self.hold, True))

    def boundary(self) -> float:
        """The next time at which a sample changes what is held, or the last one."""
        end, events = self.problem.times[-1], self.problem.events[self.event :]
        return float(min(end, events[0])) if events.size else float(end)

    def finish(self, ending: Ending) -> Run:
        """What the run came to."""
        counts = [len(rows.times) for rows in self.rows]
        times = np.concatenate([rows.times for rows in self.rows])
        states = np.concatenate([rows.states for rows in self.rows])
        holds = np.repeat([rows.hold for rows in self.rows], counts, axis=0)
        between = np.repeat([rows.between for rows in self.rows], counts)
        if self.fused.functions.loop.plant.projects and between.any():
            apart = np.flatnonzero(between)
            found, left = self.fused.projections(times[apart], states[apart], self.problem.plant)
            for index in np.flatnonzero(~(left <= REACHED)):
                found[index] = self.projected(times[apart[index]], states[apart[index]])
            states[apart] = found
        rows, valid = self.fused.rows(times, states, holds, self.problem.plant, self.problem.law)
        count = int(np.argmin(np.append(valid, False)))
        if count < len(valid):
            ending = Ending.INVALID
            self.time, self.state = self.trial_time, self.trial = times[count], states[count]
        return Run(
            rows[:count],
            ending,
            self.time,
            self.state,
            self.steps,
            self.before,
            self.next,
            self.trial_time,
            self.trial,
        )


def runner(fused: Fused, settings: Settings) -> Callable[[Problem], Run]:
    """What runs a closed loop.

    Args:
        fused: The closed loop.
        settings: How to step.
    """
    steps = None
    if settings.tableau is not None:
        steps = _Steps(fused, settings.tableau, settings.longest)

    def run(problem: Problem) -> Run:
        start = float(problem.times[0])
        course = _Course(
            fused, problem, start, problem.state, problem.hold, before=start, mark=start
        )
        try:
            if steps is None:
                _control(course, settings)
            else:
                steps.run(course)
        except _Ended as ended:
            return course.finish(ended.ending)
        return course.finish(Ending.DONE)

    return run


def _control(course: _Course, settings: Settings) -> None:
    """Error control by DOP853 as in stepper.c; rows between steps from its interpolant, on N*."""
    times, row, tried = course.problem.times, 1, 0.0
    rate: FloatArray | None = None
    course.write(course.time, course.state)
    while course.time < times[-1]:
        if course.update(is_on=rate is not None):
            rate = None
        if rate is None:
            rate = course.accepted_rate()
        limit = course.boundary()
        tried = tried or _first_step(course, rate, settings)
        step = _controlled(course, settings, rate, min(tried, settings.longest), limit)
        stop = min(int(np.searchsorted(times, step.end)), times.size - 1)
        if row < stop:
            course.write_between(step, times[row:stop])
        row = stop
        course.accept(step.end, step.reached)
        rate = step.rate if step.is_on else None
        if row < times.size - 1 and times[row] == course.time:
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
    course: _Course, settings: Settings, rate: FloatArray, size: float, limit: float
) -> _Step:
    """An accepted step from where a course is, at most to a limit in s."""
    problem, failures, rejected = course.problem, 0, False
    while True:
        end = course.time + size
        if end >= limit - SHORTEST * abs(limit):
            end = limit
        size = end - course.time
        if not size > SHORTEST * abs(course.time) or failures > MOST_FAILURES:
            raise _Ended(Ending.STUCK)
        reached, last, checks, stages = course.fused.controlled(
            course.time,
            course.state,
            course.hold,
            problem.plant,
            problem.law,
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
            return _Step(end, size, *values, is_on, following, rejected)
        failures += not good
        size *= factor if good else 0.2
        rejected = True


def _first_step(course: _Course, rate: FloatArray, settings: Settings) -> float:
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


class _Steps:
    """Fixed steps, many in one call of CasADi."""

    def __init__(self, fused: Fused, tableau: Tableau, longest: float) -> None:
        self._tableau, self._longest = tableau, longest
        self._one, self._many = fused.steps(tableau)

    def run(self, course: _Course) -> None:
        """Runs to the end of the record."""
        times = course.problem.times
        course.write(course.time, course.state)
        for block in self._blocks(course.problem):
            course.update()
            done = 0
            while done < len(block):
                done += self._advance(course, block[done : done + CHUNK])
        course.rows[-1] = course.rows[-1].without_last()
        course.update()
        course.write(times[-1], course.state)

    def _blocks(self, problem: Problem) -> Iterator[FloatArray]:
        """Times of steps between samples: where each begins, where it ends, and what is a row."""
        times = problem.times
        inside = problem.events[(problem.events > times[0]) & (problem.events < times[-1])]
        ends = np.union1d(times, inside)
        lengths = np.diff(ends)
        numbers = np.maximum(1, np.ceil(lengths / self._longest - 0.01)).astype(int)
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

    def _advance(self, course: _Course, block: FloatArray) -> int:
        """Takes some steps, and says how many."""
        problem = course.problem
        step = self._many
        if len(block) < CHUNK:
            step, block = self._one, block[:1]
        starts, ends, is_row = block.T
        given = (starts[:, None], (ends - starts)[:, None], course.hold, problem.plant, problem.law)
        states, checks = (
            values.copy().reshape(len(block), -1) for values in step(course.state, *given)
        )
        # The first number is not finite where a step has no value, the second is a Newton step.
        good = np.isfinite(checks[:, 0]) & (checks[:, 1] <= REACHED)
        count = int(np.argmin(np.append(good, False)))
        for end, state in zip(ends[:count].tolist(), states, strict=False):
            course.accept(end, state)
        chosen = np.flatnonzero(is_row[:count])
        course.rows.append(_Rows(ends[chosen], states[chosen], course.hold, False))
        if count == len(block):
            return count
        self._advance_slowly(course, *block[count])
        return count + 1

    def _advance_slowly(self, course: _Course, start: float, end: float, is_row: float) -> None:
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
            raise _Ended(Ending.SPOILT)
        course.accept(end, state)
        if is_row:
            course.write(end, state)
