"""The part of a robot's file that works: its base, a chain of joints, and the tip at its end."""

import re
import warnings
from collections.abc import Sequence
from dataclasses import replace
from itertools import product
from pathlib import Path

import numpy as np
from pydrake.multibody.parsing import GetScopedFrameByName
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import (
    BodyIndex,
    Joint,
    PrismaticJoint,
    QuaternionFloatingJoint,
    RevoluteJoint,
    RigidBody,
    RpyFloatingJoint,
    WeldJoint,
)

from drake_dae.arrays import FloatArray, unknown_name
from drake_dae.errors import ModelError, RobotFileWarning
from drake_dae.robots import MultibodyExpressions, Vector, couplings_of, joint_names, unique_names
from drake_dae.scenario.robot_file.reading import finalize, joints_of, needs_of, read_robot
from drake_dae.scenario.robot_file.robot import Robot, RobotPlacement

# Joints of grippers and wheels are locked, if others are left. A hand may be the link that the last
# joint of an arm turns, a finger not. Frames at the end of an arm have these names, the best first.
_NOT_OF_AN_ARM = re.compile(r"(?i)grip|finger|thumb|jaw|knuckle|hand|wheel|caster")
_FINGER = re.compile(r"(?i)finger|thumb|jaw|knuckle|inner|outer")
_TOOLS = ("tcp", "tool", "end_?effector|eef|(^|_)ee(_|$)", "flange", "tip")

_ARM, _LONGEST_FINGER = 5, 4
"""Where a chain of so many joints branches into chains of at most so many, a hand begins."""

_SHORT, _AT_AXIS = 3, 0.005
"""The joints of a chain that needs its last one to move the tip; the distance in m below which a
frame is at the axis of a joint."""


def read_working(file: str) -> tuple[MultibodyPlant, Robot]:
    """The plant of a robot, with what must be left out of its file."""
    robot, above = Robot(file, actuators="all"), [*Path(file).absolute().parents]
    with warnings.catch_warnings():  # The scenario's own robot reports it.
        warnings.simplefilter("ignore", RobotFileWarning)
        missing, lost = needs_of(robot)
        packages = dict[str, str]()
        for name in missing:  # Above the file, or beside it.
            beside = [folder / name for folder in above[:2] if (folder / name).is_dir()]
            found = [*(folder for folder in above if folder.name == name), *beside]
            packages.update({name: str(found[0])} if found else {})
        for more in ([], ["empty_limits"]):
            robot = replace(robot, packages=packages, leave_out=[*lost, *more])
            plant, loops = read_robot(robot)
            if any(map(_has_room, joints_of(plant))):
                break
    if loops:
        raise ModelError(
            f"joints close loops ({', '.join(loops)}), and a new scenario has none; write one by "
            "hand, as the shipped five_bar"
        )
    finalize(plant)
    return plant, robot


def _has_room(joint: Joint) -> bool:
    """Whether a joint turns or slides between limits."""
    lower, upper = joint.position_lower_limits(), joint.position_upper_limits()
    return joint.num_velocities() == 1 and bool(upper[0] > lower[0])


