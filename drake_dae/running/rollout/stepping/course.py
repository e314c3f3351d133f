"""A run under way without machine code: where it is, and its record so far."""

from collections.abc import Callable
from math import isfinite, isnan
from typing import NamedTuple

import numpy as np
from scipy.integrate import DOP853

from drake_dae.arrays import FloatArray
from drake_dae.blocks.trials import LEAST_PROGRESS, PACE_STEPS
from drake_dae.errors import InconsistentStateError
from drake_dae.running.rollout.run import Run, RunEnding, RunProblem, Tableau
from drake_dae.running.rollout.stepping.functions import DiagramFunctions

DOP = Tableau(DOP853.A, DOP853.B, DOP853.C)


class RunEnded(Exception):
    """The run cannot go on."""

    def __init__(self, ending: RunEnding) -> None:
        self.ending = ending


def stage_rates(
    rate: Callable[[float, FloatArray], FloatArray],
    tableau: Tableau,
    time: float,
    state: FloatArray,
    step: float,
    first: FloatArray | None = None,
) -> FloatArray:
    """Returns the derivatives at all stages of an explicit Runge-Kutta step, shape (s, n).

    Args:
        rate: (time, state) -> the derivative.
        tableau: The method.
        time: When the step begins, in s.
        state: The state there, shape (n,).
        step: Its length in s.
        first: The derivative at the first stage, if it is known.
    """
    rates = np.empty((tableau.c.size, state.size))
    rates[0] = rate(time, state) if first is None else first
    for number in range(1, tableau.c.size):
        stage = state + step * (tableau.a[number, :number] @ rates[:number])
        rates[number] = rate(time + float(tableau.c[number]) * step, stage)
    return rates


class Dop853Step(NamedTuple):
    """An accepted step of DOP853.

    Attributes:
        end, size: When it ends, and its length, in s.
        reached: The state at its end.
        rates: The derivatives at its twelve stages and at its end, shape (13, n).
        is_on: Whether the state is on N*.
        following: The step to try next, in s.
        rejected: Whether a longer one was rejected.
    """

    end: float
    size: float
    reached: FloatArray
    rates: FloatArray
    is_on: bool
    following: float
    rejected: bool


class RecordRows(NamedTuple):
    """States from which rows of the record are computed.

    Attributes:
        times: Their times in s, shape (k,).
        states: The states, shape (k, n).
        held: The held values of all of them.
        between: Whether they are interpolated, so that they are not on N*.
    """

    times: FloatArray
    states: FloatArray
    held: FloatArray
    between: bool


