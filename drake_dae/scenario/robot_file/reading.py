"""Reads a robot's files into a MultibodyPlant."""

import logging
import re
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import islice
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from pydrake.geometry import Mesh, Role, SceneGraph
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import MultibodyPlant

from drake_dae.errors import GeometryWarning, ModelError, RobotFileWarning, ScenarioError
from drake_dae.scenario.forms.keys import at
from drake_dae.scenario.robot_file.descriptions import find_description
from drake_dae.scenario.robot_file.efforts import Efforts, limit_joints, read_efforts
from drake_dae.scenario.robot_file.includes import check_includes
from drake_dae.scenario.robot_file.loops import joints_of
from drake_dae.scenario.robot_file.packages import add_packages, explained, find_packages
from drake_dae.scenario.robot_file.readable.markup import without_comments
from drake_dae.scenario.robot_file.readable.meshes import DRAWN, ReadableCopies, add_models
from drake_dae.scenario.robot_file.readable.placing import add_floating_joints
from drake_dae.scenario.robot_file.resources import check_resources, package_folder
from drake_dae.scenario.robot_file.robot import Robot
from drake_dae.scenario.shipped import FOLDER

_IGNORED = re.compile(r"The (?:tag|attribute) '(\w+)' .*ignored")
_IDLE = {
    *("camera", "custom", "keyframe", "light", "sensor", "site", "size", "statistic", "visual"),
    *("timestep", "integrator", "solver", "iterations", "ls_iterations", "tolerance", "jacobian"),
    *("cone", "impratio", "contype", "conaffinity", "condim", "group", "priority"),
}
"""Tags and attributes of MJCF that Drake ignores and that do not affect the equations."""


def read_robot(
    robot: Robot, scene_graph: SceneGraph | None = None, drawn: bool = True
) -> tuple[MultibodyPlant, Efforts]:
    """Makes a plant in continuous time with the models of the robot's file, not finalized.

    Args:
        robot: The key `robot` of the scenario.
        scene_graph: The scene graph for the robot's geometry; None leaves geometry out.
        drawn: Whether the geometry will be drawn: visual meshes are converted then, which takes
            longer than all else.

    Returns:
        The plant, and the effort limits of the file.

    Raises:
        ModelError: The files cannot be read, or are not supported.
        ScenarioError: A key of the scenario does not fit; the message names the key.
    """
    # In continuous time, in which the plant's own dynamics are those of (37).
    plant = MultibodyPlant(0.0)
    if scene_graph is not None:
        plant.RegisterAsSourceForSceneGraph(scene_graph)
    return plant, read_into(plant, robot, scene_graph, drawn)


def read_into(
    plant: MultibodyPlant,
    robot: Robot,
    scene_graph: SceneGraph | None = None,
    drawn: bool = True,
) -> Efforts:
    """Adds the models of the robot's file to a plant that is not finalized; see `read_robot`.

    Args:
        plant: The plant.
        robot: The key `robot` of the scenario.
        scene_graph: The scene graph for the plant's geometry; None leaves geometry out.
        drawn: Whether the geometry will be drawn.

    Returns:
        The effort limits of the file.
    """
    name, described = robot.file, tuple[Path, ...]()
    if robot.description:
        with at("robot.description"):
            description = find_description(robot.description)
        name, described = str(description.file), description.folders
    is_url = name.startswith("package://")
    if not is_url and not _is_file(name):
        raise ModelError(
            f"no file '{name}'; a relative path starts in the scenario's folder, that of a shipped "
            "scenario in the working directory"
        )
    parser = Parser(plant)
    missing: dict[str, str] = {}
    base = [robot.base.weld] if robot.base is not None else []
    copies = ReadableCopies(robot.leave_out, [*base, *robot.free], drawn)
    with TemporaryDirectory() as scratch, _drake_log(copies) as dropped:
        try:
            packages = parser.package_map()
            add_packages(robot.packages, packages)
            folders, missing = find_packages(name, packages, described)
            file = Path(packages.ResolveUrl(name) if is_url else name)
            check_includes(file, packages)
            _check_text(file)
            models = add_models(file, parser, Path(scratch).resolve(), copies)
            for instance, joints in copies.floating.items():
                add_floating_joints(plant, instance, joints)
        except (ScenarioError, ModelError):
            raise
        except (RuntimeError, ValueError, SystemExit) as error:
            # Drake raises any of them: SystemExit for a failed assertion.
            text = copies.named(str(error))
            unknown = {name: origin for name, origin in missing.items() if name in text}
            raise ModelError(explained(unknown) if unknown else _with_remedy(text)) from None
    limit_joints(plant, models)
    _warn_of_repairs(copies, robot)
    _take_empty_limits(plant, "empty_limits" in robot.leave_out)
    if "constraints" in robot.leave_out:
        for key in plant.GetConstraintIds():
            plant.RemoveConstraint(key)
    warned = [text for text in dropped.warnings if not _is_answered(text, robot)]
    # The parser of SDFormat reports a link twice, once without the line.
    warned = [text for text in warned if not text.startswith("warning: ")] or warned
    if warned:
        raise ModelError("; ".join(_explained(copies.named(text)) for text in warned))
    if scene_graph is not None:
        folders += [package_folder(file), FOLDER / "models", *map(Path, robot.packages.values())]
        folders += described[:2]  # The package and the repository of a description.
        check_resources(scene_graph, folders)
        _warn_of_omitted(copies.left_out, scene_graph, drawn)
    return read_efforts(models)


