"""Scenario files: a robot in contact, what it shall do, and how to simulate it.

A scenario is YAML, read by Drake's typed loader into the dataclasses below. A choice between
several forms is written with the form's name as a tag, for example `surface: !Sphere`.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from difflib import get_close_matches
from pathlib import Path

import numpy as np
from pydrake.common.yaml import yaml_dump_typed
from pydrake.systems.analysis import SimulatorConfig

from drake_dae.diagrams.typed_yaml import REQUIRED, Numbers, read_typed
from drake_dae.errors import ScenarioError

FOLDER = Path(__file__).resolve().parent
DEFAULT_SCENARIO = "seven_joint_wall"


def _none() -> Numbers:
    """No numbers: the key was left out."""
    return np.zeros(0)


@dataclass
class Robot:
    """A robot that Drake's Parser reads.

    Attributes:
        file: A URDF, SDFormat or model-directives file, relative to the scenario, or
            "package://drake_dae_models/<file>" for a shipped one.
        packages: Name -> folder, relative to the scenario, for other "package://<name>/...".
    """

    file: str = field(default="", metadata=REQUIRED)
    packages: dict[str, str] = field(default_factory=dict)


@dataclass
class Plane:
    """`robots.surfaces.Plane`."""

    point: list[float] = field(default_factory=list, metadata=REQUIRED)
    normal: list[float] = field(default_factory=list, metadata=REQUIRED)


@dataclass
class Sphere:
    """`robots.surfaces.Sphere`."""

    center: list[float] = field(default_factory=list, metadata=REQUIRED)
    radius: float = field(default=0.0, metadata=REQUIRED)
    axis: list[float] = field(default_factory=lambda: [0.0, 0.0, 1.0])
    inside: bool = False


@dataclass
class Cylinder:
    """`robots.surfaces.Cylinder`."""

    point: list[float] = field(default_factory=list, metadata=REQUIRED)
    axis: list[float] = field(default_factory=list, metadata=REQUIRED)
    radius: float = field(default=0.0, metadata=REQUIRED)
    inside: bool = False


@dataclass
class Ellipsoid:
    """`robots.surfaces.Ellipsoid`."""

    center: list[float] = field(default_factory=list, metadata=REQUIRED)
    semi_axes: list[float] = field(default_factory=list, metadata=REQUIRED)
    inside: bool = False


@dataclass
class Torus:
    """`robots.surfaces.Torus`."""

    center: list[float] = field(default_factory=list, metadata=REQUIRED)
    axis: list[float] = field(default_factory=list, metadata=REQUIRED)
    major_radius: float = field(default=0.0, metadata=REQUIRED)
    minor_radius: float = field(default=0.0, metadata=REQUIRED)
    inside: bool = False


@dataclass
class PointOnSurface:
    """`robots.constraints.PointOnSurface`."""

    frame: str = field(default="", metadata=REQUIRED)
    surface: Plane | Sphere | Cylinder | Ellipsoid | Torus = field(
        default_factory=Plane, metadata=REQUIRED
    )
    point: list[float] = field(default_factory=lambda: [0.0, 0.0, 0.0])
    name: str = "surface"


@dataclass
class Pose:
    """A position in m, and roll, pitch and yaw in degrees, as in Drake's model directives."""

    translation: list[float] = field(default_factory=lambda: [0.0, 0.0, 0.0])
    rpy_deg: list[float] = field(default_factory=lambda: [0.0, 0.0, 0.0])


@dataclass
class WeldedFrames:
    """`robots.constraints.WeldedFrames`."""

    frame_a: str = field(default="", metadata=REQUIRED)
    frame_b: str = field(default="", metadata=REQUIRED)
    pose: Pose = field(default_factory=Pose)
    name: str = "weld"


@dataclass
class CoincidentPoints:
    """`robots.constraints.CoincidentPoints`."""

    frame_a: str = field(default="", metadata=REQUIRED)
    point_a: list[float] = field(default_factory=list, metadata=REQUIRED)
    frame_b: str = field(default="", metadata=REQUIRED)
    point_b: list[float] = field(default_factory=list, metadata=REQUIRED)
    axes: str = "xyz"
    name: str = "pin"


