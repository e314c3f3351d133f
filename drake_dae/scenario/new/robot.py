"""The robot of a new scenario: its base, working chain, tip, and locked joints."""

import re
import warnings
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from pydrake.multibody.parsing import GetScopedFrameByName
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import (
    Joint,
    PrismaticJoint,
    QuaternionFloatingJoint,
    RevoluteJoint,
    RpyFloatingJoint,
    WeldJoint,
)

from drake_dae.analysis.tables import count_of
from drake_dae.arrays import unknown_name
from drake_dae.errors import ModelError, RobotFileWarning, ScenarioError
from drake_dae.robots.surfaces.surface import Vector
from drake_dae.scenario.forms.keys import at
from drake_dae.scenario.new.far_end import far_end
from drake_dae.scenario.new.tree import Tree
from drake_dae.scenario.robot_file.changes import finalize
from drake_dae.scenario.robot_file.loops import actuators_of, closing_joints
from drake_dae.scenario.robot_file.reading import parts_to_leave_out, read_robot, unknown_packages
from drake_dae.scenario.robot_file.robot import Robot, RobotPlacement

_NOT_OF_AN_ARM = re.compile(r"grip|finger|thumb|jaw|knuckle|hand|wheel|caster", re.IGNORECASE)
"""Names of grippers and wheels: such joints are locked, if others are left."""

# A hand may be the link that the last joint of an arm turns, a finger not.
_FINGER = re.compile(r"finger|thumb|jaw|knuckle|inner|outer", re.IGNORECASE)

_TOOLS = [
    re.compile(word, re.IGNORECASE)
    for word in ("tcp", "tool", "end_?effector|eef|(^|_)ee(_|$)", "flange", "tip")
]
"""Vendors' names of the frame at the end of an arm, the best first."""


@dataclass(frozen=True)
class NewRobot:
    """A robot with a working chain of joints, all others locked.

    Attributes:
        robot: The value of the scenario's key `robot`.
        chain: The names of the joints that move, from the base to the tip.
        tip: The frame at the end of the chain.
        point: The contact point in that frame, m, shape (3,).
        remarks: Key under `robot`, or "tip" -> why this value was chosen.
    """

    robot: Robot
    chain: tuple[str, ...]
    tip: str
    point: Vector
    remarks: Mapping[str, str]


def new_robot(file: str, tip: str = "", point: Vector = (0.0, 0.0, 0.0)) -> NewRobot:
    """Finds what a scenario needs of a robot and its file does not contain: base, chain and tip.

    The chain is the longest one of revolute and prismatic joints, without mimic joints, grippers
    and wheels; or, if a tip is given, the chain that ends there.

    Args:
        file: The robot's file, as a scenario has it.
        tip: A frame; found if empty.
        point: The point in it.

    Raises:
        ScenarioError: The file cannot be read, has no such tip, or no joint can move it.
    """
    with at("robot.file"):
        tree, robot = _read(file)
        robot, remarks = _with_base(tree, robot)
        chain, end = _chain(tree, tip)
        where = "at the end of" if tip else "the end of the longest chain, of"
        remarks["tip"] = f"{where} {count_of(len(chain), 'joint')}"
        if not (tip or any(point)) and tree.directions(chain, end, point) < min(len(chain), 3):
            point = far_end(robot, tree.bodies[end], chain[-1], tree.size) or point
            remarks["point"] = "in that frame, m: its far end, where no frame of the file is"
        remarks.setdefault("point", "in that frame, m")
        _check_reach(tree, chain, end, point)
        locked = _locked(tree, chain)
        if locked:
            remarks["locked"] = "m or rad; all that is not of the chain, or mimics"
        driven = {actuator.joint().index() for actuator in actuators_of(tree.plant)}
        actuators = None
        if any(joint.index() not in driven for joint in chain):
            actuators = "all"
            remarks["actuators"] = "that are not locked: the file drives not all of them"
        return NewRobot(
            replace(robot, locked=locked, actuators=actuators),
            tuple(tree.names[joint.index()] for joint in chain),
            end,
            point,
            remarks,
        )


def _read(file: str) -> tuple[Tree, Robot]:
    """The robot with what must be left out of its file, and its bodies and joints."""
    robot = Robot(file, _folders_above(file), actuators="all")
    with warnings.catch_warnings():  # The scenario's own robot reports it.
        warnings.simplefilter("ignore", RobotFileWarning)
        robot = replace(robot, leave_out=parts_to_leave_out(robot))
        tree = Tree(_finished(robot))
        if tree.works or not tree.empty:
            return tree, robot
        robot = replace(robot, leave_out=[*robot.leave_out, "empty_limits"])
        return Tree(_finished(robot)), robot


def _finished(robot: Robot) -> MultibodyPlant:
    """The finalized plant of a robot.

    Raises:
        ModelError: It cannot be read, or has loops.
    """
    plant, _ = read_robot(robot)
    closing = closing_joints(plant)
    if closing:
        names = ", ".join(joint.name() for joint in closing)
        raise ModelError(
            f"joints close loops ({names}), and a new scenario has none; write one by hand, as the "
            "shipped five_bar: joints that close loops become constraints there by themselves"
        )
    finalize(plant)
    return plant


def _folders_above(file: str) -> dict[str, str]:
    """Unknown packages -> folders of that name above the file or beside it."""
    folders: dict[str, str] = {}
    with suppress(
        ModelError, ScenarioError, OSError, RuntimeError
    ):  # The reader of the file reports it.
        above = list(Path(file).resolve().parents)
        for name in unknown_packages(Robot(file)):
            beside = [folder / name for folder in above[:2] if (folder / name).is_dir()]
            candidates = [*(folder for folder in above if folder.name == name), *beside]
            folders.update({name: str(candidates[0])} if candidates else {})
    return folders


