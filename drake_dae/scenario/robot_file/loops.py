"""Joints of a robot's file that close loops: they are replaced by constraints."""

from collections.abc import Iterator, Mapping, Sequence
from math import isfinite
from typing import Any, NamedTuple

import numpy as np
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import Joint, JointActuator, PrismaticJoint, RevoluteJoint, WeldJoint

from drake_dae.arrays import FloatArray
from drake_dae.errors import ModelError
from drake_dae.robots import (
    Constraint,
    PrismaticLoopJoint,
    RevoluteLoopJoint,
    axes_along,
    frame_name,
    joint_names,
    triple,
)


class CutJoint(NamedTuple):
    """A joint that closes a loop and was removed from the plant.

    Attributes:
        slides: Whether it is prismatic; else it is revolute.
        bodies: The indices of parent and child.
        poses: The poses of its frames on parent and child.
        axis: Its axis in these frames, shape (3,).
        options: Its name, damping, limits and motor, as arguments of the constraint.
    """

    slides: bool
    bodies: tuple[Any, Any]
    poses: tuple[RigidTransform, RigidTransform]
    axis: FloatArray
    options: dict[str, Any]


def joints_of(plant: MultibodyPlant) -> list[Joint]:
    """The joints of a plant."""
    return [plant.get_joint(index) for index in plant.GetJointIndices()]


def actuators_of(plant: MultibodyPlant) -> list[JointActuator]:
    """The actuators of a plant."""
    return [plant.get_joint_actuator(index) for index in plant.GetJointActuatorIndices()]


def closing_joints(plant: MultibodyPlant) -> list[Joint]:
    """The joints that close loops, so that the others form a tree; if possible without motors."""
    driven = {actuator.joint().index() for actuator in actuators_of(plant)}
    groups = list(range(plant.num_bodies()))
    closing = []
    for joint in sorted(
        joints_of(plant),
        key=lambda joint: (not _has_one_position(joint), joint.index() in driven),
        reverse=True,
    ):
        first, second = (
            groups[int(body.index())] for body in (joint.parent_body(), joint.child_body())
        )
        if first == second:
            closing.append(joint)
        groups = [second if group == first else group for group in groups]
    return closing


def _has_one_position(joint: Joint) -> bool:
    return isinstance(joint, RevoluteJoint | PrismaticJoint)


def cut_loops(
    plant: MultibodyPlant, parent_frames: Mapping[tuple[str, str], str]
) -> list[CutJoint]:
    """Removes joints until the others form a tree; driven joints only if necessary."""
    driven = {actuator.joint().index(): actuator for actuator in actuators_of(plant)}
    names = {joint.index(): name for name, joint in joint_names(plant).items()}
    cuts = []
    for joint in closing_joints(plant):
        name = names.get(joint.index(), joint.name())
        _check_ends(joint, name, plant, parent_frames)
        cuts.append(_cut(joint, name, driven.get(joint.index()), plant))
    return cuts


def _check_ends(
    joint: Joint, name: str, plant: MultibodyPlant, parents: Mapping[tuple[str, str], str]
) -> None:
    """Refuses a loop that is open where its file means it to be closed.

    A joint of SDFormat is at its child; of a frame that is its parent, only the body counts.
    """
    model = plant.GetModelInstanceName(joint.model_instance())
    named = parents.get(("", joint.name()), parents.get((model, joint.name()), ""))
    if not named or not plant.HasFrameNamed(named, joint.model_instance()):
        return
    frame = plant.GetFrameByName(named, joint.model_instance())
    places = [
        one.GetFixedPoseInBodyFrame().translation() for one in (frame, joint.frame_on_parent())
    ]
    gap = float(np.linalg.norm(places[0] - places[1]))
    if frame.name() != frame.body().name() and gap > 1e-6:
        raise ModelError(
            f"joint '{name}' closes a loop at its child, {gap:.3g} m from the frame '{named}' that "
            f"it names as its parent: of that only the body '{frame.body().name()}' counts. Let "
            "<pose> place the joint at the frame"
        )


