"""The data of a study's runs, and which of them the same closed loop can simulate."""

import json
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from typing import Any

import numpy as np

from drake_dae.errors import ScenarioError
from drake_dae.scenario.files import varied_data
from drake_dae.scenario.forms.typed_yaml import TAG
from drake_dae.scenario.plants import plant_kind
from drake_dae.scenario.scenario import read_scenario, scenario_data
from drake_dae.studies.variations import Variation

TOGETHER = 32
"""At most so many rollouts are made at once."""

Batch = Sequence[tuple[int, Variation]]
"""Runs of one structure, with their numbers."""


def study_data(
    base: Mapping[str, Any], variation: Variation, is_rollout: bool = False
) -> dict[str, Any]:
    """The complete data of a run, for a rollout with the plant that this runs.

    Args:
        base: The plain data of the study's scenario.
        variation: What the run has different.
        is_rollout: Whether it is a rollout.

    Raises:
        ScenarioError: A scenario cannot have this.
    """
    data = varied_data(base, variation)
    if any(map(_has_keys, variation.values())):  # It may leave out keys that have defaults.
        data = scenario_data(read_scenario(data))
    if is_rollout:
        from drake_dae.scenario.rolled import rolled_data

        data = rolled_data(data)
    return data


def _has_keys(value: Any) -> bool:
    return isinstance(value, dict) or (isinstance(value, list) and any(map(_has_keys, value)))


def structure_key(data: Mapping[str, Any], base: Mapping[str, Any]) -> str:
    """Text that is equal for scenarios that the same closed loop can simulate.

    They may differ in the data of a context: start, parameters of the plant, uncoupled gains, seed;
    or in the settings of the run.
    """
    return json.dumps(built_data(data, base), sort_keys=True)


def built_data(data: Mapping[str, Any], base: Mapping[str, Any]) -> dict[str, Any]:
    """A scenario's data with the data of a context taken from the base of the study.

    So the loop does not depend on which run comes first.
    """
    own = dict(data)
    for key in ("description", "plant_parameters", "duration", "integrator", "write"):
        own[key] = base[key]
    kind, plant = plant_kind(own["plant"]), base["plant"]
    if kind is plant_kind(plant):
        same = {
            key: plant[key]
            for key in kind.in_context
            if (plant[key] is None) is (own["plant"][key] is None)
        }
        own["plant"] = {**own["plant"], **same}
    if kind.carries:  # It is built with its own parameters.
        own["plant_parameters"] = data["plant_parameters"]
    elif kind.adjusts:
        own["plant_payloads"] = [{**each, "mass": 1.0} for each in own["plant_payloads"]]
        still = {"force": [0.0, 0.0, 0.0]}
        own["plant_disturbances"] = [{**each, **still} for each in own["plant_disturbances"]]
    first, positions = base["start"], own["start"].get("positions", {})
    if positions.keys() == first["positions"].keys():
        positions = first["positions"]
    own["start"] = {**first, "positions": positions}
    # Default gains depend on the built loop; and a task is built with its numbers.
    if own["gains"] and base["gains"] and not own["task"]:
        tag = own["gains"].get(TAG, "!Poles")
        if tag == base["gains"][TAG] != "!Matrices":
            own["gains"] = base["gains"]
    if "seed" in (force := own["force_feedback"]):
        deviation = force["noise_deviation"]
        if not own["task"]:  # The guards of a task know the noise.
            deviation = float(np.any(np.array(deviation) != 0.0))
        errors = {"seed": 0, "bias": 0.0, "noise_deviation": deviation}
        own["force_feedback"] = {**force, **errors}
    if own["encoders"]:
        own["encoders"] = {**own["encoders"], "seed": 0}
    return own


def lasting(base: Mapping[str, Any], variations: Iterable[Variation]) -> float:
    """The mean total duration of the runs of one structure, in s of simulated time.

    Args:
        base: The plain data of the study's scenario.
        variations: All runs of the study.
    """
    total, keys, own = 0.0, set(), study_data(base, {}, True)
    for variation in variations:
        with suppress(ScenarioError):  # That run says so itself.
            data = study_data(base, variation, True)
            total += data["duration"]
            keys.add(structure_key(data, own))
    return total / max(len(keys), 1)


def batches(
    base: Mapping[str, Any],
    runs: Iterable[tuple[int, Variation]],
    workers: int,
    are_rollouts: bool = False,
) -> list[Batch]:
    """The runs by structure, in portions: a worker builds at most one loop per portion.

    Args:
        base: The plain data of the study's scenario.
        runs: The runs.
        workers: The number of workers.
        are_rollouts: Whether they are rollouts.
    """
    groups: dict[str, list[tuple[int, Variation]]] = {}
    own = study_data(base, {}, are_rollouts)
    for number, variation in runs:
        key = ""
        with suppress(ScenarioError):  # That run says so itself.
            key = structure_key(study_data(base, variation, are_rollouts), own)
        groups.setdefault(key, []).append((number, variation))
    total = sum(map(len, groups.values()))
    size = max(1, min(TOGETHER, total // (32 * workers)))
    return [
        group[first : first + size]
        for group in groups.values()
        for first in range(0, len(group), size)
    ]
