"""From a scenario to the closed loop that it describes."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TypeVar

import numpy as np
from pydrake.geometry import Meshcat, SceneGraph
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import MultibodyPlant
from pydrake.systems.analysis import SimulatorConfig
from pydrake.systems.framework import Context

from drake_dae.arrays import FloatArray, unknown_name
from drake_dae.dae.references import Reference
from drake_dae.dae.signals import Signal
from drake_dae.dae.structure import Structure, find_structure
from drake_dae.dae.tracking import TrackingLaw
from drake_dae.diagrams.closed_loop import ClosedLoop, make_closed_loop
from drake_dae.diagrams.scenario import FOLDER, Robot, Scenario, Written
from drake_dae.errors import (
    AssumptionError,
    DrakeDaeError,
    InconsistentStateError,
    ModelError,
    ScenarioError,
)
from drake_dae.robots.actuation import Stage
from drake_dae.robots.contact import Constraint
from drake_dae.robots.links.links import Links
from drake_dae.robots.links.multibody import MultibodyExpressions
from drake_dae.robots.model import RobotModel
from drake_dae.robots.outputs import PositionOutput
from drake_dae.simulation.simulate import check_config, check_duration
from drake_dae.systems.robot_plant import RobotPlant

T = TypeVar("T")
S = TypeVar("S")


def build_scenario(
    scenario: Scenario, meshcat: Meshcat | None = None, live: bool = True
) -> tuple[ClosedLoop, Context]:
    """The closed loop of a scenario, and its context at the start.

    Args:
        scenario: As loaded.
        meshcat: Where to draw, or None.
        live: As in `make_closed_loop`.

    Raises:
        ScenarioError: What does not fit, with the key.
    """
    scene_graph = SceneGraph()
    model = scenario_model(scenario, scene_graph)
    try:
        structure = scenario_structure(model)
    except AssumptionError as error:
        key = "constraints" if error.assumption <= 3 else "outputs"
        raise ScenarioError((key, str(error))) from error
    return wire_scenario(scenario, model, structure, scene_graph, meshcat, live)


def scenario_model(scenario: Scenario, scene_graph: SceneGraph | None = None) -> RobotModel:
    """The robot of a scenario, with what it touches and what it shall steer.

    Args:
        scenario: As loaded.
        scene_graph: Where its geometry is registered, or None.

    Raises:
        ScenarioError: What does not fit, with the key.
    """
    # How long it runs, since nothing else takes less time to find.
    _check_run(scenario.duration, scenario.integrator)

    # The robot.
    name = Path(scenario.robot.file).name.split(".")[0]  # Of "two_arms.dmd.yaml", too.
    links = _links(scenario.robot, scene_graph or SceneGraph())

    # What it touches or holds.
    constraints = _constraints(scenario.constraints, links)

    # What it shall steer, from where, and by what.
    outputs = _outputs(scenario.outputs, constraints, links)
    guess = _guess(scenario.start.positions, links)
    stages = _stages(scenario.actuation, links)
    with _at("actuation" if stages else "outputs"):
        return RobotModel(links, constraints, outputs, guess, name, stages)


def scenario_structure(model: RobotModel) -> Structure:
    """The structure of a scenario's robot.

    Raises:
        AssumptionError: An assumption that it violates.
        ScenarioError: It starts nowhere near its constraints.
    """
    try:
        return find_structure(model.dae)
    except InconsistentStateError as error:
        raise ScenarioError(("constraints or start.positions", str(error))) from error


def wire_scenario(
    scenario: Scenario,
    model: RobotModel,
    structure: Structure,
    scene_graph: SceneGraph | None = None,
    meshcat: Meshcat | None = None,
    live: bool = True,
) -> tuple[ClosedLoop, Context]:
    """The closed loop of a scenario's robot, and its context at the start.

    Args:
        scenario: As loaded.
        model: Its `scenario_model`.
        structure: That of the model's system.
        scene_graph: Where the robot's geometry is registered; needed to draw it.
        meshcat: Where to draw, or None.
        live: As in `make_closed_loop`.

    Raises:
        ScenarioError: What does not fit, with the key.
    """
    # The law, the sensor that it may need, and the references.
    force = scenario.force
    with _at("force"):
        sensor = force.sensor(model.dae.num_constraints)
    with _at("force or gains" if force.is_measured else "gains"):
        gains = scenario.gains.design()
        law = TrackingLaw(
            model.dae,
            gains,
            structure=structure,
            measured_force=force.is_measured,
            force_gain=force.gain,
        )
    references = _references(scenario.references, law)

    # The diagram.
    with _at("force" if force.is_measured else "start.positions"):
        loop = make_closed_loop(
            RobotPlant(model, structure=structure),
            law,
            references,
            sensor=sensor,
            scene_graph=scene_graph,
            meshcat=meshcat,
            live=live,
            start_time=scenario.integrator.start_time,
        )

    # The start: at rest, where the references begin, plus the errors.
    context = loop.diagram.CreateDefaultContext()
    context.SetTime(scenario.integrator.start_time)
    _start(scenario, model, loop, context)
    return loop, context


@contextmanager
def _at(key: str) -> Iterator[None]:
    """Puts the key of the scenario before whatever goes wrong."""
    try:
        yield
    except ScenarioError:
        raise  # It has a key already.
    except DrakeDaeError as error:
        raise ScenarioError((key, str(error))) from error


def _each(key: str, items: Iterable[S], make: Callable[[S], T]) -> list[T]:
    """What is made of each item; an error bears the key and the item's index."""
    made = []
    for index, item in enumerate(items):
        with _at(f"{key}.{index}"):
            made.append(make(item))
    return made


