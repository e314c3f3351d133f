"""Links that a robot's file fixes to the world, and floating links.

A fixed link is released if the scenario places it. A floating link is a free body with a quaternion
in Drake; no constraint force keeps the length of the quaternion at 1. So it gets a joint in roll,
pitch and yaw.
"""

import re
import warnings
from collections.abc import Collection, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import FixedOffsetFrame, RpyFloatingJoint

from drake_dae.errors import ModelError, RobotFileWarning
from drake_dae.scenario.robot_file.readable.markup import blank, parsed

_JOINT = re.compile(r"<joint\b[^>]*(?<!/)>.*?</joint\s*>", re.DOTALL)
_BODY = re.compile(r"<body\b[^>]*?\bname\s*=\s*[\"']([^\"']*)[\"'][^>]*(?<!/)>")
_RELEASABLE = ("fixed", "floating")
"""Kinds of joints to the world that can be replaced."""


def world_links(text: str, file: Path) -> list[str]:
    """The names of the links that a file fixes to the world.

    Args:
        text: The text of a URDF, SDFormat or MJCF file without comments.
        file: The file; its suffix determines the format.
    """
    if file.suffix == ".xml":
        return _fixed_bodies(text)
    world_joints = (_world_joint(joint[0]) for joint in _JOINT.finditer(text))
    return [link for kind, link in world_joints if kind == "fixed"]


def released(text: str, file: Path, links: Collection[str]) -> str:
    """Removes the joints from the world to some links; lines stay the same.

    The arguments are those of `world_links`, and the names of the links to release.
    """
    if not links:
        return text
    if file.suffix == ".xml":
        fixed = set(_fixed_bodies(text)) & set(links)
        return _BODY.sub(lambda b: b[0] + "<freejoint/>" * (b[1] in fixed), text)

    def without_released(joint: re.Match[str]) -> str:
        kind, link = _world_joint(joint[0])
        return blank(joint) if kind in _RELEASABLE and link in links else joint[0]

    return _JOINT.sub(without_released, text)


@dataclass(frozen=True)
class FloatingJoint:
    """A floating joint.

    Attributes:
        name: Its name.
        parent: The link relative to which it floats; "world" for the world.
        child: The link that floats.
        origin: Its position in the parent, m, and roll, pitch and yaw there, rad.
    """

    name: str
    parent: str
    child: str
    origin: tuple[tuple[float, ...], tuple[float, ...]]


def floating_joints(text: str, file: Path) -> tuple[str, list[FloatingJoint]]:
    """Removes floating joints from a text with the same lines; returns it and the joints.

    Those of MJCF remain in the text: Drake reads them as free bodies.

    Raises:
        ModelError: The origin of one is not six numbers.
    """
    if file.suffix == ".xml":
        return text, list(_free_joints(text))
    floating: list[FloatingJoint] = []

    def without_floating(joint: re.Match[str]) -> str:
        kind, child, parent, name = _ends(joint[0])
        if kind != "floating":
            return joint[0]
        origin = parsed(joint[0]).find("origin")
        attributes = {} if origin is None else origin.attrib
        pose = _triple(attributes.get("xyz", ""), name), _triple(attributes.get("rpy", ""), name)
        floating.append(FloatingJoint(name, parent, child, pose))
        return blank(joint)

    return _JOINT.sub(without_floating, text), floating


def _triple(text: str, name: str) -> tuple[float, ...]:
    try:
        numbers = tuple(map(float, text.split())) or (0.0, 0.0, 0.0)
    except ValueError:
        numbers = ()
    if len(numbers) != 3:
        raise ModelError(f"joint '{name}': its origin needs three numbers, got '{text}'")
    return numbers


def _free_joints(text: str) -> Iterator[FloatingJoint]:
    for body in parsed(text).iterfind("worldbody/body"):
        joints = [*body.iterfind("freejoint"), *body.iterfind("joint[@type='free']")]
        for joint in joints[:1]:
            child = body.get("name", "")
            nowhere = (0.0, 0.0, 0.0)
            yield FloatingJoint(joint.get("name", child), "world", child, (nowhere, nowhere))


def add_floating_joints(
    plant: MultibodyPlant, instance: str, joints: Iterable[FloatingJoint]
) -> None:
    """Adds floating joints in roll, pitch and yaw, with a warning.

    Args:
        plant: The robot, not finalized; changed.
        instance: The model instance of the file; "" if it is the only one.
        joints: Its floating joints.
    """
    models = [plant.GetModelInstanceByName(instance)] if instance else []
    for joint in joints:
        is_world = joint.parent == "world"
        parent = plant.world_body() if is_world else plant.GetBodyByName(joint.parent, *models)
        body = plant.GetBodyByName(joint.child, *models)
        start = plant.GetDefaultFloatingBaseBodyPose(body)
        where = RigidTransform(RollPitchYaw(joint.origin[1]), joint.origin[0])
        frame = plant.AddFrame(
            FixedOffsetFrame(
                f"{joint.name}_origin", parent.body_frame(), where, body.model_instance()
            )
        )
        added = plant.AddJoint(RpyFloatingJoint(joint.name, frame, body.body_frame()))
        if is_world:
            added.SetDefaultPose(start)
        warnings.warn(
            f"joint '{joint.name}' is floating: its positions are roll, pitch and yaw, "
            f"{joint.name}_qx, {joint.name}_qy and {joint.name}_qz, in the place of a quaternion; "
            "it must not pitch by 90 degrees",
            RobotFileWarning,
            stacklevel=2,
        )


def _world_joint(joint: str) -> tuple[str, str]:
    """The kind and the child of a joint whose parent is the world; empty for other joints."""
    kind, child, parent, _ = _ends(joint)
    return (kind, child) if parent == "world" else ("", "")


def _ends(joint: str) -> tuple[str, str, str, str]:
    """The kind of a joint, its child, its parent and its name; empty if it cannot be read."""
    element = parsed(joint)
    parent, child = (
        "" if end is None else end.get("link", (end.text or "").strip())
        for end in (element.find("parent"), element.find("child"))
    )
    return element.get("type", ""), child, parent, element.get("name", "")


def _fixed_bodies(text: str) -> list[str]:
    """The names of the bodies in the world of an MJCF file that have no joint."""
    return [
        body.get("name", "")
        for body in parsed(text).iterfind("worldbody/body")
        if body.find("joint") is None and body.find("freejoint") is None
    ]
