"""Optimal excitation: motions and forces whose records determine parameters best."""

import sys
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from typing import Any

import numpy as np
from scipy.optimize import minimize
from tqdm import tqdm

from drake_dae.arguments import checked
from drake_dae.arrays import FloatArray, check_whole_number, listed, unknown_name, vector
from drake_dae.errors import ModelError
from drake_dae.scenario.files import varied_data
from drake_dae.scenario.model import complete_scenario
from drake_dae.scenario.scenario import Scenario, read_scenario, scenario_data
from drake_dae.simulation.records.interruption import Interruption, ending_signals
from drake_dae.studies.excitation.excitation import Excitation
from drake_dae.studies.excitation.promised import Criterion, ScenarioRun, ScenarioRuns

SPREAD = 0.4
"""The fraction of runs that are spread over the ranges; a local search uses the other runs."""

FIRST_STEP = 0.25
"""The first steps of the local search, relative to the ranges."""

CLOSE = 1e-2
"""The local search restarts when its steps are shorter than this, relative to the ranges."""

REFUSED = 1e3
"""The cost of a run for each of its problems, larger than the cost of any run without problems."""

NOISY = ("position", "force")
"""The measurements whose noise can be set."""


class _SearchEnded(Exception):
    """All runs were made, or a signal ends the search."""


@checked(ModelError)
def excite(
    scenario: Scenario,
    ranges: Mapping[str, tuple[float, float]],
    free: Sequence[str],
    *,
    noise: Mapping[str, float] | None = None,
    criterion: Criterion = "D",
    runs: int = 100,
    seed: int = 0,
    progress: bool = False,
) -> Excitation:
    """Searches for a motion and a force, within limits, that determine parameters of a plant best.

    The values of each trial are simulated by a rollout of the scenario. The information of its
    record about the parameters theta is the Fisher information of `identify`, with an unknown
    initial state:

        F = sum T^T T,    T = d(computed - measured)/dtheta / noise,

    with exact derivatives along the motion. With the diagonal matrix S of the parameters' sizes,
    the covariance of the relative parameters is C = S^-1 F^-1 S^-1. The search minimizes det(C)
    ("D") or tr(C) ("A"): first over values that are spread over the ranges, then by the simplex
    method of Nelder and Mead from the best of these. A run is refused if it exceeds a limit of a
    joint or actuator, loses a contact, has a link behind a surface or in another link, or ends
    early.

    Args:
        scenario: A scenario from `load_scenario`. Its plant has the expected values of the
            parameters. Drake's own point contact is replaced by !CompliantContact.
        ranges: Dotted key -> (least, largest) value, such as
            {"references.tool.z.amplitudes.0": (0.1, 0.3)}.
        free: The names of the parameters, as in `identify`.
        noise: "position" (rad or m) and "force" (N) -> the standard deviation of each row. It
            replaces the noise in the settings of encoders and force sensor.
        criterion: "D" for the volume of the ellipsoid, "A" for the sum of squared deviations.
        runs: The number of runs, in addition to the run of the unchanged scenario.
        seed: The seed of the spread values.
        progress: Shows a bar if stderr is a terminal.

    Returns:
        The best choice. After Ctrl-C it is the best so far, and `interrupted` is the signal.

    Raises:
        ModelError: A name is no parameter, a range is empty, a noise is unknown, or no run keeps
            the limits.
        ScenarioError: The scenario has no such key, or the key does not accept the value.

    Source: Atkinson, Donev and Tobias, Optimum Experimental Designs, with SAS, 2007; Swevers et
    al., Optimal robot excitation and identification, IEEE Trans. Robotics and Automation 13, 1997.
    """
    check_whole_number("runs", runs, 1)
    check_whole_number("seed", seed, 0)
    low, high = _ends(ranges)
    completed = complete_scenario(scenario).scenario
    trials = ScenarioRuns(completed, free, _checked_noise(noise or {}))
    keys = list(ranges)
    for ends in (low, high):
        trials.check(dict(zip(keys, ends.tolist(), strict=True)))
    before = trials.run({}, judge_all=True)
    if before.promised is None:
        (kind, text), *_ = before.problems.items()
        raise ModelError(f"the scenario itself {kind}: {text}")
    best = _BestRuns(trials, criterion, keys, (low, high), runs, before)
    bar = tqdm(total=runs, unit="run", disable=not (progress and sys.stderr.isatty()))
    with bar, ending_signals(best.interruption), suppress(_SearchEnded):
        _search(lambda point: best.cost(point, bar), len(keys), runs, seed)
    if best.trial.problems or best.trial.promised is None:
        raise ModelError(
            f"no run of {best.made} keeps all limits ({_most(best.refused)}); give other "
            "ranges, or a scenario that keeps them"
        )
    return Excitation(
        read_scenario(varied_data(scenario_data(completed), best.choice)),
        best.choice,
        before.promised,
        best.trial.promised,
        criterion,
        best.made,
        dict(best.refused),
        tuple(before.problems.values()),
        best.interruption.signal,
    )


