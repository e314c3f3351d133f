"""Reads a robot's files into a MultibodyPlant, with a scenario's changes, and into links.

Loops of joints are cut; the joints at which they are cut become constraints.
"""

import logging
import re
import warnings
from collections.abc import Callable, Container, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from threading import get_native_id
from typing import Any

import numpy as np
from pydrake.common.eigen_geometry import AngleAxis
from pydrake.geometry import SceneGraph
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix
from pydrake.multibody.parsing import (
    FlattenModelDirectives,
    LoadModelDirectives,
    ModelDirectives,
    Parser,
    ProcessModelDirectives,
)
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import (
    BodyIndex,
    Frame,
    JacobianWrtVariable,
    Joint,
    JointActuator,
    JointIndex,
    PrismaticJoint,
    QuaternionFloatingJoint,
    RevoluteJoint,
    RpyFloatingJoint,
    SpatialInertia,
    UnitInertia,
    WeldJoint,
)

from drake_dae.arrays import FloatArray, unknown_name
from drake_dae.errors import DrakeDaeError, ModelError
from drake_dae.robots import (
    Constraint,
    MultibodyExpressions,
    PrismaticLoopJoint,
    RevoluteLoopJoint,
    axes_along,
    frame_name,
    frame_named,
    joint_names,
    triple,
)
from drake_dae.scenario.form import at
from drake_dae.scenario.robot_file.mending import ARMATURE, Mender
from drake_dae.scenario.robot_file.read_by_drake import DRIVES
from drake_dae.scenario.robot_file.robot import Payload, Robot, RobotFiles

RobotLinks = tuple[MultibodyExpressions, list[Constraint]]
"""The links of a robot, and its loop-closing joints as constraints."""

LoopMakers = dict[str, Callable[[MultibodyPlant], Constraint]]
"""Joints that closed loops -> what makes their constraints, of the finalized plant."""

_Facts = Mapping[JointIndex, Mapping[str, Any]]
"""What a file says of joints: see `Mender.joints`."""

_Leaders = Mapping[JointIndex, tuple[JointIndex, float, float]]
"""Joints that follow others -> those, the ratio, and the offset, rad or m."""

_REMEDIES = {
    "friction": "robot.known_forces has friction as a !JointFriction",
    "mimic": "constraints has joints that move together as a !JointCoupler",
    "equality/": "constraints has it as a !JointCoupler, !WeldedFrames or !CoincidentPoints",
    "inertia": "it takes the nearest possible moments of inertia",
} | dict.fromkeys(DRIVES, "or name the driven joints under robot.actuators")
"""What the name of a lost part contains -> what to do besides."""


@at("robot.file")
def robot_links(
    robot: Robot, scene_graph: SceneGraph, payloads: Sequence[Payload] = (), drawn: bool = True
) -> RobotLinks:
    """The links of a scenario's robot, and its loop-closing joints as constraints."""
    plant, loops = read_robot(robot, None, scene_graph, payloads, drawn)
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
    return links, [make(plant) for make in loops.values()]


def finalize(plant: MultibodyPlant) -> None:
    """Finalizes a plant."""
    with _drake():
        plant.Finalize()


def _check_mass(plant: MultibodyPlant) -> None:
    """Checks that each joint moves a mass; otherwise its acceleration is not determined."""
    context = plant.CreateDefaultContext()
    # Some masses do not move in some configurations, as one at the end of a straight arm.
    step = np.random.default_rng(0).uniform(-1.0, 1.0, plant.num_positions())
    plant.SetPositions(context, plant.GetPositions(context) + step)
    values, modes = np.linalg.eigh(plant.CalcMassMatrix(context))
    null = modes[:, values <= 1e-12 * np.max(values, initial=0.0)]  # Zero up to round-off.
    if massless := [
        f"{name} (link {joint.child_body().name()})"
        for name, joint in joint_names(plant).items()
        if np.any(np.abs(null[joint.velocity_start() :][: joint.num_velocities()]) > 0.1)
    ]:
        raise ModelError(
            f"joints that move no mass: {', '.join(massless)}; give the links an <inertial> with "
            "mass and inertia, or lock the joints by robot.locked"
        )


