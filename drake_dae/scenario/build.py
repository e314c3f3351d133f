"""A scenario as a closed loop: for Drake's Simulator, for rollouts, and for pages."""

import time
from collections.abc import Callable, Mapping
from dataclasses import fields, replace
from math import ceil, floor
from types import SimpleNamespace
from typing import Any, NamedTuple, cast

import casadi as ca
import numpy as np
from pydrake.geometry import Meshcat, SceneGraph
from pydrake.multibody.tree import BodyIndex
from pydrake.systems.framework import Context

from drake_dae import dae
from drake_dae.arguments import checked, uncollected
from drake_dae.arrays import FloatArray, unknown_name
from drake_dae.blocks.block import NOTHING, Block
from drake_dae.blocks.lifetime import SHARED_DICTIONARY
from drake_dae.blocks.traced_system import TracedSystem
from drake_dae.dae import ConstraintStructure, Structure, TrackingLaw
from drake_dae.dae.disturbance import estimated_within
from drake_dae.diagrams import parts
from drake_dae.diagrams.closed_loop import ClosedLoop, make_closed_loop, wire_loop
from drake_dae.diagrams.record import Record, RecordAfter
from drake_dae.errors import AssumptionError, ModelError, ScenarioError, SimulationError
from drake_dae.pictures.page_controls import PUSH
from drake_dae.references import ConstantReference, Reference
from drake_dae.robots import KnownWrench, Load, PointOnSurface, RobotModel, ScaledForce
from drake_dae.running.diagnosis import DivergenceWatch
from drake_dae.running.rollout import Rollout, run_loop, start_values
from drake_dae.scenario.completion import Completed
from drake_dae.scenario.form import at, each
from drake_dae.scenario.gains import advised, estimates_all, estimating_all
from drake_dae.scenario.model import (
    completed_model,
    exogenous_references,
    references_of,
    scenario_structure,
)
from drake_dae.scenario.parts import CompliantContact, MultibodyPlant, Poles
from drake_dae.scenario.robot_file.reading import RobotLinks, robot_links
from drake_dae.scenario.scenario import Scenario
from drake_dae.scenario.start import opening_contact, start_scenario
from drake_dae.systems import Controller, ForceSensor, Plant, TaskController, open_contact
from drake_dae.systems.controller import Derived