def _cut(
    joint: Joint, name: str, actuator: JointActuator | None, plant: MultibodyPlant
) -> CutJoint:
    if not _has_one_position(joint):
        raise ModelError(
            f"joint '{name}' closes a loop, and neither turns nor slides; take it out of the file, "
            "and write it under constraints, as a !WeldedFrames or !CoincidentPoints"
        )
    limits = {
        "lower": joint.position_lower_limits()[0],
        "upper": joint.position_upper_limits()[0],
        "velocity_limit": joint.velocity_upper_limits()[0],
    }
    options: dict[str, Any] = {"damping": joint.default_damping(), "name": name}
    if actuator is not None:
        if actuator.default_rotor_inertia() != 0.0:
            raise ModelError(
                f"joint '{name}' closes a loop, as all joints of it do that could be cut, and its "
                "motor has a rotor: that cannot be a constraint; leave one joint without motor"
            )
        options["motor"] = True
        limits["effort_limit"] = actuator.effort_limit()
        plant.RemoveJointActuator(actuator)
    options |= {key: float(value) for key, value in limits.items() if isfinite(value)}
    parent, child = joint.frame_on_parent(), joint.frame_on_child()
    slides = isinstance(joint, PrismaticJoint)
    cut = CutJoint(
        slides,
        (parent.body().index(), child.body().index()),
        (parent.GetFixedPoseInBodyFrame(), child.GetFixedPoseInBodyFrame()),
        np.array(joint.translation_axis() if slides else joint.revolute_axis()),
        options,
    )
    try:
        plant.RemoveJoint(joint)
    except RuntimeError as error:
        raise ModelError(
            f"joint '{name}' closes a loop, and cannot be cut: {error} Springs stop it: "
            "robot.leave_out takes them out, as [dynamics/spring_stiffness]"
        ) from None
    return cut


def loop_constraints(cuts: Sequence[CutJoint], plant: MultibodyPlant) -> list[Constraint]:
    """The constraints that replace cut joints.

    If all joints of a loop move in one plane, the constraint is planar, since a spatial constraint
    would be redundant.
    """
    return [_constraint(cut, plant) for cut in cuts]


def _constraint(cut: CutJoint, plant: MultibodyPlant) -> Constraint:
    bodies = [plant.get_body(index) for index in cut.bodies]
    pose = plant.EvalBodyPoseInWorld(plant.CreateDefaultContext(), bodies[0]) @ cut.poses[0]
    normal = _normal(cut, pose.rotation() @ cut.axis, plant)
    axes = axes_along(cut.axis)
    if cut.slides and normal is not None:
        across = pose.rotation().inverse() @ normal
        axes = np.column_stack([across, np.cross(cut.axis, across), cut.axis])
    options = dict(cut.options)
    for letter, body, pose in zip("ab", bodies, cut.poses, strict=True):
        frame = pose @ RigidTransform(RotationMatrix(axes), np.zeros(3))
        options[f"frame_{letter}"] = frame_name(plant, body.body_frame())
        options[f"point_{letter}"] = triple("a point", frame.translation())
        options[f"rpy_{letter}"] = triple("an angle", RollPitchYaw(frame.rotation()).vector())
    if cut.slides:
        return PrismaticLoopJoint(axis="z", normal=None if normal is None else "x", **options)
    return RevoluteLoopJoint(axis="z", planar=normal is not None, **options)


def _normal(cut: CutJoint, axis: FloatArray, plant: MultibodyPlant) -> FloatArray | None:
    """The normal in the world of the plane in which all joints of a loop move, or None."""
    joints = [*_path(cut, plant), (cut.slides, axis)]
    turning = [axis for slides, axis in joints if not slides]
    sliding = [axis for slides, axis in joints if slides]
    if not turning:
        return None
    normal = turning[-1]
    are_parallel = all(np.linalg.norm(np.cross(normal, axis)) < 1e-9 for axis in turning)
    return normal if are_parallel and all(abs(normal @ axis) < 1e-9 for axis in sliding) else None


def _path(cut: CutJoint, plant: MultibodyPlant) -> Iterator[tuple[bool, FloatArray]]:
    """The other joints of a loop: whether each is prismatic, and its axis in the world."""
    context = plant.CreateDefaultContext()
    above = {int(joint.child_body().index()): joint for joint in joints_of(plant)}
    lines: list[dict[int, Joint]] = []
    for body in map(int, cut.bodies):
        line: dict[int, Joint] = {}
        while body in above and body not in line:
            line[body] = above[body]
            body = int(above[body].parent_body().index())
        lines.append(line)
    for body in set(lines[0]) ^ set(lines[1]):
        joint = (lines[0] | lines[1])[body]
        if isinstance(joint, WeldJoint):
            continue
        if not _has_one_position(joint):
            yield False, np.array([1.0, 0.0, 0.0])  # Its motion is not planar.
            yield False, np.array([0.0, 1.0, 0.0])
            continue
        slides = isinstance(joint, PrismaticJoint)
        axis = joint.translation_axis() if slides else joint.revolute_axis()
        yield slides, joint.frame_on_parent().CalcPoseInWorld(context).rotation() @ axis
