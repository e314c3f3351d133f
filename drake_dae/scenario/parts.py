"""Parts of a scenario that the library has not, or not as data: the others are its own classes."""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, ClassVar, Generic, Literal, TypeVar

import numpy as np
import pydantic
from pydrake.math import RigidTransform, RollPitchYaw

from drake_dae.arrays import brief, unknown_name
from drake_dae.dae.tracking.gains import GainDesign, gain_coefficients, gain_matrices, poles
from drake_dae.errors import GainError, ModelError
from drake_dae.robots import constraints as contact
from drake_dae.robots import outputs
from drake_dae.scenario.forms.forms import Form, Numbers, Triple
from drake_dae.scenario.forms.typed_yaml import TAG
from drake_dae.scenario.robot_file.payloads import Payload
from drake_dae.systems.control.observer_rates import Observing
from drake_dae.systems.sensing.force_sensor import ForceSensor

T = TypeVar("T")


class Written(ABC, Generic[T]):
    """What a scenario writes in another way than the library holds it."""

    @abstractmethod
    def made(self, constraints: Sequence[contact.Constraint]) -> T:
        """The object that the library holds.

        Args:
            constraints: The scenario's constraints, as far as they are made.

        Raises:
            ModelError: Something does not fit.
        """


def made(form: T | Written[T], constraints: Sequence[contact.Constraint]) -> T:
    """The object that the library holds for a form; its own classes are their own forms."""
    return form.made(constraints) if isinstance(form, Written) else form


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


@dataclass(frozen=True)
class WeldedFrames(Written[contact.Constraint]):
    """Frame B keeps a pose in frame A: `robots.contact.WeldedFrames`, its pose by angles.

    Attributes:
        frame_a: Name of frame A; "world" holds B in place.
        frame_b: Name of frame B, on another body.
        pose: The pose of B in A; by default the frames coincide.
        name: The name of the constraint, before those of its forces and its parameter.
    """

    frame_a: str
    frame_b: str
    pose: Pose = Pose()
    name: str = "weld"

    def made(self, constraints: Sequence[contact.Constraint]) -> contact.Constraint:
        rotation = RollPitchYaw(np.deg2rad(self.pose.rpy_deg))
        pose = RigidTransform(rotation, self.pose.translation)
        return contact.WeldedFrames(self.frame_a, self.frame_b, pose, self.name)


@dataclass(frozen=True)
class SurfaceCoordinates(Written[outputs.PositionOutput]):
    """The coordinates along a constraint: `robots.outputs.SurfaceCoordinates`.

    Attributes:
        constraint: The name of a constraint with coordinates, as a PointOnSurface on a !Plane.
    """

    constraint: str

    def made(self, constraints: Sequence[contact.Constraint]) -> outputs.PositionOutput:
        return outputs.SurfaceCoordinates(_named(self.constraint, constraints))


@dataclass(frozen=True)
class TiltFromNormal(Written[outputs.PositionOutput]):
    """How far a tool's axis is off the normal where it touches: `robots.outputs.TiltFromNormal`.

    Attributes:
        constraint: The name of a constraint with a free side, as a PointOnSurface.
        axis: The axis of its frame, "x", "y" or "z".
        components: Which of the two other axes are rows, "xy" for example; both if empty.
    """

    constraint: str
    axis: str
    components: str = ""

    def made(self, constraints: Sequence[contact.Constraint]) -> outputs.PositionOutput:
        contact = _named(self.constraint, constraints)
        return outputs.TiltFromNormal(contact, self.axis, self.components)


def _named(name: str, constraints: Sequence[contact.Constraint]) -> contact.Constraint:
    named = {constraint.name: constraint for constraint in constraints}
    if name not in named:
        raise ModelError(unknown_name("constraint", name, named))
    return named[name]


@dataclass(frozen=True)
class ModelForce:
    """The law uses the force of its model: (28)."""

    is_measured: ClassVar = False
    seed: ClassVar = 0
    gain: ClassVar = 0.0

    def sensor(self, size: int) -> ForceSensor | None:
        """No sensor, since none is needed."""
        return None


