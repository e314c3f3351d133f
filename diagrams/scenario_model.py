"""The robot of a scenario, with what it touches and what it shall steer."""

import logging
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from itertools import islice
from pathlib import Path
from typing import TypeVar

from pydrake.geometry import SceneGraph
from pydrake.multibody.parsing import GetScopedFrameByName, Parser
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import QuaternionFloatingJoint, RpyFloatingJoint

from drake_dae.arrays import FloatArray, unknown_name
from drake_dae.dae.signals import Parameter, Signal
from drake_dae.dae.structure.structure import Structure, find_structure
from drake_dae.diagrams.resources import check_resources, package_folder
from drake_dae.diagrams.scenario import Scenario
from drake_dae.diagrams.scenario_parts import Robot, Written, made
from drake_dae.diagrams.shipped import FOLDER
from drake_dae.errors import DrakeDaeError, InconsistentStateError, ModelError, ScenarioError
from drake_dae.robots.actuation import Stage
from drake_dae.robots.actuation.chain import chain
from drake_dae.robots.contact import Constraint
from drake_dae.robots.contact.constraint_set import ConstraintSet
from drake_dae.robots.contact.plant_constraints import plant_constraints
from drake_dae.robots.control_choice import control_choice
from drake_dae.robots.force_outputs import ForceOutput, force_outputs, force_rows
from drake_dae.robots.links.links import Links
from drake_dae.robots.links.multibody import MultibodyExpressions
from drake_dae.robots.loads import KnownForce
from drake_dae.robots.model import RobotModel
from drake_dae.robots.outputs import PositionOutput

T = TypeVar("T")
S = TypeVar("S")


def scenario_model(scenario: Scenario, scene_graph: SceneGraph | None = None) -> RobotModel:
    """The robot of a scenario, with what it touches and what it shall steer.

    Args:
        scenario: What `load_scenario` returns.
        scene_graph: Where the robot's geometry is registered; needed to draw it.

    Raises:
        ScenarioError: Something does not fit; the message names its key.
    """
    # The robot.
    name = Path(scenario.robot.file).name.split(".")[0]  # Of "two_arms.dmd.yaml", too.
    links = _links(scenario.robot, scene_graph or SceneGraph())

    # What it touches or holds.
    constraints = _constraints(scenario.constraints, links)
    actuators = (*links.actuator_signals, *ConstraintSet(constraints).motors)
    if not actuators:
        text = (
            f"'{Path(scenario.robot.file).name}' has no actuators; in a URDF, give each driven "
            "joint a <transmission>"
        )
        raise ScenarioError(("robot.file", text))

    # What it shall steer, from where, and by what.
    outputs = _outputs(scenario.outputs, constraints, links)
    guess = start_guess(scenario.start.positions, links)
    stages = _stages(scenario.actuation, links)
    _check_forces(scenario.forces, constraints, links)
    _check_compliances(scenario.compliances, constraints, links)
    loads = each("loads", scenario.loads, lambda load: _load(load, links))
    weights = scenario.control_weights or None
    with at("control_weights"):
        choice = control_choice(name, weights, actuators)
    _check_exogenous(scenario.exogenous, links, [*constraints, *loads], stages, choice)
    with at("actuation" if stages else "outputs"):
        return RobotModel(
            links,
            constraints,
            outputs,
            guess,
            name,
            stages,
            scenario.forces,
            tuple(scenario.exogenous),
            loads,
            scenario.compliances,
            weights,
            scenario.compiled,
        )


def scenario_structure(model: RobotModel) -> Structure:
    """The structure of a scenario's robot.

    Raises:
        AssumptionError: The robot violates an assumption of the theory.
        ScenarioError: The robot starts nowhere near its constraints.
    """
    try:
        return find_structure(model.dae)
    except InconsistentStateError as error:
        raise ScenarioError(("constraints or start.positions", str(error))) from error


@contextmanager
def at(key: str) -> Iterator[None]:
    """Puts the key of the scenario before whatever goes wrong."""
    try:
        yield
    except ScenarioError:
        raise  # It has a key already.
    except DrakeDaeError as error:
        raise ScenarioError((key, str(error))) from error


def each(key: str, items: Iterable[S], make: Callable[[S], T]) -> list[T]:
    """What is made of each item; an error bears the key and the item's index."""
    results = []
    for index, item in enumerate(items):
        with at(f"{key}.{index}"):
            results.append(make(item))
    return results


