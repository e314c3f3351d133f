"""Identification for a scenario: from records to a scenario with the identified values."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from drake_dae.errors import ModelError
from drake_dae.scenario.build import build_scenario
from drake_dae.scenario.files import varied_data
from drake_dae.scenario.rolled import for_rollout
from drake_dae.scenario.scenario import Scenario, read_scenario, scenario_data
from drake_dae.simulation.records.record import Record
from drake_dae.studies.identification.identified import Identified
from drake_dae.studies.identification.identify import identify
from drake_dae.studies.identification.unknowns import (
    FORCE_BIAS,
    FORCE_DELAY,
    POSITION_BIAS,
    POSITION_DELAY,
)


def recorded_scenario(records: Mapping[str, Record]) -> Scenario:
    """Returns the scenario of the first record.

    Raises:
        ModelError: The first record contains no scenario, or there is no record.
    """
    for title, record in records.items():
        data = record.about.get("scenario")
        if data is None:
            raise ModelError(
                f"'{title}' does not say of which scenario it is, as the log of a robot; name that "
                "by --scenario"
            )
        return read_scenario(data)
    raise ModelError("there is no record to identify parameters from")


def identify_scenario(
    scenario: Scenario, records: Mapping[str, Record], free: Sequence[str]
) -> tuple[Identified, Scenario]:
    """Identifies parameters of a scenario's plant, and returns the scenario with their values.

    The initial guess of a parameter is its value in the law's model; its value in
    `plant_parameters` is not used. The initial guess of a sensor's bias is 0.

    Args:
        scenario: The scenario. Drake's own point contact is replaced by !CompliantContact.
        records: The records by name.
        free: As of `identify`.

    Returns:
        The result, and the scenario whose law, plant and sensors have the identified values. The
        law of a cascade keeps its values. Undetermined parameters, delays, and biases of sensors
        that the scenario lacks are not set.

    Raises:
        ModelError: As of `identify`.
        ScenarioError: The scenario cannot be built; the message names its key.
    """
    names = {name.partition("[")[0] for name in free}
    others = {n: v for n, v in scenario.plant_parameters.items() if n not in names}
    changes = dict[str, Any]()
    if FORCE_BIAS in names and scenario.force_feedback.is_measured:
        changes["force_feedback.bias"] = 0.0
    if POSITION_BIAS in names and scenario.encoders is not None:
        changes["encoders.position_bias"] = 0.0
    initial = _changed(replace(scenario, plant_parameters=others), changes)
    loop, context = build_scenario(for_rollout(initial)[0])
    identified = identify(loop, context, records, free)
    return identified, _with_values(initial, identified)


def _with_values(scenario: Scenario, identified: Identified) -> Scenario:
    payloads = {f"{load.name}.mass": i for i, load in enumerate(scenario.plant_payloads)}
    changes = dict[str, Any]()
    values = dict[str, dict[int, float]]()
    for unknown, value, deviation in zip(
        identified.unknowns, identified.values, identified.deviations, strict=True
    ):
        if np.isfinite(deviation):
            values.setdefault(unknown.parameter, {})[unknown.entry] = float(value)
    # A cascade has no key `parameters`.
    key = "plant_parameters" if scenario.is_cascade else "parameters"
    numbers = dict(getattr(scenario, key))
    # No sensor of a scenario has a delay; the scenario may also lack the sensor.
    left_out = {FORCE_DELAY, POSITION_DELAY}
    left_out |= set() if scenario.force_feedback.is_measured else {FORCE_BIAS}
    left_out |= set() if scenario.encoders is not None else {POSITION_BIAS}
    for name, entries in values.items():
        all_entries = [
            entries.get(unknown.entry, float(start))
            for unknown, start in zip(identified.unknowns, identified.start, strict=True)
            if unknown.parameter == name
        ]
        value = all_entries[0] if len(all_entries) == 1 else all_entries
        if name in left_out:
            continue
        if name in payloads:
            changes[f"plant_payloads.{payloads[name]}.mass"] = value
        elif name == FORCE_BIAS:
            changes["force_feedback.bias"] = value
        elif name == POSITION_BIAS:
            changes["encoders.position_bias"] = value
        elif name.startswith("plant."):
            changes[name] = value
        else:
            numbers[name] = value
    return _changed(scenario, {**changes, key: numbers})


def _changed(scenario: Scenario, changes: Mapping[str, Any]) -> Scenario:
    return read_scenario(varied_data(scenario_data(scenario), changes))