@dataclass
class PointCoordinates:
    """`robots.outputs.PointCoordinates`."""

    frame: str = field(default="", metadata=REQUIRED)
    axes: str = "xyz"
    point: list[float] = field(default_factory=lambda: [0.0, 0.0, 0.0])
    name: str = ""


@dataclass
class AxisCoordinates:
    """`robots.outputs.AxisCoordinates`."""

    frame: str = field(default="", metadata=REQUIRED)
    axis: str = field(default="", metadata=REQUIRED)
    components: str = field(default="", metadata=REQUIRED)


@dataclass
class SurfaceCoordinates:
    """`robots.outputs.SurfaceCoordinates` of the constraint with a name."""

    constraint: str = field(default="", metadata=REQUIRED)


@dataclass
class JointPositions:
    """`robots.outputs.JointPositions`."""

    joints: list[str] = field(default_factory=list, metadata=REQUIRED)


@dataclass(eq=False)
class FlexibleJoints:
    """`robots.actuation.FlexibleJoints`; one number serves all actuators.

    Each is a number, one per actuator, or a matrix row by row, `[[8000, 500], [500, 6000]]`. An
    inertia that is left out is what the URDF declares.
    """

    stiffness: Numbers = field(default_factory=_none, metadata=REQUIRED)
    inertia: Numbers = field(default_factory=_none)
    damping: Numbers = field(default_factory=lambda: np.array(0.0))


@dataclass(eq=False)
class DcMotors:
    """`robots.actuation.DcMotors`; one number serves all actuators.

    Each is a number, or one per actuator. A gear ratio that is left out is what the URDF declares.
    """

    torque_constant: Numbers = field(default_factory=_none, metadata=REQUIRED)
    inductance: Numbers = field(default_factory=_none, metadata=REQUIRED)
    resistance: Numbers = field(default_factory=_none, metadata=REQUIRED)
    gear_ratio: Numbers = field(default_factory=_none)


@dataclass(eq=False)
class ElectrohydraulicServos:
    """`robots.actuation.ElectrohydraulicServos`; one number serves all, G(q) is for Python.

    Each is a number or one per actuator; leakage and geometry may be matrices, row by row.
    """

    stiffness: Numbers = field(default_factory=_none, metadata=REQUIRED)
    leakage: Numbers = field(default_factory=_none, metadata=REQUIRED)
    geometry: Numbers = field(default_factory=lambda: np.array(1.0))


@dataclass
class ModelForce:
    """The law uses the force of its model: (28)."""


@dataclass(eq=False)
class MeasuredForce:
    """The law uses the force that a `systems.sensors.ForceSensor` measures: (59), (71), (81).

    Attributes:
        time_constant: Of the sensor's lag, s.
        sample_period: s; 0 for none.
        bias: N (N m for a moment), one number for all forces or one each.
        noise_deviation: Likewise.
        seed: Of the noise.
        gain: Gbar of (59), a number or a matrix row by row; with rigid joints alone.
    """

    time_constant: float = 0.0
    sample_period: float = 0.0
    bias: Numbers = field(default_factory=lambda: np.array(0.0))
    noise_deviation: Numbers = field(default_factory=lambda: np.array(0.0))
    seed: int = 0
    gain: Numbers = field(default_factory=lambda: np.array(0.0))


@dataclass
class Poles:
    """`dae.gains.poles`: real poles for all outputs, or per output name ("*" for all others).

    Complex ones are written as Coefficients.
    """

    all: list[float] = field(default_factory=list)
    outputs: dict[str, list[float]] = field(default_factory=dict)


@dataclass
class Coefficients:
    """`dae.gains.coefficients`: K_i1, ..., K_i mu_i for all outputs, or per output name."""

    all: list[float] = field(default_factory=list)
    outputs: dict[str, list[float]] = field(default_factory=dict)


@dataclass
class Matrices:
    """`dae.gains.matrices`: for each degree, highest first, its Lambda_1, Lambda_2, ..."""

    groups: list[list[list[list[float]]]] = field(default_factory=list, metadata=REQUIRED)


@dataclass
class Constant:
    """`systems.references.constant`."""

    values: list[float] = field(default_factory=list, metadata=REQUIRED)


