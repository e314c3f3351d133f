"""The system of the law of a scenario with an observer."""

from drake_dae.dae.beyond.disturbance import with_disturbance
from drake_dae.dae.structure.structure import Structure, find_structure
from drake_dae.errors import ModelError
from drake_dae.robots.model import RobotModel
from drake_dae.scenario.forms.keys import at
from drake_dae.scenario.scenario import Scenario


def observed_structure(scenario: Scenario, model: RobotModel, structure: Structure) -> Structure:
    """The structure of the system of a scenario's law, with a disturbance if it is observed.

    Raises:
        ScenarioError: The observer does not fit; the message names its key.
    """
    observer = scenario.observer
    if observer is None:
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
        return find_structure(with_disturbance(model.dae, velocities, frictions))