def read_robot(
    robot: Robot,
    plant: MultibodyPlant | None = None,
    scene_graph: SceneGraph | None = None,
    payloads: Sequence[Payload] = (),
    drawn: bool = True,
) -> tuple[MultibodyPlant, LoopMakers]:
    """Reads a robot into a plant that is not finalized, with the changes of the scenario."""
    if plant is None:
        plant = MultibodyPlant(0.0)  # In continuous time, as (37).
        if scene_graph is not None:
            plant.RegisterAsSourceForSceneGraph(scene_graph)
    parser = Parser(plant)
    with TemporaryDirectory() as folder:
        files, own = RobotFiles(robot, parser.package_map()), Path(folder).resolve()
        mender = Mender(files, robot, own, scene_graph is not None, drawn)
        with _drake(mender):
            models = _mended(mender)
            if mender.lost:
                raise ModelError(_told(mender.lost))
            if isinstance(models, Path):
                parser.AddModels(str(models))
            else:
                ProcessModelDirectives(models, parser)
    with _drake():
        for model, name, child, origin in mender.floating:
            link = frame_named(plant, _scoped(model, child))
            start = plant.GetDefaultFloatingBaseBodyPose(link.body())
            joint = RpyFloatingJoint(name, frame_named(plant, _scoped(model, origin)), link)
            plant.AddJoint(joint).SetDefaultPose(start)
            # No force keeps the length of a quaternion at 1.
            kind = "floating joints have roll, pitch and yaw, _qx, _qy and _qz, in the place of a "
            mender.tell(f"{kind}quaternion, and must not pitch by 90 degrees", f"'{name}'")
        for (category, kind), items in mender.told.items():
            warnings.warn(f"{kind}: {_listed(items)}", category, stacklevel=2)
        facts = dict[JointIndex, Mapping[str, Any]]()
        for joint in joints_of(plant):
            name, model = joint.name(), plant.GetModelInstanceName(joint.model_instance())
            facts[joint.index()] = mender.joints.get(("", name)) or mender.joints[model, name]
        _change(plant, robot, facts)
        add_payloads("plant.payloads", payloads, plant)
        return plant, _cut_loops(plant, facts)


def needs_of(robot: Robot) -> tuple[list[str], list[str]]:
    """The packages that a robot's file names and that are not found, and what is lost of it."""
    files = RobotFiles(robot, Parser(MultibodyPlant(0.0)).package_map())
    with TemporaryDirectory() as folder, _drake():
        mender = Mender(files, robot, Path(folder), has_geometry=False, drawn=False)
        _mended(mender)
    return sorted(files.missing), list(mender.lost)


def _mended(mender: Mender) -> Path | ModelDirectives:
    """The mended copy of the robot's file, or directives with the copies of their models."""
    files = mender.files
    if not files.main.name.endswith((".dmd.yaml", ".dmd.yml")):
        return mender.copy(files.main)
    _find_packages(files, files.main)
    directives = FlattenModelDirectives(LoadModelDirectives(str(files.main)), files.packages)
    welds = (directive.add_weld for directive in directives.directives)
    placed = mender.placed | {weld.child for weld in welds if weld is not None}
    for directive in directives.directives:
        if (model := directive.add_model) is not None:
            mender.placed = {link.removeprefix(f"{model.name}::") for link in placed}
            model.file = mender.copy(files.needed(model.file, files.main), model.name).as_uri()
    return directives


def _find_packages(files: RobotFiles, file: Path) -> None:
    """Finds the packages of directives that others include."""
    with files.within(file):
        for directive in LoadModelDirectives(str(file)).directives:
            if directive.add_directives is not None:
                _find_packages(files, files.needed(directive.add_directives.file, file))