_REMEDIES = {
    r"unrecognized type": "the joints of a URDF are revolute, continuous, prismatic, planar, "
    "floating and fixed; write a ball as three revolute joints, or the robot in SDFormat",
    r"Joint type \((gearbox|ball|revolute2)\)": "take this joint out of the file; two joints that "
    "turn together are a !JointCoupler under constraints",
    r"\$[({]": "this is a template: xacro writes the URDF of it, as xacro FILE -o robot.urdf",
    r"coordinate=global": "MuJoCo up to 2.3.2 reads it, and saves it with local coordinates",
    r"pos_lower_limits": "the lower limit of a joint is above its upper limit; mend them in the "
    "file",
}
"""A pattern in Drake's messages -> the remedy."""


def _with_remedy(text: str) -> str:
    """A message of Drake's, with the remedy."""
    remedies = (remedy for pattern, remedy in _REMEDIES.items() if re.search(pattern, text))
    return "; ".join([text.rstrip("."), *remedies]) if text else text


def _is_answered(warning: str, robot: Robot) -> bool:
    """Whether the scenario has the key that a warning of Drake's parser requires."""
    if "effort limit" in warning:
        return robot.actuators is not None
    if "inertia" in warning:
        return "inertia" in robot.leave_out
    if "equality" in warning or "mimic" in warning:
        return "constraints" in robot.leave_out
    return "friction" in warning and "joint_friction" in robot.leave_out


def _warn_of_repairs(copies: ReadableCopies, robot: Robot) -> None:
    """Warns of impossible inertias that are replaced; raises an error if they must not be."""
    if not copies.repaired:
        return
    if "inertia" not in robot.leave_out:
        raise ModelError(
            "; ".join(map(str, copies.repaired)) + ". Mend them in the file, or write leave_out: "
            "[inertia] under robot, which takes the nearest possible"
        )
    for repaired in copies.repaired:
        warnings.warn(str(repaired), RobotFileWarning, stacklevel=2)


def _take_empty_limits(plant: MultibodyPlant, of_positions: bool) -> None:
    """Removes limits that are empty intervals: many authors write 0 for an unknown limit.

    Args:
        plant: The robot, not finalized; changed.
        of_positions: Whether position limits are removed as well.
    """
    unlimited = np.full(1, np.inf)
    for joint in joints_of(plant):
        if joint.num_positions() != 1:
            continue
        if of_positions and joint.position_lower_limits() == joint.position_upper_limits():
            joint.set_position_limits(-unlimited, unlimited)
        if joint.velocity_lower_limits() == joint.velocity_upper_limits() == 0.0:
            joint.set_velocity_limits(-unlimited, unlimited)


def _warn_of_omitted(unread: list[Path], scene_graph: SceneGraph, drawn: bool) -> None:
    """Warns of geometry that Drake cannot read, and of drawn geometry that Meshcat cannot draw."""
    if unread:
        warnings.warn(
            f"geometry that Drake cannot read is left out: {_listed(unread)}; no equation needs it",
            GeometryWarning,
            stacklevel=2,
        )
    if not drawn:
        return
    inspector = scene_graph.model_inspector()
    shapes = [
        inspector.GetShape(geometry) for geometry in inspector.GetAllGeometryIds(Role.kIllustration)
    ]
    meshes = [shape for shape in shapes if isinstance(shape, Mesh)]
    sources = [Path(mesh.source().path()) for mesh in meshes if mesh.source().is_path()]
    hidden = [source for source in sources if source.suffix.lower() not in DRAWN]
    if hidden:
        warnings.warn(
            f"geometry that Meshcat cannot draw is left out of the picture: {_listed(hidden)}; it "
            f"draws {', '.join(DRAWN)}, and with pip install 'drake_dae[meshes]' .stl as well",
            GeometryWarning,
            stacklevel=2,
        )