@dataclass(frozen=True)
class MeasuredForce:
    """The law uses the force that a `systems.sensors.ForceSensor` measures: (59), (71), (81).

    Attributes:
        time_constant: The time constant of the sensor's lag, in s; 0 for none.
        sample_period: The time between samples, in s; 0 for none.
        bias: A constant error in N or N m, one number for all forces or one each.
        noise_deviation: The standard deviation of the noise in N or N m, likewise.
        seed: The seed of the noise.
        gain: Gbar of (59), a number or a matrix row by row; with rigid joints alone.
    """

    time_constant: float = 0.0
    sample_period: float = 0.0
    bias: Numbers = 0.0
    noise_deviation: Numbers = 0.0
    seed: int = 0
    gain: Numbers = 0.0
    is_measured: ClassVar = True

    def __post_init__(self) -> None:
        if not 0 <= self.seed < 2**32:
            raise ModelError(f"seed: a whole number from 0 to 2^32 - 1 is needed, got {self.seed}")

    def sensor(self, size: int) -> ForceSensor | None:
        """The sensor of m = `size` forces."""
        return ForceSensor(
            size, self.time_constant, self.sample_period, self.bias, self.noise_deviation
        )


@dataclass(frozen=True)
class Observer(Observing):
    """How a `systems.observer.DisturbanceObserver` observes what the law's model lacks.

    Attributes:
        friction: The names of constraints whose coefficient of friction is identified, from that
            which they have here on: 0 where nothing is known.
    """

    friction: list[str] = field(default_factory=list)


@dataclass(frozen=True)
class IdealConstraints:
    """The plant is a `RobotPlant`: its constraints hold exactly."""


@dataclass(frozen=True)
class PerOutput:
    """Numbers for all outputs, or for each.

    Attributes:
        all: For every output alike.
        outputs: Output name -> its numbers; "*" is all others. Not beside `all`.
    """

    all: list[float] = field(default_factory=list)
    outputs: dict[str, list[float]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.all and self.outputs:
            raise GainError("give either 'all' or 'outputs', not both")


@dataclass(frozen=True)
class Poles(PerOutput):
    """Real poles of the errors, a number or mu_i of them; complex ones are Coefficients.

    Attributes:
        all: The poles of every output, in 1/s.
        outputs: Output name -> its poles, in 1/s; "*" is all others. Not beside `all`.
    """

    def design(self) -> GainDesign:
        """The design of the gains."""
        return poles(self.all or self.outputs)


@dataclass(frozen=True)
class Coefficients(PerOutput):
    """Gains K_i1, ..., K_i mu_i of (32), lowest derivative first; in 1/s^mu_i, ..., 1/s.

    Attributes:
        all: The gains of every output, in 1/s^mu_i, ..., 1/s.
        outputs: Output name -> its gains, in 1/s^mu_i, ..., 1/s; "*" is all
            others. Not beside `all`.
    """

    def design(self) -> GainDesign:
        """The design of the gains."""
        return gain_coefficients(self.all or self.outputs)


@dataclass(frozen=True)
class Matrices:
    """Gains that couple outputs of one degree: `dae.gains.gain_matrices`.

    Attributes:
        groups: For each degree mu, highest first, its Lambda_1, ..., Lambda_mu, each row by row,
            in 1/s^mu, ..., 1/s.
    """

    groups: list[list[list[list[float]]]]

    def __post_init__(self) -> None:
        for matrix in (matrix for group in self.groups for matrix in group):
            if len({len(row) for row in matrix}) != 1:
                raise GainError(f"groups: the rows of {matrix} have different lengths")

    def design(self) -> GainDesign:
        """The design of the gains."""
        return gain_matrices(*self.groups)


@dataclass(frozen=True)
class Start:
    """A start at rest, on the constraints, with given errors of the outputs.

    Where a scenario has `exogenous` signals, the robot starts in motion with its references.

    Attributes:
        positions: Joint name -> position near which the robot starts, in rad or m; the robot's
            default where not given.
        errors: Output name -> z - r at the start, in the output's unit; 0 where not given. Forces
            can start off their references where actuators have dynamics.
    """

    positions: dict[str, float] = field(default_factory=dict)
    errors: dict[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class Write:
    """What a run leaves in its folder, beside the scenario and the summary.

    Attributes:
        record: Whether it leaves record.npz, all signals at all times.
        plots: Whether it leaves plots.
        animation: Whether it leaves animation.html, which plays in a browser.
    """

    record: bool = True
    plots: bool = True
    animation: bool = True
