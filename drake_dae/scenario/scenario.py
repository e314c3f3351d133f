"""The form of a scenario: a robot in contact, its task, and its simulation; read and written.

A scenario is YAML. The library's dataclasses are written with their fields as keys; a choice
between several classes is written with the name as a tag, for example `surface: !Sphere`.
"""

import re
from collections.abc import Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar, cast

import numpy as np
from pydantic import AfterValidator
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.systems.analysis import SimulatorConfig

from drake_dae import references as rs
from drake_dae import robots
from drake_dae.arguments import checked
from drake_dae.arrays import unknown_name
from drake_dae.errors import ModelError, ScenarioError
from drake_dae.files import read_text
from drake_dae.references import Reference
from drake_dae.robots import Constraint, ForceOutput, Load, PositionOutput, Stage, Surface
from drake_dae.running.simulate import check_config
from drake_dae.scenario import form, parts
from drake_dae.scenario.form import Family, Key, Positive, Reader, keys_of
from drake_dae.scenario.robot_file.robot import Pose, Robot
from drake_dae.scenario.shipped import find_scenario, shipped_scenarios
from drake_dae.systems import phases
from drake_dae.systems.applied_control import Sampling
from drake_dae.systems.phases import Phase
from drake_dae.trace.compiled import Compiled

T = TypeVar("T", Constraint, PositionOutput)


@dataclass(frozen=True)
class WeldedFramesForm:
    """Frame B has a fixed pose in frame A, given by angles.

    Attributes:
        frame_a: Name of frame A; it may be "world".
        frame_b: Name of frame B, on another body.
        pose: The pose of B in A; by default the frames coincide.
        name: The name of the constraint, the prefix of its forces and its parameter.
    """

    frame_a: str
    frame_b: str
    pose: Pose = field(default_factory=Pose)
    name: str = "weld"

    def make(self, constraints: Sequence[Constraint]) -> Constraint:
        rotation = RollPitchYaw(np.deg2rad(self.pose.rpy_deg))
        pose = RigidTransform(rotation, self.pose.translation)
        return robots.WeldedFrames(self.frame_a, self.frame_b, pose, self.name)


@dataclass(frozen=True)
class SurfaceCoordinatesForm:
    """The coordinates along a constraint.

    Attributes:
        constraint: The name of a constraint with coordinates, such as a PointOnSurface on a !Plane.
    """

    constraint: str

    def make(self, constraints: Sequence[Constraint]) -> PositionOutput:
        return robots.SurfaceCoordinates(_named(self.constraint, constraints))


@dataclass(frozen=True)
class TiltFromNormalForm:
    """The tilt of a tool's axis from the surface normal at its contact.

    Attributes:
        constraint: The name of a constraint with a free side, such as a PointOnSurface.
        axis: The axis of its frame, "x", "y" or "z".
        components: The rows, a choice of the two other axes, "xy" for example; both if empty.
    """

    constraint: str
    axis: robots.Letter
    components: str = ""

    def make(self, constraints: Sequence[Constraint]) -> PositionOutput:
        named = _named(self.constraint, constraints)
        return robots.TiltFromNormal(named, self.axis, self.components)


WrittenConstraint = Constraint | WeldedFramesForm
WrittenOutput = PositionOutput | SurfaceCoordinatesForm | TiltFromNormalForm


def make(
    form: T | WeldedFramesForm | SurfaceCoordinatesForm | TiltFromNormalForm,
    constraints: Sequence[Constraint],
) -> T:
    """The library's object of a form that may name constraints; such an object as it is."""
    return cast(T, form.make(constraints) if hasattr(form, "make") else form)


def _named(name: str, constraints: Sequence[Constraint]) -> Constraint:
    named = {constraint.name: constraint for constraint in constraints}
    if name not in named:
        raise ModelError(unknown_name("constraint", name, named))
    return named[name]


_INTEGRATOR = {
    "integration_scheme": ("runge_kutta5", "One of Drake's: runge_kutta5, runge_kutta3, radau3"),
    "max_step_size": (0.1, "The longest step, in s; with fixed steps the step."),
    "accuracy": (1e-6, "The relative error of a step that error control allows."),
    "use_error_control": (
        True,
        "Whether the steps have the length that the accuracy needs, or all max_step_size.",
    ),
    "start_time": (0.0, "When the run begins, in s."),
    "target_realtime_rate": (
        0.0,
        "How many seconds pass in the run per second of the clock; 0 is as fast as it goes.",
    ),
}


