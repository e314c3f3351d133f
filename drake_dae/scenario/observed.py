"""The system on which the law of a scenario is based."""

from drake_dae.arrays import unknown_name
from drake_dae.dae.beyond.disturbance import with_disturbance
from drake_dae.dae.structure.structure import Structure, find_structure
from drake_dae.errors import ModelError, ScenarioError
from drake_dae.robots.model import RobotModel
from drake_dae.scenario.forms.keys import at
from drake_dae.scenario.scenario import Scenario


def latency_of(scenario: Scenario, model: RobotModel) -> float:
    """The mean time from a sample to the moment when its control acts, for rigid joints, in s.

    A plant that steps by h damps with the speed at the end of each step: h / 2 later than the mean,
    and h later than a law without sampling, which acts at each step.
    """
    sampling, material = scenario.sampling, scenario.plant.material
    step = 0.0 if material is None else material.time_step
    if model.stages:
        return 0.0
    return step if sampling is None else sampling.delay + (sampling.period + step) / 2.0


def observed_structure(scenario: Scenario, model: RobotModel, structure: Structure) -> Structure:
    """The structure of the law's system, with a disturbance if the scenario has an observer.

    Raises:
        ScenarioError: The observer does not fit; the message names its key.
    """
    estimator = scenario.estimator
    if estimator is None:
        return structure
    if estimator.rate is None:
        text = "needed, since no gains are computed; leave `law.gains` out with Drake's contact"
        raise ScenarioError(("estimator.rate", text))
    with at("estimator"):
        if scenario.exogenous:
            raise ModelError("not beside exogenous signals, whose port it feeds")
        known = [parameter.name for parameter in model.dae.parameters]
        for name in estimator.identify:
            if name not in known:
                hint = "; give the constraint friction: 0.0 if it is unknown"
                text = unknown_name("parameter", name, known)
                raise ModelError(f"identify: {text}{hint * name.endswith('.friction')}")
        velocities = [signal.name for signal in model.links.velocity_signals]
        with at("estimator.identify"):
            observed = with_disturbance(model.dae, velocities, estimator.identify)
        return find_structure(observed)
