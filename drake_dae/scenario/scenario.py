"""Scenario files: a robot in contact, what it shall do, and how to simulate it.

A scenario is YAML. What the library has as a dataclass is written with the keys of that dataclass;
a choice between several is written with the name as a tag, for example `surface: !Sphere`.
"""

from collections.abc import Callable, Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass, field, fields, replace
from functools import cache
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

from casadi import SX
from numpy.typing import ArrayLike
from pydantic import AfterValidator
from pydrake.systems.analysis import SimulatorConfig

from drake_dae.arguments import checked
from drake_dae.arrays import listed
from drake_dae.dae import references
from drake_dae.diagrams import unilateral
from drake_dae.errors import ScenarioError
from drake_dae.files import read_text
from drake_dae.robots import actuation, force_outputs, loads, outputs
from drake_dae.robots import constraints as contact
from drake_dae.robots.surfaces import maps, surface, surfaces
from drake_dae.scenario import parts as parts
from drake_dae.scenario.forms.forms import (
    Choice,
    FileName,
    Form,
    Numbers,
    Pair,
    Reader,
    Row,
    Triple,
    without_tags,
)
from drake_dae.scenario.forms.typed_yaml import (
    MOST_TEXT,
    TAG,
    dump_yaml,
    load_yaml,
    put_entry,
    set_entry,
)
from drake_dae.scenario.robot_file import payloads
from drake_dae.scenario.task import ScenarioTask
from drake_dae.simulation.simulate import check_config, check_duration
from drake_dae.systems.control import sampling
from drake_dae.systems.plants.contact import contact_material, pushes
from drake_dae.systems.sensing import encoders, tolerances
from drake_dae.systems.task import phases
from drake_dae.trace.compiled import Compiled

T = TypeVar("T")


# The families that a tag chooses from. A new member is one line here. Vectors and arrays stand in a
# file as `_WRITTEN` tells; numbers, text, truth values, Literals, dataclasses, tuples, and lists
# and dictionaries of these stand for themselves.

_WRITTEN = {surface.Vector: Triple, ArrayLike: Numbers, str | Path: FileName, maps.Pair: Pair}

Surface = Annotated[
    surfaces.Plane
    | surfaces.Sphere
    | surfaces.Cylinder
    | surfaces.Ellipsoid
    | surfaces.Torus
    | surfaces.ImplicitSurface
    | maps.HeightMap
    | maps.MeshSurface,
    Choice({**_WRITTEN, Callable[..., SX] | str: str}),
]
Constraint = Annotated[
    contact.PointOnSurface
    | parts.WeldedFrames
    | contact.CoincidentPoints
    | contact.FixedDistance
    | contact.JointCoupler
    | contact.RevoluteLoopJoint
    | contact.PrismaticLoopJoint
    | contact.AxisNormalToSurface
    | contact.Blade
    | contact.RollingWheel
    | contact.RollingBall,
    Choice({**_WRITTEN, surface.Surface: Surface}),
]
Output = Annotated[
    outputs.PointCoordinates
    | outputs.AxisCoordinates
    | parts.SurfaceCoordinates
    | parts.TiltFromNormal
    | outputs.JointPositions,
    Choice(_WRITTEN),
]
ForceOutput = Annotated[
    str | force_outputs.Squeeze | force_outputs.ForceCombination, Choice(_WRITTEN)
]
Stage = Annotated[
    actuation.FlexibleJoints | actuation.DcMotors | actuation.ElectrohydraulicServos,
    Choice(_WRITTEN),
]
_PathLimits = Annotated[references.PathLimits, Form()]
Reference = Annotated[
    Annotated[references.ConstantReference, Form(tag="!Constant")]
    | float
    | Annotated[references.SinusoidReference, Form(tag="!Sinusoids")]
    | Annotated[
        references.PointToPointReference, Form(tag="!PointToPoint", defaults={"start_time": 0.0})
    ]
    | Annotated[references.LineReference, Form(tag="!Line")]
    | Annotated[references.CircleReference, Form(tag="!Circle")]
    | Annotated[references.SpiralReference, Form(tag="!Spiral")]
    | Annotated[references.PolylineReference, Form(tag="!Polyline")]
    | Annotated[references.WaypointsReference, Form(tag="!Waypoints")]
    | Annotated[references.CsvReference, Form(tag="!Csv")]
    | Annotated[references.TextReference, Form(tag="!Text")],
    Choice({**_WRITTEN, ArrayLike: Row, references.PathLimits: _PathLimits}),
]
Load = Annotated[loads.KnownForce, Form(_WRITTEN)]
Payload = Annotated[payloads.Payload, Form()]
Push = Annotated[pushes.Push, Form(_WRITTEN)]
Force = Annotated[parts.ModelForce | parts.MeasuredForce, Choice()]
Plant = Annotated[
    parts.IdealConstraints
    | Annotated[contact_material.ContactMaterial, Form(tag="!MultibodyPlant")]
    | unilateral.Unilateral,
    Choice(),
]
Sampling = Annotated[sampling.Sampling, Form()]
Encoders = Annotated[encoders.Encoders, Form(_WRITTEN)]
Tolerances = Annotated[tolerances.Tolerances, Form()]
Observer = Annotated[parts.Observer, Form()]
_PHASE_DATA = {
    float | references.Reference: Reference,
    Mapping[str, references.Reference | float]: dict[str, Reference],
}
Phase = Annotated[
    phases.Approach | phases.Press | phases.Move | phases.Dwell | phases.Release | phases.Retreat,
    Choice(_PHASE_DATA),
]
Task = Annotated[ScenarioTask, Form({Sequence[phases.Phase]: list[Phase]})]
Gains = Annotated[parts.Poles | parts.Coefficients | parts.Matrices, Choice()]


