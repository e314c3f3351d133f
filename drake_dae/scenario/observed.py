"""The system on which the law of a scenario is based."""

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
    observer = scenario.observer
    if observer is None:
        if scenario.identified:
            text = "needs an observer; give `observer`, or leave `gains` out with Drake's contact"
            raise ScenarioError(("identified", text))
        return structure
    with at("observer"):
        if scenario.exogenous:
            raise ModelError("not beside exogenous signals, whose port it feeds")
        frictional = {
            c.name: c.friction_parameter for c in model.constraints if c.friction_parameter
        }
        for name in observer.identify_friction:
            if name not in frictional:
                raise ModelError(
                    f"identify_friction: '{name}' is not a constraint with friction; give it "
                    "friction: 0.0 if it is unknown. With friction: "
                    f"{', '.join(frictional) or 'none'}"
                )
        velocities = [signal.name for signal in model.links.velocity_signals]
        frictions = [frictional[name] for name in observer.identify_friction]
        with at("identified"):
            observed = with_disturbance(model.dae, velocities, [*frictions, *scenario.identified])
        return find_structure(observed)
