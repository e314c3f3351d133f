"""The robot model of a scenario, completed."""

import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from pydrake.geometry import SceneGraph
from pydrake.multibody.tree import BodyIndex

from drake_dae.analysis.analyze import examine
from drake_dae.analysis.report import Analysis
from drake_dae.arguments import checked
from drake_dae.arrays import unknown_name
from drake_dae.dae import Structure, find_structure
from drake_dae.errors import (
    AssumptionError,
    GeometryWarning,
    InconsistentStateError,
    ModelError,
    ScenarioError,
)
from drake_dae.robots import (
    Constraint,
    ConstraintSet,
    Links,
    MultibodyExpressions,
    PositionOutput,
    RobotModel,
    as_force_outputs,
    chain,
    control_choice,
    force_rows,
    plant_constraints,
)
from drake_dae.scenario.completion import Completed, completions
from drake_dae.scenario.form import at, each
from drake_dae.scenario.motion import in_the_way
from drake_dae.scenario.parts import make
from drake_dae.scenario.robot_file.reading import RobotLinks, robot_links
from drake_dae.scenario.robot_file.robot import Payload
from drake_dae.scenario.scenario import Scenario
from drake_dae.scenario.start import start_guess

NOTHING_FOUND = "no start was found"
"""How the note begins if no outputs and start are good along the references."""

_LARGE = 30.0
"""The ratio of the size of a surface to that of the robot above which its unit is doubtful."""


def scenario_model(scenario: Scenario, scene_graph: SceneGraph | None = None) -> RobotModel:
    """The robot model of a scenario: constraints, outputs and actuation.

    Args:
        scenario: What `load_scenario` returns.
        scene_graph: The scene graph of the robot's geometry; needed to draw it.

    Raises:
        ScenarioError: Something does not fit; the message names its key.
    """
    return completed_model(scenario, scene_graph)[1]


@checked(lambda text: ScenarioError(("", text)))
def complete_scenario(scenario: Scenario) -> Completed:
    """Adds missing outputs and a start to a scenario.

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

    Args:
        scenario: What `load_scenario` returns.

    Returns:
        The scenario, unchanged if nothing is missing, and the choices in words.

    Raises:
        ScenarioError: The scenario is not valid, the robot cannot reach the start, or no outputs
            are independent of those in the scenario; the message names the key.
    """
    return completed_model(scenario)[0]


def completed_model(
    scenario: Scenario,
    scene_graph: SceneGraph | None = None,
    payloads: Sequence[Payload] = (),
    drawn: bool = True,
    robot: RobotLinks | None = None,
) -> tuple[Completed, RobotModel, Structure | None]:
    """The results of `complete_scenario` and `scenario_model`, for a robot with payloads.

    Args:
        scenario: What `load_scenario` returns.
        scene_graph: The scene graph of the robot's geometry, or None.
        payloads: The payloads.
        drawn: Whether the scene graph, if there is one, will be drawn.
        robot: What `robot_links` made of the other arguments; None to read the robot.

    Returns:
        The completed scenario, its robot, and the structure if it was examined already.
    """
    if robot is None:
        drawn = drawn and scene_graph is not None
        robot = robot_links(scenario.robot, scene_graph or SceneGraph(), payloads, drawn)
    links, loops = robot
    constraints = _checked_constraints(scenario, links, loops)
    guess = start_guess(scenario, links)
    ways = list[tuple[Completed, RobotModel, Structure | None]]()
    problems = list[str]()
    for completed in completions(scenario, links, constraints, guess):
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
        ways.append((completed, model, structure))
        problems.append(problem)
    # One that can be examined, if there is any.
    best = next((i for i, way in enumerate(ways) if way[2] is not None), 0)
    completed, model, structure = ways[best]
    note = (
        f"{NOTHING_FOUND} from which the robot keeps its limits along the references; with this "
        f"one {problems[best]}. Move the surface or the references, make them slower, or give "
        "other outputs or start.positions"
    )
    return Completed(completed.scenario, (*completed.notes, note)), model, structure


