"""A scenario as a closed loop."""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from pydrake.geometry import Meshcat, SceneGraph
from pydrake.systems.framework import Context

from drake_dae.arguments import checked
from drake_dae.arrays import FloatArray, positive, unknown_name
from drake_dae.dae import Structure, TrackingLaw, find_structure, outputs_named, with_disturbance
from drake_dae.diagrams.closed_loop import ClosedLoop
from drake_dae.diagrams.drives import hold_before
from drake_dae.diagrams.settings import LoopSettings
from drake_dae.diagrams.state_feedback import make_sensor
from drake_dae.diagrams.wiring import make_closed_loop, wire_loop
from drake_dae.errors import AssumptionError, InconsistentStateError, ModelError, ScenarioError
from drake_dae.references import Reference
from drake_dae.robots import Links, RobotModel, ScaledForce
from drake_dae.scenario.completion import Completed
from drake_dae.scenario.form import at, each
from drake_dae.scenario.gains import advised, latency_of
from drake_dae.scenario.model import completed_model, scenario_structure
from drake_dae.scenario.motion import exogenous_references, references_of
from drake_dae.scenario.parts import Poles
from drake_dae.scenario.robot_file.reading import add_robot
from drake_dae.scenario.scenario import Scenario
from drake_dae.scenario.start import start_scenario
from drake_dae.scenario.task_controller import check_task, task_controller
from drake_dae.systems.plants.contact.disturbance_forces import DisturbanceForce
from drake_dae.systems.plants.contract import Plant


@checked(lambda text: ScenarioError(("", text)))
def build_scenario(
    scenario: Scenario, meshcat: Meshcat | None = None
) -> tuple[ClosedLoop, Context]:
    """Builds the closed loop of a scenario, and its context at the start.

    Args:
        scenario: A scenario, as `load_scenario` returns it.
        meshcat: The Meshcat for a live view; None for no view.

    Raises:
        ScenarioError: The scenario is not valid; the message names the key.
    """
    completed, loop = build_completed(scenario, meshcat)
    return loop, start_scenario(completed.scenario, loop)


def build_completed(
    scenario: Scenario, meshcat: Meshcat | None = None, commanded: bool = False
) -> tuple[Completed, ClosedLoop]:
    """Completes a scenario and builds its loop, which `start_scenario` can start repeatedly.

    Args:
        scenario, meshcat: As for `build_scenario`.
        commanded: Whether a person changes references during the run; signals for which a task
            waits are then inputs of the diagram.

    Returns:
        The scenario with outputs, start and gains, the choices in words, and the loop.
    """
    # The robot, with the outputs and the start that the scenario leaves out.
    if scenario.task is not None:
        check_task(scenario)
    scene_graph = SceneGraph()
    completed, model, structure = completed_model(scenario, scene_graph)
    if structure is None:
        try:
            structure = scenario_structure(model)
        except AssumptionError as error:
            key = "constraints" if error.assumption <= 3 else "outputs"
            hint = "" if error.state is None else "; start.positions choose another start"
            raise ScenarioError((key, f"{error}{hint}")) from error

    # The gains, with what belongs to them.
    chosen = advised(completed.scenario, model, structure)
    scenario, task = chosen.scenario, chosen.scenario.task

    # The plant, which may carry payloads and disturbances that the law does not know.
    plant, plant_exogenous, scene_graph = _plant(scenario, model, structure, scene_graph)

    # The law, of a model with a disturbance if there is an estimator of it.
    law = tracking_law(scenario, model, structure)

    # The controller, and the signals of time that it follows.
    references, exogenous = [], []
    if task is None:
        names = [signal.name for signal in law.system.output_signals]
        references = references_of(scenario, names, law.layout.reference_degrees)
    if scenario.estimator is None:
        exogenous = exogenous_references(scenario, law.system, law.exogenous_degrees)

    # The parts between plant and law; errors get the key of the part.
    force = scenario.sensors.force
    with at("sensors.force"):
        sensor = None if force is None else force.sensor(model.dae.num_constraints)
    settings = LoopSettings(
        sensor=sensor,
        encoders=scenario.sensors.encoders,
        sampling=scenario.sampling,
        control_limits=_limits(scenario, model),
        observer=scenario.estimator,
        exogenous=exogenous,
        plant_exogenous=plant_exogenous,
        signals={} if task is None or commanded else task.signals,
        commanded=commanded,
        start_time=scenario.integrator.start_time,
    )
    period = settings.period(plant.time_step)
    if settings.sampling is not None:
        with at("sampling"):
            hold_before(plant, settings.sampling)
    if settings.encoders is not None:
        with at("sensors.encoders"):
            make_sensor(plant, settings.encoders, period)
    with at("judgement.tolerances"):
        outputs_named(scenario.judgement.tolerances, model.dae.output_signals)
        for name, tolerated in scenario.judgement.tolerances.items():
            if tolerated is not None:
                positive(name, tolerated)

    # The loop.
    drawn = {"scene_graph": scene_graph, "meshcat": meshcat}
    if task is not None:
        with at("task"):
            controller = task_controller(scenario, model, law, period)
            loop = wire_loop(plant, controller, None, settings, **drawn)
    else:
        keys = ["estimator"] if scenario.estimator is not None else []
        keys += ["sensors.force"] if force is not None or keys else []
        with at(" or ".join(keys) or "start.positions"):
            loop = make_closed_loop(plant, law, references, settings, **drawn)
    loop.memory["gains"] = {repr(scenario.law.gains): None}  # Those of the law.
    return Completed(scenario, (*completed.notes, *chosen.notes)), loop


