"""The closed loop of a scenario."""

from collections.abc import Mapping, Sequence
from functools import partial

import numpy as np
from pydrake.geometry import Meshcat, SceneGraph

from drake_dae.arrays import FloatArray, positive
from drake_dae.dae.structure.structure import Structure
from drake_dae.dae.system.signals import outputs_named
from drake_dae.dae.system.system import DaeSystem
from drake_dae.dae.tracking.tracking import TrackingLaw
from drake_dae.diagrams.closed_loop import ClosedLoop
from drake_dae.diagrams.drives import hold_before
from drake_dae.diagrams.settings import LoopSettings
from drake_dae.diagrams.state_feedback import make_sensor
from drake_dae.diagrams.wiring import make_closed_loop, wire_loop
from drake_dae.errors import InconsistentStateError, ModelError, ScenarioError
from drake_dae.references import ConstantReference, Reference
from drake_dae.references.by_name import assign, in_order
from drake_dae.robots.model import RobotModel
from drake_dae.scenario.controllers.task_controller import task_controller
from drake_dae.scenario.forms.keys import at
from drake_dae.scenario.observed import latency_of, observed_structure
from drake_dae.scenario.own_model import check_disturbances, own_model
from drake_dae.scenario.parts.parts import Poles
from drake_dae.scenario.plants import RobotToSimulate
from drake_dae.scenario.robot_file.links import add_robot
from drake_dae.scenario.scenario import Scenario
from drake_dae.systems.plants.contract import Plant


def build_loop(
    scenario: Scenario,
    model: RobotModel,
    structure: Structure,
    scene_graph: SceneGraph | None = None,
    meshcat: Meshcat | None = None,
    plant: Plant | None = None,
    commanded: bool = False,
) -> ClosedLoop:
    """Builds the closed loop of a scenario's robot.

    Args:
        scenario: A completed scenario, from `advised`.
        model: The scenario's robot, by `scenario_model`.
        structure: The structure of the model's system.
        scene_graph: The scene graph of the robot's geometry; needed to draw it.
        meshcat: The Meshcat for a live view; None for no view.
        plant: A plant in place of the scenario's; None for the scenario's.
        commanded: Whether a person changes references during the run; signals for which a task
            waits are then inputs of the diagram.

    Raises:
        ScenarioError: Something does not fit; the message names its key.
    """
    # The law, and its exogenous signals.
    task, sampling = scenario.task, scenario.sampling
    observed = observed_structure(scenario, model, structure)
    law = _law(scenario, observed, latency_of(scenario, model))
    references = [] if task is not None else _references(scenario.references, law)
    exogenous = []
    if scenario.estimator is None:
        exogenous = exogenous_references(scenario, law.system, law.exogenous_degrees)
    limits = _limits(scenario, model)

    # The plant, which may have further exogenous signals.
    of_plant = own_model(scenario, model.links) if plant is None else None
    plant_exogenous = None
    if of_plant is not None:
        plant = make_plant(scenario, of_plant.model, of_plant.structure)
        scene_graph = of_plant.scene_graph
        degrees = plant.exogenous_layout.degrees
        plant_exogenous = exogenous_references(of_plant.scenario, plant.dae, degrees)
    plant = plant or make_plant(scenario, model, structure)

    # The parts between plant and law; errors get the key of the part.
    force = scenario.sensors.force
    with at("sensors.force"):
        sensor = None if force is None else force.sensor(model.dae.num_constraints)
    settings = LoopSettings(
        sensor=sensor,
        encoders=scenario.sensors.encoders,
        sampling=sampling,
        control_limits=limits,
        observer=scenario.estimator,
        exogenous=exogenous,
        plant_exogenous=plant_exogenous,
        signals={} if task is None or commanded else task.signals,
        commanded=commanded,
        start_time=scenario.integrator.start_time,
    )
    _check_parts(settings, plant)
    with at("judgement.tolerances"):
        outputs_named(scenario.judgement.tolerances, model.dae.output_signals)
        for name, error in scenario.judgement.tolerances.items():
            positive(name, error)

    # The connections.
    if task is not None:
        with at("task"):
            controller = task_controller(scenario, model, law, settings.period(plant.time_step))
            return wire_loop(
                plant, controller, None, settings, scene_graph=scene_graph, meshcat=meshcat
            )
    keys = ["estimator"] if scenario.estimator is not None else []
    keys += ["sensors.force"] if force is not None or keys else []
    with at(" or ".join(keys) or "start.positions"):
        return make_closed_loop(
            plant, law, references, settings, scene_graph=scene_graph, meshcat=meshcat
        )


