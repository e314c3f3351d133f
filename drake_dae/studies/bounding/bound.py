"""A bound of the errors of a scenario for declared ranges of unknown numbers."""

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from drake_dae.arguments import checked
from drake_dae.arrays import FloatArray, check_whole_number, number
from drake_dae.errors import ModelError
from drake_dae.scenario.build import build_completed
from drake_dae.scenario.scenario import Scenario, read_scenario, scenario_data
from drake_dae.simulation.figures import margins
from drake_dae.simulation.records.record import Record
from drake_dae.simulation.records.together import indexed_record
from drake_dae.simulation.summary import Limits
from drake_dae.studies.bounding.bounded import BoundedErrors, FailedRun
from drake_dae.studies.bounding.declared_friction import declared_margin
from drake_dae.studies.runs import Runner
from drake_dae.studies.structures import structure_key, study_data
from drake_dae.studies.variations import Variation, numbers_that_vary, variation_at

NOISE = "noise, jitter"
"""The name of the cause that other seeds are."""

_SEEDS = ("force_feedback.seed", "encoders.seed", "sampling.seed")

_SEVERAL = 3
"""The number of runs with other seeds, from which the errors by noise are found."""


@checked(ModelError)
def bound_errors(
    scenario: Scenario,
    ranges: Mapping[str, Any],
    *,
    after: float = 0.0,
    corners: int = 128,
    seed: int = 0,
    rollout: bool = True,
) -> BoundedErrors:
    """Bounds the errors |z - r| of a scenario whose plant, sensors or disturbances are uncertain.

    With a fraction s_k from 0 to 1 for each of n unknown numbers within its range, the errors are
    e(t, s). Where they are affine in s, as for unknown forces on a linear loop, the largest |e| is
    at a corner of the box [0, 1]^n (Bauer's maximum principle). The 2^n corners cannot be
    tried, but random ones suffice for almost all plants: if one number dominates, every corner has
    its largest effect; if many do, e is nearly normal with the standard deviation sigma over
    corners and sigma / sqrt(3) over plants that are uniformly distributed in the box, since a
    number on an end of its range has three times the variance of one within it. The
    largest of c corners is near q sigma, with Phi(q) = 1 - 1 / c, so that a plant exceeds it with
    probability 2 (1 - Phi(q sqrt(3))): 3e-5 for c = 128, where q = 2.4. The bound is the
    largest |e| of all runs. A few plants may exceed it: the largest error of all 2^n corners, the
    sum of all causes, is larger, but hardly any plant comes near it.

    The simulated runs are: the middle of all ranges; one run for each end of each range, with all
    others in the middle, which show the share of each cause; and the corners, where half
    of them have the lower end of each range. Each corner has seeds of its own for sensors and
    jitter. The law is the same in all runs: gains that are left out are computed once, for the
    numbers of `scenario`.

    Args:
        scenario: A scenario from `load_scenario`.
        ranges: Dotted key of the scenario -> its range, as for `random_variations`: what the user
            knows about the plant, its sensors and what disturbs it.
        after: The time in s from which errors are bounded.
        corners: The number of random corners, at least 8.
        seed: The seed of the corners.
        rollout: Simulates by `rollout` instead of Drake's Simulator.

    Returns:
        The bound, the share of each cause, the corners at which a run fails, and how far the
        highest declared friction is from the Painleve paradox.

    Raises:
        ScenarioError: A key or a value is not valid, or the loop cannot be built.
        ModelError: A number is not valid, or the run in the middle of all ranges fails.
    """
    check_whole_number("corners", corners, 8)
    after = number("after", after)
    if not 0.0 <= after < scenario.duration:
        raise ModelError(
            f"after must be from 0 s to less than the duration of {scenario.duration:g} s, got "
            f"{after:g} s"
        )
    names = numbers_that_vary(ranges)
    if not names:
        raise ModelError("no number varies in the ranges; write one as LOW..HIGH")
    completed = build_completed(scenario)[0].scenario
    base = scenario_data(completed)
    middle = dict.fromkeys(names, 0.5)
    ends = [{**middle, name: end} for name in names for end in (0.0, 1.0)]
    signs = _random_corners(len(names), corners, seed)
    points = [middle, *ends, *(dict(zip(names, row.tolist(), strict=True)) for row in signs)]
    variations = [variation_at(ranges, point) for point in points]
    first_corner = 1 + len(ends)
    seeds = _seeds(base)
    for i in range(corners if seeds else 0):
        variations[first_corner + i] |= dict.fromkeys(seeds, seed + i + 1)
    others = [
        {**variations[0], **dict.fromkeys(seeds, seed + corners + i)}
        for i in range(1, 1 + _SEVERAL * bool(seeds))
    ]
    variations += others
    points += [middle] * len(others)
    runner = Runner(base, scenario.duration * len(variations) if rollout else None)
    if (error := runner.why_not(variations[0])) is not None:
        raise error
    highest = variation_at(ranges, dict.fromkeys(names, 1.0))
    top, margin = read_scenario(study_data(base, highest, rollout)), None
    found = _Found(after, len(names), first_corner, corners)
    order = _by_structure(base, variations, rollout)
    records = runner.records([(i, variations[i]) for i in order])
    for i, (record, reason) in zip(order, records, strict=True):
        found.add(i, record, reason, runner.limits)
        if not found.middle.size:
            raise ModelError(f"in the middle of all ranges the run fails: {reason}")
        if i == 0 and record is not None:
            middle_loop = runner.loop(study_data(base, variations[0], rollout))
            margin = declared_margin(middle_loop, top, record)
    shares = dict(zip(names, found.shares[: len(names)], strict=True))
    if found.shares[-1].any():
        shares[NOISE] = found.shares[-1]
    return BoundedErrors(
        signals=found.signals,
        after=after,
        middle=np.abs(found.middle).max(axis=0),
        shares=shares,
        worst=found.worst,
        runs=len(variations),
        corners=corners,
        failed=tuple(
            FailedRun(points[min(i, len(points) - 1)], r) for i, r in found.reasons.items()
        ),
        events=dict(found.events),
        friction_margin=margin,
        scenario=completed,
    )


