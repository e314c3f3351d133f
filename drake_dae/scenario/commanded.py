"""A scenario whose references, surfaces and links a person can move while it runs."""

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
"""The prefix of the names of wrenches on links."""


@dataclass(frozen=True, eq=False)
class Commanded:
    """A loop that a person can change while it runs.

    Attributes:
        scenario: The completed scenario, with the added parameters and wrenches.
        loop: Its closed loop.
        context: The context of its diagram at the start.
        left_out: A sentence for each kind of change that is not possible.
    """

    scenario: Scenario
    loop: ClosedLoop
    context: Context
    left_out: tuple[str, ...]


@checked(lambda text: ScenarioError(("", text)))
def build_commanded(scenario: Scenario, limits: CommandLimits | None = None) -> Commanded:
    """Builds a loop with `CommandedReferences`, surfaces that can be moved, and wrenches on links.

    Without commands the loop runs as in the scenario: surfaces are fixed, and wrenches and
    additional friction are zero. Signals for which a task waits are inputs of the diagram. Changes
    that the scenario does not permit are left out.

    Args:
        scenario: What `load_scenario` returns.
        limits: How fast references follow commands; `CommandLimits()` if None.

    Raises:
        ScenarioError: The scenario itself is not valid; the message names the key.
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
            at_start = replace(completed.scenario, exogenous=scenario.exogenous)
            context = start_scenario(at_start, loop)
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
    """Makes the positions of surfaces constant exogenous signals; or says why it cannot."""
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
    """Gives frictionless contacts a coefficient of friction of 0; or says why it cannot."""
    constraints = [
        replace(constraint, friction=0.0)
        if isinstance(constraint, PointOnSurface) and constraint.friction is None
        else constraint
        for constraint in scenario.constraints
    ]
    # The plant may have a friction of its own.
    if constraints == scenario.constraints or scenario.plant.material is not None:
        return scenario
    if scenario.actuation:
        return "none, since the law would differentiate it; give the constraint a friction"
    return replace(scenario, constraints=constraints)


def _with_pushes(scenario: Scenario) -> Scenario | str:
    """Adds a zero wrench to each movable link; or says why it cannot."""
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
"""The additions by name. If the loop cannot be built, the first one is left out first."""