@dataclass(frozen=True, eq=False)
class Scenario:
    """A robot in contact, its references or task, and its simulation.

    Attributes:
        description: One line for `drake-dae list`.
        robot: The robot's file, and changes of it.
        constraints: The constraints; one without a tag is a PointOnSurface. Those in the robot's
            file, such as mimic joints, are appended.
        compliances: Constraint force -> its relative compliance, for redundant constraints, whose
            forces least squares share. {} is equal ones; left out, none may be redundant.
        outputs: Position outputs; the force outputs follow them. Missing ones are completed, see
            `complete_scenario`.
        tool_axis: The tool's axis in completed outputs: normal to the surface, fixed, or free.
        forces: Force outputs: names of constraint forces, and combinations by tags; all if left
            out. Leave out those not to be controlled, as of wheels and mimic joints; [] is none.
        actuation: Stages from the joints toward the motor; none for rigid joints.
        parameters: Parameter name -> its value for law and plant; one for all entries, or a list.
        bounds: Parameter name -> lowest and highest value, numbers or lists. Relative degrees hold
            within them; they restrict what `estimator.parameters` names, and nothing else of a run.
        exogenous: Parameter name, as "wall.position" -> references that law and plant know.
        plant: What is simulated: ideal constraints, contact that gives way, or Drake's own contact;
            and how it differs from the law's model.
        law: The tracking law: its gains, or what computed gains must keep.
        sampling: The period and the delay of the law, in s; continuous if left out.
        sensors: What the law measures: the state by encoders, the force by a sensor.
        estimator: The estimator of a disturbance and of parameters, for a sampled law with measured
            force; none if left out while `law.gains` are given.
        saturation: Whether controls are limited to the effort limits of the robot's file.
        judgement: Tolerances and friction cones for the verdict of a run.
        references: Name -> reference; a number is a constant. A name is that of an output, tool.y;
            of several, tool for all tool.x, tool.y, ..., or tool.yz; or a list, "tool.y, elbow".
        task: A sequence of phases with opening and closing contact, in place of references.
        start: The start; without positions it is computed.
        duration: The duration of the run, in s.
        integrator: Drake's SimulatorConfig; the run starts at its start_time.
        write: The files that the run writes into its folder.
        compiled: Whether functions are compiled to machine code, if there is a C compiler: true,
            false or auto, which uses the cache and compiles functions for which it pays.
    """

    description: str = field(default="", kw_only=True)
    robot: Robot
    constraints: list[WrittenConstraint] = field(default_factory=list)
    compliances: dict[str, Positive] | None = None
    outputs: list[WrittenOutput] = field(default_factory=list)
    tool_axis: Literal["normal", "fixed", "free"] = "normal"
    forces: list[str | ForceOutput] | None = None
    actuation: list[Stage] = field(default_factory=list)
    parameters: dict[str, float | list[float]] = field(default_factory=dict)
    bounds: dict[str, form.Interval] = field(default_factory=dict)
    exogenous: dict[str, list[Reference | float]] = field(default_factory=dict)
    plant: parts.ScenarioPlant = field(default_factory=parts.IdealConstraints)
    law: parts.Law = field(default_factory=parts.Law)
    sampling: Sampling | None = None
    sensors: parts.Sensors = field(default_factory=parts.Sensors)
    estimator: parts.Estimator | None = None
    saturation: bool = False
    judgement: parts.Judgement = field(default_factory=parts.Judgement)
    references: dict[str, Reference | float] = field(default_factory=dict)
    task: parts.ScenarioTask | None = None
    start: parts.Start = field(default_factory=parts.Start)
    duration: Positive = 10.0
    integrator: Annotated[SimulatorConfig, AfterValidator(lambda c: check_config(c) or c)] = field(
        default_factory=lambda: SimulatorConfig(**{n: v for n, (v, _) in _INTEGRATOR.items()})
    )
    write: parts.Write = field(default_factory=parts.Write)
    compiled: Compiled = "auto"

    @property
    def is_advised(self) -> bool:
        """Whether the gains are left out and will be computed."""
        return self.law.gains is None and self.plant.material is not None

    def __eq__(self, other: object) -> bool:
        # Arrays and Drake's SimulatorConfig cannot be compared directly.
        return isinstance(other, Scenario) and scenario_data(self) == scenario_data(other)


def _family(room: Any, names: str, plain: type | None = None) -> Family:
    forms = {f"!{name}": _FORMS.get(name) or getattr(room, name) for name in names.split()}
    return Family(forms, plain)


_FORMS = {
    "WeldedFrames": WeldedFramesForm,
    "SurfaceCoordinates": SurfaceCoordinatesForm,
    "TiltFromNormal": TiltFromNormalForm,
}
_REFERENCES: dict[str, type] = {
    "!Constant": rs.ConstantReference,
    "!Sinusoids": rs.SinusoidReference,
    "!PointToPoint": rs.PointToPointReference,
    "!Line": rs.LineReference,
    "!Circle": rs.CircleReference,
    "!Polyline": rs.PolylineReference,
    "!Waypoints": rs.WaypointsReference,
    "!Csv": rs.CsvReference,
}
_SURFACES = "Plane Sphere Cylinder Ellipsoid Torus ImplicitSurface MeasuredSurface"
_CONSTRAINTS = (
    "PointOnSurface WeldedFrames CoincidentPoints FixedDistance JointCoupler RevoluteLoopJoint "
    "PrismaticLoopJoint AxisNormalToSurface RollingWheel"
)
_OUTPUTS = "PointCoordinates AxisCoordinates SurfaceCoordinates TiltFromNormal JointPositions"
# What stands in a scenario for the types in annotations. A new member is one name here.
FAMILIES: dict[type, Family] = {
    Surface: _family(robots, _SURFACES),
    Constraint: _family(robots, _CONSTRAINTS),
    PositionOutput: _family(robots, _OUTPUTS),
    ForceOutput: _family(robots, "Squeeze ForceCombination", str),
    Stage: _family(robots, "FlexibleJoints DcMotors ElectrohydraulicServos"),
    Load: _family(robots, "KnownForce JointFriction"),
    Reference: Family(_REFERENCES, float),
    parts.ScenarioPlant: _family(
        parts, "IdealConstraints MultibodyPlant CompliantContact OwnPlant"
    ),
    parts.Poles: _family(parts, "Poles Coefficients Matrices"),
    Phase: _family(phases, "Approach Press Move Dwell Release Retreat"),
}