class _Found:
    """Collects what is needed of each run, since all records together may take gigabytes."""

    def __init__(self, after: float, count: int, first_corner: int, corners: int) -> None:
        self._after, self._count, self._times = after, count, np.zeros(0)
        self._ends, self._corners = (
            range(1, first_corner),
            range(first_corner, first_corner + corners),
        )
        self.middle = np.zeros((0, 0))
        self.reasons, self.events = dict[int, str](), Counter[str]()

    def add(self, i: int, record: Record | None, reason: str, limits: Limits) -> None:
        """Adds run i: the middle, the ends, the corners, and then those with other seeds."""
        if record is None or reason:
            self.reasons[i] = reason
            return
        begin = int(np.searchsorted(record.time, self._after - 1e-9))
        times, errors = record.time[begin:], record["tracking_error"][begin:]
        if not self.middle.size:
            self.middle, self._times = errors, times
            self.signals = tuple(record.signals["tracking_error"].signals)
            self.shares = np.zeros((self._count + 1, errors.shape[1]))
            self.worst = np.zeros(errors.shape[1])
        self.worst = np.maximum(self.worst, np.abs(errors).max(axis=0))
        if i in self._corners:
            self.events.update(_events(record, begin, limits))
            return
        if times.shape != self._times.shape or np.any(times != self._times):
            columns = (np.interp(self._times, times, column) for column in errors.T)
            errors = np.stack(list(columns), axis=1)
        cause = (i - 1) // 2 if i in self._ends else self._count
        change = np.abs(errors - self.middle).max(axis=0)
        self.shares[cause] = np.maximum(self.shares[cause], change)


def _events(record: Record, begin: int, limits: Limits) -> set[str]:
    """What a run with these rows does besides errors: contacts lost, limits exceeded."""
    forces = record["constraint_force"][begin:]
    least = forces.min(axis=0, initial=np.inf)
    events = {
        f"{signal.name}: contact lost"
        for signal, force in zip(record.signals["constraint_force"].signals, least, strict=True)
        if force <= 0.0 and not limits.can_pull(signal)
    }
    pressing = {signal.name for signal in record.signals["constraint_force"].signals}
    (exceeded,) = margins(indexed_record(record, None), limits).exceeded()
    beyond = (name for name in exceeded if name not in pressing)
    events |= {f"{name}: beyond its limit" for name in beyond}
    if "excess" in record and record["excess"].any():
        events.add("drives saturated")
    return events


def _random_corners(count: int, corners: int, seed: int) -> FloatArray:
    """Random corners; each number is at its lower end in half of them. Shape (corners, count)."""
    random = np.random.default_rng(seed)
    half = (np.arange(corners) % 2).astype(float)
    return np.stack([random.permutation(half) for _ in range(count)], axis=1)


def _seeds(base: Mapping[str, Any]) -> list[str]:
    """The keys of seeds in a scenario."""
    parts = ((key, base[key.partition(".")[0]]) for key in _SEEDS)
    return [key for key, part in parts if part and "seed" in part]


def _by_structure(
    base: Mapping[str, Any], variations: Sequence[Variation], rollout: bool
) -> list[int]:
    """The order of runs, with the first one first, in which each loop is built once."""
    own = study_data(base, {}, rollout)
    keys = [structure_key(study_data(base, changes, rollout), own) for changes in variations]
    return sorted(range(len(keys)), key=lambda i: (keys[i] != keys[0], keys[i]))
