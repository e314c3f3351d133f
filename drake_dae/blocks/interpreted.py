"""A block stepped without a C compiler: the loop of stepper.c over CasADi's interpreter."""

from math import ceil

import numpy as np

from drake_dae.arrays import FloatArray
from drake_dae.blocks.stepping import Run, RunEnding, RunProblem, StepFunctions, StepSettings
from drake_dae.blocks.trials import LEAST_PROGRESS, PACE_STEPS
from drake_dae.errors import InconsistentStateError

REACHED, NEAR = 1e-8, 1e-5
"""As in stepper.c."""

LOOKED = 64
"""The number of steps after which a run checks for Ctrl-C and divergence."""


class _Ended(Exception):
    """The run cannot go on: its argument says why."""


def run_interpreted(functions: StepFunctions, problem: RunProblem, settings: StepSettings) -> Run:
    """Makes a run until its end, or to where it cannot go on."""
    run, ending = InterpretedRun(functions, problem, settings), RunEnding.DONE
    try:
        run.steps_to_end()
    except _Ended as ended:
        (ending,) = ended.args
    rows = np.array(run.rows).reshape(-1, functions.row.numel_out(0))
    at = run.time, run.state, run.held, run.steps, run.before, run.next
    return Run(rows, ending, *at, run.trial_time, run.trial)


