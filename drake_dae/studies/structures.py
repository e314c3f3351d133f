"""The data of a study's runs, and groups of runs that the same closed loop can simulate."""

import json
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from operator import is_not
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

_OF_A_RUN = ("description", "duration", "integrator", "write")
"""The keys of a scenario that the closed loop does not depend on."""

_OF_A_PLANT = ("plant", "plant_parameters", "constraints")
"""The keys that the plant of a rollout depends on, and that it changes."""

_OF_A_START = ("start", "description", "duration", "write")
"""The keys of a scenario that the numbers of a context besides its start do not depend on."""

_text = json.JSONEncoder(sort_keys=True).encode

Batch = Sequence[tuple[int, Variation]]
"""(number, variation) of runs with one structure."""


def study_data(
    base: Mapping[str, Any],
    variation: Variation,
    is_rollout: bool = False,
    known: dict[Any, Any] | None = None,
) -> dict[str, Any]:
    """Returns the complete data of a run; for a rollout, with the plant that rollouts simulate.

    Args:
        base: The plain data of the study's scenario.
        variation: Dotted key -> the value of this run.
        is_rollout: Whether the run is a rollout.
        known: A cache for many runs; what a rollout changes is then the same object for runs with
            the same plant.

    Raises:
        ScenarioError: The scenario does not accept a key or a value.
    """
    data = varied_data(base, variation)
    if any(map(_has_keys, variation.values())):  # A mapping may lack keys that have defaults.
        data = scenario_data(read_scenario(data))
    if is_rollout:
        from drake_dae.scenario.rolled import rolled_data

        parts = [data[key] for key in _OF_A_PLANT]
        last, rolled = ([], {}) if known is None else known.get("rolled", ([], {}))
        if len(last) != len(parts) or any(map(is_not, parts, last)):
            rolled = rolled_data(data)
        if known is not None:
            known["rolled"] = parts, {key: rolled[key] for key in _OF_A_PLANT}
        data |= {key: rolled[key] for key in _OF_A_PLANT}
    return data


def _has_keys(value: Any) -> bool:
    return isinstance(value, dict) or (isinstance(value, list) and any(map(_has_keys, value)))


def structure_key(data: Mapping[str, Any], base: Mapping[str, Any]) -> str:
    """Returns a text that is equal for scenarios that the same closed loop can simulate.

    Such scenarios differ only in settings of the run and in data of a context: start, parameters of
    the plant, uncoupled gains, seed. The text has the parts that are not those of the base.
    """
    own = {}
    for name, part in built_data(data, base).items():
        if not _is_made_of(part, base[name]) and (text := _text(part)) != _text(base[name]):
            own[name] = text
    return _text(own)


def only_starts_differ(data: Mapping[str, Any], other: Mapping[str, Any]) -> bool:
    """Whether data of two runs are the same objects but for the start; False if unsure."""
    return data.keys() == other.keys() and all(
        part is other[key] or key in _OF_A_START for key, part in data.items()
    )


def _is_made_of(part: Any, other: Any) -> bool:
    """Whether a part of data is another one, or a dictionary with the same objects, at once."""
    if part is other or not (isinstance(part, dict) and isinstance(other, dict)):
        return part is other
    return part.keys() == other.keys() and all(part[key] is other[key] for key in part)


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
        if tag == base["gains"][TAG] and tag != "!Matrices":
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


def structures_of(
    base: Mapping[str, Any], variations: Iterable[Variation], are_rollouts: bool
) -> list[tuple[str, float]]:
    """Returns the structure and the simulated time in s of each run; "" and 0 of an invalid one.

    Args:
        base: The plain data of the study's scenario.
        variations: The runs.
        are_rollouts: Whether the runs are rollouts.
    """
    own, structures = study_data(base, {}, are_rollouts), list[tuple[str, float]]()
    for variation in variations:
        key, duration = "", 0.0
        with suppress(ScenarioError):  # The run itself reports the error.
            data = study_data(base, variation, are_rollouts)
            key, duration = structure_key(data, own), data["duration"]
        structures.append((key, duration))
    return structures


def lasting(structures: Sequence[tuple[str, float]]) -> float:
    """Returns the simulated time of all runs divided by the number of structures, in s."""
    keys = {key for key, _ in structures if key}
    return sum(duration for _, duration in structures) / max(len(keys), 1)


def batches(
    structures: Sequence[tuple[str, float]],
    runs: Iterable[tuple[int, Variation]],
    workers: int,
    are_rollouts: bool = False,
) -> list[Batch]:
    """Divides runs into batches of one structure; a worker builds one loop for a batch.

    Args:
        structures: The result of `structures_of` for all runs of the study.
        runs: The numbers and variations of some of them.
        workers: The number of workers.
        are_rollouts: Whether the runs are rollouts.
    """
    groups: dict[str, list[tuple[int, Variation]]] = {}
    for number, variation in runs:
        groups.setdefault(structures[number][0], []).append((number, variation))
    total = sum(map(len, groups.values()))
    # Rollouts go side by side, and take milliseconds.
    parts = 8 if are_rollouts else 32
    size = max(1, min(TOGETHER, total // (parts * workers)))
    return [
        group[first : first + size]
        for group in groups.values()
        for first in range(0, len(group), size)
    ]