def make_plant(scenario: Scenario, model: RobotModel, structure: Structure) -> Plant:
    """Makes the plant of a scenario.

    Args:
        scenario: The scenario.
        model: The robot, with payloads if the plant does not add them itself.
        structure: The structure of the model's system.

    Raises:
        ScenarioError: The robot cannot be simulated so; the message names the key.
    """
    check_disturbances(scenario.plant.disturbances, model.links)
    add = partial(add_robot, scenario.robot, payloads=scenario.plant.payloads)
    try:
        return scenario.plant.plant(model, structure, add)
    except InconsistentStateError as error:  # Its default state is projected.
        raise ScenarioError(("start.positions", str(error))) from error


def _plant(
    scenario: Scenario, model: RobotModel, structure: Structure, scene_graph: SceneGraph
) -> tuple[Plant, list[Reference] | None, SceneGraph]:
    """The plant, the references of its exogenous signals (None: the law's), and its geometry.

    In an ideal plant a payload is a further body, and the course of a disturbance an exogenous
    signal. Masses and forces are parameters, which `start_scenario` sets in a context.
    """
    payloads, disturbances = scenario.plant.payloads, scenario.plant.disturbances
    if scenario.plant.carries or not (payloads or disturbances):
        return make_plant(scenario, model, structure), None, scene_graph
    check_disturbances(disturbances, model.links)
    named = {f"plant_disturbance_{index}": entry for index, entry in enumerate(disturbances)}
    forces = [ScaledForce(d.frame, d.point, name, d.force) for name, d in named.items()]
    moving: dict[str, Any] = {f"{name}.course": [entry.course] for name, entry in named.items()}
    own = replace(
        scenario,
        robot=replace(scenario.robot, known_forces=[*scenario.robot.known_forces, *forces]),
        exogenous={**scenario.exogenous, **moving},
    )
    scene_graph = SceneGraph()
    _, model, _ = completed_model(own, scene_graph, payloads)
    plant = make_plant(own, model, scenario_structure(model))
    degrees = plant.exogenous_layout.degrees
    return plant, exogenous_references(own, plant.dae, degrees), scene_graph


def check_disturbances(disturbances: Sequence[DisturbanceForce], links: Links) -> None:
    """Refuses disturbances that do not act on a frame of the robot."""

    def check(disturbance: DisturbanceForce) -> None:
        links.position(disturbance.frame, disturbance.point)
        if disturbance.frame == "world":
            raise ModelError("a disturbance on the world moves nothing; name a frame of the robot")

    each("plant.disturbances", disturbances, check)


def tracking_law(scenario: Scenario, model: RobotModel, structure: Structure) -> TrackingLaw:
    """The law of a scenario, after `advised`."""
    settings, is_measured = scenario.law, scenario.sensors.force is not None
    damping = settings.constraint_damping
    keys = ["sensors.force", "law.gains"] if is_measured else ["law.gains"]
    keys += [f"law.{key}" for key in ("constraint_damping", "integral") if getattr(settings, key)]
    if settings.contact_stiffness is not None:
        keys = ["law.contact_stiffness", *keys]
        if scenario.task is not None:
            text = "is not for scenarios with `task`; leave it out"
            raise ScenarioError(("law.contact_stiffness", text))
    structure = _observed(scenario, model, structure)
    with at(" or ".join(keys)):
        return TrackingLaw(
            structure.system,
            (settings.gains or Poles(all=[-4.0])).design(),
            structure=structure,
            measured_force=is_measured,
            force_gain=settings.force_gain,
            constraint_damping=None if damping is None else damping.design(),
            integral=settings.integral or (),
            contact_stiffness=settings.contact_stiffness,
            latency=latency_of(scenario, model),
        )


def _observed(scenario: Scenario, model: RobotModel, structure: Structure) -> Structure:
    """The structure of the law's system, with a disturbance if the scenario has an estimator."""
    estimator = scenario.estimator
    if estimator is None:
        return structure
    if estimator.rate is None:
        text = "needed, since no gains are computed; leave `law.gains` out with Drake's contact"
        raise ScenarioError(("estimator.rate", text))
    with at("estimator"):
        if scenario.exogenous:
            raise ModelError("not beside exogenous signals, whose port it feeds")
        known = [parameter.name for parameter in model.dae.parameters]
        for name in estimator.identify:
            if name not in known:
                hint = "; give the constraint friction: 0.0 if it is unknown"
                text = unknown_name("parameter", name, known)
                raise ModelError(f"identify: {text}{hint * name.endswith('.friction')}")
        velocities = [signal.name for signal in model.links.velocity_signals]
        with at("estimator.identify"):
            observed = with_disturbance(model.dae, velocities, estimator.identify)
        return find_structure(observed)


@at("saturation")
def _limits(scenario: Scenario, model: RobotModel) -> FloatArray | None:
    """The limits of the controls, if the scenario has saturation."""
    if not scenario.saturation:
        return None
    if not np.any(np.isfinite(model.control_limits)):
        raise ModelError("the robot's file has no effort limits, or they are not on the control")
    return model.control_limits