def working_chain(
    plant: MultibodyPlant, robot: Robot, tip: str
) -> tuple[Robot, str, list[str], dict[str, str]]:
    """The robot; the tip, and the joints that move it; and key -> why it is so."""
    # The base.
    joints, floating = joints_of(plant), QuaternionFloatingJoint | RpyFloatingJoint
    for joint in joints:
        if not isinstance(joint, WeldJoint | RevoluteJoint | PrismaticJoint | floating):
            raise ModelError(
                f"joint '{joint.name()}' ({joint.type_name()}) neither turns about one axis nor "
                "slides along one; a new scenario can neither drive nor lock it"
            )
    bodies = [plant.get_body(BodyIndex(i)) for i in range(1, plant.num_bodies())]
    body_of = dict(zip(unique_names(plant, bodies), bodies, strict=True))
    above = {joint.child_body().index(): joint for joint in joints}
    roots = [n for n, body in body_of.items() if isinstance(above.get(body.index()), floating)]
    if len(roots) > 1:
        raise ModelError(
            f"{len(roots)} bodies are held by nothing ({', '.join(roots[:8])}), and a new scenario "
            "holds one; copy two_arms_free_box, and write robot.base or robot.free"
        )
    if roots:
        robot = replace(robot, base=RobotPlacement(roots[0]))

    # The chain: joints that can work, from the base to the tip.
    named_joints = joint_names(plant)
    names = {joint.index(): name for name, joint in named_joints.items()}
    couplings = couplings_of(plant) if plant.num_constraints() else []
    coupled = {name for c in couplings for name in (c.follower, c.leader)}
    works = [j for j in joints if _has_room(j) and names[j.index()] not in coupled]

    def path(body: RigidBody) -> list[Joint]:
        found = []
        while body.index() in above:
            found.append(above[body.index()])
            body = found[-1].parent_body()
        return found[::-1]

    if tip:
        try:
            body = GetScopedFrameByName(plant, tip).body()
        except RuntimeError:
            raise ModelError(unknown_name("tip", tip, body_of)) from None
        chain = [joint for joint in path(body) if joint in works]
        if not chain:
            raise ModelError(f"no joint that turns or slides for itself moves the tip '{tip}'")
        why = f"moved by {len(chain)} joints"
    else:
        paths = {name: path(body) for name, body in body_of.items()}
        arms = [j for j in works if not _NOT_OF_AN_ARM.search(j.name())]
        arms = [j for j in arms if not _FINGER.search(j.child_body().name())]
        chain = _longest([*paths.values()], arms) or _longest([*paths.values()], works)
        if not chain:
            mimics = f" (mimicking: {', '.join(sorted(coupled))})" if coupled else ""
            raise ModelError(
                f"no joint turns or slides for itself{mimics}; write a scenario by hand, in which "
                "robot.actuators names what is driven"
            )
        # The vendor's frame at its end, otherwise the outermost one.
        context = plant.CreateDefaultContext()
        origin = chain[-1].frame_on_child().CalcPoseInWorld(context).translation()
        ends = [n for n, p in paths.items() if sum(j in chain for j in p) == len(chain)]
        poses = {name: GetScopedFrameByName(plant, name).CalcPoseInWorld(context) for name in ends}
        tools = [n for n in ends if not _FINGER.search(n)]
        named = ([n for n in tools if re.search(word, n, re.IGNORECASE)] for word in _TOOLS)
        best = next(filter(None, named), ends)
        tip = max(best, key=lambda name: np.linalg.norm(poses[name].translation() - origin))
        why = f"the end of the longest chain, of {len(chain)} joints"

    # All else is locked, at zero or the nearest limit; what mimics follows.
    moving, locked = [names[joint.index()] for joint in chain], dict[str, float]()
    for name, joint in named_joints.items():
        others = {*moving, *(c.follower for c in couplings)}
        if joint.num_velocities() == 1 and name not in others:
            low, high = joint.position_lower_limits()[0], joint.position_upper_limits()[0]
            locked[name] = float(min(max(0.0, low), high))
    return replace(robot, locked=locked), tip, moving, {"frame": why}


def _longest(paths: Sequence[Sequence[Joint]], joints: Sequence[Joint]) -> list[Joint]:
    """The longest chain of some joints, up to a hand."""
    longest = max(([j for j in path if j in joints] for path in paths), key=len, default=[])
    every = [[joint for joint in path if _has_room(joint)] for path in paths]
    for count in range(_ARM, len(longest)):
        beyond = [c for c in every if c[:count] == longest[:count] and len(c) > count]
        branches = {int(chain[count].index()) for chain in beyond}
        if len(branches) > 1 and max(map(len, beyond)) <= count + _LONGEST_FINGER:
            return longest[:count]
    return longest


def far_end(links: MultibodyExpressions, tip: str, chain: Sequence[str]) -> Vector | None:
    """The far end, in m, of a link whose frame is at the axis of the joint that turns it.

    It is the middle of the face of the box around the link that is farthest from the joint; without
    geometry it is beyond the center of mass, at the end of an equivalent rod. None if the frame is
    elsewhere, or if more joints move it: a wrist may roll about an axis through the tool.
    """
    plant = links.plant
    frame, joint = GetScopedFrameByName(plant, tip), joint_names(plant)[chain[-1]]
    if len(chain) > _SHORT or not isinstance(joint, RevoluteJoint):
        return None
    body, context = frame.body(), plant.CreateDefaultContext()
    pose = joint.frame_on_child().CalcPose(context, body.body_frame())
    origin, axis = pose.translation(), pose.rotation() @ joint.revolute_axis()

    def distance(place: FloatArray) -> float:
        return float(np.linalg.norm(np.cross(axis, place - origin)))

    places = [2.0 * body.default_com() - origin]
    if points := [o.points for o in links.outlines if o.name == body.name() and len(o.points) > 1]:
        low, high = np.vstack(points).min(axis=0), np.vstack(points).max(axis=0)
        sides = product(np.eye(3, dtype=bool), (low, high))
        places = [np.where(row, side, (low + high) / 2) for row, side in sides]
    far, near = max(places, key=distance), frame.GetFixedPoseInBodyFrame().translation()
    return rounded(far, 4) if distance(near) < _AT_AXIS < distance(far) else None


def rounded(values: FloatArray, digits: int) -> Vector:
    """A place as it is written, without -0."""
    x, y, z = (float(value) + 0.0 for value in np.round(values, digits))
    return (x, y, z)