def _checked(check: Callable[[T], None]) -> Callable[[T], T]:
    """A check that passes the value on."""

    def passed_on(value: T) -> T:
        check(value)
        return value

    return passed_on


_INTEGRATOR = {"integration_scheme": "runge_kutta5", "accuracy": 1e-6, "use_error_control": True}
_INTEGRATOR_TEXTS = {
    "integration_scheme": "One of Drake's: runge_kutta5, runge_kutta3, implicit_euler, radau3, ...",
    "max_step_size": "The longest step, in s; with fixed steps the step.",
    "accuracy": "The relative error of a step that error control allows.",
    "use_error_control": "Whether the steps have the length that the accuracy needs, or all "
    "max_step_size.",
    "start_time": "When the run begins, in s.",
    "target_realtime_rate": "How many seconds pass in the run per second of the clock; 0 is as "
    "fast as it goes.",
    "publish_every_time_step": "Of Drake, which is about to remove it; the record has every step "
    "without it.",
}


@dataclass(frozen=True, eq=False, repr=False)
class Scenario:
    """A robot in contact, what it shall do, and how to simulate it.

    Attributes:
        description: One line for `drake-dae list`.
        robot: The file that the robot is read from, and what the file leaves open: what is welded,
            free, locked, and driven.
        constraints: What it touches or holds; a form without a tag is a PointOnSurface. Those that
            the robot's file has, as mimic joints, follow them.
        outputs: Position outputs; the constraint forces follow them. Where they are fewer than
            actuators less force outputs, they are completed: see `complete_scenario`.
        tool_axis: What completed outputs hold of the tool's axis: normal to the surface, fixed in
            the world, or nothing (free).
        forces: The force outputs: names of constraint forces, and combinations of forces by tags;
            all constraint forces where left out. Forces that nobody can or shall steer, as those of
            wheels and of mimic joints, stay out: [] is none.
        control_weights: One for each actuator, where they are more than the outputs: the law then
            takes the control with the least sum of weight * (u - free_control)^2. The parameter
            "free_control" is zero where `exogenous` has it not.
        actuation: Stages from the joints toward the motor; none is rigid joints.
        force: Whether the law uses its model's force or a measured one.
        plant_parameters: Parameter name -> what the plant has and the law's model does not; one
            number for all entries, or a list. A surface that may be tilted has `rpy`.
        plant_payloads: Masses that the plant carries and the law's model does not.
        plant_pushes: Forces on the plant for some time, which the law does not know.
        loads: Known forces on frames; "<name>.force" is zero where neither `exogenous` nor
            `plant_parameters` has it.
        exogenous: Parameter name -> how its entries move, known to plant and law; "wall.position"
            for example.
        compliances: Constraint force -> its compliance relative to the others, where constraints
            are redundant: their forces are shared by least squares. {} is all alike; left out, no
            constraint may be redundant.
        gains: The gains of the tracking law (28). Where left out: poles at -4 1/s with ideal
            constraints; in Drake's own contact they are advised, with what is left out of
            `integral`, `constraint_damping` and `observer`, and with measured force; see
            `contact_gains`. The scenario as run has them all. With `actuation` nothing is advised
            there.
        integral: Names of outputs whose errors are integrated as well, which take a pole more:
            positions, and forces where `force` is measured; none where left out beside `gains`.
        constraint_damping: What the law's model demands of constraints that give way, written as
            gains are, for r_i - 1 poles per constraint; none where left out beside `gains`.
        observer: How the law observes what its model lacks, a disturbance and coefficients of
            friction, where `force` is measured and the law is sampled; not at all where left out
            beside `gains`.
        plant: Whether constraints are ideal; or open and close; or Drake's own contact is in their
            place: a discrete MultibodyPlant, with the surfaces as geometry.
        sampling: The period and the delay of the law, in s; left out, it acts continuously.
        encoders: How positions and velocities are measured for the law, with `sampling`; left out,
            it gets them as they are.
        saturation: Whether the drives give no more than the effort limits of the robot's file.
        tolerances: How large errors may be; a run that leaves them ends there, with the reason.
        references: Name -> reference, where a number is a constant. A name is that of an output,
            tool.y; of several, tool for all tool.x, tool.y, ..., or tool.yz; or a list of these,
            "tool.y, elbow". Outputs that complete others may be without; they hold what they start
            with.
        task: What the robot does phase by phase, touching and letting go, in place of references.
        start: Where the robot starts; without positions that is found, but not for a task.
        duration: How long the run lasts, in s.
        integrator: Drake's SimulatorConfig; the run begins at its start_time.
        write: What the run leaves in its folder.
        compiled: Whether functions become machine code, where a C compiler is found: true, false
            or auto, which takes what the cache has and compiles what pays within the run.
    """

    description: str = field(default="", kw_only=True)
    robot: parts.Robot
    constraints: list[Constraint] = field(default_factory=list)
    outputs: list[Output] = field(default_factory=list)
    tool_axis: Literal["normal", "fixed", "free"] = "normal"
    forces: list[ForceOutput] | None = None
    control_weights: list[float] = field(default_factory=list)
    actuation: list[Stage] = field(default_factory=list)
    force: Force = field(default_factory=parts.ModelForce)
    plant_parameters: dict[str, float | list[float]] = field(default_factory=dict)
    plant_payloads: list[Payload] = field(default_factory=list)
    plant_pushes: list[Push] = field(default_factory=list)
    loads: list[Load] = field(default_factory=list)
    exogenous: dict[str, list[Reference]] = field(default_factory=dict)
    compliances: dict[str, float] | None = None
    gains: Gains | None = None
    integral: list[str] | None = None
    constraint_damping: Gains | None = None
    observer: Observer | None = None
    plant: Plant = field(default_factory=parts.IdealConstraints)
    sampling: Sampling | None = None
    encoders: Encoders | None = None
    saturation: bool = False
    tolerances: Tolerances | None = None
    references: dict[str, Reference] = field(default_factory=dict)
    task: Task | None = None
    start: parts.Start = field(default_factory=parts.Start)
    duration: Annotated[float, AfterValidator(_checked(check_duration))] = 10.0
    integrator: Annotated[
        SimulatorConfig,
        Form(defaults=_INTEGRATOR, texts=_INTEGRATOR_TEXTS),
        AfterValidator(_checked(check_config)),
    ] = field(default_factory=lambda: SimulatorConfig(**_INTEGRATOR))
    write: parts.Write = field(default_factory=parts.Write)
    compiled: Compiled = "auto"

    def __post_init__(self) -> None:
        if self.is_advised:
            return
        if self.gains is None:
            object.__setattr__(self, "gains", parts.Poles(all=[-4.0]))
        if self.integral is None:
            object.__setattr__(self, "integral", [])

    @property
    def is_advised(self) -> bool:
        """Whether the gains are left to be advised."""
        return self.gains is None and isinstance(self.plant, contact_material.ContactMaterial)

    def __repr__(self) -> str:
        names = listed(constraint.name for constraint in self.constraints)
        file = Path(self.robot.file).name
        return (
            f"Scenario('{self.description}', robot='{file}', constraints={names}, "
            f"duration={self.duration:g} s)"
        )

    def __eq__(self, other: object) -> bool:
        # Arrays, and Drake's SimulatorConfig, do not compare as a whole.
        return isinstance(other, Scenario) and _reader().write(self) == _reader().write(other)


