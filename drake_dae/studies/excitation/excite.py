"""Motions and forces that determine parameters best."""

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
"""This part of the runs is spread over the ranges; the others go on from the best of them."""

FIRST_STEP = 0.25
"""The first steps from there, relative to the ranges."""

CLOSE = 1e-2
"""A search with steps shorter than this, relative to the ranges, begins again with longer ones."""

REFUSED = 1e3
"""What a run with a problem costs, and for each further one: more than any good one."""

NOISY = ("position", "force")
"""What a noise may be given for."""


class _SearchEnded(Exception):
    """The runs are spent, or a signal asks for the end."""


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
    """A motion and a force within limits that determine parameters of a plant best.

    Each choice of the values is a rollout of the scenario. What its record would say of the
    parameters theta is the Fisher information of `identify`, with the initial state unknown:

        F = sum T^T T,    T = d(computed - measured)/dtheta / noise,

    with exact derivatives along the motion. The covariance of the parameters over their sizes is
    C = S^-1 F^-1 S^-1, and the least det(C) (D) or tr(C) (A) is searched: first among values that
    are spread over the ranges, then from the best of these by the simplex of Nelder and Mead. Runs
    beyond a limit of a joint or a drive, that lose a contact, have a link behind a surface or in
    another one, or do not come to their end, are refused.

    Args:
        scenario: What `load_scenario` returns. Its plant has the values that the parameters are
            expected to have. Drake's own point contact is taken as !CompliantContact.
        ranges: Dotted key -> least and largest value, such as
            {"references.tool.z.amplitudes.0": (0.1, 0.3)}.
        free: As of `identify`.
        noise: "position" (rad or m) and "force" (N) -> the deviation of each row, in place of what
            encoders and force sensor state.
        criterion: "D" for the volume of the ellipsoid, "A" for the sum of squared deviations.
        runs: How many runs are made beside that of the scenario as it is.
        seed: The seed of the values that are spread.
        progress: Shows a bar if stderr is a terminal.

    Returns:
        The best choice. After Ctrl-C it is the best so far, and `interrupted` names the signal.

    Raises:
        ModelError: A parameter is not one, a range is empty, a noise is not stated, or no run keeps
            the limits.
        ScenarioError: A key or a value is none of a scenario.

    Source: Atkinson, Donev and Tobias, Optimum Experimental Designs, with SAS, 2007; Swevers et
    al., Optimal robot excitation and identification, IEEE Trans. Robotics and Automation 13, 1997.
    """
    check_whole_number("runs", runs, 1)
    check_whole_number("seed", seed, 0)
    low, high = _ends(ranges)
    completed = complete_scenario(scenario).scenario
    trials = ScenarioRuns(completed, free, _noise(noise or {}))
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
        _search(lambda place: best.cost(place, bar), len(keys), runs, seed)
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
    """The best of some runs.

    Attributes:
        trial: The best run.
        choice: Its values; empty for the scenario as it is.
        made: How many runs were made.
        refused: What was wrong with a run -> with how many.
        interruption: The signal that ends the search.

    Args:
        trials: The scenario.
        criterion: "D" or "A".
        keys: The keys that vary.
        ends: Their least and largest values.
        runs: How many runs may be made.
        before: The run of the scenario as it is.
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

    def cost(self, place: FloatArray, bar: Any) -> float:
        """What is to be small, at a place in the unit cube.

        Raises:
            _Enough: The runs are spent, or a signal asks for the end.
        """
        if self.made >= self._runs or self.interruption.signal is not None:
            raise _SearchEnded
        low, high = self._ends
        values = np.clip(low + place * (high - low), low, high)
        changes = dict(zip(self._keys, values.tolist(), strict=True))
        trial = self._trials.run(changes)
        self.made += 1
        bar.update()
        self.refused.update(trial.problems.keys())
        found = _cost(trial, self._criterion)
        if found < self._least:
            self.trial, self.choice, self._least = trial, changes, found
        return found


def _search(cost: Callable[[FloatArray], float], count: int, runs: int, seed: int) -> None:
    """Looks for the least cost in the unit cube until the cost has enough."""
    random = np.random.default_rng(seed)
    first = max(1, round(SPREAD * runs))
    # A Latin hypercube: each coordinate has one value in each of as many even intervals.
    order = np.array([random.permutation(first) for _ in range(count)]).T
    places = (order + random.random((first, count))) / first
    costs = [cost(place) for place in places]
    place, step = places[int(np.argmin(costs))], FIRST_STEP
    while True:
        inward = np.where(place < 0.5, step, -step)
        simplex = np.vstack([place, place + np.diag(inward)])
        options = {"initial_simplex": simplex, "xatol": CLOSE, "fatol": np.inf, "maxfev": 10**6}
        bounds = count * [(0.0, 1.0)]
        found = minimize(cost, place, method="Nelder-Mead", bounds=bounds, options=options)
        place, step = found.x, FIRST_STEP * random.uniform(0.2, 1.0)


def _cost(trial: ScenarioRun, criterion: Criterion) -> float:
    """What is to be small: the logarithm of the criterion, and more with problems."""
    if trial.problems or trial.promised is None:
        return REFUSED * (1 + len(trial.problems))
    return float(np.log(trial.promised.size(criterion)))


def _ends(ranges: Mapping[str, tuple[float, float]]) -> tuple[FloatArray, FloatArray]:
    """The lower and the upper ends of ranges."""
    if not ranges:
        raise ModelError("ranges must have at least one key, such as start.errors.tool.z")
    for key, given in ranges.items():
        low, high = vector(f"the range of {key}", given, 2)
        if not (low < high and np.isfinite(high - low)):
            raise ModelError(
                f"the range of {key} must be a lower and a larger number, got {low:g} and {high:g}"
            )
    found = np.array([*ranges.values()], dtype=float)
    return found[:, 0], found[:, 1]


def _noise(given: Mapping[str, float]) -> Mapping[str, float]:
    for name, deviation in given.items():
        if name not in NOISY:
            raise ModelError(unknown_name("noise of", name, NOISY))
        if not deviation > 0.0:
            raise ModelError(f"the noise of {name} must be positive, got {deviation:g}")
    return given


def _most(refused: Counter[str]) -> str:
    return listed(f"{kind}: {count}" for kind, count in refused.most_common())[1:-1]
