"""The data of a study's runs, and groups of runs that the same closed loop can simulate."""

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
"""The largest number of rollouts that are computed together."""

_OF_A_RUN = ("description", "duration", "integrator", "write", "error_bound")
"""The keys of a scenario that the closed loop does not depend on."""

Batch = Sequence[tuple[int, Variation]]
"""(number, variation) of runs with one structure."""


def study_data(
    base: Mapping[str, Any], variation: Variation, is_rollout: bool = False
) -> dict[str, Any]:
    """Returns the complete data of a run; for a rollout, with the plant that rollouts simulate.

    Args:
        base: The plain data of the study's scenario.
        variation: Dotted key -> the value of this run.
        is_rollout: Whether the run is a rollout.

    Raises:
        ScenarioError: The scenario does not accept a key or a value.
    """
    data = varied_data(base, variation)
    if any(map(_has_keys, variation.values())):  # A mapping may lack keys that have defaults.
        data = scenario_data(read_scenario(data))
    if is_rollout:
        from drake_dae.scenario.rolled import rolled_data

        data = rolled_data(data)
    return data


def _has_keys(value: Any) -> bool:
    return isinstance(value, dict) or (isinstance(value, list) and any(map(_has_keys, value)))


def structure_key(data: Mapping[str, Any], base: Mapping[str, Any]) -> str:
    """Returns a text that is equal for scenarios that the same closed loop can simulate.

    Such scenarios differ only in settings of the run and in data of a context: start, parameters of
    the plant, uncoupled gains, seed.
    """
    return json.dumps(built_data(data, base), sort_keys=True)


def built_data(data: Mapping[str, Any], base: Mapping[str, Any]) -> dict[str, Any]:
    """Returns a scenario's data in which all data of a context are those of the base.

    Then the loop does not depend on the order of runs.
    """
    own = dict(data)
    for key in (
        "description",
        "plant_parameters",
        "duration",
        "integrator",
        "write",
        "error_bound",
    ):
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
        zero = {"force": [0.0, 0.0, 0.0]}
        own["plant_payloads"] = [{**payload, "mass": 1.0} for payload in own["plant_payloads"]]
        own["plant_disturbances"] = [{**force, **zero} for force in own["plant_disturbances"]]
    first, positions = base["start"], own["start"].get("positions", {})
    if positions.keys() == first["positions"].keys():
        positions = first["positions"]
    own["start"] = {**first, "positions": positions}
    # Default gains depend on the built loop, and a task contains the values of its gains.
    if own["gains"] and base["gains"] and not own["task"]:
        tag = own["gains"].get(TAG, "!Poles")
        if tag == base["gains"][TAG] != "!Matrices":
            own["gains"] = base["gains"]
    if "seed" in (force := own["force_feedback"]):
        deviation = force["noise_deviation"]
        if not own["task"]:  # The guards of a task depend on the noise.
            deviation = float(np.any(np.array(deviation) != 0.0))
        errors = {"seed": 0, "bias": 0.0, "drift": 0.0, "noise_deviation": deviation}
        own["force_feedback"] = {**force, **errors}
    if own["sampling"]:
        own["sampling"] = {**own["sampling"], "seed": 0}
    if own["encoders"]:
        own["encoders"] = {**own["encoders"], "seed": 0}
    return own


def lasting(base: Mapping[str, Any], variations: Iterable[Variation]) -> float:
    """The simulated time of all runs divided by the number of structures, in s.

    Args:
        base: The plain data of the study's scenario.
        variations: All runs of the study.
    """
    total, keys, own = 0.0, set(), study_data(base, {}, True)
    for variation in variations:
        with suppress(ScenarioError):  # The run itself reports the error.
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
    """Divides runs into batches of one structure; a worker builds one loop for a batch.

    Args:
        base: The plain data of the study's scenario.
        runs: The numbers and variations of the runs.
        workers: The number of workers.
        are_rollouts: Whether the runs are rollouts.
    """
    groups: dict[str, list[tuple[int, Variation]]] = {}
    own = study_data(base, {}, are_rollouts)
    for number, variation in runs:
        key = ""
        with suppress(ScenarioError):  # The run itself reports the error.
            key = structure_key(study_data(base, variation, are_rollouts), own)
        groups.setdefault(key, []).append((number, variation))
    total = sum(map(len, groups.values()))
    size = max(1, min(TOGETHER, total // (32 * workers)))
    return [
        group[first : first + size]
        for group in groups.values()
        for first in range(0, len(group), size)
    ]