# The rows of a record under error control, after the first; and the most rows of fixed steps: a
# larger record takes gigabytes.
ROWS, MOST_ROWS = 1000, 1e7
# The time by the clock in s between checks of a running rollout for divergence; and the fraction of
# a step within which two times are equal.
PERIOD, SAME = 0.2, 1e-6


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
        for key in ("sampling", "estimator", "task", "references", "saturation", "exogenous"):
            if getattr(scenario, key):
                raise ScenarioError((key, "robot.actuators is [], and there is nothing to control"))
        if commanded:
            raise ScenarioError(("robot.actuators", "needed: a page shows what a law steers"))
        free = dae.find_constraint_structure(model.dae)
        plant = make_plant(completed.scenario, model, free)
        return completed, wire_loop(plant, _NoController(free), **drawn)
    if structure is None:
        try:
            structure = scenario_structure(model)
        except AssumptionError as error:
            key = "constraints" if error.assumption <= 3 else "outputs"
            hint = "" if error.state is None else "; start.positions choose another start"
            raise ScenarioError((key, f"{error}{hint}")) from error

    # The gains, with what belongs to them.
    chosen = advised(completed.scenario, model, structure)
    scenario, notes = chosen.scenario, (*completed.notes, *chosen.notes)
    task, sensors = scenario.task, scenario.sensors

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
    of_law, estimator = scenario, scenario.estimator
    if estimator is not None and estimates_all(scenario, model):
        of_law = estimating_all(scenario, model)
        try:
            law = tracking_law(of_law, completed_model(of_law)[1], structure)
        except (AssumptionError, ScenarioError) as error:  # No run is refused for it.
            frictional = [c.friction_parameter for c in model.constraints if c.friction_parameter]
            of_law = replace(scenario, estimator=replace(estimator, parameters=frictional))
            law = tracking_law(of_law, model, structure)
            text = "only friction of contacts is estimated, no loads, tilts and joints"
            notes = *notes, f"{text}: {error}"
    else:
        law = tracking_law(scenario, model, structure)
    references, exogenous = list[Reference](), list[Reference]()
    if task is None:
        names = [signal.name for signal in law.system.output_signals]
        references = references_of(scenario, names, law.layout.reference_degrees)
    if scenario.estimator is None:
        exogenous = exogenous_references(scenario, law.system, law.exogenous_degrees)

    # The parts between plant and law; errors get the key of the part.
    sensor, limits = None, None
    if (force := sensors.force) is not None:
        with at("sensors.force"):
            errors = force.bias, force.noise_deviation, force.drift
            lags = force.time_constant, force.sample_period
            sensor = ForceSensor(model.dae.num_constraints, *lags, *errors)
    if scenario.saturation:
        limits = model.control_limits
        if not np.any(np.isfinite(limits)):
            text = "the robot's file has no effort limits, or not of these controls"
            raise ScenarioError(("saturation", text))
    settings = parts.LoopSettings(
        sensor=sensor,
        encoders=sensors.encoders,
        sampling=scenario.sampling,
        control_limits=limits,
        observer=of_law.estimator,
        exogenous=exogenous,
        plant_exogenous=plant_exogenous,
        signals={} if task is None or commanded else task.signals,
        commanded=commanded,
    )
    period = settings.period(plant.time_step)
    if settings.sampling is not None:
        with at("sampling"):
            parts.hold_sampling(plant, settings.sampling)
    if settings.encoders is not None:
        with at("sensors.encoders"):
            parts.make_sensor(plant, settings.encoders, period)
    with at("judgement.tolerances"):
        dae.places_of("output", scenario.judgement.tolerances, model.dae.output_signals)

    # The controller and the loop: with a task the law in contact, and one with the contact open.
    if task is not None:
        contact, gains = opening_contact(scenario, model), task.gains or scenario.law.gains
        assert gains is not None  # advised.
        with at("task.gains" if task.gains else "law.gains"):
            free = dae.find_structure(open_contact(law.system, contact.force_signals[0].name))
            of_free = TrackingLaw(free.system, gains.design(), structure=free, latency=law.latency)
        with at("task"):
            made = task.make(sensors.force_noise)
            controller = TaskController(made, law, of_free, sample_period=period or 1e-3)
            return Completed(scenario, notes), wire_loop(plant, controller, None, settings, **drawn)
    keys = ["estimator"] if scenario.estimator is not None else []
    keys += ["sensors.force"] if sensor is not None or keys else []
    with at(" or ".join(keys) or "start.positions"):
        loop = make_closed_loop(plant, law, references, settings, **drawn)
    return Completed(scenario, notes), loop


@at("start.positions")
def make_plant(scenario: Scenario, model: RobotModel, structure: ConstraintStructure) -> Plant:
    """The plant of a scenario; its default state is projected near the start."""
    return scenario.plant.plant(model, structure, scenario.robot)