def _scoped(model: str, name: str) -> str:
    return f"{model}::{name}" if model and name != "world" else name


@contextmanager
def _drake(mender: Mender | None = None) -> Iterator[None]:
    """Makes ModelErrors of Drake's errors, also of failed assertions, and tells what it logs."""
    here, logger = get_native_id(), logging.getLogger("drake")

    def text_of(message: object) -> str:
        text = str(message)
        if mender is not None:  # The names of copies become those of their files.
            text = re.sub(rf"(file:)?/*{re.escape(str(mender.folder))}/\d+/", "", text)
        return " ".join(text.split())

    def passes(record: logging.LogRecord) -> bool:
        if mender is None or record.thread != here or record.levelno < logging.WARNING:
            return True
        text = text_of(record.getMessage()).replace(" warning:", "")
        mender.tell("Drake reads the file with remarks", text[:200])
        return False

    logger.addFilter(passes)
    try:
        yield
    except DrakeDaeError:
        raise
    except (RuntimeError, ValueError, SystemExit) as error:
        raise ModelError(text_of(error)) from None
    finally:
        logger.removeFilter(passes)


def _told(lost: Mapping[str, list[str]]) -> str:
    """The message for what Drake does not read of the files."""
    text = "; ".join(f"{part} ({_listed(places)})" for part, places in lost.items())
    ways = [f"leave_out: [{', '.join(lost)}] under robot"]
    ways += [hint for word, hint in _REMEDIES.items() if any(word in part for part in lost)]
    return (
        f"the equations would lack what Drake does not take of the file: {text}. Mend it, or write "
        f"{'; '.join(dict.fromkeys(ways))}"
    )


def _listed(items: Iterable[str]) -> str:
    every = list(dict.fromkeys(items))
    return ", ".join(every[:8]) + (f" and {len(every) - 8} more" if len(every) > 8 else "")


def joints_of(plant: MultibodyPlant) -> list[Joint]:
    """The joints of a plant."""
    return [plant.get_joint(index) for index in plant.GetJointIndices()]


def _actuators_of(plant: MultibodyPlant) -> list[JointActuator]:
    return [plant.get_joint_actuator(index) for index in plant.GetJointActuatorIndices()]


def _is_simple(joint: Joint) -> bool:
    return isinstance(joint, RevoluteJoint | PrismaticJoint)


def _simple_joint(name: str, plant: MultibodyPlant) -> Joint:
    joints = {own: joint for own, joint in joint_names(plant).items() if _is_simple(joint)}
    if name not in joints:
        raise ModelError(unknown_name("turning or sliding joint", name, joints))
    return joints[name]


def _change(plant: MultibodyPlant, robot: Robot, facts: _Facts) -> None:
    """Applies the changes that a scenario makes to the robot of its file."""
    leaders = dict[JointIndex, tuple[JointIndex, float, float]]()
    follows = {index: of["follows"] for index, of in facts.items() if "follows" in of}
    for index, (name, ratio, offset) in follows.items():
        joint = plant.get_joint(index)
        model = joint.model_instance()
        if name == joint.name() or not plant.HasJointNamed(name, model):
            text = f"joint '{joint.name()}' mimics '{name}', which is no other joint of its file"
            raise ModelError(text)
        leaders[index] = plant.GetJointByName(name, model).index(), ratio, offset
    if robot.base is not None:
        with at("robot.base.weld"):
            frame, pose = _unattached(robot.base.weld, plant), robot.base.pose
            rotation = RollPitchYaw(np.deg2rad(pose.rpy_deg))
            plant.WeldFrames(plant.world_frame(), frame, RigidTransform(rotation, pose.translation))
    locked = _lock_joints(robot.locked, plant, leaders)
    for index, (leader, ratio, offset) in leaders.items():
        if index not in locked:
            pair = plant.get_joint(index), plant.get_joint(leader)
            plant.AddCouplerConstraint(*pair, ratio, offset)
    with at("robot.free"):
        for name in robot.free:
            body = _unattached(name, plant).body()
            plant.AddJoint(RpyFloatingJoint(body.name(), plant.world_frame(), body.body_frame()))
    if robot.actuators is not None:
        _drive_joints(robot.actuators, plant, leaders, facts)
    add_payloads("robot.payloads", robot.payloads, plant)

    driven = {actuator.joint().index() for actuator in _actuators_of(plant)}
    for name, joint in joint_names(plant).items():
        armature = facts.get(joint.index(), {}).get("armature")
        if armature and joint.index() not in driven and ARMATURE not in robot.leave_out:
            raise ModelError(
                f"joint '{name}' has an armature of {armature:g} and no motor, and Drake gives "
                "only motors one; name it under robot.actuators, or write leave_out: "
                "[joint/armature] under robot"
            )