class RunStepper:
    """A run under way; attributes as of `Run`.

    Args:
        functions: The diagram.
        problem: The run.
        tableau: The method of its steps.

    Attributes:
        rows: States whose rows are not computed yet.
    """

    def __init__(self, functions: DiagramFunctions, problem: RunProblem, tableau: Tableau) -> None:
        self.functions, self.problem, self._tableau = functions, problem, tableau
        self._stages = functions.stages(tableau)
        self.state, self.held = problem.state, problem.held
        self.time = self.before = self.mark = float(problem.times[0])
        self.event = self.steps = 0
        self.next = 0.0
        self.trial_time, self.trial = np.inf, np.full(1, np.nan)
        self.rows = list[RecordRows]()
        self._computed = [np.zeros((0, functions.program.width))]

    def rate(self, time: float, state: FloatArray) -> FloatArray:
        """Returns the derivative; nan where it has no value, and notes the earliest such trial."""
        values = self.functions.rate(time, state, self.held, self.problem.parameters)
        if values.size and isnan(values[0]) and time < self.trial_time and np.isfinite(state).all():
            self.trial_time, self.trial = time, state.copy()
        return values

    def stages(self, step: float, first: FloatArray) -> FloatArray:
        """Returns the derivatives at all stages of a step, shape (s, n); nan without a value.

        Args:
            step: The step in s.
            first: The derivative at the accepted state.
        """
        inputs = self.time, self.state, self.held, self.problem.parameters, first, step
        rates, finite = self._stages(*inputs)
        if isfinite(finite[0]):
            return rates.reshape(self._tableau.c.size, first.size).copy()
        # One after the other, to note the trial that has no value.
        return stage_rates(self.rate, self._tableau, self.time, self.state, step, first)

    def accepted_rate(self) -> FloatArray:
        """Returns the derivative at the accepted state."""
        values = self.rate(self.time, self.state)
        if values.size and isnan(values[0]):
            raise RunEnded(RunEnding.INVALID)
        return values

    def nearly_projected(self, time: float, state: FloatArray) -> tuple[FloatArray, bool]:
        """Returns the state on N* and True, or itself if two Newton steps do not reach N*."""
        if not self.functions.program.compiled.projects:
            return state, True
        projected = self.functions.projected(time, state, self.held, self.problem.parameters)
        return (state, False) if projected is None else (projected, True)

    def projected(self, time: float, state: FloatArray) -> FloatArray:
        """Returns the state on N*."""
        projected, is_on = self.nearly_projected(time, state)
        if is_on:
            return projected
        try:
            return self.problem.project(time, state, self.held)
        except InconsistentStateError:
            raise RunEnded(RunEnding.OFF_MANIFOLD) from None

    def update(self, *, is_on: bool = False) -> bool:
        """Projects the state and makes the updates that are due; returns whether any were.

        Args:
            is_on: Whether the state is on N* already.
        """
        event_before, state_before, problem = self.event, self.state, self.problem
        if not is_on:
            self.state = self.projected(self.time, self.state)
        while self.event < problem.events.size and problem.events[self.event] <= self.time:
            due, noise = int(problem.due[self.event]), problem.noise[self.event]
            # Unrestricted updates see the state before the projection, which is one of them.
            for state, is_unrestricted in ((state_before, True), (self.state, False)):
                inputs = self.time, state, self.held, problem.parameters
                held = self.functions.update(*inputs, noise, due, is_unrestricted)
                if not np.isfinite(held).all():
                    raise RunEnded(RunEnding.INVALID)
                self.held = held
            self.event += 1
        return self.event > event_before

    def accept(self, time: float, state: FloatArray) -> None:
        """Accepts a step; ends the run where `PACE_STEPS` of them add hardly any time."""
        self.time, self.state = time, state
        self.steps += 1
        self.trial_time = np.inf
        if self.steps % PACE_STEPS == 0:
            self.before, self.mark = self.mark, time
            if time - self.before < LEAST_PROGRESS * (time - self.problem.times[0]):
                raise RunEnded(RunEnding.SLOW)

    def write(self) -> None:
        """Adds the accepted state to the rows."""
        self.rows.append(RecordRows(np.array([self.time]), self.state[None], self.held, False))

    def write_between(self, step: Dop853Step, times: FloatArray) -> None:
        """Adds states within a step, by the interpolant of seventh order as SciPy has it."""
        size, rates = step.size, np.concatenate([step.rates, np.zeros((3, self.state.size))])
        extra = zip(DOP853.A_EXTRA, DOP853.C_EXTRA.tolist(), strict=True)
        for number, (row, part) in enumerate(extra, start=13):
            stage = self.state + size * (row[:number] @ rates[:number])
            rates[number] = self.rate(self.time + part * size, stage)
        change = step.reached - self.state
        parts = [
            change,
            size * rates[0] - change,
            2.0 * change - size * (rates[12] + rates[0]),
            *(size * (DOP853.D @ rates)),
        ]
        share = ((times - self.time) / size)[:, None]
        values = np.zeros((times.size, self.state.size))
        for j in reversed(range(len(parts))):
            values = (values + parts[j]) * (1.0 - share if j % 2 else share)
        self.rows.append(RecordRows(times, self.state + values, self.held, True))

    def boundary(self) -> float:
        """The time of the next event or of the end, in s."""
        end, events = float(self.problem.times[-1]), self.problem.events
        return min(end, float(events[self.event])) if self.event < events.size else end

    def so_far(self) -> FloatArray:
        """Returns the rows of the record without the last ones, which may still change."""
        last = self.rows.pop()
        try:
            self._compute()
        finally:
            self.rows.append(last)
        return np.concatenate(self._computed)

    def _compute(self) -> None:
        """Computes rows of the record from all states in `rows`.

        Raises:
            RunEnded: A row has no value.
        """
        if not self.rows:
            return
        counts = [len(rows.times) for rows in self.rows]
        times = np.concatenate([rows.times for rows in self.rows])
        states = np.concatenate([rows.states for rows in self.rows])
        held = np.repeat([rows.held for rows in self.rows], counts, axis=0)
        between = np.repeat([rows.between for rows in self.rows], counts)
        self.rows.clear()
        parameters = self.problem.parameters
        if self.functions.program.compiled.projects and between.any():
            inputs = times[between], states[between], held[between], parameters
            projected, is_on = self.functions.projections(*inputs)
            for index in np.flatnonzero(~is_on):
                projected[index] = self.projected(inputs[0][index], inputs[1][index])
            states[between] = projected
        rows, valid = self.functions.rows(times, states, held, parameters)
        count = int(np.argmin(np.append(valid, False)))
        self._computed.append(rows[:count])
        if count < len(valid):
            self.time, self.state = self.trial_time, self.trial = times[count], states[count]
            raise RunEnded(RunEnding.INVALID)

    def finish(self, ending: RunEnding) -> Run:
        """Returns the run with its record."""
        try:
            self._compute()
        except RunEnded as ended:
            ending = ended.ending
        return Run(
            np.concatenate(self._computed),
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
