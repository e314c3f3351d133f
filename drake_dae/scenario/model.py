"""The robot model of a scenario: constraints, outputs and actuation."""

import warnings
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from pydrake.geometry import SceneGraph
from pydrake.multibody.tree import BodyIndex

from drake_dae.analysis.analyze import examine
from drake_dae.analysis.report import Analysis
from drake_dae.arguments import checked
from drake_dae.arrays import FloatArray, unknown_name
from drake_dae.dae.structure.structure import Structure, find_structure
from drake_dae.dae.system.signals import Parameter, Signal
from drake_dae.errors import GeometryWarning, InconsistentStateError, ModelError, ScenarioError
from drake_dae.robots.actuation import Stage
from drake_dae.robots.actuation.chain import chain
from drake_dae.robots.constraints import Constraint
from drake_dae.robots.constraints.constraint_set import ConstraintSet
from drake_dae.robots.constraints.plant_constraints import plant_constraints
from drake_dae.robots.control_choice import control_choice
from drake_dae.robots.force_outputs import ForceOutput, force_outputs, force_rows
from drake_dae.robots.known_forces import Load
from drake_dae.robots.links.links import Links
from drake_dae.robots.links.multibody import MultibodyExpressions
from drake_dae.robots.model import RobotModel
from drake_dae.robots.outputs import PositionOutput
from drake_dae.scenario.completion.completion import Completed, complete
from drake_dae.scenario.completion.of_task import complete_task
from drake_dae.scenario.forms.keys import at, each
from drake_dae.scenario.parts.written import WrittenConstraint, WrittenOutput, make
from drake_dae.scenario.robot_file.links import RobotLinks, robot_links
from drake_dae.scenario.robot_file.robot import Payload
from drake_dae.scenario.scenario import Scenario

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

    Outputs are missing if there are fewer than actuators minus force outputs. Independent outputs
    are added, in this order: the world coordinates along the surface of each contact point; the
    directions of the tool's axis by `tool_axis`; and positions of joints, chosen so that B(x) of
    (16) is best conditioned and joints are away from their limits along the reference. Outputs
    without a reference keep their initial value.

    If start.positions are left out and Newton's method finds no regular start from the default
    configuration, a start with the first values of the references is searched.

    Args:
        scenario: What `load_scenario` returns.

    Returns:
        The scenario, unchanged if nothing is missing, and the choices in words.

    Raises:
        ScenarioError: The scenario is not valid, the robot cannot reach the start, or no outputs
            are independent of those in the scenario; the message names the key.
    """
    return _build(scenario, *robot_links(scenario.robot, SceneGraph(), drawn=False)).completed


def completed_model(
    scenario: Scenario,
    scene_graph: SceneGraph | None = None,
    payloads: Sequence[Payload] = (),
    drawn: bool = True,
    robot: RobotLinks | None = None,
) -> tuple[Completed, RobotModel]:
    """The results of `complete_scenario` and `scenario_model`, for a robot with payloads.

    Args:
        scenario: What `load_scenario` returns.
        scene_graph: The scene graph of the robot's geometry, or None.
        payloads: The payloads.
        drawn: Whether the scene graph, if there is one, will be drawn.
        robot: What `robot_links` made of the other arguments; None to read the robot.
    """
    drawn = drawn and scene_graph is not None
    if robot is None:
        robot = robot_links(scenario.robot, scene_graph or SceneGraph(), payloads, drawn)
    built = _build(scenario, *robot)
    scenario = built.completed.scenario
    outputs = _outputs(scenario.outputs, built.constraints, built.links)
    with at("actuation" if built.stages else "outputs"):
        model = RobotModel(
            built.links,
            built.constraints,
            outputs,
            start_guess(scenario.start.positions, built.links),
            built.name,
            built.stages,
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
    return built.completed, model


@dataclass(frozen=True, eq=False)
class _BuiltRobot:
    """A scenario's checked robot, and the completed scenario."""

    name: str
    links: MultibodyExpressions
    constraints: Sequence[Constraint]
    stages: Sequence[Stage]
    completed: Completed


