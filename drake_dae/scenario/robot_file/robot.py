"""The robot of a scenario: a file, and additions to it."""

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
    """The pose of a frame in another one, as in Drake's model directives.

    Attributes:
        translation: Its origin, m.
        rpy_deg: Roll, pitch and yaw, in degrees.
    """

    translation: Triple = (0.0, 0.0, 0.0)
    rpy_deg: Triple = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class RobotPlacement:
    """The placement of a robot whose file does not fix it to the world.

    Attributes:
        weld: A link without a joint to a parent, or a frame on it: "base_link", or
            "left::base_link".
        pose: The pose of that frame in the world.
    """

    weld: str
    pose: Pose = Pose()


def _actuators(value: Any) -> Any:
    """Checks the forms in which driven joints may be named."""
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
"""The driven joints: "all", names, or name -> effort limit."""


LeftOut = Literal["joint_friction", "inertia", "empty_limits", "constraints"]
"""The parts of a robot's file that a scenario may leave out."""


@dataclass(frozen=True)
class Robot:
    """A robot that Drake's Parser reads, with additions to its file.

    Meshes that Drake cannot read, such as collision meshes in .stl or .dae, are left out: no
    equation needs them. Joints that mimic another one become constraints "<joint>_coupler". A joint
    that closes a loop, as in SDFormat, becomes a constraint of its name; of each loop a joint
    without motor is chosen, if there is one.

    Attributes:
        file: A URDF, SDFormat or model-directives file, relative to the scenario, or
            "package://drake_dae_models/<file>" for a shipped one.
        description: Instead of a file: a robot of the package robot_descriptions by its name there,
            "panda_description", cloned when it is first used (the extra `descriptions`).
        packages: Name -> folder, relative to the scenario, for other "package://<name>/...". Not
            needed for packages with a package.xml in a folder above the file that names them, or in
            a folder of their name beside one of these, nor for those in ROS_PACKAGE_PATH.
        free: Names of bodies without a joint, "object" or "puck::object", or that the file fixes to
            the world: they get a joint in roll, pitch and yaw, with the positions "object_qx",
            "_qy", "_qz", "_x", "_y", "_z". A "floating" joint of the file also gets such positions,
            instead of a quaternion.
        base: The link that is welded to the world, if the file does not do it, or does it at
            another pose.
        locked: Joint name -> constant position in rad or m, for revolute and prismatic joints;
            joints coupled to it are locked as well. The rest of the scenario must not name locked
            joints.
        actuators: The driven joints, if they differ from those of the file: a list of names, or
            name -> effort limit in N m or N, or "all" revolute and prismatic joints that mimic no
            other. A limit that is not given is that of the file. Controls have this order, after
            those of the file's own actuators.
        leave_out: Parts of the file to leave out, which are refused otherwise: joint_friction,
            which is Coulomb friction; inertia, impossible inertias, which are replaced by the
            nearest possible ones; empty_limits, position limits that are empty intervals, 0 to 0
            for example; constraints, all those of the file except joints, such as <equality> of
            MJCF, to be written under `constraints` instead.
        payloads: Masses attached to it, in plant and law.
    """

    file: str = ""
    packages: dict[str, str] = field(default_factory=dict)
    free: list[str] = field(default_factory=list)
    base: Annotated[RobotPlacement, Form()] | None = None
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
        """Its name in messages and systems: "two_arms" of "two_arms.dmd.yaml"."""
        return self.description or Path(self.file).name.split(".")[0]
