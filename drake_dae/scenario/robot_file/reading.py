"""Reads a robot's files into a MultibodyPlant, and into links of the library."""

import logging
import warnings
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from threading import get_native_id
from types import MappingProxyType

import numpy as np
from pydrake.geometry import Box, SceneGraph
from pydrake.math import RigidTransform
from pydrake.multibody.parsing import (
    FlattenModelDirectives,
    LoadModelDirectives,
    ModelDirectives,
    Parser,
    ProcessModelDirectives,
)
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import ModelInstanceIndex, QuaternionFloatingJoint, RpyFloatingJoint

from drake_dae.errors import DrakeDaeError, ModelError
from drake_dae.robots import Constraint, MultibodyExpressions, joint_names, plant_constraints
from drake_dae.scenario.form import at
from drake_dae.scenario.robot_file.changes import (
    CutJoint,
    add_payloads,
    change_robot,
    cut_loops,
    joints_of,
    loop_constraint,
)
from drake_dae.scenario.robot_file.files import RobotFiles
from drake_dae.scenario.robot_file.mending import Mender
from drake_dae.scenario.robot_file.read_by_drake import DRIVES
from drake_dae.scenario.robot_file.robot import Payload, Robot
from drake_dae.scenario.robot_file.xml_tree import check_included

RobotLinks = tuple[MultibodyExpressions, list[Constraint]]
"""The links of a robot, and its loop-closing joints as constraints."""

_REMEDIES = {
    "friction": "robot.known_forces has friction as a !JointFriction",
    "mimic": "constraints has joints that move together as a !JointCoupler",
    "equality/joint": "constraints has joints that move together as a !JointCoupler",
    "equality/weld": "constraints has it as a !WeldedFrames",
    "equality/connect": "constraints has it as a !CoincidentPoints",
    "inertia": "it takes the nearest possible moments of inertia",
} | dict.fromkeys(DRIVES, "or name the driven joints under robot.actuators")
"""What the name of a lost part contains -> what to do besides."""

_RED = [0.8, 0.1, 0.1, 1.0]

_MASSLESS = 1e-12
"""An eigenvalue of M(q) below this fraction of the largest one is zero up to round-off."""


@at("robot.file")
def robot_links(
    robot: Robot, scene_graph: SceneGraph, payloads: Sequence[Payload] = (), drawn: bool = True
) -> RobotLinks:
    """The links of a scenario's robot, and its loop-closing joints as constraints."""
    plant, cuts = read_robot(robot, None, scene_graph, payloads, drawn)
    finalize(plant)
    for joint in joints_of(plant):
        if isinstance(joint, QuaternionFloatingJoint):
            name = joint.child_body().name()
            raise ModelError(
                f"body '{name}' is free, with a quaternion, which is not supported. Weld it to the "
                f"world by robot.base, as base: {{weld: {name}}}, or name it in robot.free, which "
                "gives it a joint in roll, pitch and yaw"
            )
    links = MultibodyExpressions(plant, scene_graph)
    _check_mass(plant)
    try:
        plant_constraints(links)
    except ModelError as error:
        raise ModelError(
            f"{error}. robot.leave_out takes them out, as [equality/connect] of MJCF, or "
            "[robot/drake:ball_constraint] of a URDF"
        ) from None
    return links, [loop_constraint(cut, plant) for cut in cuts]


def finalize(plant: MultibodyPlant) -> None:
    """Finalizes a plant."""
    with drake_errors():
        plant.Finalize()


