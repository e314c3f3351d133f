"""How far the noise of sensors spreads the signals of a sampled loop, to first order."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike
from pydrake.common import RandomDistribution
from pydrake.systems.analysis import SimulatorConfig
from pydrake.systems.framework import Diagram

from drake_dae.arguments import checked
from drake_dae.arrays import FloatArray, unknown_name
from drake_dae.diagrams.closed_loop import ClosedLoop
from drake_dae.errors import ModelError
from drake_dae.running.rollout.asked import RolloutRequest
from drake_dae.running.rollout.events import distribution_of
from drake_dae.running.rollout.problems import problems_of
from drake_dae.running.rollout.run import Run, RunEnding, RunProblem, Settings
from drake_dae.running.rollout.spread.recursion import after, of_signals, reached
from drake_dae.running.rollout.spread.waves import RoundedPositions, Rounding
from drake_dae.running.rollout.stepping.functions import DiagramFunctions, functions_of
from drake_dae.running.rollout.stepping.interpreted import run

_CHANGE, _LEAST = 1e-6, 1e-2
"""The change of a value for a difference, relative to its size, of which the least is 0.01."""

_OF_NOISE = 1e-3
"""The change of a random number for a difference, relative to its deviation."""

_MOMENTS = {
    RandomDistribution.kUniform: (0.5, 12.0**-0.5),
    RandomDistribution.kGaussian: (0.0, 1.0),
    RandomDistribution.kExponential: (1.0, 1.0),
}
"""Mean and deviation of the numbers of a RandomSource."""

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
    n_k + D n_(k+1). A, B, C and D are differences of the step at each time of interest, and until
    then the same since the time before: so there should be several during a motion. What rounds
    has no slope: of the resolution of encoders nothing is counted (`drake-dae analyze` does).

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
    if isinstance(loop, ClosedLoop) and (loop.link is not None or loop.packets is not None):
        raise ModelError(
            f"{loop.plant.get_name()} has no spread by noise: controls or measurements come late "
            "or are lost at random, which has no slope; run it with several seeds instead"
        )
    begun = 0.0 if config is None else config.start_time
    request = RolloutRequest.of(loop, np.append(begun, np.ravel(times)), config, None, None)
    program, compiled = request.program, request.program.compiled
    if compiled.changes or compiled.has_stepped:
        raise ModelError(
            f"{program.name} has no spread by noise: a block changes at times that a run locates, "
            "as at impacts and openings, or Drake steps it"
        )
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
        self._state, self._held, self._index = problem.state, problem.held, 0
        self._begun, self._quiet = problem.times[0], np.zeros_like(problem.noise)
        self._deviations = np.zeros(problem.noise.shape[1])
        for source, part in functions.program.compiled.noise:
            mean, deviation = _MOMENTS[distribution_of(source)]
            self._quiet[:, part], self._deviations[part] = mean, deviation
        size = problem.state.size + problem.held.size
        self._spread = np.zeros((size, size))
        self._rounded = None
        if rounding is not None:
            self._rounded = RoundedPositions(functions.program, rounding, size)

    def at(self, time: float) -> tuple[float, FloatArray, FloatArray]:
        """The time of a period, and the deviations of all signals and of their changes there."""
        # The signals are those at the end of the period that begins here.
        index = max(round((time - self._begun) / self._period), 1) - 1
        since = index - self._index
        middles = self._index + 0.5 + np.arange(since + 1)
        passed = []
        if since:
            done = self._run(np.array([self._index, *middles[:-1], index]))
            passed.append(done.rows[1:-1])
            self._state, self._held, self._index = done.state, done.held, index
        of_state, of_noise = self._slopes()
        size = self._state.size + self._held.size
        (a, c), (b, d) = np.split(of_state, [size]), np.split(of_noise, [size])
        # Without these, differences of counters would count, which no noise reaches.
        reached_by_noise = reached(a, b)
        a[:, ~reached_by_noise] = c[:, ~reached_by_noise] = 0.0
        a[~reached_by_noise] = 0.0
        self._spread = after(a, b @ b.T, since, self._spread)
        whole, change = of_signals((a, b, c, d), self._spread)
        if self._rounded is not None:
            passed.append(self._run(np.array([index, middles[-1], index + 1])).rows[1:-1])
            whole, change = self._rounded.after((a, b, c, d), np.vstack(passed), whole)
        return (
            self._begun + (index + 1) * self._period,
            np.sqrt(np.maximum(whole, 0.0)),
            np.sqrt(np.maximum(change, 0.0)),
        )

    def _run(
        self, times: FloatArray, change: FloatArray | None = None, noise: FloatArray | None = None
    ) -> Run:
        """Runs from here, with a change of state and held values, and with noise.

        Args:
            times: The times of its rows in periods, from this one to another.
            change, noise: The changes; None for none.
        """
        state, held = self._state, self._held
        part = self._updates(times[-1])
        if change is not None:
            state, held = state + change[: state.size], held + change[state.size :]
        problem = replace(
            self._problem,
            times=self._begun + self._period * times,
            state=state,
            held=held,
            events=self._problem.events[part],
            due=self._problem.due[part],
            noise=self._quiet[part] if noise is None else self._quiet[part] + noise,
        )
        done = run(self._functions, self._settings, problem)
        if done.ending != RunEnding.DONE:
            raise ModelError(
                f"{self._functions.program.name} has no spread by noise: its run without noise "
                f"ends at {done.time:.6g} s"
            )
        return done

    def _updates(self, last: float) -> slice:
        """The updates from here to a period, which may be at times that differ by round-off."""
        ends = self._begun + self._period * (np.array([self._index, last]) - SAME)
        return slice(*np.searchsorted(self._problem.events, ends).tolist())

    def _slopes(self) -> tuple[FloatArray, FloatArray]:
        """The slopes of states, held values and signals after a period, by both and by noise."""
        values = np.concatenate([self._state, self._held])
        sizes = _CHANGE * np.maximum(np.abs(values), _LEAST)
        period = np.array([self._index, self._index + 1.0])

        def column(change: FloatArray | None, noise: FloatArray | None) -> FloatArray:
            done = self._run(period, change, noise)
            return np.concatenate([done.state, done.held, done.rows[-1]])

        drawn = self._quiet[self._updates(self._index + 1)].shape
        count = int(np.prod(drawn))
        by_values = [
            (column(change, None) - column(-change, None)) / (2.0 * size)
            for change, size in zip(np.diag(sizes), sizes, strict=True)
        ]
        by_noise = [
            (column(None, noise) - column(None, -noise)) / (2.0 * _OF_NOISE)
            for one in np.eye(count)
            for noise in [_OF_NOISE * self._deviations * one.reshape(drawn)]
        ]
        rows = values.size + self._functions.program.width
        return np.array(by_values).T, np.array(by_noise).T.reshape(rows, count)


def _divides(part: float, period: float) -> bool:
    return abs(period / part - round(period / part)) < SAME