@at("robot.file")
def _links(robot: Robot, scene_graph: SceneGraph) -> MultibodyExpressions:
    plant = _parse(robot, scene_graph)
    for index in plant.GetJointIndices():
        joint = plant.get_joint(index)
        if isinstance(joint, QuaternionFloatingJoint):
            raise ModelError(
                f"body '{joint.child_body().name()}' is free; weld it to the world in the file, or "
                "name it in robot.free, which gives it a joint in roll, pitch and yaw. A "
                "quaternion is not supported: no force keeps its length"
            )
    links = MultibodyExpressions(plant)
    plant_constraints(links)
    return links


def _parse(robot: Robot, scene_graph: SceneGraph) -> MultibodyPlant:
    is_url = robot.file.startswith("package://")
    if not is_url and not _is_file(robot.file):
        raise ModelError(f"no file '{robot.file}'; a relative path starts in the scenario's folder")
    # Continuous: only then are the plant's own dynamics those of (37).
    plant = MultibodyPlant(0.0)
    plant.RegisterAsSourceForSceneGraph(scene_graph)
    add_robot(robot, plant, scene_graph, MultibodyPlant.Finalize)
    return plant


def add_robot(
    robot: Robot,
    plant: MultibodyPlant,
    scene_graph: SceneGraph,
    then: Callable[[MultibodyPlant], None] = lambda plant: None,
) -> None:
    """Adds the robot of a scenario to a plant.

    Args:
        robot: The robot.
        plant: A plant that is not finalized.
        scene_graph: Where the plant is registered.
        then: What is done to the plant at last.

    Raises:
        ModelError: Drake cannot read the file, or drops something of it.
    """
    is_url = robot.file.startswith("package://")
    parser = Parser(plant)
    log = logging.getLogger("drake")
    level, dropped = log.level, _Dropped(log.getEffectiveLevel())
    log.addFilter(dropped)
    log.setLevel(logging.WARNING)  # Whoever wants to see less must still be told.
    try:
        parser.package_map().AddPackageXml(str(FOLDER / "models" / "package.xml"))
        for name, folder in robot.packages.items():
            parser.package_map().Add(name, folder)
        file = parser.package_map().ResolveUrl(robot.file) if is_url else robot.file
        _check_one_robot(Path(file))
        if is_url:
            parser.AddModelsFromUrl(robot.file)
        else:
            parser.AddModels(robot.file)
        folders = [FOLDER / "models", *map(Path, robot.packages.values())]
        check_resources(scene_graph, [package_folder(Path(file)), *folders])
        _add_free_joints(robot.free, plant)
        then(plant)
    except ScenarioError:
        raise
    except (RuntimeError, ValueError, SystemExit) as error:
        # Drake has all of them: SystemExit for what an assertion of its own finds.
        raise ModelError(str(error)) from None
    finally:
        log.setLevel(level)
        log.removeFilter(dropped)
    if dropped.warnings:
        raise ModelError("; ".join(map(_explained, dropped.warnings)))


@at("robot.free")
def _add_free_joints(bodies: Sequence[str], plant: MultibodyPlant) -> None:
    """Gives bodies that no joint holds one in roll, pitch and yaw, for which files have no word."""
    for name in bodies:
        try:
            body = GetScopedFrameByName(plant, name).body()
            joints = [plant.get_joint(index) for index in plant.GetJointIndices()]
            held = [j.name() for j in joints if j.child_body().index() == body.index()]
            if held:
                raise ModelError(f"'{name}' is not free: joint '{held[0]}' holds it")
            plant.AddJoint(RpyFloatingJoint(body.name(), plant.world_frame(), body.body_frame()))
        except RuntimeError as error:
            raise ModelError(f"'{name}' is no body that can be free: {error}") from None


class _Dropped(logging.Filter):
    """Collects what Drake's parser changes or leaves out, with no more than a warning."""

    KINDS = ("inertia", "friction", "effort limit", "equality", "mimic")

    def __init__(self, level: int) -> None:
        super().__init__()
        self._level = level
        self.warnings: list[str] = []

    def filter(self, record: logging.LogRecord) -> bool:
        text = record.getMessage()
        is_dropped = "warning: " in text and any(kind in text for kind in self.KINDS)
        if is_dropped:
            self.warnings.append(text)
        return not is_dropped and record.levelno >= self._level


