"""The adaptive law of a scenario."""

import numpy as np

from drake_dae.dae.structure.structure import Structure
from drake_dae.errors import ScenarioError
from drake_dae.robots.model import RobotModel
from drake_dae.scenario.parts.parts import Adaptive
from drake_dae.scenario.scenario import Scenario
from drake_dae.systems.adaptive.controller import AdaptiveController
from drake_dae.systems.adaptive.law import AdaptiveLaw


def check_adaptive(scenario: Scenario) -> None:
    """Checks that a scenario with an adaptive law has no keys that this law does not use.

    Raises:
        ScenarioError: There are such keys.
    """
    law, force = scenario.law, scenario.force_feedback
    if not isinstance(law, Adaptive):
        return
    used = {
        "gains": scenario.gains is not None and scenario.gains != law.gains,
        "integral": bool(scenario.integral),
        "observer": scenario.observer is not None,
        "constraint_damping": scenario.constraint_damping is not None,
        "task": scenario.task is not None,
    }
    problems = [
        (key, "an adaptive law does not use it; leave it out")
        for key, is_given in used.items()
        if is_given
    ]
    if force.is_measured is not (law.force_rate > 0.0) or np.any(force.gain):
        why = "an adaptive law needs !MeasuredForce, without gain, exactly with a force_rate"
        problems.append(("force_feedback", why))
    if problems:
        raise ScenarioError(*problems)


def adaptive_controller(
    law: Adaptive, model: RobotModel, structure: Structure, period: float
) -> AdaptiveController:
    """The controller of an adaptive law, with the period of its samples in s."""
    settings = law.parameters, law.rate, law.damping, law.force_rate
    return AdaptiveController(AdaptiveLaw(model, *settings, structure), period)