class InterpretedRun:
    """A run under way; attributes as of `Run`."""

    def __init__(
        self, functions: StepFunctions, problem: RunProblem, settings: StepSettings
    ) -> None:
        self.functions, self.problem, self.settings = functions, problem, settings
        self.state, self.held, self.rows = problem.state, problem.held, list[FloatArray]()
        self.start = self.time = self.mark = self.before = float(problem.times[0])
        self.events, self.event, self.steps, self.is_on = problem.events, 0, 0, False
        self.next, self.trial_time, self.trial = np.nan, np.inf, np.full(1, np.nan)

    def value(self, name: str, time: float, state: FloatArray) -> FloatArray:
        """The first result of a function, now; notes the earliest trial without a value."""
        function = self.functions.buffered[name]
        value = function(time, state, self.held, self.problem.parameters)[0].copy()
        is_trial = time < self.trial_time and np.isfinite(state).all()
        if is_trial and not np.isfinite(value).all():
            self.trial_time, self.trial = time, np.array(state)
        return value

    def rate(self, time: float, state: FloatArray) -> FloatArray:
        return self.value("rate", time, state)

    def write(self, time: float, state: FloatArray) -> None:
        """Adds a row of the record."""
        row = self.value("row", time, state)
        if not np.isfinite(row).all():
            raise _Ended(RunEnding.INVALID)
        self.rows.append(row)

    def newton(self, time: float, state: FloatArray) -> tuple[FloatArray, bool]:
        """The state after Newton steps to the manifold; the state itself, and False, far away."""
        found = state
        for attempt in range(8 if self.functions.projects else 0):
            held, parameters = self.held, self.problem.parameters
            moved, left = self.functions.buffered["newton"](time, found, held, parameters)
            found = moved.copy()
            if left[0] <= REACHED:
                return found, True
            if attempt and not left[0] <= NEAR:
                break
        return state, not self.functions.projects

    def project(self) -> None:
        state, self.is_on = self.newton(self.time, self.state)
        if not self.is_on:
            try:
                parameters = self.problem.parameters
                state = self.functions.projected(self.time, self.state, self.held, parameters)
            except InconsistentStateError:
                raise _Ended(RunEnding.OFF_MANIFOLD) from None
        self.state, self.is_on = state, True

    def update(self) -> bool:
        """Unrestricted updates, the projection, discrete updates; whether any were made."""
        first = self.event
        while True:
            is_due = self.event < self.events.size and self.events[self.event] <= self.time
            if is_due:
                self.apply(True)
            if not self.is_on:
                self.project()
            if not is_due:
                return self.event > first
            self.apply(False)
            self.event += 1

    def apply(self, is_unrestricted: bool) -> None:
        """Makes the updates of one kind that are due, all at once."""
        held, noise = self.held.copy(), self.problem.noise[self.event]
        for number, rate in enumerate(self.functions.rates):
            is_due = self.problem.due[self.event] >> number & 1
            if not is_due or rate.is_unrestricted != is_unrestricted:
                continue
            given = self.time, self.state, self.held, self.problem.parameters, noise
            (held[rate.places],) = self.functions.buffered[f"update_{number}"](*given)
            if not np.isfinite(held[rate.places]).all():
                raise _Ended(RunEnding.INVALID)
        self.held = held

    def steps_to_end(self) -> None:
        """Steps from row to row and sample to sample, in the order of stepper.c."""
        from scipy.integrate import DOP853

        times, row = self.problem.times, 0
        is_fixed, plan = self.settings.tableau is not None, list[float]()
        solver, tried, longest = None, None, self.settings.longest
        while True:
            at_row = self.time >= times[row]
            if at_row and row == times.size - 1:
                self.update()  # The last row comes after the updates of its time.
                return self.write(self.time, self.state)
            if at_row:
                if not is_fixed and self.steps and not self.is_on:
                    self.project()
                self.write(self.time, self.state)
                row += 1
            if self.steps % LOOKED == 0 and self.settings.look(lambda: np.array(self.rows)):
                raise _Ended(RunEnding.PAUSED)
            was_on = self.is_on
            if self.update() or not was_on:
                solver = None
            limit = float(times[row] if is_fixed else times[-1])
            if self.event < self.events.size:
                limit = min(limit, float(self.events[self.event]))
            if solver is None:
                rate = self.rate(self.time, self.state)
                if not np.isfinite(rate).all():
                    raise _Ended(RunEnding.INVALID)
            if is_fixed:
                if not plan:
                    count = max(1, ceil((limit - self.time) / longest - 0.01))
                    plan = [self.time + (limit - self.time) * (i / count) for i in range(1, count)]
                    plan.append(limit)
                self.fixed_step(plan.pop(0), rate)
                continue
            if solver is None:
                solver = DOP853(
                    self.rate,
                    self.time,
                    self.state,
                    limit,
                    max_step=longest,
                    rtol=self.settings.relative,
                    atol=self.settings.absolute,
                    first_step=None if tried is None else min(tried, limit - self.time),
                )
            advised = solver.h_abs
            solver.step()
            if solver.status == "failed":
                raise _Ended(RunEnding.STUCK)
            reached, self.is_on = self.newton(solver.t, solver.y)
            solver.y, solver.f = reached, self.rate(solver.t, reached)
            if not np.isfinite(solver.f).all():
                raise _Ended(RunEnding.INVALID)
            solver.K[-1] = solver.f
            if times[row] < solver.t:
                between = solver.dense_output()
            while times[row] < solver.t:
                moment = float(times[row])
                self.write(moment, self.newton(moment, between(moment))[0])
                row += 1
            # A step that only ended early, at a sample, says nothing against longer ones.
            tried = max(solver.h_abs, advised if solver.t >= limit else 0.0)
            self.accept(float(solver.t), reached)

    def fixed_step(self, end: float, first: FloatArray) -> None:
        tableau, step = self.settings.tableau, end - self.time
        assert tableau is not None
        rates = np.empty((tableau.c.size, self.state.size))
        rates[0] = first
        for i in range(1, tableau.c.size):
            stage = self.state + step * (tableau.a[i, :i] @ rates[:i])
            rates[i] = self.rate(self.time + float(tableau.c[i]) * step, stage)
        reached = self.state + step * (tableau.b @ rates)
        self.next = end
        if not np.isfinite(reached).all():
            raise _Ended(RunEnding.SPOILT)
        self.is_on = False
        self.accept(end, reached)

    def accept(self, time: float, state: FloatArray) -> None:
        """Accepts a step; ends the run where a thousand of them add hardly any time."""
        self.time, self.state, self.steps = time, state, self.steps + 1
        self.trial_time = np.inf
        if self.steps % PACE_STEPS == 0:
            self.before, self.mark = self.mark, time
            if time - self.before < LEAST_PROGRESS * (time - self.start):
                raise _Ended(RunEnding.SLOW)
