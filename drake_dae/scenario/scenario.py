"""The form of a scenario: a robot in contact, what it shall do, and how to simulate it.

A scenario is YAML. What the library has as a dataclass is written with the keys of that dataclass;
a choice between several is written with the name as a tag, for example `surface: !Sphere`.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

from pydantic import AfterValidator
from pydrake.systems.analysis import SimulatorConfig

from drake_dae.arrays import listed
from drake_dae.scenario import plants
from drake_dae.scenario.forms.forms import Form
from drake_dae.scenario.forms.problems import without_tags
from drake_dae.scenario.forms.reader import Reader
from drake_dae.scenario.forms.values import Interval
from drake_dae.scenario.parts import parts as parts
from drake_dae.scenario.parts.families import (
    Constraint,
    Encoders,
    Force,
    ForceOutput,
    Gains,
    Load,
    Observer,
    Output,
    Payload,
    Plant,
    Push,
    Reference,
    Sampling,
    Stage,
    Task,
    Tolerances,
)
from drake_dae.scenario.robot_file.robot import Robot
from drake_dae.simulation.simulate import check_config, check_duration
from drake_dae.trace.compiled import Compiled

T = TypeVar("T")


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
        bounds: Parameter name -> its lowest and its highest value, between which it stays, in this
            run and in every other: "wall.position" for example, each a number or one for each
            entry. Relative degrees are looked at for all such values; bounds of one value hold it.
            They restrict no run.
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
        may_diverge: Whether a run goes on whose errors or states leave all measure; otherwise it
            ends there, with what grew.
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
    robot: Robot
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
    bounds: dict[str, Interval] = field(default_factory=dict)
    compliances: dict[str, float] | None = None
    gains: Gains | None = None
    integral: list[str] | None = None
    constraint_damping: Gains | None = None
    observer: Observer | None = None
    plant: Plant = field(default_factory=plants.IdealConstraints)
    sampling: Sampling | None = None
    encoders: Encoders | None = None
    saturation: bool = False
    tolerances: Tolerances | None = None
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
        """Whether the gains are left to be advised."""
        return self.gains is None and self.plant.material is not None

    def __repr__(self) -> str:
        names = listed(constraint.name for constraint in self.constraints)
        file = Path(self.robot.file).name
        return (
            f"Scenario('{self.description}', robot='{file}', constraints={names}, "
            f"duration={self.duration:g} s)"
        )

    def __eq__(self, other: object) -> bool:
        # Arrays, and Drake's SimulatorConfig, do not compare as a whole.
        return isinstance(other, Scenario) and scenario_reader().write(
            self
        ) == scenario_reader().write(other)


@cache
def scenario_reader() -> Reader[Scenario]:
    """What reads scenarios from plain data, and writes them as such."""
    return Reader(Scenario)


def scenario_schema(tags: bool = True) -> dict[str, Any]:
    """The JSON Schema of a scenario as plain data.

    Args:
        tags: Whether the data have tags as entries "_tag", as those of `read_scenario` do. Without,
            it is for data that have none, as a plain reader of YAML or an editor gives them: any
            form fits where a tag chooses.
    """
    schema = scenario_reader().schema
    return schema if tags else dict(without_tags(schema))


def scenario_data(scenario: Scenario) -> dict[str, Any]:
    """A scenario as plain data, of which `read_scenario` makes the same."""
    return dict(scenario_reader().write(scenario))


def read_scenario(data: Mapping[str, Any], folder: Path | None = None) -> Scenario:
    """The scenario that plain data describe, the paths of its robot as they are.

    Args:
        data: Plain data.
        folder: Where the names of other files start; None for the working directory.

    Raises:
        ScenarioError: Keys are unknown or missing, or values cannot be used; all are told at once.
    """
    return scenario_reader().read(data, folder)