def _check_mass(plant: MultibodyPlant) -> None:
    """Checks that each joint moves a mass; otherwise its acceleration is not determined."""
    context = plant.CreateDefaultContext()
    # Some masses do not move in some configurations, as one at the end of a straight arm.
    step = np.random.default_rng(0).uniform(-1.0, 1.0, plant.num_positions())
    plant.SetPositions(context, plant.GetPositions(context) + step)
    values, modes = np.linalg.eigh(plant.CalcMassMatrix(context))
    null = modes[:, values <= _MASSLESS * np.max(values, initial=0.0)]
    massless = {
        name: joint.child_body().name()
        for name, joint in joint_names(plant).items()
        if np.any(np.abs(null[joint.velocity_start() :][: joint.num_velocities()]) > 0.1)
    }
    if massless:
        raise ModelError(
            f"joints that move no mass: {', '.join(massless)}. Links without it, which no force "
            f"can move: {', '.join(massless.values())}; give them <inertial> with mass and "
            "inertia, or lock the joints by robot.locked"
        )


def read_robot(
    robot: Robot,
    plant: MultibodyPlant | None = None,
    scene_graph: SceneGraph | None = None,
    payloads: Sequence[Payload] = (),
    drawn: bool = True,
) -> tuple[MultibodyPlant, list[CutJoint]]:
    """Reads a robot into a plant that is not finalized, with the changes of the scenario.

    Joints that close loops are cut.
    """
    if plant is None:
        plant = MultibodyPlant(0.0)  # In continuous time, as (37).
        if scene_graph is not None:
            plant.RegisterAsSourceForSceneGraph(scene_graph)
    shapes = ["read", *["drawn"] * drawn] if scene_graph is not None else []
    parser = Parser(plant)
    files = RobotFiles(robot, parser.package_map())
    with TemporaryDirectory() as folder:
        mender = Mender(files, robot, Path(folder).resolve(), shapes)
        with drake_errors(mender.originals):
            models = _mended(robot, files, mender)
            if mender.lost:
                raise ModelError(_told(mender.lost))
            with _remarks(mender):
                if isinstance(models, Path):
                    parser.AddModels(str(models))
                else:
                    ProcessModelDirectives(models, parser)
            _add_floating_joints(plant, mender)
    for (category, kind), items in mender.told.items():
        warnings.warn(f"{kind}: {_listed(items)}", category, stacklevel=2)
    for model, name in sorted(mender.crossed):
        body = plant.GetBodyByName(name, *_instance(plant, model)) if name else plant.world_body()
        for axis in range(3):
            bar = Box(*np.where(np.arange(3) == axis, 0.06, 0.004))
            plant.RegisterVisualGeometry(body, RigidTransform(), bar, f"left_out_{axis}", _RED)
    with drake_errors():
        _free_limits(robot, plant)
        change_robot(robot, plant, mender.joints)
        add_payloads("plant.payloads", payloads, plant)
        return plant, cut_loops(plant, mender.joints["parent"])


def needs_of(robot: Robot) -> tuple[list[str], list[str]]:
    """The packages that a robot's file names and that are not found, and what is lost of it."""
    files = RobotFiles(robot, Parser(MultibodyPlant(0.0)).package_map())
    mender = Mender(files, robot, None, ["read"])
    with drake_errors():
        _mended(robot, files, mender)
    return list(files.missing), list(mender.lost)


def _mended(robot: Robot, files: RobotFiles, mender: Mender) -> Path | ModelDirectives:
    """The mended copy of the robot's file, or directives with the copies of their models."""
    placed = [*([robot.base.weld] if robot.base is not None else []), *robot.free]
    if not files.main.name.endswith((".dmd.yaml", ".dmd.yml")):
        return mender.copy(files.main, "", placed)
    _find_packages(files, files.main, ())
    directives = FlattenModelDirectives(LoadModelDirectives(str(files.main)), files.packages)
    welds = (directive.add_weld for directive in directives.directives)
    placed += [weld.child for weld in welds if weld is not None]
    for directive in directives.directives:
        if (model := directive.add_model) is not None:
            links = [link.removeprefix(f"{model.name}::") for link in placed]
            file = files.needed(model.file, files.main)
            model.file = mender.copy(file, model.name, links).as_uri()
    return directives


def _find_packages(files: RobotFiles, file: Path, within: tuple[Path, ...]) -> None:
    """Finds the packages of directives that others include."""
    check_included(file, within)
    for directive in LoadModelDirectives(str(file)).directives:
        if directive.add_directives is not None:
            inner = files.needed(directive.add_directives.file, file)
            _find_packages(files, inner, (*within, file.resolve()))


