"""The robot of a scenario: a file, and what the file does not say of it."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import pydantic

from drake_dae.arrays import brief
from drake_dae.errors import ModelError
from drake_dae.scenario.forms.forms import Form
from drake_dae.scenario.forms.typed_yaml import TAG
from drake_dae.scenario.forms.values import Triple
from drake_dae.scenario.robot_file.payloads import Payload


@dataclass(frozen=True)
class Pose:
    """Where a frame stands in another one, as in Drake's model directives.

    Attributes:
        translation: Its origin, m.
        rpy_deg: Roll, pitch and yaw, in degrees.
    """

    translation: Triple = (0.0, 0.0, 0.0)
    rpy_deg: Triple = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class Base:
    """Where a robot stands whose file does not say it.

    Attributes:
        weld: A link that no joint holds, or a frame on it: "base_link", or "left::base_link".
        pose: The pose of that frame in the world.
    """

    weld: str
    pose: Pose = Pose()


def _actuators(value: Any) -> Any:
    """Refuses what is none of the ways to name driven joints."""
    if value is None or value == "all":
        return value
    if isinstance(value, list) and all(isinstance(name, str) for name in value):
        return value
    if isinstance(value, dict) and TAG not in value:
        for name, limit in value.items():
            if limit is not None and not (type(limit) in (int, float) and 0 < limit < np.inf):
                raise ValueError(
                    f"the effort limit of {name} must be a positive number of N m or N, or nothing "
                    f"for that of the file, got {brief(limit)}"
                )
        return value
    raise ValueError(
        f"expected all, a list of joints, or joints with effort limits, got {brief(value)}"
    )


Actuators = Annotated[
    Any,
    pydantic.PlainValidator(_actuators),
    pydantic.PlainSerializer(lambda value: value),
    pydantic.WithJsonSchema(
        {
            "anyOf": [
                {"const": "all"},
                {"type": "array", "items": {"type": "string"}},
                {
                    "type": "object",
                    "additionalProperties": {"anyOf": [{"type": "number"}, {"type": "null"}]},
                },
                {"type": "null"},
            ]
        }
    ),
]
"""Which joints are driven: "all", names, or name -> effort limit."""


LeftOut = Literal["joint_friction", "inertia", "empty_limits", "constraints"]
"""What a scenario may leave out of a robot's file."""


@dataclass(frozen=True)
class Robot:
    """A robot that Drake's Parser reads, and what its file does not say of it.

    Meshes that Drake cannot read, as collisions in .stl or .dae, are left out: no equation needs
    them.
    Joints that mimic another one are constraints "<joint>_coupler". Joints that close loops, as in
    SDFormat, are constraints of their names; where a loop has joints without motors, one of these.

    Attributes:
        file: A URDF, SDFormat or model-directives file, relative to the scenario, or
            "package://drake_dae_models/<file>" for a shipped one.
        description: Instead of a file: a robot of the package robot_descriptions by its name there,
            "panda_description", cloned when it is first used (the extra `descriptions`).
        packages: Name -> folder, relative to the scenario, for other "package://<name>/...". Those
            of which a package.xml lies in a folder above the file that names them, or beside such a
            folder under their name, and those in ROS_PACKAGE_PATH are found without it.
        free: Names of bodies that no joint holds, "object" or "puck::object", or that the file
            fixes to the world: they get a joint in roll, pitch and yaw, with the positions
            "object_qx", "_qy", "_qz", "_x", "_y", "_z". A "floating" joint of the file has such
            positions as well, in the place of a quaternion.
        base: What is welded to the world, where the file does not do it, or elsewhere than it does.
        locked: Joint name -> position in rad or m where it stays, for joints that turn or slide; a
            joint that is coupled to it stays as well. Such joints are none in the rest of the
            scenario.
        actuators: The driven joints, where they are others than those of the file: a list of
            names, or name -> effort limit in N m or N, or "all" that turn or slide and mimic no
            other. Where no limit is given it is that of the file. Controls have this order, after
            those that the file gives actuators.
        leave_out: What the file has and the equations have not, which without this is refused:
            joint_friction, which is Coulomb friction; inertia that no body can have, in whose place
            the nearest possible one is taken; empty_limits, the position limits of joints that
            they leave no room, 0 to 0 for example; constraints, all those that the file has beside
            its joints, as <equality> of MJCF, which are then written under `constraints`.
        payloads: Masses that it carries, which plant and law have both.
    """

    file: str = ""
    packages: dict[str, str] = field(default_factory=dict)
    free: list[str] = field(default_factory=list)
    base: Annotated[Base, Form()] | None = None
    locked: dict[str, float] = field(default_factory=dict)
    actuators: Actuators = None
    leave_out: list[LeftOut] = field(default_factory=list)
    description: str = ""
    payloads: list[Annotated[Payload, Form()]] = field(default_factory=list)

    def __post_init__(self) -> None:
        if bool(self.file) == bool(self.description):
            wanted = "the key 'file', or 'description' for a robot of robot_descriptions"
            raise ModelError(f"needs {wanted}{', not both' if self.file else ''}")

    @property
    def title(self) -> str:
        """What messages and systems call it: "two_arms" of "two_arms.dmd.yaml"."""
        return self.description or Path(self.file).name.split(".")[0]