@cache
def scenario_reader() -> Reader:
    """The reader and writer of scenarios as plain data."""
    move = dict(keys_of(rs.PointToPointReference))
    move["start_time"] = replace(move["start_time"], default=0.0)
    keys: dict[type, Mapping[str, Key]] = {rs.PointToPointReference: move}
    keys[SimulatorConfig] = {n: Key(type(v), v, text) for n, (v, text) in _INTEGRATOR.items()}
    return Reader(Scenario, FAMILIES, keys)


def scenario_schema() -> dict[str, Any]:
    """The JSON Schema of a scenario for editors of YAML, which see the value after a tag."""
    reader = scenario_reader()
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "$comment": f"Tags, for an editor: {', '.join(f'{tag} mapping' for tag in reader.tags)}",
        **reader.schema,
        "patternProperties": {"^_": True},
    }


def scenario_data(scenario: Scenario) -> dict[str, Any]:
    """Converts a scenario to plain data, the inverse of `read_scenario`."""
    return dict(scenario_reader().write(scenario))


def read_scenario(data: Mapping[str, Any]) -> Scenario:
    """Makes a scenario from plain data."""
    scenario: Scenario = scenario_reader().read(data)
    return scenario


def varied_data(data: Mapping[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    """Plain data of a scenario with other values at dotted keys."""
    varied = deepcopy(dict(data))
    for key, value in changes.items():
        scenario_reader().put(varied, key, value)
    return varied


@checked(lambda text: ScenarioError(("", text)))
def load_scenario(path: str | Path, settings: Sequence[str] = ()) -> Scenario:
    """Reads a scenario file.

    Args:
        path: The file, or the name of a shipped scenario such as "two_link_wall".
        settings: Changes "key=value" with dotted keys, for example "integrator.accuracy=1e-8" or
            "constraints.0.surface.point=[0.7, 0, 0]". Relative file names are in the folder of the
            scenario; for a shipped one, which names no such files, in the working directory.

    Raises:
        ScenarioError: There is no such file, its YAML is broken, or keys are unknown, missing or
            given twice, or values are not valid; all problems are listed, with their lines.
    """
    path = find_scenario(str(path))
    try:
        text = read_text(path, 4 * form.MOST_TEXT)
        is_shipped = path in shipped_scenarios().values()
        folder = Path().absolute() if is_shipped else path.absolute().parent
    except UnicodeDecodeError:
        raise ScenarioError((str(path), "the file is not UTF-8 text; save it as such")) from None
    except (OSError, ValueError) as error:  # It is larger.
        raise ScenarioError((str(path), getattr(error, "strerror", None) or str(error))) from None
    robot = r"\A\s*(<.*)?<(robot|sdf|mujoco)\b|^directives\s*:"
    if re.search(robot, text, re.DOTALL | re.MULTILINE):
        problem = (
            f"this is a robot, not a scenario; `drake-dae new {path}` writes a scenario with it, "
            "and in one of your own it is robot.file"
        )
        raise ScenarioError((str(path), problem))
    data, line_of = form.load_lines(text, str(path))
    data = {} if data is None else data
    if isinstance(data, dict):
        # Drake's convention: keys with an underscore are a place for anchors.
        data = {key: data[key] for key in data if key == form.TAG or not key.startswith("_")}
    changed = []
    for setting in settings:
        key, separator, value = setting.partition("=")
        if not separator:
            raise ScenarioError((f"--set {setting}", "expected key=value, for example duration=5"))
        scenario_reader().put(data, key, form.load_yaml(value, key))
        changed.append(key)

    def place_of(key: str) -> str:
        line = None if form.first_name(changed, key) is not None else line_of(key)
        return "" if line is None else f"[{path.name}:{line}]"

    return scenario_reader().read(data, folder, place_of)


def save_scenario(scenario: Scenario, path: str | Path, comment: str = "") -> None:
    """Writes what differs from defaults, after a first line "# ..." that may be empty."""
    head = f"{comment}\n" if comment else ""
    Path(path).write_text(head + form.dump_yaml(scenario_data(scenario)), encoding="utf-8")
