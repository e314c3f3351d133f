"""Numbers of a loop with the least cost within limits, by the exact gradient of its run."""

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
    """The numbers of a loop with the least cost of its run, within limits.

    It solves min J(p, record(p)) subject to low <= p <= high and the limits, by IPOPT, where the
    record is that of `rollout`. Derivatives of the record are exact: those of the steps taken.
    Cost and limits are CasADi expressions of the record:

        found = optimize(
            loop, context, times, {"gains.tool.z": (1.0, 400.0)},
            cost=lambda run: casadi.sumsqr(run["tracking_error", "tool.z"]),
            limits=lambda run: {"torque": (-90.0, run["control"], 90.0)},
            config=config,
        )

    Args:
        loop: The closed loop, or any diagram that `rollout` takes.
        context: Its context at the start, with the values to begin with.
        times: When the record has rows, in s, from the start to the end, shape (j,). Cost and
            limits see these rows alone.
        free: Name -> least and largest value, None for no bound, of parameters of the context:
            "link1.mass", "wall.position[0]" for one entry, "gains.tool.z" for the gains of an
            output, parameters of references by their names, and "start.joint1" for an entry of the
            plant's state. A number that plant and law both have is changed in both;
            "plant.link1.mass" and "law.link1.mass" change it in one. A start is brought to N*,
            after which its entries may be slightly beyond their bounds.
        cost: Takes the run as `RunSymbols`, returns the cost, one number.
        limits: Takes it likewise, returns name -> (least value, expression, largest value), None
            for no bound; an expression may have many entries. None for no limits.
        more: Name -> first value of variables that cost and limits have beside the loop, such as a
            peak to be made small.
        config: Drake's settings, with fixed steps.
        seed: The seed of the noise, as of `rollout`.
        iterations: At most so many iterations.

    Returns:
        The best numbers, whether they are a local optimum, and a context with them. After Ctrl-C it
        is the best so far, and `interrupted` names the signal.

    Raises:
        ModelError: A name is unknown, bounds or limits make no sense, the cost is no expression or
            depends on no variable, or the run has no derivatives, as with error control, impacts
            and openings.
        InconsistentStateError: The start is not on N* and cannot be brought there.
        SimulationError: The run with the values to begin with fails.
    """
    check_whole_number("iterations", iterations, 1)
    program, moments = program_of(loop), checked_times(times)
    start, parameters = start_values(loop, context)
    variables = chosen_variables(program.compiled, start, parameters, free)
    extra = {name: number(f"'{name}' of more", value) for name, value in (more or {}).items()}
    names = [one.name for one in variables]
    if doubles := set(names) & set(extra):
        raise ModelError(f"'{min(doubles)}' of more is a number of the loop; give it another name")
    layout = None
    if not isinstance(loop, Diagram) and loop.generator is not None:
        layout = loop.controller.law.layout
    run = RunSymbols(moments, program.signals, [*names, *extra], layout)
    asked = Objective.of(run, cost, limits)
    trials = LoopRuns(loop, start, parameters, variables, moments, config, seed)
    search = _Search(trials, asked, variables, extra)
    with ending_signals(search.hear, in_callbacks=True):
        ended = solve(search.problem, search.start, iterations)
    return search.optimum(context, ended)


