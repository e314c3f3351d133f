"""Builds a scenario so that a person can move references, surfaces and links while it runs."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

from pydrake.geometry import SceneGraph
from pydrake.multibody.tree import BodyIndex
from pydrake.systems.framework import Context

from drake_dae.arguments import checked
from drake_dae.diagrams.closed_loop import ClosedLoop
from drake_dae.errors import DrakeDaeError, ModelError, ScenarioError
from drake_dae.pictures.page.controls import PUSH
from drake_dae.references import ConstantReference
from drake_dae.robots import KnownWrench, PointOnSurface
from drake_dae.scenario.build import build_completed
from drake_dae.scenario.robot_file.reading import robot_links
from drake_dae.scenario.rolled import for_rollout
from drake_dae.scenario.scenario import Scenario
from drake_dae.scenario.start import start_scenario


@dataclass(frozen=True, eq=False)
class Commanded:
    """A loop that a person can change while it runs, and its start.

    `left_out` is a sentence for each kind of change that is not possible.
    """

    scenario: Scenario
    loop: ClosedLoop
    context: Context
    left_out: tuple[str, ...]


@checked(lambda text: ScenarioError(("", text)))
def build_commanded(scenario: Scenario) -> Commanded:
    """Builds a loop with `CommandedReferences`, surfaces that can be moved, and wrenches on links.

    Without commands the loop behaves as in the scenario: surfaces are fixed, and wrenches and
    additional friction are zero. Signals for which a task waits are inputs of the diagram.
    """
    scenario, remark = for_rollout(scenario)
    if scenario.plant.carries:
        text = "Drake's hydroelastic contact cannot be traced: take a !CompliantContact instead"
        raise ScenarioError(("plant", text))
    extended, left_out = scenario, [f"Drake's plant: {remark}"] if remark else []
    parts: Mapping[str, Callable[[Scenario], Scenario]] = {
        "friction of the plant": _with_friction,
        "surfaces that are dragged": _with_moving_surfaces,
        "links that are pushed": _with_pushes,
    }
    for name, add in parts.items():
        try:
            extended = add(extended)
        except ModelError as error:
            left_out.append(f"{name}: none, since {error}")
    try:
        completed, loop = build_completed(extended, commanded=True)
    except DrakeDaeError as error:
        completed, loop = build_completed(scenario, commanded=True)  # Its own errors come first.
        left_out = left_out[: bool(remark)] + [f"{name}: {error}" for name in parts]
    # The original exogenous signals decide whether the loop starts at rest.
    initial = replace(completed.scenario, exogenous=scenario.exogenous)
    return Commanded(completed.scenario, loop, start_scenario(initial, loop), tuple(left_out))


def _with_friction(scenario: Scenario) -> Scenario:
    """Adds a coefficient of friction of 0 to frictionless contacts."""
    bare = [
        constraint
        for constraint in scenario.constraints
        if isinstance(constraint, PointOnSurface) and constraint.friction is None
    ]
    # A compliant contact has its friction in the material.
    if not bare or scenario.plant.material is not None:
        return scenario
    if scenario.actuation:
        raise ModelError("the law would differentiate it; give the constraint a friction")
    rough = [replace(c, friction=0.0) if c in bare else c for c in scenario.constraints]
    return replace(scenario, constraints=rough)


def _with_moving_surfaces(scenario: Scenario) -> Scenario:
    """Makes the positions of surfaces constant exogenous signals."""
    if scenario.plant.material is not None:
        return scenario  # Of a compliant contact they are parameters of the plant alone.
    if scenario.estimator is not None:
        raise ModelError(
            "an estimator does not know how a surface moves, and an ideal contact needs a law that "
            "does; with `plant: !CompliantContact` they are dragged"
        )
    moving = dict[str, Any]()
    for constraint in scenario.constraints:
        if isinstance(constraint, PointOnSurface):
            position = constraint.parameters[0]
            if position.name not in scenario.exogenous:
                moving[position.name] = [ConstantReference(x) for x in position.value.tolist()]
    return replace(scenario, exogenous={**scenario.exogenous, **moving})


def _with_pushes(scenario: Scenario) -> Scenario:
    """Adds a zero wrench to each movable link."""
    plant = robot_links(scenario.robot, SceneGraph(), drawn=False)[0].plant
    bodies = [plant.get_body(BodyIndex(i)) for i in range(1, plant.num_bodies())]
    pushes = [
        KnownWrench(body.scoped_name().get_full(), name=PUSH + body.scoped_name().get_full())
        for body in bodies
        if plant.GetVisualGeometriesForBody(body) and not plant.IsAnchored(body)
    ]
    robot = scenario.robot
    return replace(scenario, robot=replace(robot, known_forces=[*robot.known_forces, *pushes]))