def add_payloads(key: str, payloads: Sequence[Payload], plant: MultibodyPlant) -> None:
    """Adds the payloads of a key of the scenario to a plant that is not finalized."""
    for index, payload in enumerate(payloads):
        with at(f"{key}.{index}"):
            frame = frame_named(plant, payload.frame)
            if frame.body() == plant.world_body():
                raise ModelError(f"a payload on '{payload.frame}', of the world, moves nothing")
            if plant.HasBodyNamed(payload.name):
                raise ModelError(f"a body '{payload.name}' is there; give the payload another name")
            inertia = SpatialInertia(payload.mass, [0.0, 0.0, 0.0], UnitInertia(0.0, 0.0, 0.0))
            body = plant.AddRigidBody(payload.name, frame.model_instance(), inertia)
            plant.WeldFrames(frame, body.body_frame(), RigidTransform(list(payload.point)))


def _unattached(name: str, plant: MultibodyPlant) -> Frame:
    """A frame of a body without a joint to a parent."""
    frame = frame_named(plant, name)
    if frame.body() == plant.world_body():
        raise ModelError("the world is no part of the robot; name a frame of the robot")
    holding = {joint.child_body().index(): joint.name() for joint in reversed(joints_of(plant))}
    if frame.body().index() in holding:
        joint = holding[frame.body().index()]
        raise ModelError(f"'{name}' is attached already, by joint '{joint}'; name another body")
    return frame


@at("robot.locked")
def _lock_joints(
    locked: Mapping[str, float], plant: MultibodyPlant, leaders: _Leaders
) -> Container[JointIndex]:
    """Replaces joints, and those that follow them, by welds with their constant X_FM(q).

    Drake supports locked joints only in discrete time. Actuator, damping and rotor go.
    """
    names = {joint.index(): name for name, joint in joint_names(plant).items()}
    positions = {index: offset for index, (_, ratio, offset) in leaders.items() if ratio == 0.0}
    positions |= {_simple_joint(name, plant).index(): value for name, value in locked.items()}
    for _ in leaders:  # As often as the longest chain needs.
        for follower, (leader, ratio, offset) in leaders.items():
            if leader in positions and ratio != 0.0:
                coupled = ratio * positions[leader] + offset
                if abs(positions.setdefault(follower, coupled) - coupled) > 1e-9:
                    raise ModelError(
                        f"'{names[follower]}' follows '{names[leader]}', which makes it "
                        f"{coupled:g}, and not {positions[follower]:g}; lock one of them"
                    )
            elif follower in positions and ratio != 0.0:
                positions[leader] = (positions[follower] - offset) / ratio
    welds = list[WeldJoint]()
    for index, value in positions.items():
        name = names[index]
        joint = _simple_joint(name, plant)
        low, high = joint.position_lower_limits()[0], joint.position_upper_limits()[0]
        if isinstance(joint, PrismaticJoint):
            unit, pose = "m", RigidTransform(value * joint.translation_axis())
        else:
            unit, pose = "rad", RigidTransform(AngleAxis(value, joint.revolute_axis()), np.zeros(3))
        if not low - 1e-9 <= value <= high + 1e-9:  # Round-off of a ratio puts nothing outside.
            why = "" if name in locked else ", as the joint that it is coupled to has it,"
            raise ModelError(
                f"{name} = {value:g} {unit}{why} is outside its limits, {low:g} to {high:g} {unit}"
            )
        frames = joint.frame_on_parent(), joint.frame_on_child()
        welds.append(WeldJoint(joint.name(), *frames, pose))
        # Python's joint must be gone before Drake's: a new one at its address is taken for it.
        del joint
        _remove_joint(index, plant, f"'{name}' cannot be locked")
    for weld in welds:
        plant.AddJoint(weld)
    return positions


