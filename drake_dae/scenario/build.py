"""The closed loop that a scenario describes."""

from collections.abc import Mapping, Sequence

import numpy as np
from pydrake.geometry import Meshcat, SceneGraph
from pydrake.systems.framework import Context

from drake_dae.arguments import checked
from drake_dae.arrays import FloatArray
from drake_dae.dae.references import ConstantReference, Reference
from drake_dae.dae.references.by_name import assigned, in_order
from drake_dae.dae.structure.structure import Structure
from drake_dae.dae.system.system import DaeSystem
from drake_dae.dae.tracking.tracking import TrackingLaw
from drake_dae.diagrams.closed_loop import ClosedLoop
from drake_dae.diagrams.closed_loop_wiring import can_be_fed_back, make_closed_loop
from drake_dae.diagrams.state_feedback import make_sensor
from drake_dae.diagrams.task_loop import TaskLoop
from drake_dae.diagrams.unilateral import Unilateral
from drake_dae.diagrams.wiring import hold_before
from drake_dae.errors import (
    AssumptionError,
    ModelError,
    ScenarioError,
)
from drake_dae.robots.model import RobotModel
from drake_dae.scenario.advice import advised
from drake_dae.scenario.completion.completion import Completed
from drake_dae.scenario.keys import at, violated
from drake_dae.scenario.model import (
    completed_model,
    scenario_structure,
)
from drake_dae.scenario.observed import observed_structure
from drake_dae.scenario.own_model import own_model
from drake_dae.scenario.plant import contact_plant
from drake_dae.scenario.scenario import Scenario
from drake_dae.scenario.start import start_closed_loop
from drake_dae.scenario.task_build import check_task, start_task, wire_task
from drake_dae.systems.plants.contact.contact_material import ContactMaterial
from drake_dae.systems.plants.contact.contact_plant import ContactPlant
from drake_dae.systems.plants.robot_plant import RobotPlant
from drake_dae.systems.plants.unilateral.plant import UnilateralRobotPlant


@checked(lambda text: ScenarioError(("", text)))
def build_scenario(
    scenario: Scenario, meshcat: Meshcat | None = None
) -> tuple[ClosedLoop | TaskLoop, Context]:
    """The closed loop of a scenario, and its context at the start.

    Args:
        scenario: What `load_scenario` returns.
        meshcat: Where to draw while the run goes on; None draws nothing.

    Raises:
        ScenarioError: Something does not fit; the message names its key.
    """
    completed, loop = build_completed(scenario, meshcat)
    return loop, start_scenario(completed.scenario, loop)


def build_completed(
    scenario: Scenario, meshcat: Meshcat | None = None
) -> tuple[Completed, ClosedLoop | TaskLoop]:
    """A scenario completed, and its loop, which `start_scenario` starts as often as one likes.

    The arguments and errors are those of `build_scenario`.
    """
    if scenario.task is not None:
        check_task(scenario)
    scene_graph = SceneGraph()
    completed, model = completed_model(scenario, scene_graph)
    try:
        structure = scenario_structure(model)
    except AssumptionError as error:
        raise violated(error) from error
    if completed.scenario.task is not None:
        return completed, wire_task(completed.scenario, model, structure, scene_graph, meshcat)
    chosen = advised(completed.scenario, model, structure)
    completed = Completed(chosen.scenario, (*completed.notes, *chosen.notes))
    return completed, wire_loop(completed.scenario, model, structure, scene_graph, meshcat)


def start_scenario(scenario: Scenario, loop: ClosedLoop | TaskLoop) -> Context:
    """A new context of a closed loop at a scenario's start.

    Args:
        scenario: The scenario of the loop; start, plant_parameters, integrator, the numbers of
            uncoupled gains, and the seed of the sensor may be others than those it was built with.
        loop: What `build_completed` made.

    Raises:
        ScenarioError: Something does not fit; the message names its key.
    """
    if isinstance(loop, TaskLoop):
        return start_task(scenario, loop)
    return start_closed_loop(scenario, loop)


def wire_scenario(
    scenario: Scenario,
    model: RobotModel,
    structure: Structure,
    scene_graph: SceneGraph | None = None,
    meshcat: Meshcat | None = None,
) -> tuple[ClosedLoop, Context]:
    """The closed loop of a scenario's robot, and its context at the start.

    The arguments and errors are those of `wire_loop`.
    """
    loop = wire_loop(scenario, model, structure, scene_graph, meshcat)
    return loop, start_scenario(scenario, loop)


