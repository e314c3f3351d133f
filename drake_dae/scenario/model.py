"""The robot model of a scenario, completed, and what its references demand of it."""

from collections.abc import Callable, Sequence
from itertools import islice
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from pydrake.geometry import SceneGraph

from drake_dae import robots
from drake_dae.analysis import robot_limits
from drake_dae.arguments import checked
from drake_dae.arrays import FloatArray, unknown_name
from drake_dae.dae import DaeSystem, PinnedMotion, Structure, ZeroDynamics, find_structure
from drake_dae.errors import AssumptionError, DrakeDaeError, InconsistentStateError, ScenarioError
from drake_dae.references import ConstantReference, Reference
from drake_dae.references.by_name import assign, in_order
from drake_dae.references.reference import stack_references
from drake_dae.robots import (
    Constraint,
    ForceOutput,
    Links,
    MultibodyExpressions,
    PositionOutput,
    RobotModel,
)
from drake_dae.scenario.completion import Completed, completions
from drake_dae.scenario.form import at, each
from drake_dae.scenario.robot_file.reading import RobotLinks, robot_links
from drake_dae.scenario.robot_file.robot import Payload
from drake_dae.scenario.scenario import Scenario, make
from drake_dae.scenario.start import start_guess, start_state

T = TypeVar("T")

NOTHING_FOUND = "no start was found"  # So the note begins if none is good along the references.
# At how many times a completed scenario is examined, and the excess over a limit that counts.
_TIMES, _SLACK = 201, 1e-6


@checked(lambda text: ScenarioError(("", text)))
def complete_scenario(scenario: Scenario) -> Completed:
    """Adds missing outputs and a start to a scenario, with the choices in words.

    Outputs are missing if there are fewer than actuators minus force outputs. They are added by
    this rule, as long as some are missing, each if it is independent of those before it:

    1. what `references` name, as tool for its position along the surface;
    2. the position of each contact point along its surface: of its world coordinates all but that
       closest to the normal;
    3. the direction of the tool's axis, by `tool_axis`: its tilt from the normal; if no start keeps
       it and all limits along the reference, it is left free;
    4. positions of the joints that are left free, the choice for which B(x) of (16) is best
       conditioned. They are held where they start, and a run is not judged by their errors.

    If start.positions are left out, a start with the first values of the references is searched by
    inverse kinematics from many guesses, with the tool's axis along the normal if possible. Of the
    starts, and of the choices of joints, that one is taken with which the robot is best conditioned
    along the whole reference, within the limits of joints. It is examined along the reference by
    inverse dynamics, as `analyze` does; if that exceeds a limit, the next one is tried. If there is
    none, a note says what is in the way.

    Raises:
        ScenarioError: The scenario is not valid, the robot cannot reach the start, or no outputs
            are independent of those in the scenario; the message names the key.
    """
    return completed_model(scenario)[0]


def completed_model(
    scenario: Scenario,
    scene_graph: SceneGraph | None = None,
    payloads: Sequence[Payload] = (),
    robot: RobotLinks | None = None,
) -> tuple[Completed, RobotModel, Structure | None]:
    """The result of `complete_scenario`, its robot model, and the structure where it is known."""
    if robot is None:
        drawn = scene_graph is not None
        robot = robot_links(scenario.robot, scene_graph or SceneGraph(), payloads, drawn)
    links, loops = robot
    constraints = _checked_constraints(scenario, links, loops)
    found = list[tuple[bool, str, Completed, RobotModel, Structure | None]]()
    for completed in completions(scenario, links, constraints, start_guess(scenario, links)):
        model, structure = _model(completed.scenario, links, constraints), None
        if completed.scenario is scenario or scenario.task is not None:
            return completed, model, None
        try:
            structure = scenario_structure(model)
            problem = in_the_way(completed.scenario, model, structure)
        except (AssumptionError, ScenarioError) as error:
            problem = str(error)
        if not problem:
            return completed, model, structure
        found.append((structure is None, problem, completed, model, structure))
    _, problem, completed, model, structure = min(found, key=lambda entry: entry[0])
    note = (
        f"{NOTHING_FOUND} from which the robot keeps its limits along the references; with this "
        f"one {problem}. Move the surface or the references, make them slower, or give other "
        "outputs or start.positions"
    )
    return Completed(completed.scenario, (*completed.notes, note)), model, structure