def _check_reach(tree: Tree, chain: Sequence[Joint], tip: str, point: Vector) -> None:
    """Refuses a tip that cannot both press and move along.

    Raises:
        ModelError: It moves in one direction, or not at all.
    """
    directions = tree.directions(chain, tip, point)
    if directions > 1:
        return
    names = ", ".join(tree.names[joint.index()] for joint in chain)
    way = "in one direction alone" if directions else "nowhere"
    raise ModelError(
        f"the tip '{tip}' moves {way} by {count_of(len(chain), 'joint')} ({names}), and a contact "
        "takes one direction to press and another to move along; give another tip, as "
        "--tip LINK:x,y,z, at the end of two joints or more"
    )


def _with_base(tree: Tree, robot: Robot) -> tuple[Robot, dict[str, str]]:
    """The robot with its base fixed to the world, and remarks."""
    remarks: dict[str, str] = {}
    if robot.packages:
        remarks["packages"] = "where package://<name>/ leads"
    if robot.leave_out:
        remarks["leave_out"] = "what the file has and the equations have not"
    floating = QuaternionFloatingJoint | RpyFloatingJoint
    free = {j.child_body().index() for j in tree.joints if isinstance(j, floating)}
    roots = [name for name, body in tree.bodies.items() if body.index() in free]
    if len(roots) > 1:
        raise ModelError(
            f"{len(roots)} bodies are held by nothing ({', '.join(roots[:8])}), and a new scenario "
            "holds one; copy a shipped scenario with several bodies, as two_arms_free_box, and "
            "write robot.base or robot.free"
        )
    for joint in tree.joints:
        kinds = WeldJoint | RevoluteJoint | PrismaticJoint | floating
        if not isinstance(joint, kinds):
            raise ModelError(
                f"joint '{joint.name()}' ({joint.type_name()}) neither turns about one axis nor "
                "slides along one; a new scenario can neither drive nor lock it"
            )
    if roots:
        remarks["base"] = "nothing in the file holds it"
        robot = replace(robot, base=RobotPlacement(roots[0]))
    return robot, remarks


def _chain(tree: Tree, tip: str) -> tuple[list[Joint], str]:
    """The joints of the chain, and the name of the frame at its end."""
    if tip:
        try:
            body = GetScopedFrameByName(tree.plant, tip).body()
        except RuntimeError:
            raise ModelError(unknown_name("tip", tip, tree.bodies)) from None
        chain = [joint for joint in tree.path(body) if tree.can_work(joint)]
        if not chain:
            raise ModelError(f"no joint that turns or slides for itself moves the tip '{tip}'")
        return chain, tip

    def longest(joints: Sequence[Joint]) -> list[Joint]:
        allowed = {joint.index() for joint in joints}
        paths = [
            [joint for joint in tree.path(body) if joint.index() in allowed]
            for body in tree.bodies.values()
        ]
        return max(paths, key=len, default=[])

    arms = [
        joint
        for joint in tree.works
        if not _NOT_OF_AN_ARM.search(joint.name()) and not _FINGER.search(joint.child_body().name())
    ]
    chain = longest(arms) or longest(tree.works)
    if not chain:
        raise ModelError(_why_none(tree))
    return chain, _tip(tree, chain)


def _why_none(tree: Tree) -> str:
    """The reason why there is no working joint, and the remedy."""
    text = "no joint turns or slides for itself, so that there is nothing to drive"
    still = {"weld", "quaternion_floating", "rpy_floating"}
    if not {joint.type_name() for joint in tree.joints} - still:
        return f"{text}: the file has no joints that move; take one of a robot that has"
    coupled = ", ".join(sorted(tree.coupled))
    if coupled:
        text += f"; mimic joints and those that they follow are not driven: {coupled}"
    return f"{text}; write a scenario by hand, in which robot.actuators names what is driven"


def _tip(tree: Tree, chain: Sequence[Joint]) -> str:
    """The vendor's frame at the end of a chain, otherwise the outermost one."""
    last, moving = chain[-1], {joint.index() for joint in chain}
    context = tree.plant.CreateDefaultContext()
    origin = last.frame_on_child().CalcPoseInWorld(context).translation()
    distances: dict[str, float] = {}
    for name, body in tree.bodies.items():
        if sum(joint.index() in moving for joint in tree.path(body)) == len(chain):
            place = tree.plant.EvalBodyPoseInWorld(context, body).translation()
            distances[name] = float(np.linalg.norm(place - origin))
    for word in _TOOLS:
        named = [n for n in distances if word.search(n) and not _FINGER.search(n)]
        if named:
            return max(named, key=lambda name: distances[name])
    return max(distances, key=lambda name: distances[name])


def _locked(tree: Tree, chain: Sequence[Joint]) -> dict[str, float]:
    """The positions of joints outside the chain: 0, or the nearest limit. Mimic joints follow."""
    skipped = {tree.names[joint.index()] for joint in chain}
    skipped |= {coupling.follower for coupling in tree.couplings}
    locked = {}
    for joint in tree.joints:
        if not isinstance(joint, RevoluteJoint | PrismaticJoint):
            continue
        name = tree.names[joint.index()]
        if name not in skipped:
            low, high = joint.position_lower_limits()[0], joint.position_upper_limits()[0]
            locked[name] = float(min(max(0.0, low), high))
    return locked
