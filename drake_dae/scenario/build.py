"""A scenario as a closed loop."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any, cast

import casadi as ca
import numpy as np
from pydrake.geometry import Meshcat, SceneGraph
from pydrake.systems.framework import Context

from drake_dae.arguments import checked, uncollected
from drake_dae.arrays import FloatArray, unknown_name
from drake_dae.blocks.block import NOTHING, Block
from drake_dae.blocks.lifetime import SHARED_DICTIONARY
from drake_dae.blocks.traced_system import TracedSystem
from drake_dae.dae import (
    ConstraintStructure,
    DaeSystem,
    Structure,
    TrackingLaw,
    find_constraint_structure,
    find_structure,
    outputs_named,
    with_disturbance,
)
from drake_dae.dae.disturbance import estimated_within
from drake_dae.diagrams.closed_loop import ClosedLoop, make_closed_loop, wire_loop
from drake_dae.diagrams.parts import LoopSettings, hold_sampling, make_sensor
from drake_dae.errors import AssumptionError, ModelError, ScenarioError
from drake_dae.references import Reference
from drake_dae.robots import RobotModel, ScaledForce
from drake_dae.scenario.completion import Completed
from drake_dae.scenario.form import at, each
from drake_dae.scenario.gains import (
    advised,
    estimates_all,
    with_all_estimated,
    with_friction_estimated,
)
from drake_dae.scenario.model import (
    completed_model,
    exogenous_references,
    references_of,
    scenario_structure,
)
from drake_dae.scenario.parts import Poles, ScenarioTask
from drake_dae.scenario.robot_file.reading import RobotLinks
from drake_dae.scenario.scenario import Scenario
from drake_dae.scenario.start import opening_contact, start_scenario
from drake_dae.systems.controller import Controller, Derived
from drake_dae.systems.opening_contact import open_contact
from drake_dae.systems.plant import Plant
from drake_dae.systems.sensors import ForceSensor
from drake_dae.systems.task_controller import TaskController


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


@uncollected
def build_completed(
    scenario: Scenario,
    meshcat: Meshcat | None = None,
    commanded: bool = False,
    robot: RobotLinks | None = None,
) -> tuple[Completed, ClosedLoop]:
    """The completed scenario and its loop; a person may change the references if `commanded`.

    A `robot` that is read already is not drawn.
    """
    # The robot, with the outputs and the start that the scenario leaves out.
    check_task(scenario)
    drawn = {"scene_graph": (scene_graph := SceneGraph()), "meshcat": meshcat}
    completed, model, structure = completed_model(scenario, scene_graph, robot=robot)
    if not model.dae.num_controls:
        return completed, _mechanism(completed.scenario, model, **drawn)
    if structure is None:
        try:
            structure = scenario_structure(model)
        except AssumptionError as error:
            key = "constraints" if error.assumption <= 3 else "outputs"
            hint = "" if error.state is None else "; start.positions choose another start"
            raise ScenarioError((key, f"{error}{hint}")) from error

    # The gains, with what belongs to them.
    chosen = advised(completed.scenario, model, structure)
    scenario, task, sensors = chosen.scenario, chosen.scenario.task, chosen.scenario.sensors

    # The plant. In an ideal one a payload is a further body, and the course of a disturbance an
    # exogenous signal; the law knows neither. Masses and forces are parameters, set at the start.
    disturbances, plant_exogenous = scenario.plant.disturbances, None
    each("plant.disturbances", disturbances, lambda d: model.links.position(d.frame, d.point))
    if (scenario.plant.payloads or disturbances) and not scenario.plant.carries:
        pushes = {f"plant_disturbance_{i}": d for i, d in enumerate(disturbances)}
        forces = [ScaledForce(d.frame, d.point, name, d.force) for name, d in pushes.items()]
        known = [*scenario.robot.known_forces, *forces]
        moving: dict[str, Any] = {f"{name}.course": [d.course] for name, d in pushes.items()}
        pushed = replace(scenario.robot, known_forces=known)
        own = replace(scenario, robot=pushed, exogenous={**scenario.exogenous, **moving})
        drawn["scene_graph"] = SceneGraph()
        _, of_plant, _ = completed_model(own, drawn["scene_graph"], scenario.plant.payloads)
        plant = make_plant(own, of_plant, scenario_structure(of_plant))
        plant_exogenous = exogenous_references(own, plant.dae, plant.exogenous_layout.degrees)
    else:
        plant = make_plant(scenario, model, structure)

    # The law, of a model with a disturbance if there is an estimator of it; and what it follows.
    of_law, references, exogenous = scenario, list[Reference](), []
    if estimates_all(scenario, model):
        of_law = with_all_estimated(scenario, model)
        try:
            law = tracking_law(of_law, completed_model(of_law)[1], structure)
        except (AssumptionError, ScenarioError) as error:  # No run is refused for it.
            of_law = with_friction_estimated(scenario, model)
            law = tracking_law(of_law, model, structure)
            note = f"only friction of contacts is estimated, no loads, tilts and joints: {error}"
            completed = Completed(completed.scenario, (*completed.notes, note))
    else:
        law = tracking_law(scenario, model, structure)
    if task is None:
        names = [signal.name for signal in law.system.output_signals]
        references = references_of(scenario, names, law.layout.reference_degrees)
    if scenario.estimator is None:
        exogenous = exogenous_references(scenario, law.system, law.exogenous_degrees)

    # The parts between plant and law; errors get the key of the part.
    sensor, limits = None, None
    if sensors.force is not None:
        with at("sensors.force"):
            force = sensors.force
            errors = force.bias, force.noise_deviation, force.drift
            lags = force.time_constant, force.sample_period
            sensor = ForceSensor(model.dae.num_constraints, *lags, *errors)
    if scenario.saturation:
        limits = model.control_limits
        if not np.any(np.isfinite(limits)):
            text = "the robot's file has no effort limits, or not of these controls"
            raise ScenarioError(("saturation", text))
    settings = LoopSettings(
        sensor=sensor,
        encoders=sensors.encoders,
        sampling=scenario.sampling,
        control_limits=limits,
        observer=of_law.estimator,
        exogenous=exogenous,
        plant_exogenous=plant_exogenous,
        signals={} if task is None or commanded else task.signals,
        commanded=commanded,
        start_time=scenario.integrator.start_time,
    )
    period = settings.period(plant.time_step)
    if settings.sampling is not None:
        with at("sampling"):
            hold_sampling(plant, settings.sampling)
    if settings.encoders is not None:
        with at("sensors.encoders"):
            make_sensor(plant, settings.encoders, period)
    with at("judgement.tolerances"):
        outputs_named(scenario.judgement.tolerances, model.dae.output_signals)

    # The controller and the loop.
    if task is not None:
        with at("task"):
            controller = _task_controller(scenario, task, model, law, period)
            loop = wire_loop(plant, controller, None, settings, **drawn)
    else:
        keys = ["estimator"] if scenario.estimator is not None else []
        keys += ["sensors.force"] if sensor is not None or keys else []
        with at(" or ".join(keys) or "start.positions"):
            loop = make_closed_loop(plant, law, references, settings, **drawn)
    return Completed(scenario, (*completed.notes, *chosen.notes)), loop


@at("start.positions")
def make_plant(scenario: Scenario, model: RobotModel, structure: ConstraintStructure) -> Plant:
    """The plant of a scenario; its default state is projected near the start."""
    return scenario.plant.plant(model, structure, scenario.robot)


def tracking_law(scenario: Scenario, model: RobotModel, structure: Structure) -> TrackingLaw:
    """The law of a scenario, after `advised`; of a system with a disturbance for an estimator."""
    settings, is_measured = scenario.law, scenario.sensors.force is not None
    damping, estimator = settings.constraint_damping, scenario.estimator
    keys = ["sensors.force", "law.gains"] if is_measured else ["law.gains"]
    keys += [f"law.{key}" for key in ("constraint_damping", "integral") if getattr(settings, key)]
    if settings.contact_stiffness is not None:
        keys = ["law.contact_stiffness", *keys]
        if scenario.task is not None:
            text = "is not for scenarios with `task`; leave it out"
            raise ScenarioError(("law.contact_stiffness", text))
    if estimator is not None:
        if estimator.rate is None:
            text = "needed, since no gains are computed; leave `law.gains` out with Drake's contact"
            raise ScenarioError(("estimator.rate", text))
        if scenario.exogenous:
            text = "not beside exogenous signals, whose port it feeds"
            raise ScenarioError(("estimator", text))
        known, names = [p.name for p in model.dae.parameters], estimator.parameters or []
        for name in {*names} - {*known}:
            hint = "; give the constraint friction: 0.0 if it is unknown" * name.endswith(
                ".friction"
            )
            text = f"parameters: {unknown_name('parameter', name, known)}{hint}"
            raise ScenarioError(("estimator", text))
        with at("estimator.parameters"):
            velocities = [signal.name for signal in model.links.velocity_signals]
            observed = with_disturbance(model.dae, velocities, names)
            friction = {contact.friction for contact in model.dae.contacts}
            others = [p for p in model.dae.parameters if p.name in {*names} - friction]
            estimated_within(others, estimator.ranges)
        with at("estimator"):
            structure = find_structure(observed)
    # The mean time from a sample to the moment when its control acts, for rigid joints. A plant
    # that steps by h damps with the speed at the end of each step: h / 2 later than the mean, and h
    # later than a law without sampling, which acts at each step.
    sampling, material = scenario.sampling, scenario.plant.material
    step = 0.0 if material is None else material.time_step
    latency = step if sampling is None else sampling.delay + (sampling.period + step) / 2.0
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
            latency=0.0 if model.stages else latency,
        )


def check_task(scenario: Scenario) -> None:
    """Checks that the keys of a scenario fit its task, if it has one."""
    if (task := scenario.task) is None:
        return
    problems = []
    if scenario.references:
        problems.append(("references", "a task has the references of its phases; leave them out"))
    names = [name for name in task.make().watched("signal") if name not in task.signals]
    problems += [(f"task.signals.{name}", "needed: a phase watches it") for name in names]
    if scenario.plant.material is None:
        ideal = "ideal constraints neither open nor strike, as a task needs it"
        problems.append(("plant", f"{ideal}: take !CompliantContact or !MultibodyPlant"))
    if scenario.start.errors:
        problems.append(("start.errors", "a task begins at start.positions; leave them out"))
    if problems:
        raise ScenarioError(*problems)


def _task_controller(
    scenario: Scenario, task: ScenarioTask, model: RobotModel, law: TrackingLaw, period: float
) -> TaskController:
    """The controller of a task: the law in contact, and one with the contact open."""
    points = opening_contact(scenario, model)
    forces = [signal.name for point in points for signal in point.force_signals]
    free_system, gains = open_contact(law.system, forces), task.gains or scenario.law.gains
    assert gains is not None  # advised.
    with at("task.gains" if task.gains else "law.gains"):
        structure = find_structure(free_system)
        free_law = TrackingLaw(
            free_system, gains.design(), structure=structure, latency=law.latency
        )
    # The noise of the sum over the points.
    noise = scenario.sensors.force_noise * len(points) ** 0.5
    return TaskController(task.make(noise), law, free_law, sample_period=period or 1e-3)


def _mechanism(scenario: Scenario, model: RobotModel, **drawn: Any) -> ClosedLoop:
    """The loop of a mechanism that nothing drives."""
    for key in ("sampling", "estimator", "task", "references", "saturation", "exogenous"):
        if getattr(scenario, key):
            raise ScenarioError((key, "robot.actuators is [], and there is nothing to control"))
    structure = find_constraint_structure(model.dae)
    plant = make_plant(scenario, model, structure)
    return wire_loop(plant, _NoController(structure), **drawn)


class _NoController(TracedSystem, Controller):
    """Steers nothing: the place of a controller in the loop of a mechanism without drive."""

    __slots__ = SHARED_DICTIONARY

    def __init__(self, structure: ConstraintStructure) -> None:
        self._structure = structure
        self.law = cast(TrackingLaw, _NoLaw(structure.system))
        x = ca.SX.sym("x", structure.system.num_states)
        super().__init__(Block("no_controller", {"estimated_state": x}, {"control": NOTHING}))

    @property
    def start_structure(self) -> ConstraintStructure:
        return self._structure

    def check_plant(self, plant: Plant) -> None:
        pass

    def derived(self, values: Mapping[str, FloatArray]) -> Derived:
        none = np.zeros((*values["state"].shape[:-1], 0))
        return {name: (none, ()) for name in ("desired_output", "tracking_error")}

    def predicted_error(
        self, times: FloatArray, values: Mapping[str, FloatArray], parameters: FloatArray
    ) -> FloatArray:
        return np.zeros((times.size, 0))


class _NoLaw:
    """Has of a law what records ask for, its system; all else of a law is an error."""

    structure = measured_force = None

    def __init__(self, system: DaeSystem) -> None:
        self.system = system

    def __getattr__(self, name: str) -> Any:
        text = f"robot.actuators is [], and there is no law with {name}; simulate runs it"
        raise ModelError(text)