def tracking_law(scenario: Scenario, model: RobotModel, structure: Structure) -> TrackingLaw:
    """The law of a scenario, after `advised`; of a system with a disturbance for an estimator."""
    settings, is_measured = scenario.law, scenario.sensors.force is not None
    damping, estimator = settings.constraint_damping, scenario.estimator
    if settings.contact_stiffness is not None and scenario.task is not None:
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
            rough = "; give the constraint friction: 0.0 if it is unknown"
            text = f"parameters: {unknown_name('parameter', name, known)}"
            raise ScenarioError(("estimator", text + rough * name.endswith(".friction")))
        with at("estimator.parameters"):
            velocities = [signal.name for signal in model.links.velocity_signals]
            observed = dae.with_disturbance(model.dae, velocities, names)
            friction = {contact.friction for contact in model.dae.contacts}
            others = [p for p in model.dae.parameters if p.name in {*names} - friction]
            estimated_within(others, estimator.ranges)
        with at("estimator"):
            structure = dae.find_structure(observed)
    # The mean time from a sample to the moment when its control acts, for rigid joints. A plant
    # that steps by h damps with the speed at the end of each step: h / 2 later than the mean, and h
    # later than a law without sampling, which acts at each step.
    sampling, material = scenario.sampling, scenario.plant.material
    step = 0.0 if material is None else material.time_step
    latency = step if sampling is None else sampling.delay + (sampling.period + step) / 2.0
    more = ("contact_stiffness", "constraint_damping", "integral")
    keys = ["sensors.force"] * is_measured + ["law.gains"]
    with at(" or ".join([*keys, *(f"law.{key}" for key in more if getattr(settings, key))])):
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


class _NoController(TracedSystem, Controller):
    """Steers nothing: the place of a controller in the loop of a mechanism without drive."""

    __slots__ = SHARED_DICTIONARY

    def __init__(self, structure: ConstraintStructure) -> None:
        self._structure, system = structure, structure.system
        known = SimpleNamespace(system=system, structure=None, measured_force=None)
        self.law = cast(TrackingLaw, known)
        x = ca.SX.sym("x", system.num_states)
        super().__init__(Block("no_controller", {"estimated_state": x}, {"control": NOTHING}))

    @property
    def start_structure(self) -> ConstraintStructure:
        return self._structure

    def derived(self, values: Mapping[str, FloatArray]) -> Derived:
        none = np.zeros((*values["state"].shape[:-1], 0))
        return {name: (none, ()) for name in ("desired_output", "tracking_error")}

    def predicted_error(self, times: FloatArray, *_: object) -> FloatArray:
        return np.zeros((times.size, 0))


def for_rollout(scenario: Scenario) -> tuple[Scenario, str]:
    """A scenario with a plant that rollouts support, and a remark if this changed the plant."""
    given = scenario.plant
    if not isinstance(given, MultibodyPlant) or given.contact_model != "point":
        return scenario, ""
    # Drake's contact has no viscous friction.
    viscous = [c.name for c in scenario.constraints if getattr(c, "viscous_friction", None)]
    none = {f"{name}.viscous_friction": 0.0 for name in viscous}
    numbers = {item.name: getattr(given, item.name) for item in fields(CompliantContact)}
    plant = CompliantContact(**{**numbers, "parameters": {**given.parameters, **none}})
    return replace(scenario, plant=plant), (
        "a !CompliantContact runs in place of !MultibodyPlant: the same equations of contact, "
        "traced. Drake's solver stops at a relative residual of 1e-6, and joints stop at their "
        "limits in Drake's plant alone"
    )


def rollout_times(scenario: Scenario, time_step: float = 0.0) -> FloatArray:
    """The times of the rows of a rollout's record, in s: equidistant, or those of fixed steps."""
    config, duration = scenario.integrator, scenario.duration
    start, end = config.start_time, config.start_time + duration
    fixed = time_step or (0.0 if config.use_error_control else config.max_step_size)
    if fixed and duration / fixed > MOST_ROWS:
        raise ModelError(
            f"steps of {fixed:g} s make {duration / fixed:.2g} rows for {duration:g} s; a rollout "
            f"keeps at most {MOST_ROWS:g}"
        )
    if time_step:
        first, after = floor(start / time_step + SAME) + 1, ceil(end / time_step - SAME)
        return np.concatenate([[start], time_step * np.arange(first, after), [end]])
    rows = max(1, ceil(duration / fixed - 0.01)) if fixed else ROWS
    times: FloatArray = start + np.linspace(0.0, duration, rows + 1)
    return times


