"""Scenario files: a robot in contact, what it shall do, and how to simulate it.

A scenario is YAML. What the library has as a dataclass is written with the keys of that dataclass;
a choice between several is written with the name as a tag, for example `surface: !Sphere`. The
classes here are what has no such dataclass.
"""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import Annotated, Any, ClassVar, Generic, TypeVar, cast

import numpy as np
from numpy.typing import ArrayLike
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.systems.analysis import SimulatorConfig

from drake_dae.arrays import unknown_name
from drake_dae.dae import references
from drake_dae.dae.gains import GainDesign, gain_coefficients, gain_matrices, poles
from drake_dae.diagrams.forms import Choice, Form, Numbers, Reader, Row, Triple
from drake_dae.diagrams.typed_yaml import TAG, dump_yaml, load_yaml, set_entry
from drake_dae.errors import GainError, ModelError, ScenarioError
from drake_dae.robots import actuation, contact, outputs
from drake_dae.robots.contact import surfaces
from drake_dae.systems.sensors import ForceSensor

FOLDER = Path(__file__).resolve().parent
DEFAULT_SCENARIO = "seven_joint_wall"

T = TypeVar("T")


class Written(ABC, Generic[T]):
    """What a scenario writes in another way than the library holds it."""

    @abstractmethod
    def made(self, constraints: Sequence[contact.Constraint]) -> T:
        """What the library holds.

        Args:
            constraints: Those of the scenario, as far as they are made.

        Raises:
            ModelError: What does not fit.
        """