def _free_limits(robot: Robot, plant: MultibodyPlant) -> None:
    """Takes away limits that leave no room: speeds of 0, and positions if the scenario says so."""
    unlimited = np.full(1, np.inf)  # Many authors write 0 for an unknown limit.
    for joint in joints_of(plant):
        if joint.num_positions() == 1:
            low, high = joint.position_lower_limits(), joint.position_upper_limits()
            if "empty_limits" in robot.leave_out and low == high:
                joint.set_position_limits(-unlimited, unlimited)
            if joint.velocity_lower_limits() == joint.velocity_upper_limits() == 0.0:
                joint.set_velocity_limits(-unlimited, unlimited)


def _add_floating_joints(plant: MultibodyPlant, mender: Mender) -> None:
    """Adds floating joints in roll, pitch and yaw: Drake has a quaternion in their place.

    No constraint force keeps the length of a quaternion at 1.
    """
    kind = (
        "floating joints have positions in roll, pitch and yaw, _qx, _qy and _qz, in the place of "
        "a quaternion, and must not pitch by 90 degrees"
    )
    for model, name, child, origin in mender.floating:
        models, is_world = _instance(plant, model), origin == "world"
        body = plant.GetBodyByName(child, *models)
        start = plant.GetDefaultFloatingBaseBodyPose(body)
        frame = plant.world_frame() if is_world else plant.GetFrameByName(origin, *models)
        joint = plant.AddJoint(RpyFloatingJoint(name, frame, body.body_frame()))
        if is_world:
            joint.SetDefaultPose(start)
        mender.tell(kind, f"'{name}'")


def _instance(plant: MultibodyPlant, model: str) -> list[ModelInstanceIndex]:
    return [plant.GetModelInstanceByName(model)] if model else []


@contextmanager
def drake_errors(originals: Mapping[Path, Path] = MappingProxyType({})) -> Iterator[None]:
    """Converts Drake's exceptions to ModelError, also the SystemExit of a failed assertion."""
    try:
        yield
    except DrakeDaeError:
        raise
    except (RuntimeError, ValueError, SystemExit) as error:
        raise ModelError(_of_originals(str(error), originals)) from None


@contextmanager
def _remarks(mender: Mender) -> Iterator[None]:
    """Tells what Drake logs in this thread."""
    here, logger = get_native_id(), logging.getLogger("drake")

    def passes(record: logging.LogRecord) -> bool:
        is_remark = record.thread == here and record.levelno >= logging.WARNING
        if is_remark:
            text = _of_originals(record.getMessage(), mender.originals).replace(" warning:", "")
            mender.tell("Drake reads the file with remarks", text[:200])
        return not is_remark

    logger.addFilter(passes)
    try:
        yield
    finally:
        logger.removeFilter(passes)


def _of_originals(text: str, originals: Mapping[Path, Path]) -> str:
    """A text of Drake with the names of files in the place of those of their copies."""
    for copy, file in originals.items():
        text = text.replace(f"/{copy}", file.name).replace(str(copy), file.name)
    return " ".join(text.split())


def _told(lost: Mapping[str, list[str]]) -> str:
    """The message for what Drake does not read of the files."""
    text = "; ".join(f"{part} ({_listed(places)})" for part, places in lost.items())
    ways = [f"leave_out: [{', '.join(lost)}] under robot"]
    ways += [hint for word, hint in _REMEDIES.items() if any(word in part for part in lost)]
    return (
        f"the equations would lack what Drake does not read of the file: {text}. Mend it, or write "
        f"{'; '.join(dict.fromkeys(ways))}"
    )


def _listed(items: Iterable[str], most: int = 8) -> str:
    every = list(dict.fromkeys(items))
    more = f" and {len(every) - most} more" if len(every) > most else ""
    return ", ".join(every[:most]) + more
