"""Payloads and disturbances of a scenario's ideal plant, unknown to its law."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

from pydrake.geometry import SceneGraph

from drake_dae.dae.structure.structure import Structure
from drake_dae.errors import ModelError
from drake_dae.robots.known_forces import KnownForce
from drake_dae.robots.links.links import Links
from drake_dae.robots.model import RobotModel
from drake_dae.scenario.forms.keys import each
from drake_dae.scenario.model import completed_model, scenario_structure
from drake_dae.scenario.scenario import Scenario
from drake_dae.systems.plants.contact.disturbance_forces import DisturbanceForce


@dataclass(frozen=True, eq=False)
class OwnModel:
    """The model of a plant that differs from its law's.

    Attributes:
        scenario: The scenario in which the payloads and disturbances are known.
        model, structure: The robot with them.
        scene_graph: The scene graph of its geometry.
    """

    scenario: Scenario
    model: RobotModel
    structure: Structure
    scene_graph: SceneGraph


def own_model(scenario: Scenario, links: Links) -> OwnModel | None:
    """The model of a scenario's ideal plant; None if it is that of its law.

    A payload is a further body, and a disturbance is a force like those of `known_forces` as an
    exogenous signal.

    Args:
        scenario: The scenario, completed.
        links: The links of the law's model.

    Raises:
        ScenarioError: Something does not fit; the message names its key.
    """
    payloads, disturbances = scenario.plant_payloads, scenario.plant_disturbances
    if scenario.plant.carries or not (payloads or disturbances):
        return None
    check_disturbances(disturbances, links)
    named = {
        f"plant_disturbance_{index}": disturbance for index, disturbance in enumerate(disturbances)
    }
    known_forces = [
        KnownForce(disturbance.frame, disturbance.point, name)
        for name, disturbance in named.items()
    ]
    moving: dict[str, Any] = {
        f"{name}.force": [disturbance.reference] for name, disturbance in named.items()
    }
    own = replace(
        scenario,
        known_forces=[*scenario.known_forces, *known_forces],
        exogenous={**scenario.exogenous, **moving},
    )
    scene_graph = SceneGraph()
    model = completed_model(own, scene_graph, payloads)[1]
    return OwnModel(own, model, scenario_structure(model), scene_graph)


def check_disturbances(disturbances: Sequence[DisturbanceForce], links: Links) -> None:
    """Refuses disturbances on unknown or fixed frames.

    Raises:
        ScenarioError: There is no such frame of the robot.
    """

    def check(disturbance: DisturbanceForce) -> None:
        links.position(disturbance.frame, disturbance.point)
        if disturbance.frame == "world":
            raise ModelError("a disturbance on the world moves nothing; name a frame of the robot")

    each("plant_disturbances", disturbances, check)