def _remove_joint(index: JointIndex, plant: MultibodyPlant, consequence: str) -> None:
    """Removes a joint and its motor."""
    for actuator in _actuators_of(plant):
        if actuator.joint().index() == index:
            plant.RemoveJointActuator(actuator)
    try:
        plant.RemoveJoint(plant.get_joint(index))
    except RuntimeError as error:
        raise ModelError(
            f"{consequence}: {error} Springs and constraints of the file stop it: robot.leave_out "
            "takes them out, as [dynamics/spring_stiffness] or [equality/connect]"
        ) from None


@at("robot.actuators")
def _drive_joints(
    driven: str | Sequence[str] | Mapping[str, float | None],
    plant: MultibodyPlant,
    followers: Container[JointIndex],
    facts: _Facts,
) -> None:
    """Adds actuators to the joints that a scenario names, and removes those of all other joints.

    Actuators of the file remain, with their gear ratios and rotors.
    """
    if driven == "all":
        driven = [
            name
            for name, joint in joint_names(plant).items()
            if _is_simple(joint) and joint.index() not in followers
        ]
    limits = driven if isinstance(driven, Mapping) else dict.fromkeys(driven)
    names = {_simple_joint(name, plant).index(): name for name in limits}
    for actuator in _actuators_of(plant):
        name = names.get(actuator.joint().index())
        if name is None:
            plant.RemoveJointActuator(actuator)
        elif (limit := limits[name]) is not None:
            actuator.set_effort_limit(limit)
    moved = {actuator.joint().index() for actuator in _actuators_of(plant)}
    for index, name in ((index, name) for index, name in names.items() if index not in moved):
        joint, known = plant.get_joint(index), facts.get(index, {})
        effort = known.get("effort") or np.inf if limits[name] is None else limits[name]
        actuator = plant.AddJointActuator(joint.name(), joint, effort)
        actuator.set_default_rotor_inertia(known.get("armature", 0.0))


def _cut_loops(plant: MultibodyPlant, facts: _Facts) -> LoopMakers:
    """Removes joints until the others form a tree; driven joints only if necessary."""
    driven = {actuator.joint().index() for actuator in _actuators_of(plant)}
    names = {joint.index(): name for name, joint in joint_names(plant).items()}
    groups, loops = list(range(plant.num_bodies())), LoopMakers()
    for joint in sorted(
        joints_of(plant),
        key=lambda joint: (not _is_simple(joint), joint.index() in driven),
        reverse=True,
    ):
        ends = joint.parent_body(), joint.child_body()
        first, second = (groups[int(body.index())] for body in ends)
        if first == second:
            name = names.get(joint.index(), joint.name())
            loops[name] = _cut(joint, name, plant, facts.get(joint.index(), {}).get("parent", ""))
        groups = [second if group == first else group for group in groups]
    return loops


