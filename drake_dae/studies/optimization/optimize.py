"""Optimization of parameters and initial states of a loop, by exact gradients of its run."""

import signal
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from pydrake.systems.analysis import SimulatorConfig
from pydrake.systems.framework import Context, Diagram

from drake_dae.arguments import checked
from drake_dae.arrays import FloatArray, check_whole_number, listed, number
from drake_dae.diagrams.closed_loop import ClosedLoop
from drake_dae.errors import ModelError
from drake_dae.running.rollout.events import Seed
from drake_dae.running.rollout.problems import checked_times, start_values
from drake_dae.running.rollout.program import program_of
from drake_dae.running.rollout.rollout import Rollout
from drake_dae.simulation.records.interruption import ending_signals
from drake_dae.studies.optimization.expressions import Objective, RunSymbols
from drake_dae.studies.optimization.ipopt import IpoptProblem, IpoptResult, solve
from drake_dae.studies.optimization.loop_runs import LoopRuns
from drake_dae.studies.optimization.optimum import MET, Optimum, limit_sizes, limit_states
from drake_dae.studies.optimization.variables import Variable, chosen_variables


@checked(ModelError)
def optimize(
    loop: ClosedLoop | Diagram,
    context: Context,
    times: ArrayLike,
    free: Mapping[str, tuple[float | None, float | None]],
    cost: Callable[[RunSymbols], Any],
    limits: Callable[[RunSymbols], Any] | None = None,
    *,
    more: Mapping[str, float] | None = None,
    config: SimulatorConfig,
    seed: Seed | None = None,
    iterations: int = 200,
) -> Optimum:
    """Minimizes the cost of a loop's run over its parameters and initial state, within limits.

    IPOPT solves min J(p, record(p)) subject to low <= p <= high and the limits. The record is the
    one of `rollout`, and its derivatives are exact: they are the derivatives of the steps.
    Cost and limits are CasADi expressions of the record:

        found = optimize(
            loop, context, times, {"gains.tool.z": (1.0, 400.0)},
            cost=lambda run: casadi.sumsqr(run["tracking_error", "tool.z"]),
            limits=lambda run: {"torque": (-90.0, run["control"], 90.0)},
            config=config,
        )

    Args:
        loop: The closed loop, or any diagram that `rollout` supports.
        context: Its context at the start time, with the initial guess.
        times: The times of the rows of the record, in s, from the start to the end, shape (j,).
            Cost and limits use only these rows.
        free: Name -> (least, largest) value, None for no bound. Names are those of parameters:
            "link1.mass", "wall.position[0]" for one entry, "gains.tool.z" for the gains of an
            output, and names of parameters of references; and "start.joint1" for an entry of the
            plant's initial state. A parameter of both plant and law is changed in both;
            "plant.link1.mass" and "law.link1.mass" change it in one of them. The initial state is
            projected onto N*, after which its entries may be slightly beyond their bounds.
        cost: Function of the run, as `RunSymbols`, that returns the cost, one number.
        limits: Function of the run that returns name -> (least value, expression, largest value),
            with None for no bound; an expression may have many entries. None for no limits.
        more: Name -> initial guess of further variables of cost and limits, such as a peak that is
            minimized.
        config: Drake's settings, with fixed steps.
        seed: The seed of the noise, as in `rollout`.
        iterations: The largest number of iterations.

    Returns:
        The best values, whether they are a local optimum, and a context with them. After Ctrl-C
        they are the best so far, and `interrupted` is the signal.

    Raises:
        ModelError: A name is unknown, bounds or limits contradict each other, the cost is no
            expression or depends on no variable, or the run has no derivatives, as with error
            control, impacts and openings.
        InconsistentStateError: The initial state cannot be projected onto N*.
        SimulationError: The run with the initial guess fails.
    """
    check_whole_number("iterations", iterations, 1)
    program, moments = program_of(loop), checked_times(times)
    start, parameters = start_values(loop, context)
    variables = chosen_variables(program.compiled, start, parameters, free)
    extra = {name: number(f"'{name}' of more", value) for name, value in (more or {}).items()}
    names = [variable.name for variable in variables]
    if doubles := set(names) & set(extra):
        raise ModelError(f"'{min(doubles)}' of more is a number of the loop; give it another name")
    layout = None
    if not isinstance(loop, Diagram) and loop.generator is not None:
        layout = loop.controller.law.layout
    run = RunSymbols(moments, program.signals, [*names, *extra], layout)
    objective = Objective.of(run, cost, limits)
    trials = LoopRuns(loop, start, parameters, variables, moments, config, seed)
    search = _Search(trials, objective, variables, extra)
    with ending_signals(search.interrupt, in_callbacks=True):
        solution = solve(search.problem, search.start, iterations)
    return search.optimum(context, solution)


