"""The robot of a scenario: a file, and changes of it."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

from pydantic import AfterValidator, Field, ValidationInfo

from drake_dae.arrays import positive
from drake_dae.robots import Load, Vector
from drake_dae.scenario.form import FileName, expected, in_folder


@dataclass(frozen=True)
class Pose:
    """The pose of a frame relative to another one, as in Drake's model directives.

    Attributes:
        translation: The position of its origin, m.
        rpy_deg: Roll, pitch and yaw, in degrees.
    """

    translation: Vector = (0.0, 0.0, 0.0)
    rpy_deg: Vector = (0.0, 0.0, 0.0)


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


@dataclass(frozen=True)
class Payload:
    """A point mass attached to a robot.

    Attributes:
        frame: Name of the frame to which it is attached.
        mass: Its mass, in kg; the parameter "<name>.mass".
        point: Its position in the frame, m.
        name: The name of its body.
    """

    frame: str
    mass: float
    point: Vector = (0.0, 0.0, 0.0)
    name: str = "payload"

    def __post_init__(self) -> None:
        positive("the mass of a payload", self.mass)


def _robot_file(name: str, info: ValidationInfo) -> str:
    return name if name.startswith("package://") else in_folder(name, info)


RobotFile = Annotated[str, AfterValidator(_robot_file), expected("the name of a file")]
Actuators = Annotated[
    Literal["all"] | list[str] | dict[str, Annotated[float, Field(gt=0.0)] | None] | None,
    expected(
        "all, a list of joints, or joints with effort limits in N m or N, positive, or nothing for "
        "that of the file"
    ),
]
LeftOut = Annotated[
    str,
    Field(pattern="^[^/]+/[^/]|^inertia$|^empty_limits$"),
    expected('"<parent>/<name>" of an element or attribute, inertia, or empty_limits'),
]


@dataclass(frozen=True)
class Robot:
    """A robot's file that Drake's Parser reads, with changes.

    Meshes that Drake cannot read, such as collision meshes in .stl or .dae, are left out: no
    equation needs them. A joint that mimics another one becomes a constraint "<joint>_coupler". In
    each closed loop of joints one joint, if possible one without motor, becomes a constraint of the
    joint's name.

    Attributes:
        file: A URDF, SDFormat or model-directives file, relative to the scenario, or
            "package://drake_dae_models/<file>" for a shipped one.
        packages: Name -> folder, relative to the scenario, of a package in "package://<name>/...".
            Packages are found without this key if their package.xml is in a folder above the file
            that names them, or in a folder of the package's name in one of these, or in
            ROS_PACKAGE_PATH.
        free: Names of bodies, "object" or "puck::object", that have no joint or that the file fixes
            to the world. They get a joint in roll, pitch and yaw, with the positions "object_qx",
            "_qy", "_qz", "_x", "_y", "_z". A "floating" joint of the file gets such positions as
            well, instead of a quaternion.
        base: The link that is welded to the world, if the file does not weld it, or welds it at
            another pose.
        locked: Joint name -> constant position in rad or m, for revolute and prismatic joints;
            joints coupled to it are locked as well. The rest of the scenario must not name locked
            joints.
        actuators: The driven joints, if they differ from those of the file: a list of names, or
            name -> effort limit in N m or N, or "all" revolute and prismatic joints that mimic no
            other. Without a number the limit is that of the file. Controls have this order, after
            those of the file's own actuators.
        leave_out: What is left out of the file: elements and attributes by "<parent>/<name>", as
            "joint/stiffness" or "equality/weld", and of one type of joints by "<type>/<name>", as
            "universal/spring_stiffness". Drake reads not all that a file says; what of it changes
            the equations is an error until it is named here. Besides, inertia: impossible
            moments of inertia, which the nearest possible ones replace; empty_limits: position
            limits that are empty intervals, such as 0 to 0.
        payloads: Masses attached to the robot, known to plant and law.
        known_forces: Known forces on frames; "<name>.force" is zero unless it is in `exogenous` or
            `plant.parameters`. And friction of joints.
    """

    file: RobotFile
    packages: dict[str, FileName] = field(default_factory=dict)
    free: list[str] = field(default_factory=list)
    base: RobotPlacement | None = None
    locked: dict[str, float] = field(default_factory=dict)
    actuators: Actuators = None
    leave_out: list[LeftOut] = field(default_factory=list)
    payloads: list[Payload] = field(default_factory=list)
    known_forces: list[Load] = field(default_factory=list)

    @property
    def title(self) -> str:
        """The robot's name in messages and systems: "two_arms" for "two_arms.dmd.yaml"."""
        return Path(self.file).name.split(".")[0]
