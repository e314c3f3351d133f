"""Scenarios and closed loops, run into records."""

import shutil
from collections.abc import Callable, Container, Iterable
from functools import cache
from typing import Any

import jsonschema
import numpy as np
import pytest
from _pytest.mark import ParameterSet
from pydrake.geometry import SceneGraph
from pydrake.systems.analysis import SimulatorConfig
from pydrake.systems.framework import Context

from drake_dae import ClosedLoop, Record, RobotModel, build_scenario, load_scenario, simulate
from drake_dae.scenario.build import roll_scenario
from drake_dae.scenario.model import completed_model
from drake_dae.scenario.scenario import Scenario, scenario_schema
from drake_dae.scenario.shipped import find_scenario, shipped_scenarios

with_compiler = pytest.param(
    True, marks=pytest.mark.skipif(shutil.which("cc") is None, reason="there is no C compiler")
)

both = pytest.mark.parametrize("compiled", [False, with_compiler])
"""Interpreted, and as machine code."""

mostly_compiled = pytest.mark.parametrize(
    "compiled", [pytest.param(False, marks=pytest.mark.thorough), with_compiler]
)
"""As machine code; interpreted where all is tested, since other tests compare both."""

MANY_PIECES = (
    "references={tool: !Polyline {points: [[0.3], [0.5], [0.2]], corner: 0.0005, "
    "limits: {speed: 0.5, acceleration: 5, jerk: 100}}, wall.force: 20}"
)
"""A setting of the two links on a wall: a path of 1,000 polynomials, which are in a table."""

DEAR = (
    *("three_fingers", "seven_joint_flexible_motors", "planar_4rrr", "biped", "conveyor"),
    *("crank_turning", "four_bar", "planar_3rrr", "seven_joint_dome", "seven_joint_flexible"),
    *("seven_joint_pipe", "slider_crank", "stewart_platform", "two_arms", "two_arms_free_box"),
    "two_link_flexible",
)
"""Scenarios that show nothing which cheaper ones do not, where code is made of all of them."""


def _with_keys(*keys: str) -> tuple[str, ...]:
    """The shipped scenarios that have one of these keys."""
    texts = {name: path.read_text("utf-8") for name, path in shipped_scenarios().items()}
    return tuple(n for n, text in texts.items() if any(f"\n{key}:" in text for key in keys))


IN_CONTACT = _with_keys("plant", "task")
"""The scenarios with compliant contacts, or contacts that open."""

TASKS = _with_keys("task")
"""The scenarios with a task, which has two laws."""


def each_scenario(left_out: Callable[[str], bool] = lambda name: False) -> list[ParameterSet]:
    """The shipped scenarios except for some: all slow but the first one, the dear ones thorough."""
    marks = {
        "two_link_wall": [],
        **{name: [pytest.mark.slow, pytest.mark.thorough] for name in DEAR},
    }
    return [
        pytest.param(name, marks=marks.get(name, [pytest.mark.slow]))
        for name in shipped_scenarios()
        if not left_out(name)
    ]


def some(
    cases: Iterable[Any], of: int = 2, dear: Container[Any] = (), first: int = 0
) -> list[ParameterSet]:
    """Cases of which all but one in so many are thorough, and the dear ones: they show the same.

    A tuple is a case of several arguments. Tests of one list begin at different places in it, so
    that together they run all of its cases.
    """
    found = []
    for i, case in enumerate(cases):
        values = case if isinstance(case, tuple) else (case,)
        given = case if isinstance(case, ParameterSet) else pytest.param(*values)
        left_out = i % of != first or given.values[0] in dear
        marks = [*given.marks, *[pytest.mark.thorough] * left_out]
        found.append(pytest.param(*given.values, marks=marks, id=given.id))
    return found


def first_quick(cases: Iterable[Any]) -> list[ParameterSet]:
    """Cases of which all but the first one are slow."""
    return [pytest.param(case, marks=[pytest.mark.slow] * (i > 0)) for i, case in enumerate(cases)]


def scenario(name: str, *settings: str) -> Scenario:
    """A shipped scenario, with settings as those of `--set`."""
    return load_scenario(find_scenario(name), settings)


def scenario_model(chosen: Scenario, scene_graph: SceneGraph | None = None) -> RobotModel:
    """The robot model of a scenario: constraints, outputs and actuation."""
    return completed_model(chosen, scene_graph)[1]


def untagged(data: Any) -> Any:
    """Plain data as a reader of YAML without tags, such as an editor, has them."""
    if isinstance(data, dict):
        return {key: untagged(value) for key, value in data.items() if key != "_tag"}
    return [*map(untagged, data)] if isinstance(data, list) else data


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


def roll(chosen: Scenario) -> tuple[ClosedLoop, Record]:
    """A scenario from its start to its end, as a rollout, in less time.

    That it is Drake's run is shown where rollouts are tested.
    """
    loop, context = build_scenario(chosen)
    found = roll_scenario(chosen, loop, context)
    assert found.failure is None
    return loop, found.record


def same_records(one, other):
    """Asserts that two records have the same numbers, names and units."""
    np.testing.assert_array_equal(one.time, other.time)
    assert set(one.signals) == set(other.signals)
    for name, recorded in one.signals.items():
        np.testing.assert_array_equal(recorded.values, other[name])
        assert recorded.signals == other.signals[name].signals


def close_records(found, wanted, tolerance, rows=slice(None), least=1.0):
    """Asserts that rows are equal to a share of a signal's largest value, or of the least size."""
    for name, recorded in wanted.signals.items():
        np.testing.assert_allclose(
            found[name][rows],
            recorded.values[rows],
            rtol=0.0,
            atol=tolerance * np.abs(recorded.values).max(initial=least),
            err_msg=name,
        )