def wire_loop(
    scenario: Scenario,
    model: RobotModel,
    structure: Structure,
    scene_graph: SceneGraph | None = None,
    meshcat: Meshcat | None = None,
    plant: RobotPlant | ContactPlant | UnilateralRobotPlant | None = None,
) -> ClosedLoop:
    """The closed loop of a scenario's robot.

    Args:
        scenario: What `load_scenario` returns.
        model: The scenario's robot, by `scenario_model`.
        structure: The structure of the model's system.
        scene_graph: Where the robot's geometry is registered; needed to draw it.
        meshcat: Where to draw while the run goes on; None draws nothing.
        plant: What is simulated in place of what the scenario has; None for that.

    Raises:
        ScenarioError: Something does not fit; the message names its key.
    """
    scenario = advised(scenario, model, structure).scenario
    # The law, the sensor that it may need, and the references.
    force = scenario.force
    with at("force"):
        sensor = force.sensor(model.dae.num_constraints)
    damping = scenario.constraint_damping
    keys = [key for key, used in (("force", force.is_measured), ("gains", True)) if used]
    keys += [key for key in ("constraint_damping", "integral") if getattr(scenario, key)]
    observed = observed_structure(scenario, model, structure)
    with at(" or ".join(keys)):
        assert scenario.gains is not None  # advised.
        assert scenario.integral is not None
        gains = scenario.gains.design()
        law = TrackingLaw(
            observed.system,
            gains,
            structure=observed,
            measured_force=force.is_measured,
            force_gain=force.gain,
            constraint_damping=None if damping is None else damping.design(),
            integral=scenario.integral,
        )
    references = _references(scenario.references, law)
    exogenous = []
    if scenario.observer is None:
        exogenous = exogenous_references(scenario, law.system, law.exogenous_degrees)

    # The diagram.
    limits = _limits(scenario, model)
    feedback = can_be_fed_back(law, scenario.sampling, limits)
    own = own_model(scenario, model.links) if plant is None else None
    plant_exogenous = None
    if own is None:
        plant = plant or _plant(scenario, model, structure, feedback)
    else:
        plant, scene_graph = _plant(scenario, own.model, own.structure, False), own.scene_graph
        degrees = plant.exogenous_layout.degrees
        plant_exogenous = exogenous_references(own.scenario, plant.dae, degrees)
    if scenario.sampling is not None:
        with at("sampling"):
            hold_before(plant, scenario.sampling)
    if scenario.encoders is not None:
        with at("encoders"):
            period = scenario.sampling.period if scenario.sampling else plant.time_step
            make_sensor(plant, scenario.encoders, period)
    if scenario.tolerances is not None:
        with at("tolerances"):
            scenario.tolerances.places(model.dae.output_signals)
    observer = scenario.observer
    keys = ["observer"] if observer is not None else []
    keys += ["force"] if force.is_measured or observer is not None else []
    with at(" or ".join(keys) or "start.positions"):
        return make_closed_loop(
            plant,
            law,
            references,
            exogenous=exogenous,
            plant_exogenous=plant_exogenous,
            sensor=sensor,
            sampling=scenario.sampling,
            encoders=scenario.encoders,
            control_limits=limits,
            tolerances=scenario.tolerances,
            observer=observer,
            scene_graph=scene_graph,
            meshcat=meshcat,
            start_time=scenario.integrator.start_time,
        )


def _plant(
    scenario: Scenario, model: RobotModel, structure: Structure, feedback: bool
) -> RobotPlant | ContactPlant | UnilateralRobotPlant:
    """What is simulated."""
    if isinstance(scenario.plant, Unilateral):
        with at("plant.restitution"):
            return scenario.plant.plant(model, structure)
    if not isinstance(scenario.plant, ContactMaterial):
        return RobotPlant(model, structure=structure, feedback=feedback)
    return contact_plant(scenario, model, structure)


@at("saturation")
def _limits(scenario: Scenario, model: RobotModel) -> FloatArray | None:
    """The largest controls, if the scenario wants drives that give no more."""
    if not scenario.saturation:
        return None
    if not np.any(np.isfinite(model.control_limits)):
        raise ModelError("the robot's file has no effort limits, or they are not on the control")
    return model.control_limits


def _references(references: Mapping[str, Reference | float], law: TrackingLaw) -> list[Reference]:
    """References in the order of the outputs, each smooth enough."""
    outputs = [signal.name for signal in law.system.output_signals]
    found = []
    for name, reference in references.items():
        with at(f"references.{name}"):
            found.append(assigned(name, reference, outputs, law.degrees))
    with at("references"):
        return in_order(found, outputs)


def exogenous_references(
    scenario: Scenario, system: DaeSystem, needed: Sequence[int]
) -> list[Reference]:
    """How each parameter moves that does, in the order of the system, each smooth enough.

    Args:
        scenario: The scenario.
        system: The system of its plant or of its law.
        needed: How many derivatives of each entry are needed.

    Raises:
        ScenarioError: There are too few or too many, or one is not smooth enough.
    """
    moving: list[Reference] = []
    degrees = list(needed)
    for parameter in system.exogenous.moving:
        key = f"exogenous.{parameter.name}"
        references = [
            one if isinstance(one, Reference) else ConstantReference(one)
            for one in scenario.exogenous[parameter.name]
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
