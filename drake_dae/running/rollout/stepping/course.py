"""A run under way without machine code: where it is, and what is kept of it."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple, Self

import numpy as np
from scipy.integrate import DOP853

from drake_dae.arrays import FloatArray
from drake_dae.errors import InconsistentStateError
from drake_dae.running.rollout.run import Run, RunEnding, RunProblem
from drake_dae.running.rollout.stepping.fused import DiagramFunctions, GuardInputs
from drake_dae.running.rollout.stepping.many import BLOCK, VectorizedFunction
from drake_dae.systems.blocks.trials import LEAST_PROGRESS, PACE_STEPS

REACHED = 1e-11
"""A Newton step longer than this, the second, says that N* was not reached in two."""


class RunEnded(Exception):
    """The run cannot go on."""

    def __init__(self, ending: RunEnding) -> None:
        self.ending = ending


class Dop853Step(NamedTuple):
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


class RecordRows(NamedTuple):
    """Rows of a record to be.

    Attributes:
        times: Their times in s, shape (k,).
        states: The states, shape (k, n).
        held: What is held in all of them.
        between: Whether an interpolant gave them, so that they are not on N*.
    """

    times: FloatArray
    states: FloatArray
    held: FloatArray
    between: bool

    def without_last(self) -> Self:
        """The same without the last one."""
        return self._replace(times=self.times[:-1], states=self.states[:-1])


class StepSpan(NamedTuple):
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


def fill(spans: Sequence[StepSpan], rate: VectorizedFunction, parameters: FloatArray) -> None:
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


@dataclass(eq=False)
class RunStepper:
    """A run under way; see `Run` and `RunProblem`."""

    fused: DiagramFunctions
    problem: RunProblem
    time: float
    state: FloatArray
    held: FloatArray
    rows: list[RecordRows] = field(default_factory=list)
    spans: list[StepSpan] = field(default_factory=list)
    done: list[FloatArray] = field(default_factory=list)
    event: int = 0
    steps: int = 0
    before: float = 0.0
    mark: float = 0.0
    next: float = 0.0
    seen: GuardInputs | None = None
    trial_time: float = np.inf
    trial: FloatArray = field(default_factory=lambda: np.full(1, np.nan))

    def rate(self, time: float, state: FloatArray) -> FloatArray:
        """The derivative; nan where it has no value, and the earliest such trial is kept."""
        values = self.fused.rate(time, state, self.held, self.problem.parameters)
        if np.isnan(values[0]) and time < self.trial_time and np.isfinite(state).all():
            self.trial_time, self.trial = time, state.copy()
        return values

    def accepted_rate(self) -> FloatArray:
        """The derivative at the accepted state."""
        values = self.rate(self.time, self.state)
        if np.isnan(values[0]):
            raise RunEnded(RunEnding.INVALID)
        return values

    def projected(self, time: float, state: FloatArray) -> FloatArray:
        """A state on N*."""
        if not self.fused.program.compiled.projects:
            return state
        given = np.array([time]), state[None], self.held[None], self.problem.parameters
        states, left = self.fused.projections(*given)
        if left[0] <= REACHED:
            return states[0]
        try:
            return self.problem.project(time, state, self.held)
        except InconsistentStateError:
            raise RunEnded(RunEnding.OFF_MANIFOLD) from None

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
        before, state = self.event, self.state
        if not is_on:
            self.state = self.projected(self.time, self.state)
        problem = self.problem
        while self.event < problem.events.size and problem.events[self.event] <= self.time:
            if problem.due[self.event] & self.fused.watched_rates:
                found = self.fused.watched(self.time, state, self.held, problem.parameters)
                if found.is_due:
                    self.state, self.next = state, self.time
                    raise RunEnded(RunEnding.CHANGE)
            # Unrestricted updates see what was before the projection, which is one of them.
            for seen, is_unrestricted in ((state, True), (self.state, False)):
                held = self.fused.update(
                    self.time,
                    seen,
                    self.held,
                    problem.parameters,
                    problem.noise[self.event],
                    int(problem.due[self.event]),
                    is_unrestricted,
                )
                if not np.isfinite(held).all():
                    raise RunEnded(RunEnding.INVALID)
                self.held = held
            self.event += 1
        return self.event > before

    def accept(self, time: float, state: FloatArray) -> None:
        """Takes over a step; refuses one in a thousand that hardly led on."""
        self.time, self.state = time, state
        self.steps += 1
        self.trial_time = np.inf
        if self.steps % PACE_STEPS == 0:
            self.before, self.mark = self.mark, time
            if time - self.before < LEAST_PROGRESS * (time - self.problem.times[0]):
                raise RunEnded(RunEnding.SLOW)

    def write(self, time: float, state: FloatArray) -> None:
        """Keeps a row of the record."""
        self.rows.append(RecordRows(np.array([time]), state[None], self.held, False))

    def write_between(self, step: "Dop853Step", times: FloatArray) -> None:
        """Keeps rows that lie within a step, for its interpolant to be computed with others."""
        found = np.zeros((times.size, self.state.size))
        rates = np.concatenate([step.stages, step.rate[None]])
        ends = self.time, step.size, self.state, step.reached
        self.spans.append(StepSpan(*ends, rates, self.held, times, found))
        self.rows.append(RecordRows(times, found, self.held, True))
        if len(self.spans) == BLOCK:
            self.fill()

    def fill(self) -> None:
        """Computes the rows within steps."""
        fill(self.spans, self.fused.rates, self.problem.parameters)
        self.spans.clear()

    def look(self) -> None:
        """Looks at the guards where a step begins; ends where a block has to react first."""
        if self.fused.program.compiled.guards:
            self.seen = self.fused.seen(self.time, self.state, self.held, self.problem.parameters)
            is_begin = self.problem.has_reacted and self.time == self.problem.times[0]
            if self.seen.is_due and not is_begin:
                self.next = self.time
                raise RunEnded(RunEnding.CHANGE)

    def check(self, time: float, state: FloatArray) -> None:
        """Ends where a step that leads to a state passes a change."""
        if self.seen is not None:
            found = self.fused.seen(time, state, self.held, self.problem.parameters)
            if found.follows_change(self.seen):
                self.next = time
                raise RunEnded(RunEnding.CHANGE)

    def boundary(self) -> float:
        """The next time at which a sample changes what is held, or the last one."""
        end, events = float(self.problem.times[-1]), self.problem.events
        return min(end, float(events[self.event])) if self.event < events.size else end

    def so_far(self) -> FloatArray:
        """The rows of the record up to now, without the last ones, which may still change."""
        *whole, last = self.rows
        self.rows[:] = whole
        try:
            self._compute()
        finally:
            self.rows.append(last)
        return self.problem.whole(self._joined())

    def _joined(self) -> FloatArray:
        return np.concatenate([np.zeros((0, self.fused.program.width)), *self.done])

    def _compute(self) -> None:
        """Makes rows of the record of all that is kept.

        Raises:
            Ended: A row has no value.
        """
        self.fill()
        if not self.rows:
            return
        counts = [len(rows.times) for rows in self.rows]
        times = np.concatenate([rows.times for rows in self.rows])
        states = np.concatenate([rows.states for rows in self.rows])
        held = np.repeat([rows.held for rows in self.rows], counts, axis=0)
        between = np.repeat([rows.between for rows in self.rows], counts)
        self.rows.clear()
        parameters = self.problem.parameters
        if self.fused.program.compiled.projects and between.any():
            apart = np.flatnonzero(between)
            given = times[apart], states[apart], held[apart], parameters
            found, left = self.fused.projections(*given)
            for index in np.flatnonzero(~(left <= REACHED)):
                found[index] = self.projected(times[apart[index]], states[apart[index]])
            states[apart] = found
        rows, valid = self.fused.rows(times, states, held, parameters)
        count = int(np.argmin(np.append(valid, False)))
        self.done.append(rows[:count])
        if count < len(valid):
            self.time, self.state = self.trial_time, self.trial = times[count], states[count]
            raise RunEnded(RunEnding.INVALID)

    def finish(self, ending: RunEnding) -> Run:
        """What the run came to."""
        try:
            self._compute()
        except RunEnded as ended:
            ending = ended.ending
        return Run(
            self._joined(),
            ending,
            self.time,
            self.state,
            self.held,
            self.event,
            self.steps,
            self.before,
            self.next,
            self.trial_time,
            self.trial,
        )
