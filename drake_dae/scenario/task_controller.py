"""The controller of a scenario with a task, and the keys that it excludes."""

import numpy as np

from drake_dae.dae import TrackingLaw, find_structure
from drake_dae.errors import ModelError, ScenarioError
from drake_dae.robots import Constraint, RobotModel
from drake_dae.scenario.form import at
from drake_dae.scenario.plants import IdealConstraints
from drake_dae.scenario.scenario import Scenario
from drake_dae.systems.task.contacts import open_contact
from drake_dae.systems.task.controller import TaskController


def check_task(scenario: Scenario) -> None:
    """Checks that the keys of a scenario fit its task.

    Raises:
        ScenarioError: A key does not fit a task, or start.positions are missing.
    """
    refused = {"references": "a task has the references of its phases; leave them out"}
    problems = [(key, text) for key, text in refused.items() if getattr(scenario, key)]
    if (task := scenario.task) is not None:
        names = [name for name in task.make().watched("signal") if name not in task.signals]
        problems += [(f"task.signals.{name}", "needed: a phase watches it") for name in names]
    if isinstance(scenario.plant, IdealConstraints):
        text = (
            "ideal constraints neither open nor strike, as a task needs it: take !CompliantContact "
            "or !MultibodyPlant"
        )
        problems.append(("plant", text))
    if scenario.start.errors:
        problems.append(("start.errors", "a task begins at start.positions; leave them out"))
    if problems:
        raise ScenarioError(*problems)


def task_controller(
    scenario: Scenario, model: RobotModel, law: TrackingLaw, period: float
) -> TaskController:
    """The controller of a scenario with a task.

    Args:
        scenario: The scenario.
        model: Its robot.
        law: The law in contact.
        period: The time between its samples in s; 0 for 1 ms.

    Raises:
        ScenarioError: Something does not fit; the message names its key.
    """
    task = scenario.task
    assert task is not None
    assert scenario.law.gains is not None  # advised.
    noise = float(np.max(scenario.sensors.force_noise))
    points = opening_contact(scenario, model)
    forces = [signal.name for point in points for signal in point.force_signals]
    with at("task"):
        free_system = open_contact(law.system, forces)
    with at("task.gains" if task.gains else "law.gains"):
        structure = find_structure(free_system)
        gains = (task.gains or scenario.law.gains).design()
        free_law = TrackingLaw(free_system, gains, structure=structure, latency=law.latency)
    with at("task"):
        # The noise of the sum over the points.
        return TaskController(
            task.make(noise * len(points) ** 0.5), law, free_law, sample_period=period or 1e-3
        )


def opening_contact(scenario: Scenario, model: RobotModel) -> tuple[Constraint, ...]:
    """The constraints of the points of the contact of a task."""
    assert scenario.task is not None
    fitting = {c.name: c for c in model.constraints if c.is_unilateral == (True,)}
    given = scenario.task.contact
    names = [given] if isinstance(given, str) and given else list(given)
    with at("task.contact"):
        for name in names:
            if name not in fitting:
                raise ModelError(
                    f"'{name}' is not a unilateral constraint with one force; these are "
                    f"{', '.join(fitting) or 'none'}"
                )
        if len(set(names)) < len(names):
            raise ModelError(f"a point is named twice: {', '.join(names)}")
        if not names and len(fitting) != 1:
            raise ModelError(
                "needed, since the unilateral constraints with one force are "
                f"{', '.join(fitting) or 'none'}; give one, or a list of points"
            )
    return tuple(c for name, c in fitting.items() if not names or name in names)
