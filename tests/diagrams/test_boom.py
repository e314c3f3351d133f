"""The shipped boom, whose actuator is in a loop: its limits are foreseen."""

import pytest
from runs import scenario

from drake_dae import build_scenario
from drake_dae.errors import ScenarioError
from drake_dae.scenario.judging import find_feasibility

NAME = "boom"


@pytest.mark.slow
def test_limits_of_the_actuator_are_reported_before_it_runs():
    report = find_feasibility(scenario(NAME, "constraints.0.upper=1.05", "duration=6"))
    assert any("actuator.travel" in problem for problem in report.problems)
    assert not find_feasibility(scenario(NAME, "duration=6")).problems
    weak = find_feasibility(scenario(NAME, "constraints.0.effort_limit=200", "duration=6"))
    assert any("actuator.motor" in problem for problem in weak.problems)


def test_stages_do_not_reach_a_motor_in_a_loop():
    text = "actuation=[{_tag: '!FlexibleJoints', stiffness: 100.0}]"
    with pytest.raises(ScenarioError, match="actuation"):
        build_scenario(scenario(NAME, text))