class _BestRuns:
    """The trials of a search, and the best of them.

    Attributes:
        trial: The best run.
        choice: The values of the best run; empty for the unchanged scenario.
        made: The number of runs so far.
        refused: Kind of problem -> number of runs.
        interruption: The signal that ends the search.

    Args:
        trials: The runs of the scenario.
        criterion: "D" or "A".
        keys: The keys that vary.
        ends: The least and the largest values of the keys.
        runs: The largest number of runs.
        before: The run of the unchanged scenario.
    """

    def __init__(
        self,
        trials: ScenarioRuns,
        criterion: Criterion,
        keys: Sequence[str],
        ends: tuple[FloatArray, FloatArray],
        runs: int,
        before: ScenarioRun,
    ) -> None:
        self._trials, self._criterion, self._keys = trials, criterion, keys
        self._ends, self._runs = ends, runs
        self.trial, self.choice = before, dict[str, float]()
        self._least = _cost(before, criterion)
        self.made, self.refused, self.interruption = 0, Counter[str](), Interruption()

    def cost(self, point: FloatArray, bar: Any) -> float:
        """The cost of the run at a point of the unit cube.

        Raises:
            _SearchEnded: All runs were made, or a signal ends the search.
        """
        if self.made >= self._runs or self.interruption.signal is not None:
            raise _SearchEnded
        low, high = self._ends
        values = np.clip(low + point * (high - low), low, high)
        changes = dict(zip(self._keys, values.tolist(), strict=True))
        trial = self._trials.run(changes)
        self.made += 1
        bar.update()
        self.refused.update(trial.problems.keys())
        cost = _cost(trial, self._criterion)
        if cost < self._least:
            self.trial, self.choice, self._least = trial, changes, cost
        return cost


def _search(cost: Callable[[FloatArray], float], count: int, runs: int, seed: int) -> None:
    """Minimizes a cost over the unit cube until the cost raises `_SearchEnded`."""
    random = np.random.default_rng(seed)
    first = max(1, round(SPREAD * runs))
    # A Latin hypercube: each coordinate has one value in each of as many even intervals.
    order = np.array([random.permutation(first) for _ in range(count)]).T
    points = (order + random.random((first, count))) / first
    costs = [cost(point) for point in points]
    point, step = points[int(np.argmin(costs))], FIRST_STEP
    while True:
        inward = np.where(point < 0.5, step, -step)
        simplex = np.vstack([point, point + np.diag(inward)])
        options = {"initial_simplex": simplex, "xatol": CLOSE, "fatol": np.inf, "maxfev": 10**6}
        bounds = count * [(0.0, 1.0)]
        best = minimize(cost, point, method="Nelder-Mead", bounds=bounds, options=options)
        point, step = best.x, FIRST_STEP * random.uniform(0.2, 1.0)


def _cost(trial: ScenarioRun, criterion: Criterion) -> float:
    """The logarithm of the criterion, or a larger number for a run with problems."""
    if trial.problems or trial.promised is None:
        return REFUSED * (1 + len(trial.problems))
    return float(np.log(trial.promised.size(criterion)))


def _ends(ranges: Mapping[str, tuple[float, float]]) -> tuple[FloatArray, FloatArray]:
    """The lower and the upper ends of ranges."""
    if not ranges:
        raise ModelError("ranges must have at least one key, such as start.errors.tool.z")
    for key, ends in ranges.items():
        low, high = vector(f"the range of {key}", ends, 2)
        if not (low < high and np.isfinite(high - low)):
            raise ModelError(
                f"the range of {key} must be a lower and a larger number, got {low:g} and {high:g}"
            )
    lows, highs = np.array([*ranges.values()], dtype=float).T
    return lows, highs


def _checked_noise(noise: Mapping[str, float]) -> Mapping[str, float]:
    for name, deviation in noise.items():
        if name not in NOISY:
            raise ModelError(unknown_name("noise of", name, NOISY))
        if not deviation > 0.0:
            raise ModelError(f"the noise of {name} must be positive, got {deviation:g}")
    return noise


def _most(refused: Counter[str]) -> str:
    return listed(f"{kind}: {count}" for kind, count in refused.most_common())[1:-1]