@dataclass(frozen=True)
class Robot:
    """A robot that Drake's Parser reads.

    Attributes:
        file: A URDF, SDFormat or model-directives file, relative to the scenario, or
            "package://drake_dae_models/<file>" for a shipped one.
        packages: Name -> folder, relative to the scenario, for other "package://<name>/...".
    """

    file: str
    packages: dict[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class Pose:
    """A position in m, and roll, pitch and yaw in degrees, as in Drake's model directives."""

    translation: Triple = (0.0, 0.0, 0.0)
    rpy_deg: Triple = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class WeldedFrames(Written[contact.Constraint]):
    """`robots.contact.WeldedFrames`, its pose by angles."""

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
    """`robots.outputs.SurfaceCoordinates` of the constraint with a name."""

    constraint: str

    def made(self, constraints: Sequence[contact.Constraint]) -> outputs.PositionOutput:
        named = {constraint.name: constraint for constraint in constraints}
        if self.constraint not in named:
            raise ModelError(unknown_name("constraint", self.constraint, named))
        return outputs.SurfaceCoordinates(cast(contact.PointOnSurface, named[self.constraint]))


@dataclass(frozen=True)
class ModelForce:
    """The law uses the force of its model: (28)."""

    is_measured: ClassVar = False
    seed: ClassVar = 0
    gain: ClassVar = 0.0

    def sensor(self, size: int) -> ForceSensor | None:
        """None is needed."""
        return None


@dataclass(frozen=True)
class MeasuredForce:
    """The law uses the force that a `systems.sensors.ForceSensor` measures: (59), (71), (81).

    Attributes:
        time_constant: Of the sensor's lag, in s.
        sample_period: In s; 0 for none.
        bias: In N (N m for a moment), one number for all forces or one each.
        noise_deviation: Likewise.
        seed: Of the noise.
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
        """The sensor of a number of forces."""
        return ForceSensor(
            size, self.time_constant, self.sample_period, self.bias, self.noise_deviation
        )


@dataclass(frozen=True)
class PerOutput:
    """Numbers for all outputs, or per output name ("*" for all others)."""

    all: list[float] = field(default_factory=list)
    outputs: dict[str, list[float]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.all and self.outputs:
            raise GainError("give either 'all' or 'outputs', not both")


@dataclass(frozen=True)
class Poles(PerOutput):
    """`dae.gains.poles`; complex ones are written as Coefficients."""

    def design(self) -> GainDesign:
        """The gains."""
        return poles(self.all or self.outputs)


@dataclass(frozen=True)
class Coefficients(PerOutput):
    """`dae.gains.gain_coefficients`: K_i1, ..., K_i mu_i."""

    def design(self) -> GainDesign:
        """The gains."""
        return gain_coefficients(self.all or self.outputs)


@dataclass(frozen=True)
class Matrices:
    """`dae.gains.gain_matrices`: for each degree, highest first, its Lambda_1, Lambda_2, ..."""

    groups: list[list[list[list[float]]]]

    def __post_init__(self) -> None:
        for matrix in (matrix for group in self.groups for matrix in group):
            if len({len(row) for row in matrix}) != 1:
                raise GainError(f"groups: the rows of {matrix} have different lengths")

    def design(self) -> GainDesign:
        """The gains."""
        return gain_matrices(*self.groups)


@dataclass(frozen=True)
class Start:
    """At rest, on the constraint, with given errors of the position outputs.

    Attributes:
        positions: Joint name -> position near which the robot starts, in rad or m; the robot's
            default where not given.
        errors: Output name -> z - r at the start; 0 where not given. Forces can start off their
            references where actuators have dynamics.
    """

    positions: dict[str, float] = field(default_factory=dict)
    errors: dict[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class Write:
    """What a run leaves in its folder, beside the scenario and the summary."""

    record: bool = True
    plots: bool = True
    animation: bool = True


# The families that a tag chooses from, and what stands in a file for the types of their fields. A
# new member is one line here.

Surface = Annotated[
    surfaces.Plane | surfaces.Sphere | surfaces.Cylinder | surfaces.Ellipsoid | surfaces.Torus,
    Choice({surfaces.Vector: Triple}),
]
Constraint = Annotated[
    contact.PointOnSurface | WeldedFrames | contact.CoincidentPoints,
    Choice({surfaces.Vector: Triple, surfaces.Surface: Surface}),
]
Output = Annotated[
    outputs.PointCoordinates
    | outputs.AxisCoordinates
    | SurfaceCoordinates
    | outputs.JointPositions,
    Choice({surfaces.Vector: Triple}),
]
Stage = Annotated[
    actuation.FlexibleJoints | actuation.DcMotors | actuation.ElectrohydraulicServos,
    Choice({ArrayLike: Numbers}),
]
Reference = Annotated[
    Annotated[references.ConstantReference, Form(tag="!Constant")]
    | Annotated[references.SinusoidReference, Form(tag="!Sinusoids")]
    | Annotated[
        references.PointToPointReference, Form(tag="!PointToPoint", defaults={"start_time": 0.0})
    ],
    Choice({ArrayLike: Row}),
]
Force = Annotated[ModelForce | MeasuredForce, Choice()]
Gains = Annotated[Poles | Coefficients | Matrices, Choice()]

_INTEGRATOR = {"integration_scheme": "runge_kutta5", "accuracy": 1e-6, "use_error_control": True}


@dataclass(frozen=True, eq=False)
class Scenario:
    """A robot in contact, what it shall do, and how to simulate it.

    Attributes:
        description: One line for `drake-dae list`.
        robot: Where it is read from.
        constraints: What it touches or holds; a form without a tag is a PointOnSurface.
        outputs: Position outputs; the constraint forces follow them.
        actuation: Stages from the joints toward the motor; none is rigid joints.
        force: Whether the law uses its model's force or a measured one.
        plant_parameters: Parameter name -> what the plant has and the law's model does not.
        gains: Of the tracking law (28).
        references: One below the other, in the order of the outputs, the forces last.
        start: Where it starts.
        duration: In s.
        integrator: Drake's SimulatorConfig; the run begins at its start_time.
        write: What to keep.
    """

    description: str = field(default="", kw_only=True)
    robot: Robot
    constraints: list[Constraint] = field(default_factory=list)
    outputs: list[Output] = field(default_factory=list)
    actuation: list[Stage] = field(default_factory=list)
    force: Force = ModelForce()
    plant_parameters: dict[str, list[float]] = field(default_factory=dict)
    gains: Gains = Poles()
    references: list[Reference] = field(kw_only=True)
    start: Start = Start()
    duration: float = 10.0
    integrator: Annotated[SimulatorConfig, Form(defaults=_INTEGRATOR)] = field(
        default_factory=lambda: SimulatorConfig(**_INTEGRATOR)
    )
    write: Write = Write()

    def __eq__(self, other: object) -> bool:
        # Arrays, and Drake's SimulatorConfig, do not compare as a whole.
        return isinstance(other, Scenario) and _reader().write(self) == _reader().write(other)


@cache
def _reader() -> Reader[Scenario]:
    return Reader(Scenario)


def scenario_schema() -> dict[str, Any]:
    """The JSON Schema of a scenario as plain data, where a tag is an entry "_tag"."""
    return _reader().schema


def shipped_scenarios() -> dict[str, Path]:
    """Name -> file of the scenarios that come with drake_dae."""
    return {path.stem: path for path in sorted((FOLDER / "scenarios").glob("*.yaml"))}


def find_scenario(name: str) -> Path:
    """The file of a shipped scenario, or a path as it is.

    Raises:
        ScenarioError: There is neither.
    """
    shipped = shipped_scenarios()
    if name in shipped:
        return shipped[name]
    path = Path(name)
    if path.is_file():
        return path
    message = unknown_name("scenario file", name, shipped)
    raise ScenarioError(("", message.replace("there are", "shipped scenarios:")))


def load_scenario(path: str | Path, settings: Sequence[str] = ()) -> Scenario:
    """Reads a scenario file.

    Args:
        path: The file.
        settings: Changes "key=value" with dotted keys, for example "integrator.accuracy=1e-8" or
            "constraints.0.surface.point=[0.7, 0, 0]".

    Raises:
        ScenarioError: No such file, broken YAML, or keys that are unknown, missing or given twice
            and values that cannot be used, all at once.
    """
    path = Path(path)
    try:
        text = path.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise ScenarioError((str(path), str(error))) from None
    data = load_yaml(text, str(path))
    data = {} if data is None else data
    if isinstance(data, dict):
        # As Drake has it: a place for anchors.
        data = {key: data[key] for key in data if key == TAG or not key.startswith("_")}
    for setting in settings:
        set_entry(data, setting, _reader().free_names)
    scenario = _reader().read(data)
    # Absolute, so that the scenario as run means the same wherever it is written.
    robot, here = scenario.robot, path.resolve().parent
    file = robot.file
    if file and not file.startswith("package://"):
        file = str((here / file).resolve())
    packages = {name: str((here / folder).resolve()) for name, folder in robot.packages.items()}
    return replace(scenario, robot=Robot(file, packages))


def save_scenario(scenario: Scenario, path: str | Path, comment: str = "") -> None:
    """Writes a scenario file that `load_scenario` reads back equal.

    Args:
        scenario: What.
        path: Where.
        comment: A first line, with its "#".
    """
    head = f"{comment}\n" if comment else ""
    Path(path).write_text(head + dump_yaml(_reader().write(scenario)), encoding="utf-8")
