"""A scenario whose references, surfaces and links a person moves while it runs."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

from pydrake.geometry import SceneGraph
from pydrake.multibody.tree import BodyIndex
from pydrake.systems.framework import Context

from drake_dae.arguments import checked
from drake_dae.dae.references import ConstantReference
from drake_dae.diagrams.closed_loop import ClosedLoop
from drake_dae.errors import DrakeDaeError, ScenarioError
from drake_dae.robots.constraints.points import PointOnSurface
from drake_dae.robots.known_forces import KnownWrench
from drake_dae.scenario.build import build_completed
from drake_dae.scenario.robot_file.links import robot_links
from drake_dae.scenario.scenario import Scenario
from drake_dae.scenario.start import start_scenario
from drake_dae.systems.control.command_filter import CommandLimits

PUSH = "push."
"""Begins the names of the wrenches that push links."""


@dataclass(frozen=True, eq=False)
class Commanded:
    """A loop that a person changes while it runs.

    Attributes:
        scenario: The scenario, completed, with what was added to it.
        loop: Its loop.
        context: The context of its diagram at the start.
        left_out: What cannot be changed in it, a sentence for each.
    """

    scenario: Scenario
    loop: ClosedLoop
    context: Context
    left_out: tuple[str, ...]


@checked(lambda text: ScenarioError(("", text)))
def build_commanded(scenario: Scenario, limits: CommandLimits | None = None) -> Commanded:
    """The loop of a scenario with `CommandedReferences`, surfaces that move, and links to push.

    What nobody commands is as in the scenario: surfaces stand still, wrenches and friction are
    zero. Signals for which a task waits are inputs of the diagram, to be given by hand. Where a
    part does not fit the scenario, it is left out.

    Args:
        scenario: What `load_scenario` returns.
        limits: How fast references follow; `CommandLimits()` if None.

    Raises:
        ScenarioError: The scenario itself does not fit; the message names its key.
    """
    limits = limits or CommandLimits()
    parts = dict(_PARTS)
    left_out = dict[str, str]()
    while True:
        try:
            changed = scenario
            for name, add in parts.items():
                result = add(changed)
                if isinstance(result, str):
                    left_out[name] = f"{name}: {result}"
                else:
                    changed = result
            completed, loop = build_completed(changed, commands=limits)
            # At rest, where the scenario itself starts at rest.
            begun = replace(completed.scenario, exogenous=scenario.exogenous)
            context = start_scenario(begun, loop)
            if loop.plant.pushes is not None:
                left_out.pop(_PUSHED, None)
            return Commanded(completed.scenario, loop, context, tuple(left_out.values()))
        except DrakeDaeError as error:
            if not parts:
                raise
            name = next(iter(parts))
            del parts[name]
            left_out[name] = f"{name}: {error}"


_PUSHED = "links that are pushed"

_COMPLIANT = "none, since the contact of the plant is compliant"


def _with_moving_surfaces(scenario: Scenario) -> Scenario | str:
    """Surfaces whose positions are exogenous signals that stand still; or why there are none."""
    if scenario.plant.material is not None:
        return _COMPLIANT
    if scenario.task is not None:
        return "none, since tasks support no moving surfaces"
    if scenario.observer is not None:
        return "none, since an observer supports no exogenous signals"
    moving = dict[str, Any]()
    for constraint in scenario.constraints:
        if isinstance(constraint, PointOnSurface):
            position = constraint.parameters[0]
            if position.name not in scenario.exogenous:
                moving[position.name] = [ConstantReference(x) for x in position.value.tolist()]
    return replace(scenario, exogenous={**scenario.exogenous, **moving})


def _with_friction(scenario: Scenario) -> Scenario | str:
    """Surfaces with the parameters of friction, which is zero; or why without."""
    lacks = any(
        isinstance(each, PointOnSurface) and each.friction is None for each in scenario.constraints
    )
    if not lacks or scenario.plant.material is not None:
        return scenario  # The plant may have a friction of its own.
    if scenario.actuation:
        return "none, since the law would differentiate it; give the constraint a friction"
    constraints = [
        replace(each, friction=0.0)
        if isinstance(each, PointOnSurface) and each.friction is None
        else each
        for each in scenario.constraints
    ]
    return replace(scenario, constraints=constraints)


def _with_pushes(scenario: Scenario) -> Scenario | str:
    """Links with wrenches that are zero; or why there are none."""
    if scenario.plant.material is not None:
        return _COMPLIANT
    plant = robot_links(scenario.robot, SceneGraph())[0].plant
    bodies = [plant.get_body(BodyIndex(i)) for i in range(1, plant.num_bodies())]
    pushes = [
        KnownWrench(body.scoped_name().get_full(), name=PUSH + body.scoped_name().get_full())
        for body in bodies
        if plant.GetVisualGeometriesForBody(body) and not plant.IsAnchored(body)
    ]
    return replace(scenario, known_forces=[*scenario.known_forces, *pushes])


_PARTS: Mapping[str, Callable[[Scenario], Scenario | str]] = {
    "friction of the plant": _with_friction,
    "surfaces that are dragged": _with_moving_surfaces,
    _PUSHED: _with_pushes,
}
"""What is added, in the order in which it is left out again."""