def _checked_constraints(
    scenario: Scenario, links: MultibodyExpressions, loops: Sequence[Constraint]
) -> list[Constraint]:
    """The constraints, and a check of every key that the model takes, for errors with its place."""
    robot, kinematics = scenario.robot, links.kinematics()
    constraints = each("constraints", scenario.constraints, lambda form: make(form, ()))
    of_file = (*loops, *robots.plant_constraints(links))
    names = [constraint.name for constraint in of_file]
    for index, constraint in enumerate(constraints):
        with at(f"constraints.{index}"):  # Unknown names.
            if constraint.residual(links).numel() < len(constraint.force_signals):
                constraint.rate(kinematics)
        if not constraint.name or constraint.name in names:
            text = f"each constraint needs a name of its own, got '{constraint.name}'"
            raise ScenarioError((f"constraints.{index}.name", text))
        names.append(constraint.name)
    bound = robots.ConstraintSet([*constraints, *of_file])
    actuators = (*links.actuator_signals, *bound.motors)
    if not actuators and robot.actuators != []:
        text = (
            f"no joint of '{Path(robot.file).name or robot.title}' is driven; write all, or a list "
            "of joints. Without this key those are driven to which the file gives an actuator, as "
            "a URDF does by a <transmission>"
        )
        raise ScenarioError(("robot.actuators", text))
    _outputs(scenario, [*constraints, *loops], links)
    stages = scenario.actuation if links.actuator_signals else ()  # Else the model refuses them.
    attached = each("actuation", stages, lambda stage: stage.attach(links))

    def rows(force: str | ForceOutput) -> Any:
        return robots.force_rows(robots.as_force_outputs([force], bound), bound, links)

    each("forces", scenario.forces or (), rows)
    for force in scenario.compliances or {}:
        with at(f"compliances.{force}"):
            bound.place(force)
    each("robot.known_forces", robot.known_forces, lambda f: f.reaction(kinematics))
    with at("law.control_weights"):
        choice = robots.control_choice(scenario.law.control_weights or None, actuators)
    parts: tuple[Any, ...] = (links, *constraints, *loops, *robot.known_forces, *attached)
    parameters = [p.name for p in (*choice, *(p for part in parts for p in part.parameters))]
    for moving in scenario.exogenous:
        if moving not in parameters:
            raise ScenarioError(("exogenous", unknown_name("parameter", moving, parameters)))
    return [*constraints, *loops]


def _model(
    scenario: Scenario, links: MultibodyExpressions, constraints: Sequence[Constraint]
) -> RobotModel:
    """The robot model of a completed scenario."""
    with at("actuation" if scenario.actuation else "outputs"):
        model = RobotModel(
            links,
            constraints,
            _outputs(scenario, constraints, links),
            start_guess(scenario, links),
            scenario.robot.title,
            scenario.actuation,
            [] if scenario.robot.actuators == [] else scenario.forces,
            tuple(scenario.exogenous),
            scenario.robot.known_forces,
            scenario.compliances,
            scenario.law.control_weights or None,
            scenario.compiled,
        )
    with at("parameters"):
        model.dae = model.dae.with_values(scenario.parameters)
    with at("bounds"):
        bounds = {name: (low, high) for name, (low, high) in scenario.bounds.items()}
        model.dae = model.dae.with_bounds(bounds)
    return model


def scenario_structure(model: RobotModel) -> Structure:
    """The structure of a scenario's robot."""
    return of_steered(model, find_structure)


