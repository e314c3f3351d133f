"""Scenarios and closed loops, run into records."""

from functools import cache

import jsonschema
from pydrake.systems.analysis import SimulatorConfig
from pydrake.systems.framework import Context

from drake_dae import ClosedLoop, Record, build_scenario, load_scenario, simulate
from drake_dae.diagrams.scenario import Scenario, scenario_schema
from drake_dae.diagrams.shipped import find_scenario


def scenario(name: str, *settings: str) -> Scenario:
    """A shipped scenario, with settings as those of `--set`."""
    return load_scenario(find_scenario(name), settings)


@cache
def scenario_validator() -> jsonschema.Draft202012Validator:
    """Of the JSON Schema of scenarios, which takes a second to check itself."""
    schema = scenario_schema()
    jsonschema.Draft202012Validator.check_schema(schema)
    return jsonschema.Draft202012Validator(schema)


def run(loop: ClosedLoop, context: Context, duration: float, config: SimulatorConfig) -> Record:
    simulate(loop.diagram, context, duration, config)
    return loop.record(context)


def run_scenario(chosen: Scenario) -> tuple[ClosedLoop, Context, Record]:
    """A scenario from its start to its end, without Meshcat."""
    loop, context = build_scenario(chosen)
    return loop, context, run(loop, context, chosen.duration, chosen.integrator)
