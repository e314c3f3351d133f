"""Payloads and disturbances of a scenario's ideal plant, unknown to its law."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from pydrake.geometry import SceneGraph
from pydrake.systems.framework import Context

from drake_dae.dae.structure.structure import Structure
from drake_dae.errors import ModelError
from drake_dae.robots.known_forces import ScaledForce
from drake_dae.robots.links.links import Links
from drake_dae.robots.model import RobotModel
from drake_dae.scenario.forms.keys import at, each
from drake_dae.scenario.model import completed_model, scenario_structure
from drake_dae.scenario.scenario import Scenario
from drake_dae.systems.plants.contact.disturbance_forces import DisturbanceForce
from drake_dae.systems.plants.contract import Plant


@dataclass(frozen=True, eq=False)
class OwnModel:
    """The model of a plant with payloads and disturbances that its law does not know.

    Attributes:
        scenario: The scenario with disturbances among its known forces.
        model, structure: The robot with payloads and disturbances.
        scene_graph: The scene graph of its geometry.
    """

    scenario: Scenario
    model: RobotModel
    structure: Structure
    scene_graph: SceneGraph


def own_model(scenario: Scenario, links: Links) -> OwnModel | None:
    """The model of a scenario's ideal plant; None if it is that of its law.

    A payload is a further body, and the course of a disturbance is an exogenous signal. Masses and
    forces are parameters, which `begin_own_model` sets in a context.

    Args:
        scenario: The scenario, completed.
        links: The links of the law's model.

    Raises:
        ScenarioError: Something does not fit; the message names its key.
    """
    payloads, disturbances = scenario.plant.payloads, scenario.plant.disturbances
    if scenario.plant.carries or not (payloads or disturbances):
        return None
    check_disturbances(disturbances, links)
    named = {_name(index): disturbance for index, disturbance in enumerate(disturbances)}
    known_forces = [
        ScaledForce(disturbance.frame, disturbance.point, name, disturbance.force)
        for name, disturbance in named.items()
    ]
    moving: dict[str, Any] = {
        f"{name}.course": [disturbance.course] for name, disturbance in named.items()
    }
    of_plant = replace(
        scenario,
        robot=replace(scenario.robot, known_forces=[*scenario.robot.known_forces, *known_forces]),
        exogenous={**scenario.exogenous, **moving},
    )
    scene_graph = SceneGraph()
    model = completed_model(of_plant, scene_graph, payloads)[1]
    return OwnModel(of_plant, model, scenario_structure(model), scene_graph)


def _name(index: int) -> str:
    return f"plant_disturbance_{index}"


def begin_own_model(scenario: Scenario, plant: Plant, context: Context) -> None:
    """Sets the masses of payloads and the forces of disturbances in the context of a plant.

    Raises:
        ScenarioError: A number makes no sense; the message names its key.
    """
    if scenario.plant.carries:
        return
    numbers: list[tuple[str, str, ArrayLike]] = [
        *(("plant.payloads", f"{p.name}.mass", p.mass) for p in scenario.plant.payloads),
        *(
            ("plant.disturbances", f"{_name(index)}.force", disturbance.force)
            for index, disturbance in enumerate(scenario.plant.disturbances)
        ),
    ]
    values = plant.parameters(context)
    for key, name, value in numbers:
        with at(key):
            # A user's own plant may not let these numbers be set, and has been made with them.
            if not np.array_equal(values[plant.dae.parameter_slice(name)], np.ravel(value)):
                plant.set_parameter(context, name, value)


def check_disturbances(disturbances: Sequence[DisturbanceForce], links: Links) -> None:
    """Checks that disturbances act on movable frames.

    Raises:
        ScenarioError: There is no such frame of the robot.
    """

    def check(disturbance: DisturbanceForce) -> None:
        links.position(disturbance.frame, disturbance.point)
        if disturbance.frame == "world":
            raise ModelError("a disturbance on the world moves nothing; name a frame of the robot")

    each("plant.disturbances", disturbances, check)
