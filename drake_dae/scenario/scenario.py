"""The form of a scenario: a robot in contact, its task, and its simulation.

A scenario is YAML. The library's dataclasses are written with their fields as keys; a choice
between several classes is written with the name as a tag, for example `surface: !Sphere`.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

from pydantic import AfterValidator
from pydrake.systems.analysis import SimulatorConfig

from drake_dae.arguments import checked
from drake_dae.arrays import listed
from drake_dae.errors import ModelError
from drake_dae.scenario import plants
from drake_dae.scenario.forms.forms import Form
from drake_dae.scenario.forms.problems import without_tags
from drake_dae.scenario.forms.reader import Reader
from drake_dae.scenario.forms.values import Interval
from drake_dae.scenario.parts import parts as parts
from drake_dae.scenario.parts.families import (
    Constraint,
    DisturbanceForce,
    Encoders,
    Force,
    ForceOutput,
    FrictionCone,
    Gains,
    LargestErrors,
    Load,
    Observer,
    Output,
    Payload,
    Plant,
    Reference,
    Sampling,
    Stage,
    Task,
)
from drake_dae.scenario.robot_file.robot import Robot
from drake_dae.simulation.simulate import check_config, check_duration
from drake_dae.trace.compiled import Compiled

T = TypeVar("T")


def _checked(check: Callable[[T], None]) -> Callable[[T], T]:
    """The check as a function that returns its argument, as pydantic needs it."""

    def checked(value: T) -> T:
        check(value)
        return value

    return checked


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
    """A robot in contact, its references or task, and its simulation.

    Attributes:
        description: One line for `drake-dae list`.
        robot: The robot's file, with additions: which frames are welded or free, which joints are
            locked or driven.
        constraints: The constraints; one without a tag is a PointOnSurface. Constraints in the
            robot's file, such as mimic joints, are appended.
        outputs: Position outputs; the force outputs follow them. If there are fewer than actuators
            minus force outputs, they are completed: see `complete_scenario`.
        tool_axis: The direction of the tool's axis in completed outputs: normal to the surface,
            fixed in the world, or free.
        forces: The force outputs: names of constraint forces, and combinations of forces by tags;
            all constraint forces if left out. Leave out forces that are not to be controlled, such
            as those of wheels and mimic joints; [] is none.
        control_weights: One weight per actuator, if there are more actuators than outputs. The law
            then chooses the control with the least sum of weight * (u - free_control)^2. The
            parameter "free_control" is zero unless it is in `exogenous`.
        actuation: Stages from the joints toward the motor; none for rigid joints.
        force_feedback: Whether the law uses its model's force or a measured one.
        parameters: Parameter name -> its value for law and plant, in place of that of the robot's
            file, a constraint or a stage; one number for all entries, or a list.
        plant_parameters: Parameter name -> the plant's value, unknown to the law's model; one
            number for all entries, or a list. A surface can be tilted if it has the key `rpy`.
        plant_payloads: Additional masses on the plant, unknown to the law's model.
        plant_disturbances: Disturbance forces on the plant, unknown to the law.
        known_forces: Known forces on frames; "<name>.force" is zero unless it is in `exogenous` or
            `plant_parameters`. And friction of joints.
        exogenous: Parameter name -> references of its entries, known to plant and law;
            "wall.position" for example.
        bounds: Parameter name -> its lowest and highest value, for example of "wall.position"; a
            number, or one per entry. Relative degrees are checked for all values within bounds; if
            both bounds are equal, the value is fixed. Bounds do not restrict a run, only values
            that are `identified`.
        friction_cones: Contacts that must not slide, such as grips: `analyze` and the verdict of a
            run say where their forces leave these cones.
        compliances: Constraint force -> its relative compliance, for redundant constraints: their
            forces are shared by least squares. {} is equal compliances; if left out, constraints
            must not be redundant.
        contact_stiffness: The stiffness of compliant contacts in N/m, if it is known and references
            of forces change within periods of the contact: its deflection is then fed ahead. It
            needs rigid joints, and references, no task.
        gains: The gains of the tracking law (28). If left out: poles at -4 1/s with ideal
            constraints. With Drake's own contact gains are computed, see `advised`, together with
            `integral`, `constraint_damping`, `observer` and measured force if these are left out;
            the scenario in the folder of the run contains them; not with `actuation`.
        integral: Names of outputs whose errors are integrated as well, with one more pole:
            positions, and forces if `force_feedback` is measured; none if left out while `gains`
            are given.
        constraint_damping: Damping of compliant constraints by the law, written as gains, with r_i
            - 1 poles per constraint; none if left out while `gains` are given.
        observer: The observer of a disturbance and of coefficients of friction, for a sampled law
            with measured `force_feedback`; none if left out while `gains` are given.
        identified: Names of parameters that the observer estimates while the robot moves, each with
            a standard deviation, within `bounds`: masses and places of payloads, friction of
            joints, "wall.rpy" of a surface.
        largest_roughness: The largest permitted rms change of the controls from sample to sample by
            the noise of `encoders`, over all joints, in N m, for computed gains; if left out 0.3 %
            of the largest effort limit, or 1 N m without limits.
        largest_errors: The largest permitted errors for computed gains: those are then the
            smoothest ones within them, and without a bound the ones with the least errors.
        plant: The plant: ideal constraints, contact that gives way, or Drake's own contact in a
            discrete MultibodyPlant with the surfaces as geometry.
        sampling: The period and the delay of the law, in s; continuous if left out.
        encoders: The measurement of positions and velocities for the law, with `sampling`; exact if
            left out.
        saturation: Whether controls are limited to the effort limits of the robot's file.
        tolerances: Output name -> the error in its unit that the verdict of a run tolerates. For
            others it is 1 % of the range of the references in their unit.
        may_diverge: Whether a run continues when its errors or states diverge; otherwise it ends
            with the reason.
        references: Name -> reference; a number is a constant. A name is that of an output, tool.y;
            of several, tool for all tool.x, tool.y, ..., or tool.yz; or a list, "tool.y, elbow".
            Completed outputs without a reference keep their initial value.
        task: A sequence of phases with opening and closing contact, in place of references.
        start: The start; without positions it is computed (not for a task).
        duration: The duration of the run, in s.
        integrator: Drake's SimulatorConfig; the run starts at its start_time.
        write: The files that the run writes into its folder.
        compiled: Whether functions are compiled to machine code, if there is a C compiler: true,
            false or auto, which uses the cache and compiles functions for which it pays.
    """

    description: str = field(default="", kw_only=True)
    robot: Robot
    constraints: list[Constraint] = field(default_factory=list)
    outputs: list[Output] = field(default_factory=list)
    tool_axis: Literal["normal", "fixed", "free"] = "normal"
    forces: list[ForceOutput] | None = None
    control_weights: list[float] = field(default_factory=list)
    actuation: list[Stage] = field(default_factory=list)
    force_feedback: Force = field(default_factory=parts.ModelForce)
    parameters: dict[str, float | list[float]] = field(default_factory=dict)
    plant_parameters: dict[str, float | list[float]] = field(default_factory=dict)
    plant_payloads: list[Payload] = field(default_factory=list)
    plant_disturbances: list[DisturbanceForce] = field(default_factory=list)
    known_forces: list[Load] = field(default_factory=list)
    exogenous: dict[str, list[Reference]] = field(default_factory=dict)
    bounds: dict[str, Interval] = field(default_factory=dict)
    friction_cones: list[FrictionCone] = field(default_factory=list)
    compliances: dict[str, float] | None = None
    contact_stiffness: float | None = None
    gains: Gains | None = None
    integral: list[str] | None = None
    constraint_damping: Gains | None = None
    observer: Observer | None = None
    identified: list[str] = field(default_factory=list)
    largest_roughness: float | None = None
    largest_errors: LargestErrors | None = None
    plant: Plant = field(default_factory=plants.IdealConstraints)
    sampling: Sampling | None = None
    encoders: Encoders | None = None
    saturation: bool = False
    tolerances: dict[str, float] = field(default_factory=dict)
    may_diverge: bool = False
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
        """Whether the gains are left out and will be computed."""
        return self.gains is None and self.plant.material is not None

    def __repr__(self) -> str:
        names = listed(constraint.name for constraint in self.constraints)
        file = Path(self.robot.file).name
        return (
            f"Scenario('{self.description}', robot='{file}', constraints={names}, "
            f"duration={self.duration:g} s)"
        )

    def __eq__(self, other: object) -> bool:
        # Arrays and Drake's SimulatorConfig cannot be compared directly.
        return isinstance(other, Scenario) and scenario_reader().write(
            self
        ) == scenario_reader().write(other)


@cache
def scenario_reader(keys: tuple[str, ...] = ()) -> Reader[Scenario]:
    """The reader and writer of scenarios as plain data, of some keys or of all."""
    return Reader(Scenario, keys)


@checked(ModelError)
def scenario_schema(tags: bool = True) -> dict[str, Any]:
    """The JSON Schema of a scenario as plain data.

    Args:
        tags: Whether the data have tags as entries "_tag", as for `read_scenario`. Without tags, as
            from a plain reader of YAML or an editor, any form of a family fits.
    """
    schema = scenario_reader().schema
    return schema if tags else dict(without_tags(schema))


def scenario_data(scenario: Scenario, keys: tuple[str, ...] = ()) -> dict[str, Any]:
    """Converts a scenario to plain data, the inverse of `read_scenario`.

    Args:
        scenario: The scenario.
        keys: The keys that are needed, which takes less time than all; all if empty.
    """
    return dict(scenario_reader(keys).write(scenario))


def read_scenario(data: Mapping[str, Any], folder: Path | None = None) -> Scenario:
    """Makes a scenario from plain data, with the paths of its robot unchanged.

    Args:
        data: Plain data.
        folder: The folder of relative file names; None for the working directory.

    Raises:
        ScenarioError: Keys are unknown or missing, or values are not valid; all problems are
            listed.
    """
    return scenario_reader().read(data, folder)