def _check_run(duration: float, integrator: SimulatorConfig) -> None:
    with _at("duration"):
        check_duration(duration)
    with _at("integrator"):
        check_config(integrator)


@_at("robot.file")
def _links(robot: Robot, scene_graph: SceneGraph) -> MultibodyExpressions:
    links = MultibodyExpressions(_parse(robot, scene_graph))
    if not links.actuator_signals:
        raise ModelError(
            f"'{Path(robot.file).name}' has no actuators; in a URDF, give each driven joint a "
            "<transmission>"
        )
    return links


def _parse(robot: Robot, scene_graph: SceneGraph) -> MultibodyPlant:
    is_url = robot.file.startswith("package://")
    if not is_url and not Path(robot.file).is_file():
        raise ModelError(f"no file '{robot.file}'; a relative path starts in the scenario's folder")
    # Continuous: only then are the plant's own dynamics those of (37).
    plant = MultibodyPlant(0.0)
    plant.RegisterAsSourceForSceneGraph(scene_graph)
    parser = Parser(plant)
    try:
        parser.package_map().AddPackageXml(str(FOLDER / "models" / "package.xml"))
        for name, folder in robot.packages.items():
            parser.package_map().Add(name, folder)
        if is_url:
            parser.AddModelsFromUrl(robot.file)
        else:
            parser.AddModels(robot.file)
        plant.Finalize()
    except RuntimeError as error:
        raise ModelError(str(error)) from None
    return plant


def _constraints(
    forms: Sequence[Constraint | Written[Constraint]], links: Links
) -> list[Constraint]:
    def make(form: Constraint | Written[Constraint]) -> Constraint:
        constraint = form.made(()) if isinstance(form, Written) else form
        constraint.residual(links)  # Now, while the index is known.
        return constraint

    constraints = _each("constraints", forms, make)
    names = [constraint.name for constraint in constraints]
    for index, name in enumerate(names):
        if not name or name in names[:index]:
            key = f"constraints.{index}.name"
            raise ScenarioError((key, f"each constraint needs a name of its own, got '{name}'"))
    return constraints


def _outputs(
    forms: Sequence[PositionOutput | Written[PositionOutput]],
    constraints: Sequence[Constraint],
    links: Links,
) -> list[PositionOutput]:
    def make(form: PositionOutput | Written[PositionOutput]) -> PositionOutput:
        output = form.made(constraints) if isinstance(form, Written) else form
        output.expression(links)
        return output

    return _each("outputs", forms, make)