def _listed(files: list[Path]) -> str:
    return ", ".join(dict.fromkeys(f"'{file.name}'" for file in files))


@contextmanager
def _drake_log(copies: ReadableCopies) -> Iterator["_Dropped"]:
    """Collects the messages of Drake's parser."""
    log = logging.getLogger("drake")
    level, dropped = log.level, _Dropped(log.getEffectiveLevel(), copies)
    log.addFilter(dropped)
    log.setLevel(logging.WARNING)  # Warnings are collected at any log level of the user.
    try:
        yield dropped
    finally:
        log.setLevel(level)
        log.removeFilter(dropped)


class _Dropped(logging.Filter):
    """Collects the warnings of Drake's parser about changed or ignored parts."""

    KINDS = ("inertia", "friction", "effort limit", "equality", "mimic")

    def __init__(self, level: int, copies: ReadableCopies) -> None:
        super().__init__()
        self._level = level
        self._copies = copies
        self.warnings: list[str] = []

    def filter(self, record: logging.LogRecord) -> bool:
        text = record.getMessage()
        is_dropped = "warning: " in text and any(kind in text for kind in self.KINDS)
        if is_dropped:
            self.warnings.append(text)
        ignored = _IGNORED.search(text)
        if ignored and ignored[1] in _IDLE:
            return False
        record.msg, record.args = self._copies.named(text), ()
        return not is_dropped and record.levelno >= self._level


def _explained(warning: str) -> str:
    """Adds the name of link or joint to a warning "<file>:<line>: warning: <text>" of Drake's.

    For SDFormat file and line may be missing.
    """
    before, _, text = warning.rpartition("warning: ")
    place = before.removesuffix(": ") or "the robot's file"
    kind = "link" if "inertia" in text else "joint"
    if "inertia" in text:
        text = (
            "mass or inertia of no body: a mass is positive, moments of inertia are positive and "
            "none exceeds the sum of the others. Mend it, or write leave_out: [inertia] under robot"
        )
    elif "friction" in text:
        text = (
            "Coulomb friction of joints is not read from files; write leave_out: [joint_friction] "
            "under robot, and the friction as a !JointFriction under robot.known_forces"
        )
    elif "effort limit" in text:
        text += " Name the driven joints under robot.actuators"
    elif "equality" in text:
        return (
            f"{place}: {' '.join(text.split())} Write leave_out: [constraints] under robot, and "
            "the constraint under constraints; two joints that move together are a !JointCoupler"
        )
    file, _, line = place.rpartition(":")
    owner = ""
    if _is_file(file) and line.isdecimal():
        with open(file, encoding="utf-8", errors="replace") as lines:
            before = "".join(islice(lines, int(line)))
        names = re.findall(rf"<{kind}\s[^>]*?name\s*=\s*[\"']([^\"']*)", before)
        owner = f"{kind} '{names[-1]}': " if names else ""
    return f"{place}: {owner}{' '.join(text.split())}"


_WITH_COMMA = re.compile(r"(?:=\s*[\"']|>)\s*([-+.\deE\s]*\d,\d[-+.\deE,\s]*)[\"'<]")
"""A value in XML that consists of numbers, with a comma between two digits."""


def _check_text(file: Path) -> None:
    """Checks for errors that Drake ignores: several robots in a URDF, and commas in numbers."""
    if file.suffix not in (".urdf", ".sdf", ".xml"):
        return
    text = without_comments(file.read_text("utf-8", errors="replace"))
    if comma := _WITH_COMMA.search(text):
        line = text.count("\n", 0, comma.start(1)) + 1
        raise ModelError(
            f"'{file.name}', line {line}: '{comma[1].strip()}': numbers have a point and no comma, "
            "and blanks between them"
        )
    if file.suffix != ".urdf":
        return
    names = re.findall(r"<robot\b[^>]*", text)
    if len(names) > 1:
        raise ModelError(f"'{file.name}' has {len(names)} <robot>s, and only one is read")


def _is_file(name: str) -> bool:
    try:
        return Path(name).is_file()
    except (OSError, ValueError):  # A null byte.
        return False
