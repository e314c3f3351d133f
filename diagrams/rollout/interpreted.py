"""A closed loop stepped without a compiler: CasADi maps fixed steps, SciPy controls the error."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
from scipy.integrate import DOP853

from drake_dae.arrays import FloatArray
from drake_dae.diagrams.rollout.fused import CHUNK, Fused
from drake_dae.diagrams.rollout.run import Ending, Problem, Run, Settings, Tableau
from drake_dae.errors import InconsistentStateError
from drake_dae.systems.trials import SLOWEST, STEPS

REACHED = 1e-11
"""A Newton step longer than this, the second, says that N* was not reached in two."""


class _Ended(Exception):
    """The run cannot go on."""

    def __init__(self, ending: Ending) -> None:
        self.ending = ending


@dataclass(eq=False)
class _Course:
    """A run under way; see `Run` and `Problem`."""

    fused: Fused
    problem: Problem
    time: float
    state: FloatArray
    hold: FloatArray
    rows: list[tuple[float, FloatArray, FloatArray]] = field(default_factory=list)
    apart: list[int] = field(default_factory=list)
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

    def update(self) -> None:
        """What happens at the start of a step: the projection, then a sample."""
        self.state = self.projected(self.time, self.state)
        problem = self.problem
        while self.event < problem.events.size and problem.events[self.event] <= self.time:
            noise = problem.noise[self.event]
            self.hold = self.fused.sample(
                self.time, self.state, self.hold, noise, problem.plant, problem.law
            )
            if not np.isfinite(self.hold).all():
                raise _Ended(Ending.INVALID)
            self.event += 1

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
        self.rows.append((time, state, self.hold))

    def boundary(self) -> float:
        """The next time at which a sample changes what is held, or the last one."""
        end, events = self.problem.times[-1], self.problem.events[self.event :]
        return float(min(end, events[0])) if events.size else float(end)

    def _project_rows(self) -> None:
        """Puts rows that an interpolant gave on N*."""
        if not (self.apart and self.fused.functions.loop.plant.projects):
            return
        times = np.array([self.rows[index][0] for index in self.apart])
        states = np.array([self.rows[index][1] for index in self.apart])
        found, left = self.fused.projections(times, states, self.problem.plant)
        for index, state, length in zip(self.apart, found, left, strict=True):
            time, other, hold = self.rows[index]
            if not length <= REACHED:
                state = self.projected(time, other)
            self.rows[index] = time, state, hold

    def finish(self, ending: Ending) -> Run:
        """What the run came to."""
        self._project_rows()
        rows, valid = self.fused.rows(self.rows, self.problem.plant, self.problem.law)
        count = int(np.argmin(np.append(valid, False)))
        if count < len(valid):
            ending = Ending.INVALID
            self.trial_time, self.trial = self.rows[count][0], self.rows[count][1]
            self.time, self.state = self.trial_time, self.trial
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
    """Error control by SciPy's DOP853; rows between steps from its interpolant, on N*."""
    times, row, longer = course.problem.times, 1, None
    apart = course.apart
    course.write(course.time, course.state)
    while course.time < times[-1]:
        course.update()
        course.accepted_rate()
        limit = course.boundary()
        solver = DOP853(
            course.rate,
            course.time,
            course.state,
            limit,
            max_step=settings.longest,
            rtol=settings.relative,
            atol=settings.absolute,
            first_step=longer and min(longer, limit - course.time),
        )
        while solver.status == "running":
            solver.step()
            if solver.status == "failed":
                raise _Ended(Ending.STUCK)
            between = None
            while row < times.size - 1 and times[row] < solver.t:
                between = between or solver.dense_output()
                course.write(times[row], between(times[row]))
                apart.append(len(course.rows) - 1)
                row += 1
            course.accept(solver.t, solver.y)
            solver.y = course.state = course.projected(course.time, course.state)
            if row < times.size - 1 and times[row] == course.time:
                course.write(course.time, course.state)
                row += 1
            if solver.status == "running":
                solver.f = course.accepted_rate()
        # A step that only ended early, at a sample, says nothing against longer ones.
        longer = max(solver.h_abs, longer or 0.0)
    course.update()
    course.write(course.time, course.state)


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
        course.rows.pop()
        course.update()
        course.write(times[-1], course.state)

    def _blocks(self, problem: Problem) -> Iterator[FloatArray]:
        """Times of steps between samples: where each begins, where it ends, and what is a row."""
        times, longest = problem.times, self._longest
        inside = problem.events[(problem.events > times[0]) & (problem.events < times[-1])]
        ends = np.union1d(times, inside)
        parts = []
        for first, last in pairwise(ends):
            number = int(max(1, np.ceil((last - first) / longest - 0.01)))
            moments = first + (last - first) * (np.arange(number + 1) / number)
            moments[-1] = last
            is_row = np.zeros(number)
            is_row[-1] = last in times
            parts.append(np.column_stack([moments[:-1], moments[1:], is_row]))
            if last in inside or last == ends[-1]:
                yield np.concatenate(parts)
                parts = []

    def _advance(self, course: _Course, block: FloatArray) -> int:
        """Takes some steps, and says how many."""
        problem = course.problem
        step = self._many
        if len(block) < CHUNK:
            step, block = self._one, block[:1]
        starts, lengths = block[:, 0][None], (block[:, 1] - block[:, 0])[None]
        given = (starts, lengths, course.hold, problem.plant, problem.law)
        states, checks = (np.array(values) for values in step(course.state, *given))
        # The first number is not finite where a step has no value, the second is a Newton step.
        good = np.isfinite(checks[0]) & (checks[1] <= REACHED)
        count = int(np.argmin(np.append(good, False)))
        for index in range(count):
            course.accept(block[index, 1], states[:, index])
            if block[index, 2]:
                course.write(course.time, course.state)
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