def _stages(stages: Sequence[Stage], links: Links) -> Sequence[Stage]:
    _each("actuation", stages, lambda stage: stage.attach(links))
    return stages


@_at("start.positions")
def _guess(positions: dict[str, float], links: Links) -> FloatArray:
    """q near which the robot starts."""
    guess = links.default_positions.copy()
    for name, value in positions.items():
        index = _index(name, links.position_signals, "joint position")
        low, high = (limits[index] for limits in links.position_limits)
        if not low <= value <= high:
            unit = links.position_signals[index].unit
            raise ModelError(
                f"{name} = {value:g} {unit} is outside its limits, {low:g} to {high:g} {unit}"
            )
        guess[index] = value
    return guess


def _references(references: Sequence[Reference], law: TrackingLaw) -> Sequence[Reference]:
    """References that together cover all outputs, each smooth enough."""
    signals = law.system.output_signals
    first = 0

    def check(reference: Reference) -> None:
        nonlocal first
        degrees = law.degrees[first : first + reference.size]
        if len(degrees) < reference.size:
            raise ModelError(
                f"too many: {reference.size} values, but left without a reference: "
                f"{_names(signals[first:])}"
            )
        reference.derivatives(degrees)
        first += reference.size

    _each("references", references, check)
    if first < len(signals):
        raise ScenarioError(
            (
                "references",
                f"too few, left without one: {_names(signals[first:])}; needed, in this order: "
                f"{_names(signals)}",
            )
        )
    return references


def _start(scenario: Scenario, model: RobotModel, loop: ClosedLoop, context: Context) -> None:
    """Sets parameters, state and sensor of a context."""
    plant = loop.plant
    own = plant.GetMyMutableContextFromRoot(context)
    with _at("plant_parameters"):
        for name, numbers in scenario.plant_parameters.items():
            plant.set_parameter(own, name, numbers)
    parameters = plant.parameters(own)
    wanted = _wanted(scenario.start.errors, loop, context.get_time())
    positions, forces = np.split(wanted, [len(model.position_signals)])
    with _at("start"):
        guess = _guess(scenario.start.positions, model.links)
        q = _configuration(model, positions, guess, parameters)
        plant.set_consistent_state(own, model.rest_state(q, forces, parameters))
    if loop.sensor is not None:
        loop.sensor.set_force(loop.sensor.GetMyMutableContextFromRoot(context), forces)
        loop.set_seed(context, scenario.force.seed)


@_at("start.errors")
def _wanted(errors: dict[str, float], loop: ClosedLoop, time: float) -> FloatArray:
    """z at the start: the references plus the errors, shape (p,)."""
    degrees = loop.controller.law.degrees
    wanted = loop.controller.law.layout.values(loop.reference.reference(time))
    for name, error in errors.items():
        index = _index(name, loop.plant.dae.output_signals, "output")
        if degrees[index] == 0:
            raise ModelError(
                f"'{name}' has degree 0: the law meets it at once and it has no start error"
            )
        wanted[index] += error
    return wanted


def _configuration(
    model: RobotModel, positions: FloatArray, guess: FloatArray, parameters: FloatArray
) -> FloatArray:
    """q with given position outputs, on the constraints."""
    try:
        return model.configuration(positions, guess, parameters)
    except InconsistentStateError as error:
        goal = ", ".join(
            f"{signal.name} = {value:.4g} {signal.unit}".rstrip()
            for signal, value in zip(model.position_signals, positions, strict=True)
        )
        raise ModelError(
            f"found no configuration near start.positions with {goal} (the references and "
            f"start.errors at the start) on the constraints: {error}"
        ) from error


def _index(name: str, signals: Sequence[Signal], kind: str) -> int:
    """Where a name stands among signals."""
    names = [signal.name for signal in signals]
    if name not in names:
        raise ModelError(unknown_name(kind, name, names))
    return names.index(name)


def _names(signals: Sequence[Signal]) -> str:
    return ", ".join(signal.name for signal in signals) or "none"
