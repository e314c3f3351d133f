"""The controller of a scenario with a task, and the keys that it excludes."""

import numpy as np

from drake_dae.dae.structure.structure import find_structure
from drake_dae.dae.tracking.tracking import TrackingLaw
from drake_dae.errors import ModelError, ScenarioError
from drake_dae.robots.constraints import Constraint
from drake_dae.robots.constraints.points import PointOnSurface
from drake_dae.robots.model import RobotModel
from drake_dae.robots.surfaces.plate import Plate
from drake_dae.scenario.forms.keys import at
from drake_dae.scenario.scenario import Scenario
from drake_dae.systems.task.contacts.laws import laws_of_latches
from drake_dae.systems.task.contacts.open_contact import open_contact
from drake_dae.systems.task.controller import TaskController
from drake_dae.systems.task.phases import Insert


def check_task(scenario: Scenario) -> None:
    """Checks that the keys of a scenario fit its task.

    Raises:
        ScenarioError: A key does not fit a task, or start.positions are missing.
    """
    refused = {"references": "a task has the references of its phases; leave them out"}
    refused |= TaskController.refused
    problems = [(key, text) for key, text in refused.items() if getattr(scenario, key)]
    if (task := scenario.task) is not None:
        names = [name for name in task.make().signals if name not in task.signals]
        problems += [(f"task.signals.{name}", "needed: a phase waits for it") for name in names]
        ending = [c.name for c in scenario.constraints if isinstance(c, Constraint) and c.ends]
        entering = [phase.name for phase in task.phases if phase.enters_holes]
        if ending and entering and not scenario.plant.has_sides:
            text = (
                f"{entering[0]} enters a hole, and the ideal contact of '{ending[0]}' has a face "
                "that ends, and no sides without a peg; give it, as pegs: [{constraint: "
                f"{ending[0]}, radius: 0.00495, length: 0.02}}], or take !MultibodyPlant"
            )
            problems.append(("plant", text))
        problems += _too_deep(scenario)
    if scenario.start.errors:
        problems.append(("start.errors", "a task begins at start.positions; leave them out"))
    if problems:
        raise ScenarioError(*problems)


def _too_deep(scenario: Scenario) -> list[tuple[str, str]]:
    """Insertions beyond the end of what the plant has in a hole.

    A through hole lets a longer peg through, in ideal contact up to its far side. Nothing is in the
    hole behind a peg, or where a ball has left it.
    """
    plant, task = scenario.plant, scenario.task
    assert task is not None
    plates = {
        c.name: c.surface
        for c in scenario.constraints
        if isinstance(c, PointOnSurface) and isinstance(c.surface, Plate)
    }
    inserts = [phase for phase in task.phases if isinstance(phase, Insert)]
    if not inserts or not plant.has_sides:
        return []
    pegs = {peg.constraint: peg for peg in plant.pegs}
    material, ends = plant.material, list[tuple[float, str]]()
    if material is None:
        for name, peg in pegs.items():
            end = min(peg.length, plates[name].thickness if name in plates else np.inf)
            text = "in ideal contact it must be less than {end:g} m, the length of the peg or the "
            ends.append(
                (float(np.nextafter(end, 0.0)), text.format(end=end) + "thickness of the plate")
            )
    else:
        pegs = {peg.constraint: peg for peg in material.pegs}
        for name, plate in plates.items():
            if plate.hole is None:
                continue
            if name in pegs:
                end = pegs[name].length
                text = f"the peg of '{name}' (plant.pegs) is {end:g} m long"
            else:
                end = plate.thickness + 2.0 * material.radius
                text = (
                    f"the tool is a ball of {material.radius:g} m (plant.radius), which has left "
                    f"the plate of '{name}' at its far side then, {plate.thickness:g} m below its "
                    "face; give a smaller depth, or a peg as plant.pegs"
                )
            ends.append((end, text))
    return [
        ("task.phases", f"{phase.name} is {phase.depth:g} m deep, and {text}")
        for phase in inserts
        for end, text in ends
        if phase.depth > end
    ]


def task_controller(
    scenario: Scenario, model: RobotModel, law: TrackingLaw, period: float
) -> TaskController:
    """The controller of a scenario with a task.

    Args:
        scenario: The scenario.
        model: Its robot.
        law: The law in contact.
        period: The time between its samples in s; 0 for none.

    Raises:
        ScenarioError: Something does not fit; the message names its key.
    """
    task = scenario.task
    assert task is not None
    assert scenario.gains is not None  # advised.
    noise = float(np.max(np.asarray(getattr(scenario.force_feedback, "noise_deviation", 0.0))))
    if noise and not period:
        text = (
            f"needed: the force sensor has noise of {noise:g} N, which a task without samples "
            "cannot filter, and would take for a touch"
        )
        raise ScenarioError(("sampling", text))
    if scenario.observer is not None and any(isinstance(p, Insert) for p in task.phases):
        text = (
            "an Insert lets the hole push the tool aside, and an observer would cancel that push; "
            "give gains, and no observer"
        )
        raise ScenarioError(("observer", text))
    if task.make().plan.latches:
        return _latched(scenario, model, law.latency, period)
    points = opening_contact(scenario, model)
    forces = [signal.name for point in points for signal in point.force_signals]
    with at("task"):
        free_system = open_contact(law.system, forces)
    with at("task.gains" if task.gains else "gains"):
        structure = find_structure(free_system)
        gains = (task.gains or scenario.gains).design()
        free_law = TrackingLaw(free_system, gains, structure=structure, latency=law.latency)
    with at("task"):
        # The noise of the sum over the points.
        return TaskController(
            task.make(noise * len(points) ** 0.5), law, free_law, sample_period=period
        )


def _latched(
    scenario: Scenario, model: RobotModel, latency: float, period: float
) -> TaskController:
    """The controller of a scenario whose task opens and closes latches."""
    task = scenario.task
    assert task is not None
    assert scenario.gains is not None
    if task.contact:
        text = "its phases name the latches that they open and close; leave it out"
        raise ScenarioError(("task.contact", text))
    for key in ("observer", "integral"):
        if getattr(scenario, key):
            raise ScenarioError((key, "not for a task with latches; leave it out"))
    if scenario.force_feedback.is_measured:
        text = "a law of a task with latches takes no measured force; leave it out"
        raise ScenarioError(("force_feedback", text))
    with at("task"):
        made = task.make()
        free = None if task.gains is None else task.gains.design()
        gains = scenario.gains.design()
        pairs = laws_of_latches(made.plan, model.dae, gains, free, latency)
        return TaskController(
            made, *pairs[0], further=pairs[1:], whole=model.dae, sample_period=period
        )


def opening_contact(scenario: Scenario, model: RobotModel) -> tuple[Constraint, ...]:
    """The constraint that opens and closes, or those of the points of a face; none with latches."""
    assert scenario.task is not None
    if scenario.task.make().plan.latches:
        return ()
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
                f"{', '.join(fitting) or 'none'}; give one, or a list of the points of a face"
            )
    return tuple(c for name, c in fitting.items() if not names or name in names)