def _cut(
    joint: Joint, name: str, plant: MultibodyPlant, parent_frame: str
) -> Callable[[MultibodyPlant], Constraint]:
    if not _is_simple(joint):
        raise ModelError(
            f"joint '{name}' closes a loop, and neither turns nor slides; take it out of the file, "
            "and write it under constraints, as a !WeldedFrames or !CoincidentPoints"
        )
    frames = joint.frame_on_parent(), joint.frame_on_child()
    poses = [frame.GetFixedPoseInBodyFrame() for frame in frames]
    # A joint of SDFormat is at its child; of a frame that is its parent, only the body counts.
    if parent_frame and plant.HasFrameNamed(parent_frame, joint.model_instance()):
        frame = plant.GetFrameByName(parent_frame, joint.model_instance())
        gap = frame.GetFixedPoseInBodyFrame().translation() - poses[0].translation()
        if frame.name() != frame.body().name() and np.linalg.norm(gap) > 1e-6:
            raise ModelError(
                f"joint '{name}' closes a loop at its child, {np.linalg.norm(gap):.3g} m from the "
                f"frame '{parent_frame}' that it names as its parent: of that only the body "
                f"'{frame.body().name()}' counts. Let <pose> place the joint at the frame"
            )
    options: dict[str, Any] = {
        "name": name,
        "damping": joint.default_damping(),
        "lower": float(joint.position_lower_limits()[0]),
        "upper": float(joint.position_upper_limits()[0]),
        "velocity_limit": float(joint.velocity_upper_limits()[0]),
    }
    for actuator in _actuators_of(plant):
        if actuator.joint().index() == joint.index():
            if actuator.default_rotor_inertia() != 0.0:
                raise ModelError(
                    f"joint '{name}' closes a loop, as all joints of it do that could be cut, and "
                    "the rotor of its motor cannot be a constraint; leave one joint without motor"
                )
            options |= {"motor": True, "effort_limit": float(actuator.effort_limit())}
    options = {key: value for key, value in options.items() if value not in (np.inf, -np.inf)}
    slides = isinstance(joint, PrismaticJoint)
    axis = np.array(joint.translation_axis() if slides else joint.revolute_axis())
    bodies = [frame.body().index() for frame in frames]
    _remove_joint(joint.index(), plant, f"joint '{name}' closes a loop, and cannot be cut")
    return partial(_loop_constraint, slides, bodies, poses, axis, options)


def _loop_constraint(
    slides: bool,
    indices: Sequence[BodyIndex],
    poses: Sequence[RigidTransform],
    axis: FloatArray,
    options: Mapping[str, Any],
    plant: MultibodyPlant,
) -> Constraint:
    """The constraint that replaces a cut joint; planar where the loop is, or it were redundant."""
    bodies, context = [plant.get_body(index) for index in indices], plant.CreateDefaultContext()
    rotation = plant.EvalBodyPoseInWorld(context, bodies[0]).rotation() @ poses[0].rotation()
    # The columns of the rate of the child in the parent: of joints that turn, and that slide.
    rates = plant.CalcJacobianSpatialVelocity(
        context,
        JacobianWrtVariable.kV,
        bodies[1].body_frame(),
        np.zeros((3, 1)),
        bodies[0].body_frame(),
        plant.world_frame(),
    )
    turning = [column for column in rates[:3].T if np.linalg.norm(column) > 1e-9]
    sliding = [*rates[3:].T]
    (sliding if slides else turning).append(rotation @ axis)
    normal = turning[-1] if turning else np.zeros(3)
    leans = [np.linalg.norm(np.cross(normal, other)) for other in turning]
    leans += [abs(normal @ other) for other in sliding]
    is_planar = bool(turning) and bool(max(leans) <= 1e-9)
    axes = axes_along(axis)
    if slides and is_planar:
        across = rotation.inverse() @ normal
        axes = np.column_stack([across, np.cross(axis, across), axis])
    own = dict(options)
    for letter, body, pose in zip("ab", bodies, poses, strict=True):
        frame = pose @ RigidTransform(RotationMatrix(axes), np.zeros(3))
        own[f"frame_{letter}"] = frame_name(plant, body.body_frame())
        own[f"point_{letter}"] = triple("a point", frame.translation())
        own[f"rpy_{letter}"] = triple("an angle", RollPitchYaw(frame.rotation()).vector())
    if slides:
        return PrismaticLoopJoint(axis="z", normal="x" if is_planar else None, **own)
    return RevoluteLoopJoint(axis="z", planar=is_planar, **own)