@cache
def _reader() -> Reader[Scenario]:
    return Reader(Scenario)


def scenario_schema(tags: bool = True) -> dict[str, Any]:
    """The JSON Schema of a scenario as plain data.

    Args:
        tags: Whether the data have tags as entries "_tag", as those of `read_scenario` do. Without,
            it is for data that have none, as a plain reader of YAML or an editor gives them: any
            form fits where a tag chooses.
    """
    return _reader().schema if tags else dict(without_tags(_reader().schema))


def scenario_data(scenario: Scenario) -> dict[str, Any]:
    """A scenario as plain data, of which `read_scenario` makes the same."""
    return dict(_reader().write(scenario))


def varied_data(data: Mapping[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    """A scenario's plain data with other values at dotted keys.

    Raises:
        ScenarioError: There is no such place.
    """
    varied = deepcopy(dict(data))
    for key, value in changes.items():
        put_entry(varied, key, value, _reader().free_names)
    return varied


def read_scenario(data: Mapping[str, Any], folder: Path | None = None) -> Scenario:
    """The scenario that plain data describe, the paths of its robot as they are.

    Args:
        data: Plain data.
        folder: Where the names of other files start; None for the working directory.

    Raises:
        ScenarioError: Keys are unknown or missing, or values cannot be used; all are told at once.
    """
    return _reader().read(data, folder)


@checked(lambda text: ScenarioError(("", text)))
def load_scenario(path: str | Path, settings: Sequence[str] = ()) -> Scenario:
    """Reads a scenario file.

    Args:
        path: The file.
        settings: Changes "key=value" with dotted keys, for example "integrator.accuracy=1e-8" or
            "constraints.0.surface.point=[0.7, 0, 0]".

    Raises:
        ScenarioError: There is no such file, its YAML is broken, or keys are unknown, missing or
            given twice, or values cannot be used; all of these are told at once.
    """
    path = Path(path)
    try:
        text = read_text(path, 4 * MOST_TEXT)
    except UnicodeDecodeError:
        raise ScenarioError((str(path), "the file is not UTF-8 text; save it as such")) from None
    except (OSError, ValueError) as error:  # A null byte in the path.
        raise ScenarioError((str(path), getattr(error, "strerror", None) or str(error))) from None
    data = load_yaml(text, str(path))
    data = {} if data is None else data
    if isinstance(data, dict):
        # Drake's convention: keys with an underscore are a place for anchors.
        data = {key: data[key] for key in data if key == TAG or not key.startswith("_")}
    for setting in settings:
        set_entry(data, setting, _reader().free_names)
    scenario = _reader().read(data, path.absolute().parent)
    # Absolute, so that the scenario as run means the same wherever it is written.
    robot = scenario.robot
    file = robot.file
    try:
        here = path.resolve().parent
        if file and not file.startswith("package://"):
            file = str((here / file).resolve())
        packages = {name: str((here / folder).resolve()) for name, folder in robot.packages.items()}
    except (OSError, RuntimeError, ValueError) as error:
        # The working directory is gone; a link that leads to itself; a null byte.
        raise ScenarioError(("robot", f"no path: {error}")) from None

    def located(one: Any) -> Any:
        if isinstance(one, Mapping):
            return {name: located(inner) for name, inner in one.items()}
        if isinstance(one, list):
            return [*map(located, one)]
        if isinstance(one, phases.Phase):
            inside = {part.name: located(getattr(one, part.name)) for part in fields(one)}
            return replace(one, **inside)
        return one.beside(here) if isinstance(one, references.Reference) else one

    task = scenario.task
    return replace(
        scenario,
        robot=replace(robot, file=file, packages=packages),
        references=located(scenario.references),
        exogenous=located(scenario.exogenous),
        task=None if task is None else replace(task, phases=located([*task.phases])),
    )


def save_scenario(scenario: Scenario, path: str | Path, comment: str = "") -> None:
    """Writes a scenario file that `load_scenario` reads back equal.

    Args:
        scenario: The scenario.
        path: The file to write.
        comment: A first line, with its "#"; empty for none.
    """
    head = f"{comment}\n" if comment else ""
    Path(path).write_text(head + dump_yaml(_reader().write(scenario)), encoding="utf-8")