class _Search:
    """The runs of an optimization: their values, their derivatives, and the best run.

    IPOPT's variables, cost and limits are scaled by their sizes.

    Attributes:
        start: The scaled initial guess, shape (n,).
        problem: The scaled problem for IPOPT.
        interrupted: The signal that ends the search.

    Args:
        trials: The runs.
        objective: Cost and limits.
        variables: The variables of the loop.
        extra: Name -> initial guess of the further variables of cost and limits.
    """

    def __init__(
        self,
        trials: LoopRuns,
        objective: Objective,
        variables: list[Variable],
        extra: Mapping[str, float],
    ) -> None:
        self._trials, self._objective, self._variables = trials, objective, variables
        self._extra = list(extra)
        every = [*variables, *(Variable(name, start=value) for name, value in extra.items())]
        self._sizes = np.array([variable.size for variable in every])
        self._bounds = [np.array([getattr(v, name) for v in every]) for name in ("low", "high")]
        self._limit_sizes = limit_sizes(objective.low, objective.high)
        self._tangents = objective.tangents(len(every))
        self.interrupted: signal.Signals | None = None
        self._last_run: tuple[bytes, FloatArray, Rollout] | None = None
        self._last_slopes: tuple[bytes, FloatArray] | None = None
        self._best: tuple[float, float, FloatArray] | None = None
        guess = np.array([variable.start for variable in every])
        self._first_cost = self._checked_values(guess)[0]
        slopes, self._idle = self._checked_slopes(guess)
        cost_size = np.abs(slopes[0] * self._sizes).max() or 1.0
        self._scales = np.concatenate([[cost_size], self._limit_sizes])
        self.start = guess / self._sizes
        low, high = (bounds / self._sizes for bounds in self._bounds)
        low[self._idle] = high[self._idle] = self.start[self._idle]
        self.problem = IpoptProblem(
            self._scaled_values,
            self._scaled_slopes,
            low,
            high,
            objective.low / self._limit_sizes,
            objective.high / self._limit_sizes,
            lambda: self.interrupted is not None,
        )

    def interrupt(self, number: signal.Signals) -> None:
        """Stores the first signal, which ends the search."""
        self.interrupted = self.interrupted or number

    def _checked_values(self, guess: FloatArray) -> FloatArray:
        """Cost and limits of the initial guess; raises if they are not finite."""
        values, run = self._evaluated(guess)
        if run.failure is not None:
            raise run.failure
        if not np.isfinite(values).all():
            names = np.repeat(self._objective.names, self._objective.sizes)
            labels = ["the cost", *(f"limit '{name}'" for name in names)]
            wrong = labels[int(np.argmin(np.isfinite(values)))]
            raise ModelError(f"{wrong} is not finite at the initial guess")
        return values

    def _checked_slopes(self, guess: FloatArray) -> tuple[FloatArray, list[int]]:
        """The derivatives at the initial guess, and the indices of variables without effect."""
        changes = self._changes(guess)
        if not any(self._objective.reads(changes, only_cost=True)):
            names = listed([variable.name for variable in self._variables] + self._extra)[1:-1]
            raise ModelError(f"the cost does not depend on what is free: {names}")
        reads = self._objective.reads(changes, only_cost=False)
        slopes = self._slopes_from(guess, changes)
        if not np.isfinite(slopes).all():
            raise ModelError(
                "cost or limits have no finite derivatives at the initial guess, for example a "
                "square root at 0"
            )
        return slopes, [i for i, read in enumerate(reads) if not read]

    def _evaluated(self, values: FloatArray) -> tuple[FloatArray, Rollout]:
        """Cost and limits, nan if the run fails, and the run."""
        key = values.tobytes()
        if self._last_run is None or self._last_run[0] != key:
            run = self._trials.run(values[: len(self._variables)])
            results = np.full(1 + self._objective.values.numel(), np.nan)
            if run.failure is None:
                signals = [run.record[name] for name in self._objective.signals]
                results = self._objective.evaluate(values, *signals).full()[:, 0]
            self._last_run = key, results, run
            self._update_best(values, results)
        return self._last_run[1:]

    def _update_best(self, values: FloatArray, results: FloatArray) -> None:
        """The best run has the least cost if it meets all limits, otherwise the least violation."""
        if not np.isfinite(results).all():
            return
        objective, limited = self._objective, results[1:]
        beyond = np.maximum(objective.low - limited, limited - objective.high) / self._limit_sizes
        worst = max(0.0, float(beyond.max(initial=0.0)))
        rank = (worst if worst > MET else 0.0), float(results[0])
        if self._best is None or rank < self._best[:2]:
            self._best = *rank, values.copy()

    def _changes(self, values: FloatArray) -> dict[str, FloatArray]:
        """The derivatives of the signals by all variables, shapes (n, j, k)."""
        changes = self._trials.changes(values[: len(self._variables)], self._objective.signals)
        return {
            name: np.concatenate([of_loop, np.zeros((len(self._extra), *of_loop.shape[1:]))])
            for name, of_loop in changes.items()
        }

    def _slopes_from(self, values: FloatArray, changes: Mapping[str, FloatArray]) -> FloatArray:
        """The derivatives of cost and limits, from those of the signals."""
        _, run = self._evaluated(values)
        signals = [run.record[name] for name in self._objective.signals]
        stacked = [np.hstack([*changes[name]]) for name in self._objective.signals]
        return self._tangents(values, *signals, np.eye(values.size), *stacked).full()

    def _scaled_values(self, x: FloatArray) -> FloatArray:
        return self._evaluated(x * self._sizes)[0] / self._scales

    def _scaled_slopes(self, x: FloatArray) -> FloatArray:
        # IPOPT requests the derivatives of the cost and of the limits in two calls.
        if self._last_slopes is None or self._last_slopes[0] != x.tobytes():
            values = x * self._sizes
            slopes = self._slopes_from(values, self._changes(values))
            self._last_slopes = x.tobytes(), slopes * self._sizes / self._scales[:, None]
        return self._last_slopes[1]

    def optimum(self, context: Context, solution: IpoptResult) -> Optimum:
        """The result of the search: IPOPT's solution if it converged, otherwise the best run."""
        assert self._best is not None
        converged = solution.converged and self.interrupted is None
        values = np.clip(solution.x * self._sizes, *self._bounds) if converged else self._best[2]
        results, run = self._evaluated(values)
        count, objective = len(self._variables), self._objective
        return Optimum(
            self._trials.context_with(values[:count], context),
            run,
            tuple(self._variables),
            self._trials.projected_values(values[:count]),
            dict(zip(self._extra, values[count:].tolist(), strict=True)),
            float(self._first_cost),
            float(results[0]),
            limit_states(objective, results[1:]),
            solution.iterations,
            self._trials.made,
            converged,
            solution.status,
            tuple(self._variables[i].name for i in self._idle if i < count),
            self.interrupted,
        )
