"""A block stepped without a C compiler: the loop of stepper.c over CasADi's interpreter."""

from functools import partial
from math import ceil

import numpy as np

from drake_dae.arrays import FloatArray
from drake_dae.blocks.failures import LEAST_PROGRESS, PACE_STEPS
from drake_dae.blocks.stepping import Run, RunEnding, RunProblem, StepFunctions, StepSettings
from drake_dae.errors import InconsistentStateError


class _Ended(Exception):
    """The run cannot go on: its argument says why."""


def run_interpreted(functions: StepFunctions, problem: RunProblem, settings: StepSettings) -> Run:
    """Makes a run until its end, or to where it cannot go on."""
    run, ending = _Interpreted(functions, problem, settings), RunEnding.DONE
    try:
        run.steps_to_end()
    except _Ended as ended:
        (ending,) = ended.args
    rows = np.array(run.rows).reshape(-1, functions.row.numel_out(0))
    return Run(rows, ending, run.time, run.state, run.held, run.steps)


class _Interpreted:
    """A run under way; attributes as of `Run`."""

    def __init__(
        self, functions: StepFunctions, problem: RunProblem, settings: StepSettings
    ) -> None:
        self.functions, self.problem, self.settings = functions, problem, settings
        self.state, self.held, self.rows = problem.state, problem.held, list[FloatArray]()
        self.start = self.time = self.mark = float(problem.times[0])
        self.event, self.steps, self.is_on = 0, 0, False

    def value(self, name: str, time: float, state: FloatArray) -> FloatArray:
        """The first result of a function, now."""
        given = time, state, self.held, self.problem.parameters
        return self.functions.buffered[name](*given)[0].copy()

    def write(self, time: float, state: FloatArray) -> None:
        self.rows.append(_valid(self.value("row", time, state)))

    def projected(self, time: float, state: FloatArray) -> FloatArray:
        """A state moved onto the manifold."""
        try:
            given = time, state, self.held, self.problem.parameters
            return self.functions.projected(*given) if self.functions.projects else state
        except InconsistentStateError:
            raise _Ended(RunEnding.OFF_MANIFOLD) from None

    def project(self) -> None:
        if not self.is_on:
            self.state, self.is_on = self.projected(self.time, self.state), True

    def update(self) -> bool:
        """Unrestricted updates, the projection, discrete updates; whether any were made."""
        first, events, problem = self.event, self.problem.events, self.problem
        while self.event < events.size and events[self.event] <= self.time:
            for is_unrestricted in (True, False):  # Those of one kind all at once.
                held, noise = self.held.copy(), problem.noise[self.event]
                given = self.time, self.state, self.held, problem.parameters, noise
                for number, rate in enumerate(self.functions.rates):
                    is_due = problem.due[self.event] >> number & 1
                    if is_due and rate.is_unrestricted == is_unrestricted:
                        (values,) = self.functions.buffered[f"update_{number}"](*given)
                        held[rate.places] = _valid(values)
                self.held = held
                self.project()
            self.event += 1
        self.project()
        return self.event > first

    def steps_to_end(self) -> None:
        """Steps from row to row and sample to sample, in the order of stepper.c."""
        from scipy.integrate import DOP853

        times, events, settings = self.problem.times, self.problem.events, self.settings
        rate, solver, tried = partial(self.value, "rate"), None, 0.0
        while self.time < times[-1]:
            if self.time >= times[len(self.rows)]:
                self.write(self.time, self.state)
            solver = None if self.update() else solver
            limit = float(times[-1] if settings.tableau is None else times[len(self.rows)])
            limit = min(limit, *events[self.event : self.event + 1].tolist(), np.inf)
            if settings.tableau is not None:
                self.fixed_steps(limit, *settings.tableau)
                continue
            if solver is None:
                _valid(rate(self.time, self.state))
                first = min(tried, limit - self.time) or None
                tolerances = settings.longest, settings.relative, settings.absolute
                solver = DOP853(rate, self.time, self.state, limit, *tolerances, first_step=first)
            advised = solver.h_abs
            solver.step()
            if solver.status == "failed":
                raise _Ended(RunEnding.STUCK)
            # A step that only ended early, at a sample, says nothing against longer ones.
            tried = max(solver.h_abs, advised if solver.t >= limit else 0.0)
            self.accept(float(solver.t), solver.y)
            self.project()
            solver.y, solver.f = self.state, _valid(rate(self.time, self.state))
            solver.K[-1] = solver.f
            if times[len(self.rows)] < self.time:
                between = solver.dense_output()
            while (moment := float(times[len(self.rows)])) < self.time:
                self.write(moment, self.projected(moment, between(moment)))
        self.update()  # The last row comes after the updates of its time.
        self.write(self.time, self.state)

    def fixed_steps(self, limit: float, a: FloatArray, b: FloatArray, c: FloatArray) -> None:
        """Steps of equal lengths to a time, each by x + h (b k), k_i = x'(t + c_i h, x + h a k)."""
        begin, rates = self.time, np.empty((c.size, self.state.size))
        count = max(1, ceil((limit - begin) / self.settings.longest - 0.01))
        for end in [*(begin + (limit - begin) * (i / count) for i in range(1, count)), limit]:
            self.project()
            h, rates[0] = end - self.time, _valid(self.value("rate", self.time, self.state))
            for i in range(1, c.size):
                stage = self.state + h * (a[i, :i] @ rates[:i])
                rates[i] = self.value("rate", self.time + float(c[i]) * h, stage)
            self.accept(end, _valid(self.state + h * (b @ rates), RunEnding.SPOILT))

    def accept(self, time: float, state: FloatArray) -> None:
        """Accepts a step. The run ends where a thousand add hardly any time, or by `look`."""
        self.time, self.state, self.steps, self.is_on = time, state, self.steps + 1, False
        if self.steps % PACE_STEPS == 0:
            before, self.mark = self.mark, time
            if time - before < LEAST_PROGRESS * (time - self.start):
                raise _Ended(RunEnding.SLOW)
        if self.steps % 64 == 0 and self.settings.look(lambda: np.array(self.rows)):
            raise _Ended(RunEnding.PAUSED)


def _valid(values: FloatArray, ending: RunEnding = RunEnding.INVALID) -> FloatArray:
    if not np.isfinite(values).all():
        raise _Ended(ending)
    return values