@dataclass
class Sinusoids:
    """`systems.references.sinusoids`; the phases are 0 where none are given."""

    offset: float = field(default=0.0, metadata=REQUIRED)
    amplitudes: list[float] = field(default_factory=list, metadata=REQUIRED)
    frequencies: list[float] = field(default_factory=list, metadata=REQUIRED)
    phases: list[float] = field(default_factory=list)


@dataclass
class PointToPoint:
    """`systems.references.point_to_point`."""

    start: list[float] = field(default_factory=list, metadata=REQUIRED)
    end: list[float] = field(default_factory=list, metadata=REQUIRED)
    start_time: float = 0.0
    end_time: float = field(default=0.0, metadata=REQUIRED)
    order: int = 2


@dataclass
class Start:
    """At rest, on the constraint, with given errors of the position outputs.

    Attributes:
        positions: Joint name -> position near which the robot starts, rad or m; the robot's
            default where not given.
        errors: Output name -> z - r at the start; 0 where not given. Forces can start off their
            references where actuators have dynamics.
    """

    positions: dict[str, float] = field(default_factory=dict)
    errors: dict[str, float] = field(default_factory=dict)


@dataclass
class Write:
    """What a run leaves in its folder, beside the scenario and the summary."""

    record: bool = True
    plots: bool = True
    animation: bool = True


@dataclass(eq=False)
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
        duration: s.
        integrator: Drake's SimulatorConfig; the run begins at its start_time.
        write: What to keep.
    """

    description: str = ""
    robot: Robot = field(default_factory=Robot, metadata=REQUIRED)
    constraints: list[PointOnSurface | WeldedFrames | CoincidentPoints] = field(
        default_factory=list
    )
    outputs: list[PointCoordinates | AxisCoordinates | SurfaceCoordinates | JointPositions] = field(
        default_factory=list
    )
    actuation: list[FlexibleJoints | DcMotors | ElectrohydraulicServos] = field(
        default_factory=list
    )
    force: ModelForce | MeasuredForce = field(default_factory=ModelForce)
    plant_parameters: dict[str, list[float]] = field(default_factory=dict)
    gains: Poles | Coefficients | Matrices = field(default_factory=Poles)
    references: list[Constant | Sinusoids | PointToPoint] = field(
        default_factory=list, metadata=REQUIRED
    )
    start: Start = field(default_factory=Start)
    duration: float = 10.0
    integrator: SimulatorConfig = field(
        default_factory=lambda: SimulatorConfig(
            integration_scheme="runge_kutta5", accuracy=1e-6, use_error_control=True
        )
    )
    write: Write = field(default_factory=Write)

    def __eq__(self, other: object) -> bool:
        # Drake's SimulatorConfig compares by identity.
        return isinstance(other, Scenario) and yaml_dump_typed(self) == yaml_dump_typed(other)


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
    near = get_close_matches(name, shipped, n=1)
    hint = f"did you mean '{near[0]}'? " if near else ""
    raise ScenarioError(f"no scenario file '{name}'; {hint}shipped scenarios: {', '.join(shipped)}")


def load_scenario(path: str | Path, settings: Sequence[str] = ()) -> Scenario:
    """Reads a scenario file.

    Args:
        path: The file.
        settings: Changes "key=value" with dotted keys, for example "integrator.accuracy=1e-8" or
            "constraints.0.surface.point=[0.7, 0, 0]".

    Raises:
        ScenarioError: No such file, broken YAML, a key that is unknown, missing or given twice, or
            a value of a wrong type.
    """
    path = Path(path)
    try:
        text = path.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise ScenarioError(f"{path}: {error}") from None
    scenario = read_typed(Scenario, text, settings, str(path))
    # Absolute, so that the scenario as run means the same wherever it is written.
    robot, here = scenario.robot, path.resolve().parent
    if robot.file and not robot.file.startswith("package://"):
        robot.file = str((here / robot.file).resolve())
    robot.packages = {
        name: str((here / folder).resolve()) for name, folder in robot.packages.items()
    }
    return scenario


def save_scenario(scenario: Scenario, path: str | Path, comment: str = "") -> None:
    """Writes a scenario file that `load_scenario` reads back equal.

    Args:
        scenario: What.
        path: Where.
        comment: A first line, with its "#".
    """
    head = f"{comment}\n" if comment else ""
    Path(path).write_text(head + yaml_dump_typed(scenario), encoding="utf-8")
