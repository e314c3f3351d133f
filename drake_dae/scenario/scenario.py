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
    Estimator,
    ForceOutput,
    Judgement,
    Law,
    Output,
    Plant,
    Reference,
    Sampling,
    Sensors,
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
            locked or driven, known payloads and forces.
        constraints: The constraints; one without a tag is a PointOnSurface. Constraints in the
            robot's file, such as mimic joints, are appended.
        compliances: Constraint force -> its relative compliance, for redundant constraints: their
            forces are shared by least squares. {} is equal compliances; if left out, constraints
            must not be redundant.
        outputs: Position outputs; the force outputs follow them. If there are fewer than actuators
            minus force outputs, they are completed: see `complete_scenario`.
        tool_axis: The direction of the tool's axis in completed outputs: normal to the surface,
            fixed in the world, or free.
        forces: The force outputs: names of constraint forces, and combinations of forces by tags;
            all constraint forces if left out. Leave out forces that are not to be controlled, such
            as those of wheels and mimic joints; [] is none.
        actuation: Stages from the joints toward the motor; none for rigid joints.
        parameters: Parameter name -> its value for law and plant, in place of that of the robot's
            file, a constraint or a stage; one number for all entries, or a list.
        bounds: Parameter name -> its lowest and highest value, for example of "wall.position"; a
            number, or one per entry. Relative degrees are checked for all values within bounds; if
            both bounds are equal, the value is fixed. Bounds do not restrict a run, only values
            that `estimator.identify` names.
        exogenous: Parameter name -> references of its entries, known to plant and law;
            "wall.position" for example.
        plant: The plant: ideal constraints, contact that gives way, or Drake's own contact in a
            discrete MultibodyPlant with the surfaces as geometry. And how it differs from the law's
            model.
        law: The tracking law: its gains, or what computed gains must keep.
        sampling: The period and the delay of the law, in s; continuous if left out.
        sensors: What the law measures: the state by encoders, the force by a sensor.
        estimator: The estimator of a disturbance and of parameters, for a sampled law with measured
            force; none if left out while `law.gains` are given.
        saturation: Whether controls are limited to the effort limits of the robot's file.
        judgement: What counts in the verdict of a run.
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
    compliances: dict[str, float] | None = None
    outputs: list[Output] = field(default_factory=list)
    tool_axis: Literal["normal", "fixed", "free"] = "normal"
    forces: list[ForceOutput] | None = None
    actuation: list[Stage] = field(default_factory=list)
    parameters: dict[str, float | list[float]] = field(default_factory=dict)
    bounds: dict[str, Interval] = field(default_factory=dict)
    exogenous: dict[str, list[Reference]] = field(default_factory=dict)
    plant: Plant = field(default_factory=plants.IdealConstraints)
    law: Law = field(default_factory=parts.Law)
    sampling: Sampling | None = None
    sensors: Sensors = field(default_factory=parts.Sensors)
    estimator: Estimator | None = None
    saturation: bool = False
    judgement: Judgement = field(default_factory=parts.Judgement)
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

    @property
    def is_advised(self) -> bool:
        """Whether the gains are left out and will be computed."""
        return self.law.gains is None and self.plant.material is not None

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