def _build(
    scenario: Scenario, links: MultibodyExpressions, loops: Sequence[Constraint]
) -> _BuiltRobot:
    # The constraints.
    name = scenario.robot.title
    constraints = _constraints(scenario.constraints, loops, links)
    actuators = (*links.actuator_signals, *ConstraintSet(constraints).motors)
    if not actuators:
        text = (
            f"no joint of '{Path(scenario.robot.file).name or name}' is driven; write all, or a "
            "list of joints. Without this key those are driven to which the file gives an "
            "actuator, as a URDF does by a <transmission>"
        )
        raise ScenarioError(("robot.actuators", text))

    # Outputs, start and actuation.
    _outputs(scenario.outputs, constraints, links)
    guess = start_guess(scenario.start.positions, links)
    stages = _stages(scenario.actuation, links)
    bound = ConstraintSet([*constraints, *plant_constraints(links)])
    _check_forces(scenario.forces, bound, links)
    _check_compliances(scenario.compliances or {}, bound)
    known_forces = scenario.robot.known_forces
    each("robot.known_forces", known_forces, lambda force: force.reaction(links.kinematics()))
    with at("law.control_weights"):
        choice = control_choice(name, scenario.law.control_weights or None, actuators)
    _check_exogenous(scenario.exogenous, links, [*constraints, *known_forces], stages, choice)

    # The completion.
    completing = complete if scenario.task is None else complete_task
    completed = completing(scenario, links, constraints, plant_constraints(links), guess)
    return _BuiltRobot(name, links, constraints, stages, completed)


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


def _constraints(
    forms: Sequence[WrittenConstraint],
    loops: Sequence[Constraint],
    links: MultibodyExpressions,
) -> list[Constraint]:
    constraints = each("constraints", forms, lambda form: make(form, ()))
    each("constraints", constraints, lambda constraint: _evaluate(constraint, links))
    names = [constraint.name for constraint in (*plant_constraints(links), *loops)]
    for index, constraint in enumerate(constraints):
        name = constraint.name
        if not name or name in names:
            key = f"constraints.{index}.name"
            raise ScenarioError((key, f"each constraint needs a name of its own, got '{name}'"))
        names.append(name)
        _compare_sizes(constraint, links)
    return [*constraints, *loops]


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


def _evaluate(constraint: Constraint, links: Links) -> None:
    """Evaluates a constraint's equations, which raises an error for unknown names."""
    if constraint.residual(links).numel() < len(constraint.force_signals):
        constraint.rate(links.kinematics())


def _check_forces(
    forces: Sequence[str | ForceOutput] | None, bound: ConstraintSet, links: Links
) -> None:
    each("forces", forces or (), lambda f: force_rows(force_outputs([f], bound), bound, links))
    with at("forces"):
        force_outputs(forces, bound)


def _check_compliances(compliances: Mapping[str, float], bound: ConstraintSet) -> None:
    for name, value in compliances.items():
        with at(f"compliances.{name}"):
            bound.place(name)
            if not value > 0.0:
                raise ModelError(f"a compliance must be positive, got {value}")


def _outputs(
    forms: Sequence[WrittenOutput],
    constraints: Sequence[Constraint],
    links: Links,
) -> list[PositionOutput]:
    outputs = each("outputs", forms, lambda form: make(form, constraints))
    each("outputs", outputs, lambda output: output.expression(links))
    return outputs


def _stages(stages: Sequence[Stage], links: Links) -> Sequence[Stage]:
    if links.actuator_signals:
        each("actuation", stages, lambda stage: stage.attach(links))
    else:
        with at("actuation"):
            chain(stages, links)  # The model refuses them.
    return stages


@at("exogenous")
def _check_exogenous(
    names: Iterable[str],
    links: Links,
    members: Sequence[Constraint | Load],
    stages: Sequence[Stage],
    choice: Sequence[Parameter],
) -> None:
    """Checks that exogenous names are parameters."""
    attached = [stage.attach(links).parameters for stage in stages]
    groups = [links.parameters, *(member.parameters for member in members), *attached]
    parameters = [parameter.name for group in (*groups, choice) for parameter in group]
    for name in names:
        if name not in parameters:
            raise ModelError(unknown_name("parameter", name, parameters))


@at("start.positions")
def start_guess(
    positions: dict[str, float], links: Links, others: FloatArray | None = None
) -> FloatArray:
    """The initial guess of q for the computation of the start.

    Args:
        positions: Joint name -> position.
        links: The robot.
        others: The positions of all joints that are not named, shape (nq,); the robot's defaults
            if None.
    """
    guess = (links.default_positions if others is None else others).copy()
    for name, value in positions.items():
        index = index_of(name, links.position_signals, "joint position")
        low, high = (limits[index] for limits in links.position_limits)
        if not low <= value <= high:
            unit = links.position_signals[index].unit
            raise ModelError(
                f"{name} = {value:g} {unit} is outside its limits, {low:g} to {high:g} {unit}"
            )
        guess[index] = value
    return guess


def index_of(name: str, signals: Sequence[Signal], kind: str) -> int:
    """The index of a name among signals."""
    names = [signal.name for signal in signals]
    if name not in names:
        raise ModelError(unknown_name(kind, name, names))
    return names.index(name)