def _checked_constraints(
    scenario: Scenario, links: MultibodyExpressions, loops: Sequence[Constraint]
) -> list[Constraint]:
    """The constraints, and a check of every key that the model takes, for errors with its place."""
    name = scenario.robot.title
    constraints = each("constraints", scenario.constraints, lambda form: make(form, ()))
    names = [constraint.name for constraint in (*plant_constraints(links), *loops)]
    for index, constraint in enumerate(constraints):
        with at(f"constraints.{index}"):  # Unknown names.
            if constraint.residual(links).numel() < len(constraint.force_signals):
                constraint.rate(links.kinematics())
        if not constraint.name or constraint.name in names:
            key = f"constraints.{index}.name"
            text = f"each constraint needs a name of its own, got '{constraint.name}'"
            raise ScenarioError((key, text))
        names.append(constraint.name)
        _compare_sizes(constraint, links)
    constraints += loops
    bound = ConstraintSet([*constraints, *plant_constraints(links)])
    actuators = (*links.actuator_signals, *bound.motors)
    if not actuators:
        text = (
            f"no joint of '{Path(scenario.robot.file).name or name}' is driven; write all, or a "
            "list of joints. Without this key those are driven to which the file gives an "
            "actuator, as a URDF does by a <transmission>"
        )
        raise ScenarioError(("robot.actuators", text))
    _outputs(scenario, constraints, links)
    if links.actuator_signals:
        each("actuation", scenario.actuation, lambda stage: stage.attach(links))
    with at("actuation"):
        chain(scenario.actuation, links)
    forces, known = scenario.forces, scenario.robot.known_forces
    each("forces", forces or (), lambda f: force_rows(as_force_outputs([f], bound), bound, links))
    with at("forces"):
        as_force_outputs(forces, bound)
    for force, value in (scenario.compliances or {}).items():
        with at(f"compliances.{force}"):
            bound.place(force)
            if not value > 0.0:
                raise ModelError(f"a compliance must be positive, got {value}")
    each("robot.known_forces", known, lambda force: force.reaction(links.kinematics()))
    with at("law.control_weights"):
        choice = control_choice(name, scenario.law.control_weights or None, actuators)
    with at("exogenous"):
        attached = [stage.attach(links).parameters for stage in scenario.actuation]
        members = [one.parameters for one in constraints] + [one.parameters for one in known]
        groups = [links.parameters, *members, *attached, choice]
        parameters = [parameter.name for group in groups for parameter in group]
        for moving in scenario.exogenous:
            if moving not in parameters:
                raise ModelError(unknown_name("parameter", moving, parameters))
    return constraints


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
            scenario.forces,
            tuple(scenario.exogenous),
            scenario.robot.known_forces,
            scenario.compliances,
            scenario.law.control_weights or None,
            scenario.compiled,
        )
    with at("parameters"):
        model.dae = model.dae.with_values(scenario.parameters)
    with at("bounds"):
        model.dae = model.dae.with_bounds(scenario.bounds)
    return model


def scenario_structure(model: RobotModel) -> Structure:
    """The structure of a scenario's robot.

    Raises:
        AssumptionError: The robot violates an assumption of the theory.
        ScenarioError: The robot's start is not near its constraints.
    """
    _check_outputs(model)
    with _near_constraints():
        return find_structure(model.dae)


def examine_scenario(model: RobotModel) -> Analysis:
    """What `analyze` finds of a scenario's robot, without its motion.

    Raises:
        ScenarioError: The robot's start is not near its constraints.
    """
    _check_outputs(model)
    with _near_constraints():
        return examine(model.dae)


def _check_outputs(model: RobotModel) -> None:
    if model.dae.num_outputs == 0:
        actuators = model.dae.num_controls
        text = (
            "there are none, and they cannot be completed without references or force outputs: "
            f"name {actuators}, one for each actuator, or give references of some of them"
        )
        raise ScenarioError(("outputs", text))


@contextmanager
def _near_constraints() -> Iterator[None]:
    """Names the keys of a start that is not near the constraints."""
    try:
        yield
    except InconsistentStateError as error:
        raise ScenarioError(("constraints or start.positions", str(error))) from error


def _compare_sizes(constraint: Constraint, links: MultibodyExpressions) -> None:
    """Warns of a surface much larger than the robot: its file may be in millimetres."""
    extent = getattr(getattr(constraint, "surface", None), "extent", None)
    if extent is None:
        return
    plant = links.plant
    context = plant.CreateDefaultContext()
    bodies = (plant.get_body(BodyIndex(i)) for i in range(plant.num_bodies()))
    places = [plant.EvalBodyPoseInWorld(context, body).translation() for body in bodies]
    robot = float(np.linalg.norm(np.ptp(places, axis=0)))
    size = float(np.max(extent[1] - extent[0]))
    if size > _LARGE * robot > 0.0:
        warnings.warn(
            f"the surface of '{constraint.name}' is {size:.3g} m long, and the robot "
            f"{robot:.2g} m: if a unit of its file is a millimetre, write scale: 0.001",
            GeometryWarning,
            stacklevel=2,
        )


def _outputs(
    scenario: Scenario, constraints: Sequence[Constraint], links: Links
) -> list[PositionOutput]:
    outputs = each("outputs", scenario.outputs, lambda form: make(form, constraints))
    each("outputs", outputs, lambda output: output.expression(links))
    return outputs
