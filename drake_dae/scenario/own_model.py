"""What a scenario's plant has and its law does not know: payloads and pushes on an ideal plant."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

from pydrake.geometry import SceneGraph

from drake_dae.dae.structure.structure import Structure
from drake_dae.errors import ModelError
from drake_dae.robots.links.links import Links
from drake_dae.robots.loads import KnownForce
from drake_dae.robots.model import RobotModel
from drake_dae.scenario.forms.keys import each
from drake_dae.scenario.model import completed_model, scenario_structure
from drake_dae.scenario.scenario import Scenario
from drake_dae.systems.plants.contact.pushes import Push


@dataclass(frozen=True, eq=False)
class OwnModel:
    """The model of a plant that is not its law's.

    Attributes:
        scenario: The scenario in which the payloads and pushes are known.
        model, structure: The robot with them.
        scene_graph: Where its geometry is registered.
    """

    scenario: Scenario
    model: RobotModel
    structure: Structure
    scene_graph: SceneGraph


def own_model(scenario: Scenario, links: Links) -> OwnModel | None:
    """The model of a scenario's ideal plant; None if that of its law will do.

    A payload is another body, and a push is a force like one of `loads` that moves as an exogenous
    signal: so the plant is a robot like any other.

    Args:
        scenario: The scenario, completed.
        links: The links of the law's model.

    Raises:
        ScenarioError: Something does not fit; the message names its key.
    """
    payloads, pushes = scenario.plant_payloads, scenario.plant_pushes
    if scenario.plant.carries or not (payloads or pushes):
        return None
    check_pushes(pushes, links)
    named = {f"plant_push_{index}": push for index, push in enumerate(pushes)}
    loads = [KnownForce(push.frame, push.point, name) for name, push in named.items()]
    moving: dict[str, Any] = {f"{name}.force": [push.reference] for name, push in named.items()}
    own = replace(
        scenario,
        loads=[*scenario.loads, *loads],
        exogenous={**scenario.exogenous, **moving},
    )
    scene_graph = SceneGraph()
    model = completed_model(own, scene_graph, payloads)[1]
    return OwnModel(own, model, scenario_structure(model), scene_graph)


def check_pushes(pushes: Sequence[Push], links: Links) -> None:
    """Refuses pushes on frames that are not there, or stand still.

    Raises:
        ScenarioError: There is no such frame of the robot.
    """

    def check(push: Push) -> None:
        links.position(push.frame, push.point)
        if push.frame == "world":
            raise ModelError("a push on the world moves nothing; name a frame of the robot")

    each("plant_pushes", pushes, check)
