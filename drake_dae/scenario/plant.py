"""The plant of a scenario in Drake's own contact."""

from functools import partial

from drake_dae.dae.structure.structure import Structure
from drake_dae.robots.model import RobotModel
from drake_dae.scenario.forms.keys import at
from drake_dae.scenario.model import add_robot
from drake_dae.scenario.own_model import check_pushes
from drake_dae.scenario.scenario import Scenario
from drake_dae.systems.plants.contact.contact_material import ContactMaterial
from drake_dae.systems.plants.contact.contact_plant import ContactPlant


@at("plant or plant_parameters")
def contact_plant(scenario: Scenario, model: RobotModel, structure: Structure) -> ContactPlant:
    """The plant of a scenario in Drake's contact.

    Args:
        scenario: A scenario with `plant: !MultibodyPlant`.
        model: The scenario's robot, by `scenario_model`.
        structure: The structure of the model's system.

    Raises:
        ScenarioError: The robot cannot touch in this way.
    """
    check_pushes(scenario.plant_pushes, model.links)
    assert isinstance(scenario.plant, ContactMaterial)
    return ContactPlant(
        model,
        partial(add_robot, scenario.robot, payloads=scenario.plant_payloads),
        scenario.plant,
        structure=structure,
        parameters=scenario.plant_parameters,
        pushes=scenario.plant_pushes,
    )