class _Search:
    """The values, derivatives and the best of the runs of an optimization.

    IPOPT has variables, cost and limits over their sizes.

    Attributes:
        start: The variables over their sizes to begin with, shape (n,).
        interrupted: The signal that ends the search.

    Args:
        trials: The runs.
        asked: Cost and limits.
        variables: The variables of the loop.
        extra: Those of cost and limits alone.
    """

    def __init__(
        self,
        trials: LoopRuns,
        asked: Objective,
        variables: list[Variable],
        extra: Mapping[str, float],
    ) -> None:
        self._trials, self._asked, self._variables = trials, asked, variables
        self._extra = dict(extra)
        more = [Variable(name, start=value) for name, value in extra.items()]
        both = [*variables, *more]
        self._sizes = np.array([one.size for one in both])
        self._bounds = [np.array([getattr(one, n) for one in both]) for n in ("low", "high")]
        self._limit_sizes = limit_sizes(asked.low, asked.high)
        self._tangents = asked.tangents(len(both))
        self.interrupted: signal.Signals | None = None
        self._known: tuple[bytes, FloatArray, Rollout] | None = None
        self._last: tuple[bytes, FloatArray] | None = None
        begin = np.array([one.start for one in both])
        self._best: tuple[float, float, FloatArray] | None = None
        self._cost_size = 1.0
        values = self._begin(begin)
        self._first = values[0]
        slopes, self._idle = self._check(begin)
        largest = np.abs(slopes[0] * self._sizes).max()
        self._cost_size = largest if largest > 0.0 else 1.0
        self.start = begin / self._sizes
        low, high = (each / self._sizes for each in self._bounds)
        for place in self._idle:
            low[place] = high[place] = self.start[place]
        self.problem = IpoptProblem(
            self._values,
            self._slopes,
            low,
            high,
            asked.low / self._limit_sizes,
            asked.high / self._limit_sizes,
            lambda: self.interrupted is not None,
        )

    def hear(self, number: signal.Signals) -> None:
        """Remembers the signal that ends the search."""
        self.interrupted = self.interrupted or number

    def _begin(self, begin: FloatArray) -> FloatArray:
        values, run = self._asked_at(begin)
        if run.failure is not None:
            raise run.failure
        if not np.isfinite(values).all():
            names = ["the cost", *np.repeat(self._asked.names, self._asked.sizes)]
            wrong = names[int(np.argmin(np.isfinite(values)))]
            what = wrong if wrong == "the cost" else f"limit '{wrong}'"
            raise ModelError(f"{what} is not finite with the values to begin with")
        return values

    def _check(self, begin: FloatArray) -> tuple[FloatArray, list[int]]:
        """The derivatives at the beginning, and the variables without effect."""
        changes = self._changes(begin)
        if not any(self._asked.reads(changes, only_cost=True)):
            names = listed([one.name for one in self._variables] + [*self._extra])[1:-1]
            raise ModelError(f"the cost does not depend on what is free: {names}")
        reads = self._asked.reads(changes, only_cost=False)
        slopes = self._slopes_from(begin, changes)
        if not np.isfinite(slopes).all():
            raise ModelError(
                "cost or limits have no finite derivatives with the values to begin with, as of "
                "the root of a number that is 0"
            )
        return slopes, [i for i, read in enumerate(reads) if not read]

    def _asked_at(self, values: FloatArray) -> tuple[FloatArray, Rollout]:
        """Cost and limits, not finite where the run fails."""
        key = values.tobytes()
        if self._known is None or self._known[0] != key:
            run = self._trials.run(values[: len(self._variables)])
            found = np.full(1 + self._asked.values.numel(), np.nan)
            if run.failure is None:
                signals = [run.record[name] for name in self._asked.signals]
                found = self._asked.evaluate(values, *signals).full()[:, 0]
            self._known = key, found, run
            self._remember(values, found)
        return self._known[1], self._known[2]

    def _remember(self, values: FloatArray, found: FloatArray) -> None:
        """Keeps the best: the least cost where limits are met, or else the least violation."""
        if not np.isfinite(found).all():
            return
        asked = self._asked
        beyond = np.maximum(asked.low - found[1:], found[1:] - asked.high) / self._limit_sizes
        worst = max(0.0, float(beyond.max(initial=0.0)))
        rank = (worst if worst > MET else 0.0), float(found[0])
        if self._best is None or rank < self._best[:2]:
            self._best = *rank, values.copy()

    def _changes(self, values: FloatArray) -> dict[str, FloatArray]:
        """How the signals change with all variables, shapes (n, j, k)."""
        count = len(self._variables)
        found = self._trials.changes(values[:count], self._asked.signals)
        none = len(self._extra)
        return {
            name: np.concatenate([each, np.zeros((none, *each.shape[1:]))])
            for name, each in found.items()
        }

    def _slopes_from(self, values: FloatArray, changes: Mapping[str, FloatArray]) -> FloatArray:
        _, run = self._asked_at(values)
        signals = [run.record[name] for name in self._asked.signals]
        stacked = [np.hstack([*changes[name]]) for name in self._asked.signals]
        return self._tangents(values, *signals, np.eye(values.size), *stacked).full()

    def _values(self, x: FloatArray) -> FloatArray:
        found, _ = self._asked_at(x * self._sizes)
        return found / self._scales

    def _slopes(self, x: FloatArray) -> FloatArray:
        # IPOPT asks for those of cost and limits one after the other.
        if self._last is None or self._last[0] != x.tobytes():
            values = x * self._sizes
            found = self._slopes_from(values, self._changes(values))
            self._last = x.tobytes(), found * self._sizes / self._scales[:, None]
        return self._last[1]

    @property
    def _scales(self) -> FloatArray:
        return np.concatenate([[self._cost_size], self._limit_sizes])

    def optimum(self, context: Context, ended: IpoptResult) -> Optimum:
        """The result."""
        assert self._best is not None
        values = np.clip(ended.x * self._sizes, *self._bounds)
        converged = ended.converged and self.interrupted is None
        if not converged:
            values = self._best[2]
        found, run = self._asked_at(values)
        count, asked = len(self._variables), self._asked
        return Optimum(
            self._trials.put(values[:count], context),
            run,
            tuple(self._variables),
            self._trials.shown(values[:count]),
            dict(zip(self._extra, values[count:].tolist(), strict=True)),
            float(self._first),
            float(found[0]),
            limit_states(asked.names, asked.sizes, found[1:], asked.low, asked.high),
            ended.iterations,
            self._trials.made,
            converged,
            ended.status,
            tuple(self._variables[i].name for i in self._idle if i < count),
            self.interrupted,
        )