def make_plant(
    scenario: Scenario,
    model: RobotModel,
    structure: Structure,
) -> Plant:
    """Makes the plant of a scenario.

    Args:
        scenario: The scenario.
        model: The robot, with payloads if the plant does not add them itself.
        structure: The structure of the model's system.

    Raises:
        ScenarioError: The robot cannot be simulated so; the message names the key.
    """
    check_disturbances(scenario.plant.disturbances, model.links)
    robot = RobotToSimulate(
        model,
        structure,
        partial(add_robot, scenario.robot, payloads=scenario.plant.payloads),
        scenario.plant.parameters,
        scenario.plant.disturbances,
    )
    try:
        return scenario.plant.plant(robot)
    except InconsistentStateError as error:  # Its default state is projected.
        raise ScenarioError(("start.positions", str(error))) from error


def _law(scenario: Scenario, structure: Structure, latency: float) -> TrackingLaw:
    """The law of a scenario for a system, with a latency in s."""
    law, is_measured = scenario.law, scenario.sensors.force is not None
    damping = law.constraint_damping
    keys = ["sensors.force", "law.gains"] if is_measured else ["law.gains"]
    keys += [f"law.{key}" for key in ("constraint_damping", "integral") if getattr(law, key)]
    if law.contact_stiffness is not None:
        keys = ["law.contact_stiffness", *keys]
        if scenario.task is not None:
            text = "is not for scenarios with `task`; leave it out"
            raise ScenarioError(("law.contact_stiffness", text))
    with at(" or ".join(keys)):
        return TrackingLaw(
            structure.system,
            (law.gains or Poles(all=[-4.0])).design(),
            structure=structure,
            measured_force=is_measured,
            force_gain=law.force_gain,
            constraint_damping=None if damping is None else damping.design(),
            integral=law.integral or (),
            contact_stiffness=law.contact_stiffness,
            latency=latency,
        )


def _check_parts(settings: LoopSettings, plant: Plant) -> None:
    """Checks that the parts of a loop fit the plant; errors get the keys of the parts."""
    if settings.sampling is not None:
        with at("sampling"):
            hold_before(plant, settings.sampling)
    if settings.encoders is not None:
        with at("sensors.encoders"):
            make_sensor(plant, settings.encoders, settings.period(plant.time_step))


@at("saturation")
def _limits(scenario: Scenario, model: RobotModel) -> FloatArray | None:
    """The limits of the controls, if the scenario has saturation."""
    if not scenario.saturation:
        return None
    if not np.any(np.isfinite(model.control_limits)):
        raise ModelError("the robot's file has no effort limits, or they are not on the control")
    return model.control_limits


def _references(references: Mapping[str, Reference | float], law: TrackingLaw) -> list[Reference]:
    """References in the order of the outputs, each smooth enough."""
    outputs = [signal.name for signal in law.system.output_signals]
    smooth = []
    for name, reference in references.items():
        with at(f"references.{name}"):
            degrees = law.layout.reference_degrees
            smooth.append(assign(name, reference, outputs, degrees))
    with at("references"):
        return in_order(smooth, outputs)


def exogenous_references(
    scenario: Scenario, system: DaeSystem, needed: Sequence[int]
) -> list[Reference]:
    """The references of the exogenous parameters, in the order of the system.

    Args:
        scenario: The scenario.
        system: The system of its plant or of its law.
        needed: The number of derivatives of each entry that are needed.

    Raises:
        ScenarioError: There are too few or too many, or one is not smooth enough.
    """
    moving: list[Reference] = []
    degrees = list(needed)
    for parameter in system.exogenous.moving:
        key = f"exogenous.{parameter.name}"
        references = [
            entry if isinstance(entry, Reference) else ConstantReference(entry)
            for entry in scenario.exogenous[parameter.name]
        ]
        size = sum(reference.size for reference in references)
        if size != parameter.value.size:
            text = f"{size} values, but the parameter has {parameter.value.size}"
            raise ScenarioError((key, text))
        for index, reference in enumerate(references):
            with at(f"{key}.{index}"):
                reference.derivatives(degrees[: reference.size])
            del degrees[: reference.size]
        moving += references
    return moving
