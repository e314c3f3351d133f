"""The loop of a scenario with a task."""

import numpy as np
from pydrake.geometry import Meshcat, SceneGraph
from pydrake.systems.framework import Context

from drake_dae.dae.structure.structure import Structure
from drake_dae.dae.tracking.tracking import TrackingLaw
from drake_dae.diagrams.task_loop import TaskLoop, make_task_loop
from drake_dae.diagrams.unilateral import Unilateral
from drake_dae.diagrams.wiring import hold_before
from drake_dae.errors import ModelError, ScenarioError
from drake_dae.robots.constraints import Constraint
from drake_dae.robots.model import RobotModel
from drake_dae.scenario.forms.keys import at
from drake_dae.scenario.model import start_guess
from drake_dae.scenario.plant import contact_plant
from drake_dae.scenario.scenario import Scenario
from drake_dae.scenario.start import new_context
from drake_dae.systems.plants.contact.contact_material import ContactMaterial
from drake_dae.systems.plants.contact.contact_plant import ContactPlant
from drake_dae.systems.plants.unilateral.plant import UnilateralRobotPlant
from drake_dae.systems.task.controller import TaskController
from drake_dae.systems.task.open_contact import open_contact


def wire_task(
    scenario: Scenario,
    model: RobotModel,
    structure: Structure,
    scene_graph: SceneGraph | None = None,
    meshcat: Meshcat | None = None,
) -> TaskLoop:
    """The loop of a scenario with a task.

    Args:
        scenario: The scenario.
        model: Its robot.
        structure: The structure of the model's system.
        scene_graph: Where the robot's geometry is registered; needed to draw it.
        meshcat: Where to draw while the run goes on; None draws nothing.

    Raises:
        ScenarioError: Something does not fit; the message names its key.
    """
    task = scenario.task
    assert task is not None
    contact = _contact(scenario, model)
    (force,) = [signal.name for signal in contact.force_signals]
    with at("task"):
        free_system = open_contact(model.dae, force)
    damping, gains = scenario.constraint_damping, scenario.gains
    if gains is None:
        raise ScenarioError(("gains", "none are advised for a task in Drake's contact: give some"))
    with at("gains, force, integral or constraint_damping"):
        law = TrackingLaw(
            model.dae,
            gains.design(),
            structure=structure,
            measured_force=scenario.force.is_measured,
            force_gain=scenario.force.gain,
            constraint_damping=None if damping is None else damping.design(),
            integral=scenario.integral or (),
        )
        sensor = scenario.force.sensor(model.dae.num_constraints)
    with at("task.gains" if task.gains else "gains"):
        free_law = TrackingLaw(free_system, (task.gains or gains).design())

    plant: ContactPlant | UnilateralRobotPlant
    if isinstance(scenario.plant, ContactMaterial):
        plant = contact_plant(scenario, model, structure)
    else:
        with at("plant or plant_parameters"):
            given = scenario.plant
            made = given if isinstance(given, Unilateral) else Unilateral({contact.name: 0.0})
            plant = made.plant(model, structure)
    period = plant.time_step
    if scenario.sampling is not None:
        period = scenario.sampling.period
        with at("sampling"):
            hold_before(plant, scenario.sampling)
    with at("task"):
        controller = TaskController(task.made(), law, free_law, sample_period=period)
        return make_task_loop(
            plant,
            controller,
            sensor=sensor,
            sampling=scenario.sampling,
            scene_graph=scene_graph,
            meshcat=meshcat,
        )


def start_task(scenario: Scenario, loop: TaskLoop) -> Context:
    """A new context of a task's loop at a scenario's start: at rest at start.positions.

    Where the first phase is in contact, or other constraints hold, it is on these next to them.

    The arguments and errors are those of `start_scenario`.
    """
    context, plant, model = new_context(scenario, loop), loop.plant, loop.plant.model
    own = plant.GetMyMutableContextFromRoot(context)
    controller, values = loop.controller, plant.current_parameters(own)
    law = controller.law if controller.task.contacts[0] else controller.free_law
    with at("start"):
        guess = start_guess(scenario.start.positions, model.links)
        forces = np.zeros(model.dae.num_outputs - len(model.position_signals))
        near = model.rest_state(guess, forces, values)
        q = law.structure.manifold.settle(near, values)[: guess.size]
        loop.set_state(context, model.rest_state(q, forces, values))
    loop.set_seed(context, scenario.force.seed)
    return context


def check_task(scenario: Scenario) -> None:
    """Refuses what a task has no use for.

    Raises:
        ScenarioError: A key does not fit a task, or start.positions are missing.
    """
    refused = {
        "references": "a task has the references of its phases; leave them out",
        "exogenous": "nothing may move in a task; leave it out",
        "saturation": "the drives of a task have no limits; leave it out",
        **dict.fromkeys(
            ("observer", "encoders", "tolerances", "plant_payloads", "plant_pushes"),
            "a task does not know it; leave it out",
        ),
    }
    found = [(key, text) for key, text in refused.items() if getattr(scenario, key)]
    if scenario.start.errors:
        found.append(("start.errors", "a task begins at start.positions; leave them out"))
    if not scenario.start.positions:
        found.append(("start.positions", "needed: where the task begins, joint by joint"))
    if found:
        raise ScenarioError(*found)


def _contact(scenario: Scenario, model: RobotModel) -> Constraint:
    """The constraint that opens and closes."""
    assert scenario.task is not None
    fitting = {one.name: one for one in model.constraints if one.can_only_push == (True,)}
    name = scenario.task.contact
    with at("task.contact"):
        if name:
            if name in fitting:
                return fitting[name]
            raise ModelError(
                f"'{name}' is no constraint with one force that can only push; such are "
                f"{', '.join(fitting) or 'none'}"
            )
        if len(fitting) != 1:
            raise ModelError(
                "needed, since the constraints with one force that can only push are "
                f"{', '.join(fitting) or 'none'}"
            )
    return next(iter(fitting.values()))