def _explained(warning: str) -> str:
    """A warning of Drake's parser, "<file>:<line>: warning: <text>", with the link or joint."""
    place, text = warning.split(": warning: ", 1)
    kind = "link" if "inertia" in text else "joint"
    if "inertia" in text:
        text = (
            "mass or inertia of no body: a mass is positive, moments of inertia are positive and "
            "none exceeds the sum of the others"
        )
    elif "friction" in text:
        text = "Coulomb friction of a joint is not supported; leave <dynamics friction> out"
    elif "equality" in text:
        return (
            f"{place}: {' '.join(text.split())} Take it out of the file, and write it under "
            "constraints; two joints that move together are a !JointCoupler"
        )
    file, _, line = place.rpartition(":")
    owner = ""
    if _is_file(file) and line.isdecimal():
        with open(file, encoding="utf-8", errors="replace") as lines:
            before = "".join(islice(lines, int(line)))
        names = re.findall(rf"<{kind}\s[^>]*?name\s*=\s*[\"']([^\"']*)", before)
        owner = f"{kind} '{names[-1]}': " if names else ""
    return f"{place}: {owner}{' '.join(text.split())}"


def _check_one_robot(file: Path) -> None:
    """Refuses a second robot in a URDF, which Drake would not read."""
    if file.suffix != ".urdf":
        return
    text = re.sub(r"<!--.*?-->", "", file.read_text("utf-8", errors="replace"), flags=re.DOTALL)
    names = re.findall(r"<robot\b[^>]*", text)
    if len(names) > 1:
        raise ModelError(f"'{file.name}' has {len(names)} <robot>s, and only one is read")


def _is_file(name: str) -> bool:
    try:
        return Path(name).is_file()
    except (OSError, ValueError):  # A null byte.
        return False


def _constraints(
    forms: Sequence[Constraint | Written[Constraint]], links: Links
) -> list[Constraint]:
    constraints = each("constraints", forms, lambda form: made(form, ()))
    each("constraints", constraints, lambda constraint: _try(constraint, links))
    taken = [constraint.name for constraint in plant_constraints(links)]
    for index, constraint in enumerate(constraints):
        name = constraint.name
        if not name or name in taken:
            key = f"constraints.{index}.name"
            raise ScenarioError((key, f"each constraint needs a name of its own, got '{name}'"))
        taken.append(name)
    return constraints


def _try(constraint: Constraint, links: Links) -> None:
    """Writes a constraint's equations, so that what it names is looked for."""
    if constraint.residual(links).numel() < len(constraint.force_signals):
        constraint.rate(links.kinematics())


def _check_forces(
    forces: Sequence[str | ForceOutput] | None, constraints: Sequence[Constraint], links: Links
) -> None:
    bound = ConstraintSet([*constraints, *plant_constraints(links)])
    each("forces", forces or (), lambda one: force_rows(force_outputs([one], bound), bound, links))
    with at("forces"):
        force_outputs(forces, bound)


def _check_compliances(
    compliances: Mapping[str, float] | None, constraints: Sequence[Constraint], links: Links
) -> None:
    bound = ConstraintSet([*constraints, *plant_constraints(links)])
    for name, value in (compliances or {}).items():
        with at(f"compliances.{name}"):
            bound.place(name)
            if not value > 0.0:
                raise ModelError(f"a compliance must be positive, got {value}")


def _outputs(
    forms: Sequence[PositionOutput | Written[PositionOutput]],
    constraints: Sequence[Constraint],
    links: Links,
) -> list[PositionOutput]:
    outputs = each("outputs", forms, lambda form: made(form, constraints))
    each("outputs", outputs, lambda output: output.expression(links))
    return outputs


def _stages(stages: Sequence[Stage], links: Links) -> Sequence[Stage]:
    if links.actuator_signals:
        each("actuation", stages, lambda stage: stage.attach(links))
    else:
        with at("actuation"):
            chain(stages, links)  # It refuses them.
    return stages


def _load(load: KnownForce, links: Links) -> KnownForce:
    load.reaction(links.kinematics())
    return load


@at("exogenous")
def _check_exogenous(
    names: Iterable[str],
    links: Links,
    members: Sequence[Constraint | KnownForce],
    stages: Sequence[Stage],
    choice: Sequence[Parameter],
) -> None:
    """Refuses to move what is no parameter."""
    attached = [stage.attach(links).parameters for stage in stages]
    groups = [links.parameters, *(member.parameters for member in members), *attached]
    known = [parameter.name for group in (*groups, choice) for parameter in group]
    for name in names:
        if name not in known:
            raise ModelError(unknown_name("parameter", name, known))


@at("start.positions")
def start_guess(positions: dict[str, float], links: Links) -> FloatArray:
    """q near which the robot starts."""
    guess = links.default_positions.copy()
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
    """Where a name stands among signals."""
    names = [signal.name for signal in signals]
    if name not in names:
        raise ModelError(unknown_name(kind, name, names))
    return names.index(name)