def of_steered(model: RobotModel, find: Callable[[DaeSystem], T]) -> T:
    """What is found of the system of a scenario's robot, which has controls and outputs."""
    if not model.dae.num_controls:
        raise ScenarioError(("robot.actuators", "nothing is driven, and a law has nothing to do"))
    if not model.dae.num_outputs:
        text = (
            "there are none, and they cannot be completed without references or force outputs: "
            f"name {model.dae.num_controls}, one for each actuator, or give references of some"
        )
        raise ScenarioError(("outputs", text))
    try:
        return find(model.dae)
    except InconsistentStateError as error:
        raise ScenarioError(("constraints or start.positions", str(error))) from error


def _outputs(
    scenario: Scenario, constraints: Sequence[Constraint], links: Links
) -> list[PositionOutput]:
    outputs = each("outputs", scenario.outputs, lambda form: make(form, constraints))
    each("outputs", outputs, lambda output: output.expression(links))
    return outputs


def references_of(
    scenario: Scenario, outputs: Sequence[str], degrees: Sequence[int]
) -> list[Reference]:
    """The references in the order of the outputs, each smooth enough for its degree."""
    smooth = []
    for name, reference in scenario.references.items():
        with at(f"references.{name}"):
            smooth.append(assign(name, reference, outputs, degrees))
    with at("references"):
        return in_order(smooth, outputs)


def exogenous_references(
    scenario: Scenario, system: DaeSystem, needed: Sequence[int] | None = None
) -> list[Reference]:
    """The references of the exogenous parameters, in the order of the system."""
    moving, degrees = list[Reference](), iter(needed or ())
    for parameter in system.exogenous.moving:
        key = f"exogenous.{parameter.name}"
        entries = scenario.exogenous[parameter.name]
        references = [e if isinstance(e, Reference) else ConstantReference(e) for e in entries]
        size = sum(reference.size for reference in references)
        if size != parameter.value.size:
            text = f"{size} values, but the parameter has {parameter.value.size}"
            raise ScenarioError((key, text))
        if needed is not None:
            each(key, references, lambda r: r.derivatives([*islice(degrees, r.size)]))
        moving += references
    return moving


def reference_and_start(
    scenario: Scenario, model: RobotModel, structure: Structure
) -> tuple[Callable[[float], FloatArray], FloatArray]:
    """R(t) of the law's model, and a state where the motion along it begins."""
    names = [signal.name for signal in model.dae.output_signals]
    degrees = structure.layout.reference_degrees
    stacked = stack_references(references_of(scenario, names, degrees), degrees)
    outputs = stacked(scenario.integrator.start_time)[structure.layout.lowest]
    parameters = model.dae.parameter_values
    with at("start"):
        start = start_state(scenario, model, outputs, parameters, parameters)
    return stacked, start


def motion_along(
    scenario: Scenario, model: RobotModel, structure: Structure, count: int
) -> PinnedMotion:
    """The motion along the references, without errors, at equidistant times."""
    times = scenario.integrator.start_time + np.linspace(0.0, scenario.duration, count)
    reference, start = reference_and_start(scenario, model, structure)
    exogenous = exogenous_references(scenario, model.dae)
    dynamics = ZeroDynamics(model.dae, structure=structure)
    return dynamics.motion(reference, times, start, exogenous=exogenous)


def in_the_way(scenario: Scenario, model: RobotModel, structure: Structure) -> str:
    """What is in the way along the references, as a sentence; empty if nothing is."""
    try:
        motion = motion_along(scenario, model, structure, _TIMES)
    except DrakeDaeError as error:
        return str(error)
    if motion.ending is not None:
        return str(motion.ending)
    limits = robot_limits(model, scenario.judgement.friction_cones)
    for one in limits.ranges(motion.times, limits.of_motion(motion)):
        # A start may be on the limit of a joint.
        if one.excess and abs(one.excess.value - one.excess.limit) > _SLACK:
            return str(one.excess)
    behind = robots.links_behind(model, motion.times, motion.states, motion.parameters)
    return "; ".join(map(str, behind))
