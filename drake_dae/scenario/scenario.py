"""The form of a scenario: a robot in contact, its task, and its simulation.

A scenario is YAML. The library's dataclasses are written with their fields as keys; a choice
between several classes is written with the name as a tag, for example `surface: !Sphere`.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import AfterValidator
from pydrake.systems.analysis import SimulatorConfig

from drake_dae.arrays import listed
from drake_dae.references import Reference
from drake_dae.robots import ForceOutput, Stage
from drake_dae.running.simulate import check_config, check_duration
from drake_dae.scenario.forms import values
from drake_dae.scenario.forms.forms import Reader
from drake_dae.scenario.parts.families import CONFIG, FAMILIES, KEYS, VALUES
from drake_dae.scenario.parts.parts import Estimator, Judgement, Law, Sensors, Start, Write
from drake_dae.scenario.parts.task import ScenarioTask
from drake_dae.scenario.parts.written import WrittenConstraint, WrittenOutput
from drake_dae.scenario.plants import IdealConstraints, ScenarioPlant
from drake_dae.scenario.robot_file.robot import Robot
from drake_dae.systems.control.sampling import Sampling
from drake_dae.trace.compiled import Compiled


def _duration(duration: float) -> float:
    check_duration(duration)
    return duration


def _config(config: SimulatorConfig) -> SimulatorConfig:
    check_config(config)
    return config


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
        judgement: Tolerances and friction cones for the verdict of a run.
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
    constraints: list[WrittenConstraint] = field(default_factory=list)
    compliances: dict[str, float] | None = None
    outputs: list[WrittenOutput] = field(default_factory=list)
    tool_axis: Literal["normal", "fixed", "free"] = "normal"
    forces: list[str | ForceOutput] | None = None
    actuation: list[Stage] = field(default_factory=list)
    parameters: dict[str, float | list[float]] = field(default_factory=dict)
    bounds: dict[str, Annotated[Any, values.INTERVAL]] = field(default_factory=dict)
    exogenous: dict[str, list[Reference | float]] = field(default_factory=dict)
    plant: ScenarioPlant = field(default_factory=IdealConstraints)
    law: Law = field(default_factory=Law)
    sampling: Sampling | None = None
    sensors: Sensors = field(default_factory=Sensors)
    estimator: Estimator | None = None
    saturation: bool = False
    judgement: Judgement = field(default_factory=Judgement)
    references: dict[str, Reference | float] = field(default_factory=dict)
    task: ScenarioTask | None = None
    start: Start = field(default_factory=Start)
    duration: Annotated[float, AfterValidator(_duration)] = 10.0
    integrator: Annotated[SimulatorConfig, AfterValidator(_config)] = field(
        default_factory=lambda: SimulatorConfig(**CONFIG)
    )
    write: Write = field(default_factory=Write)
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
        return isinstance(other, Scenario) and scenario_data(self) == scenario_data(other)


@cache
def scenario_reader() -> Reader[Scenario]:
    """The reader and writer of scenarios as plain data."""
    return Reader(Scenario, FAMILIES, VALUES, KEYS)


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


def read_scenario(data: Mapping[str, Any], folder: Path | None = None) -> Scenario:
    """Makes a scenario from plain data.

    Args:
        data: Plain data.
        folder: The folder of relative file names; None for the working directory.

    Raises:
        ScenarioError: Keys are unknown or missing, or values are not valid; all problems are
            listed.
    """
    return scenario_reader().read(data, folder)