def roll_scenario(
    scenario: Scenario,
    loop: ClosedLoop,
    context: Context,
    lasting: float | None = None,
    look: Callable[[RecordAfter], bool] = lambda record: False,
) -> Rollout:
    """Runs a scenario by `rollout`; a diverging run ends, as by `simulate`."""
    start, parameters = start_values(loop, context)
    sensors, seeds = scenario.sensors, dict[str, int]()
    if sensors.force is not None:
        seeds["force_noise"] = sensors.force.seed
    if sensors.encoders is not None:
        seeds[parts.ENCODER_NOISE] = parts.encoder_seed(sensors.encoders.seed)
    watch, due = DivergenceWatch(loop.plant), time.perf_counter() + PERIOD
    seen: float | None = None
    failure: SimulationError | None = None

    def diverges(rows: Record) -> bool:
        nonlocal seen, due, failure
        due = time.perf_counter() + PERIOD
        if not scenario.judgement.may_diverge and failure is None and rows.time.size:
            seen = float(rows.time[-1])
            try:
                watch.look(rows)
            except SimulationError as error:
                failure = error
        return failure is not None

    def watched(record: RecordAfter) -> bool:
        return (time.perf_counter() > due and diverges(record(seen))) or look(record)

    times = rollout_times(scenario, loop.plant.time_step)
    more: dict[str, Any] = {"config": scenario.integrator, "seeds": [seeds], "lasting": lasting}
    (rollout,) = run_loop(loop, start, parameters, times, look=watched, **more)
    if diverges(rollout.record.after(seen)):
        assert failure is not None
        rollout = rollout.ended(failure)
    return rollout


class Commanded(NamedTuple):
    """A loop that a person can change while it runs, its start, and why some changes are none."""

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
    left_out = [f"Drake's plant: {remark}"] if remark else []
    robot, constraints, exogenous = scenario.robot, scenario.constraints, {**scenario.exogenous}

    # Friction of the plant: a coefficient of 0 for frictionless contacts. A compliant contact has
    # friction and the places of surfaces in its plant alone.
    points = [c for c in constraints if isinstance(c, PointOnSurface)]
    if scenario.plant.material is not None:
        points = []
    bare = [point for point in points if point.friction is None]
    if bare and scenario.actuation:
        left_out.append(
            "friction of the plant: none, since the law would differentiate it; give the "
            "constraint a friction"
        )
    else:
        constraints = [replace(c, friction=0.0) if c in bare else c for c in constraints]

    # Surfaces that are dragged: their places are constant exogenous signals.
    if points and scenario.estimator is not None:
        left_out.append(
            "surfaces that are dragged: none, since an estimator does not know how a surface "
            "moves, and an ideal contact needs a law that does; with `plant: !CompliantContact` "
            "they are dragged"
        )
    else:
        for place in (point.parameters[0] for point in points):
            exogenous.setdefault(place.name, [*map(ConstantReference, place.value.tolist())])

    # Links that are pushed: a zero wrench on each that moves and is drawn.
    plant, pushes = robot_links(robot, SceneGraph(), drawn=False)[0].plant, list[Load]()
    for body in (plant.get_body(BodyIndex(i)) for i in range(1, plant.num_bodies())):
        if plant.GetVisualGeometriesForBody(body) and not plant.IsAnchored(body):
            name = body.scoped_name().get_full()
            pushes.append(KnownWrench(name, name=PUSH + name))
    robot = replace(robot, known_forces=[*robot.known_forces, *pushes])
    extended = replace(scenario, robot=robot, constraints=constraints, exogenous=exogenous)
    completed, loop = build_completed(extended, commanded=True)
    # The original exogenous signals decide whether the loop starts at rest.
    initial = replace(completed.scenario, exogenous=scenario.exogenous)
    return Commanded(loop, start_scenario(initial, loop), tuple(left_out))
