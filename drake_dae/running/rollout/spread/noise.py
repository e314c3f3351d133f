"""How far the noise of sensors spreads the signals of a sampled loop, to first order."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from pydrake.systems.analysis import SimulatorConfig
from pydrake.systems.framework import Diagram

from drake_dae.arguments import checked
from drake_dae.arrays import FloatArray, unknown_name
from drake_dae.diagrams.closed_loop import ClosedLoop
from drake_dae.errors import ModelError
from drake_dae.running.rollout.asked import RolloutRequest
from drake_dae.running.rollout.events import moments_of
from drake_dae.running.rollout.problems import problems_of
from drake_dae.running.rollout.program import RolloutProgram
from drake_dae.running.rollout.run import Run, RunProblem, Settings
from drake_dae.running.rollout.spread.recursion import Step, of_signals, passed, reached
from drake_dae.running.rollout.spread.rounding import RoundedRuns, Rounding
from drake_dae.running.rollout.spread.slopes import PeriodSlopes, undisturbed
from drake_dae.running.rollout.stepping.functions import DiagramFunctions, functions_of

_OTHERWISE, _SHORTEST = 0.5, 12
"""Between times by whose slopes a deviation differs by more than 50 %, there is another time,
unless they are at most 12 periods apart."""

SAME = 1e-6
"""Times that differ by less than this fraction of a period are the same."""


@dataclass(frozen=True, eq=False)
class NoiseSpread:
    """The standard deviations of the signals of a loop by noise.

    Attributes:
        times: The times of the samples in s, shape (k,).
        deviations: Name of a signal -> the deviations of its entries, shape (k, entries).
        changes: The same of their changes from one sample to the next.
    """

    times: FloatArray
    deviations: Mapping[str, FloatArray]
    changes: Mapping[str, FloatArray]

    def rms(self, name: str) -> FloatArray:
        """The root mean square of the deviations of a signal over the times, shape (entries,).

        Raises:
            ModelError: There is no such signal.
        """
        rms: FloatArray = np.sqrt(np.mean(np.square(_of(self.deviations, name)), axis=0))
        return rms

    def roughness(self, name: str) -> float:
        """The root mean square length of the change of a signal from one sample to the next.

        Raises:
            ModelError: There is no such signal.
        """
        return float(np.sqrt(np.mean(np.sum(np.square(_of(self.changes, name)), axis=1))))


def _of(signals: Mapping[str, FloatArray], name: str) -> FloatArray:
    """The values of a signal."""
    if not isinstance(name, str) or name not in signals:
        raise ModelError(unknown_name("signal", name, list(signals)))
    return signals[name]


@checked(ModelError)
def noise_spread(
    loop: ClosedLoop | Diagram,
    start: ArrayLike,
    parameters: ArrayLike | None,
    times: ArrayLike,
    *,
    config: SimulatorConfig | None = None,
) -> NoiseSpread:
    """Predicts how far random numbers spread the signals of a sampled loop.

    The samples of all blocks repeat after T, the longest of their periods, in which random numbers
    are drawn: n_k as multiples of their deviations, from their means. From one period to the next
    all states z of the diagram become F(t_k, z_k, n_k), and its signals are G(t_k, z_k, n_k). About
    the run without noise, with all numbers at their means, a deviation moves, to first order, as

        dz_(k+1) = A dz_k + B n_k,    dy_k = C dz_k + D n_k,

    so that its covariance, zero at the start, and that of the signals are

        P_(k+1) = A P_k A^T + B B^T,    C P C^T + D D^T,

    and that of the change of the signals to the next period is that of (C A - C) dz_k + (C B - D)
    n_k + D n_(k+1). A, B, C and D are differences of the step at each time of interest, and at
    times between, where they change much; they hold for half of the way to the next time. What
    rounds has no slope: of the resolution of encoders nothing is counted (`drake-dae analyze`
    does).

    Args:
        loop: The closed loop, or a diagram of blocks that can be traced, as for `rollout`.
        start, parameters: As for `rollout`, of one run.
        times: The times of interest in s, shape (k,), increasing, the first after the start.
        config: As for `rollout`.

    Returns:
        The deviations at the periods next to these times.

    Raises:
        ModelError: Arguments have wrong shapes; samples do not repeat with the longest of their
            periods; signals are late or lost at random; blocks change at times that a run locates;
            Drake steps a block; or the run without noise ends early.
        InconsistentStateError: The start is not on N*.
    """
    return spread_with_rounding(loop, start, parameters, times, config, None)


def spread_with_rounding(
    loop: ClosedLoop | Diagram,
    start: ArrayLike,
    parameters: ArrayLike | None,
    times: ArrayLike,
    config: SimulatorConfig | None,
    rounding: Rounding | None,
) -> NoiseSpread:
    """`noise_spread` of a loop whose encoders round.

    Args:
        loop: The loop, whose encoders have `rounding.deviations` as noise instead.
        start, parameters, times, config: As for `noise_spread`.
        rounding: How they round; None if they do not.

    Raises:
        ModelError, InconsistentStateError: As for `noise_spread`.
    """
    begun = 0.0 if config is None else config.start_time
    request = RolloutRequest.of(loop, np.append(begun, np.ravel(times)), config, None, None)
    program = request.program
    check_smooth(loop, program)
    problems = problems_of(program, start, parameters, request.times, None)
    if len(problems) != 1:
        raise ModelError(f"the spread by noise is that of one run, got {len(problems)} starts")
    samples = _Samples(functions_of(program), request.settings, problems[0], rounding)
    found = [samples.at(time) for time in request.times[1:].tolist()]
    whole, changes = (np.array(part) for part in zip(*((d, c) for _, d, c in found), strict=True))
    stops = np.cumsum([0, *map(len, program.signals.values())])[:-1]

    def signals(values: FloatArray) -> Mapping[str, FloatArray]:
        return dict(zip(program.signals, np.split(values, stops[1:], axis=1), strict=True))

    return NoiseSpread(np.array([time for time, _, _ in found]), signals(whole), signals(changes))


def check_smooth(loop: ClosedLoop | Diagram, program: RolloutProgram) -> None:
    """Checks that noise has an effect to first order.

    Raises:
        ModelError: Signals are late or lost at random; blocks change at times that a run locates;
            or Drake steps a block.
    """
    if isinstance(loop, ClosedLoop) and (loop.link is not None or loop.packets is not None):
        raise ModelError(
            f"{loop.plant.get_name()} has no spread by noise: controls or measurements come late "
            "or are lost at random, which has no slope; run it with several seeds instead"
        )
    if program.compiled.changes or program.compiled.has_stepped:
        raise ModelError(
            f"{program.name} has no spread by noise: a block changes at times that a run locates, "
            "as at impacts and openings, or Drake steps it"
        )


class _Point(NamedTuple):
    """A period of a run.

    Attributes:
        state, held: The states where it begins.
        passed: The rows of signals where periods before it begin, if these are asked for.
        own: Those where it begins, where it ends, and a period later.
        step: Its A, B, C and D.
        read: The slopes of rounded positions before each of its updates.
    """

    state: FloatArray
    held: FloatArray
    passed: FloatArray
    own: FloatArray
    step: Step
    read: FloatArray


class _Samples:
    """The periods of the samples in a run without noise, one after the other."""

    def __init__(
        self,
        functions: DiagramFunctions,
        settings: Settings,
        problem: RunProblem,
        rounding: Rounding | None,
    ) -> None:
        periods = [rate.period for rate in functions.program.compiled.rates]
        self._period = max(periods, default=0.0)
        if not periods or any(not _divides(each, self._period) for each in periods):
            raise ModelError(
                f"{functions.program.name} has no spread by noise: that needs samples that repeat "
                "with the longest of their periods"
            )
        self._functions, self._settings, self._problem = functions, settings, problem
        self._index = 0
        means, self._deviations = moments_of(functions.program.compiled)
        self._begun, self._quiet = problem.times[0], np.zeros_like(problem.noise) + means
        size = problem.state.size + problem.held.size
        self._spread = np.zeros((size, size))
        self._rounded = None
        if rounding is not None:
            self._rounded = RoundedRuns(functions.program, rounding, size)
        self._points: dict[int, _Point] = {}
        width = sum(map(len, functions.program.signals.values()))
        self._points[0] = self._point(problem.state, problem.held, 0, np.zeros((0, width)))

    def at(self, time: float) -> tuple[float, FloatArray, FloatArray]:
        """The time of a period, and the deviations of all signals and of their changes there."""
        # The signals are those at the end of the period that begins here.
        index = max(round((time - self._begun) / self._period), 1) - 1
        whole, change = self._go_on(index)
        return (
            self._begun + (index + 1) * self._period,
            np.sqrt(np.maximum(whole, 0.0)),
            np.sqrt(np.maximum(change, 0.0)),
        )

    def _go_on(self, index: int) -> tuple[FloatArray, FloatArray]:
        """Goes on to a period; the variances of the signals and of their changes there."""
        begun, since = self._index, index - self._index
        if index not in self._points:
            times = np.linspace(begun, index, since + 1 if self._rounded is not None else 2)
            done = self._run(begun, times)
            self._points[index] = self._point(done.state, done.held, index, done.rows[:-1])
        first, last = self._points[begun], self._points[index]
        if since > _SHORTEST and self._differ(first.step, last.step, since):
            self._go_on(begun + since // 2)
            return self._go_on(index)
        self._index = index
        for before in [each for each in self._points if each < index]:
            del self._points[before]
        self._spread = passed(first.step, last.step, since, self._spread)
        whole, change = of_signals(last.step, self._spread)
        if self._rounded is not None:
            rows = np.vstack([last.passed[len(last.passed) - since :], last.own])
            steps, read = (first.step, last.step), (first.read, last.read)
            whole, change = self._rounded.after(steps, read, rows, self._moments(index))
        return whole, change

    def _differ(self, first: Step, last: Step, since: int) -> bool:
        """Whether signals spread otherwise by periods like the first than like the last."""
        # Where slopes of a moment make deviations grow for longer, they are beyond all numbers.
        with np.errstate(over="ignore", invalid="ignore"):
            by_each = (
                of_signals(last, passed(each, each, since, self._spread))[0]
                for each in (first, last)
            )
            less, more = np.sort(np.sqrt(np.maximum(list(by_each), 0.0)), axis=0)
        return not bool(np.all(more <= (1.0 + _OTHERWISE) * less))

    def _point(
        self, state: FloatArray, held: FloatArray, index: int, passed: FloatArray
    ) -> "_Point":
        """A period, with the rows where those before it begin."""
        none = np.zeros((0, 0))
        self._points[index] = _Point(state, held, passed, none, (none,) * 4, none)
        period = self._problem_of(index, np.array([index, index + 1.0]))
        positions = None if self._rounded is None else self._rounded.positions
        slopes = PeriodSlopes(self._functions, self._settings, period, self._deviations, positions)
        a, b, c, d = slopes.step()
        # Without these, differences of counters would count, which no noise reaches.
        reached_by_noise = reached(a, b)
        a[:, ~reached_by_noise] = c[:, ~reached_by_noise] = 0.0
        a[~reached_by_noise] = 0.0
        own = none
        if self._rounded is not None:
            own = self._run(index, index + np.arange(3.0)).rows
        return _Point(state, held, passed, own, (a, b, c, d), np.array(slopes.read))

    def _moments(self, index: int) -> FloatArray:
        """When the updates of a period are due, as parts of it."""
        events = self._problem.events[self._updates(index, index + 1.0)]
        return (events - self._begun) / self._period - index

    def _problem_of(self, index: int, times: FloatArray) -> RunProblem:
        """The run from a period without noise, with rows at these times in periods."""
        point, part = self._points[index], self._updates(index, times[-1])
        return replace(
            self._problem,
            times=self._begun + self._period * times,
            state=point.state,
            held=point.held,
            events=self._problem.events[part],
            due=self._problem.due[part],
            noise=self._quiet[part],
        )

    def _run(self, index: int, times: FloatArray) -> Run:
        return undisturbed(self._functions, self._settings, self._problem_of(index, times))

    def _updates(self, first: int, last: float) -> slice:
        """The updates from a period to another, which may be at times that differ by round-off."""
        ends = self._begun + self._period * (np.array([first, last]) - SAME)
        return slice(*np.searchsorted(self._problem.events, ends).tolist())


def _divides(part: float, period: float) -> bool:
    return abs(period / part - round(period / part)) < SAME
