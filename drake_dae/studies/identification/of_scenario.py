"""Identification for a scenario: from records to a scenario with the values that were found."""

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
    """The scenario of the first of some records.

    Raises:
        ModelError: It has none.
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
    """Parameters of a scenario's plant from records, and the scenario with their values.

    The parameters begin with the values of the law's model: what `plant_parameters` says of them is
    not used. Biases of sensors begin at 0.

    Args:
        scenario: The scenario. Drake's own point contact is taken as !CompliantContact.
        records: The records by name.
        free: As of `identify`.

    Returns:
        The result, and the scenario whose law, plant and sensors have the values that were found
        (for the law of a cascade its plant alone), except for those that are not determined,
        delays, and biases of sensors that it does not have.

    Raises:
        ModelError: As of `identify`.
        ScenarioError: The scenario cannot be built; the message names its key.
    """
    names = {name.partition("[")[0] for name in free}
    own = {n: v for n, v in scenario.plant_parameters.items() if n not in names}
    changes = dict[str, Any]()
    if FORCE_BIAS in names and scenario.force_feedback.is_measured:
        changes["force_feedback.bias"] = 0.0
    if POSITION_BIAS in names and scenario.encoders is not None:
        changes["encoders.position_bias"] = 0.0
    begun = _changed(replace(scenario, plant_parameters=own), changes)
    loop, context = build_scenario(for_rollout(begun)[0])
    found = identify(loop, context, records, free)
    return found, _with_values(begun, found)


def _with_values(scenario: Scenario, found: Identified) -> Scenario:
    """A scenario with the values that were found."""
    payloads = {f"{one.name}.mass": i for i, one in enumerate(scenario.plant_payloads)}
    changes = dict[str, Any]()
    values = dict[str, dict[int, float]]()
    for unknown, value, deviation in zip(
        found.unknowns, found.values, found.deviations, strict=True
    ):
        if np.isfinite(deviation):
            values.setdefault(unknown.parameter, {})[unknown.entry] = float(value)
    # A cascade does not know `parameters`.
    key = "plant_parameters" if scenario.is_cascade else "parameters"
    numbers = dict(getattr(scenario, key))
    # No sensor of a scenario has a delay, and there may be none.
    left_out = {FORCE_DELAY, POSITION_DELAY}
    left_out |= set() if scenario.force_feedback.is_measured else {FORCE_BIAS}
    left_out |= set() if scenario.encoders is not None else {POSITION_BIAS}
    for name, entries in values.items():
        all_entries = [
            entries.get(unknown.entry, float(start))
            for unknown, start in zip(found.unknowns, found.start, strict=True)
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
    """A scenario with other values at dotted keys."""
    return read_scenario(varied_data(scenario_data(scenario), changes))
