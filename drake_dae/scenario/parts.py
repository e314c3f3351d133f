"""What stands below the keys of a scenario where no class of the library says it."""

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from importlib import import_module
from typing import Annotated, ClassVar, cast

import numpy as np
from numpy.typing import ArrayLike
from pydantic import Field
from pydrake.geometry import SceneGraph
from pydrake.multibody.plant import MultibodyPlant as DrakePlant
from pydrake.systems.framework import Context

from drake_dae import systems
from drake_dae.arrays import unknown_name
from drake_dae.dae import ConstraintStructure, GainDesign, gain_coefficients, gain_matrices, poles
from drake_dae.errors import DrakeDaeError, GainError, ModelError
from drake_dae.references import Reference
from drake_dae.robots import FrictionCone, RobotModel
from drake_dae.scenario.form import Positive, at, expected
from drake_dae.scenario.robot_file.reading import read_robot
from drake_dae.scenario.robot_file.robot import Payload, Robot
from drake_dae.systems import Observing, Plant, PointMaterial


@dataclass(frozen=True, kw_only=True)
class ScenarioPlant(ABC):
    """What a scenario simulates.

    Attributes:
        parameters: Parameter name -> the plant's value, unknown to the law's model; one number for
            all entries, or a list. A surface can be tilted if it has the key `rpy`.
        payloads: Additional masses on the plant, unknown to the law's model.
        disturbances: Disturbance forces on the plant, unknown to the law.
    """

    parameters: dict[str, float | list[float]] = field(default_factory=dict)
    payloads: list[Payload] = field(default_factory=list)
    disturbances: list[systems.DisturbanceForce] = field(default_factory=list)

    carries: ClassVar[bool] = False
    """Whether the plant has these itself. Else a model has the payloads and disturbances, and
    numbers are set in a context, or, if it does not adjust, the plant is made anew for each."""
    adjusts: ClassVar[bool] = True
    in_context: ClassVar[frozenset[str]] = frozenset()
    """The keys of numbers that `begin` sets in a context."""

    @property
    def material(self) -> PointMaterial | None:
        """The material of contacts that give way."""
        return None

    def begin(self, plant: Plant, context: Context) -> None:  # noqa: B027 - Nothing by default.
        """Sets the numbers of `in_context` in a context of the plant."""

    @abstractmethod
    def plant(self, model: RobotModel, structure: ConstraintStructure, robot: Robot) -> Plant:
        """The plant of a robot, with the structure of its system."""


@dataclass(frozen=True)
class IdealConstraints(ScenarioPlant):
    """The plant is a `RobotPlant`: its constraints hold exactly, and pull where they must."""

    def plant(self, model: RobotModel, structure: ConstraintStructure, robot: Robot) -> Plant:
        return systems.RobotPlant(model, structure=structure)


@dataclass(frozen=True)
class MultibodyPlant(systems.ContactMaterial, ScenarioPlant):
    """The plant is a `ContactPlant`: Drake's own contact, in a discrete MultibodyPlant.

    A ball at the tool touches the surfaces of the constraints. Where the tool tilts, it rolls, the
    farther off ideal contact the larger its radius.
    """

    carries: ClassVar[bool] = True

    @property
    def material(self) -> systems.ContactMaterial:
        return self

    def plant(self, model: RobotModel, structure: ConstraintStructure, robot: Robot) -> Plant:
        def add(plant: DrakePlant, scene_graph: SceneGraph) -> None:
            read_robot(robot, plant, scene_graph, self.payloads)

        with at("plant or plant.parameters"):
            return systems.ContactPlant(
                model,
                add,
                self,
                structure=structure,
                parameters=self.parameters,
                disturbances=self.disturbances,
            )


@dataclass(frozen=True)
class CompliantContact(PointMaterial, ScenarioPlant):
    """The plant is a `CompliantPlant`: Drake's point contact as equations of this library.

    It supports what `!MultibodyPlant` does not: surfaces of any shape, moving surfaces, exogenous
    signals, exports. It has no stops at the limits of joints. With a time_step of 0 it is
    continuous.
    """

    in_context: ClassVar = frozenset({"stiffness", "dissipation", "friction", "radius"})

    @property
    def material(self) -> PointMaterial:
        return self

    def begin(self, plant: Plant, context: Context) -> None:
        cast(systems.CompliantPlant, plant).set_contact(context, self)

    def plant(self, model: RobotModel, structure: ConstraintStructure, robot: Robot) -> Plant:
        with at("plant or plant.parameters"):  # Whose numbers are set in a context.
            return systems.CompliantPlant(model, self, structure=structure)


@dataclass(frozen=True)
class OwnPlant(ScenarioPlant):
    """The plant is your own class that follows the contract of `drake_dae.Plant`.

    It is called with the robot and its structure, as `maker(model, structure)`. Running such a
    scenario imports the module, found by PYTHONPATH, also in the processes of a sweep: use only
    files from people whose code you trust.

    Attributes:
        maker: The module and the class in it, as "my_plants:SpringyPlant".
    """

    maker: Annotated[
        str,
        Field(pattern=r"^[^:]+:[^\W\d]\w*$"),
        expected("a module and a class in it, as my_plants:SpringyPlant"),
    ]
    adjusts: ClassVar[bool] = False

    def plant(self, model: RobotModel, structure: ConstraintStructure, robot: Robot) -> Plant:
        module, _, name = self.maker.partition(":")
        with at("plant.maker"):
            try:
                plant = getattr(import_module(module), name)(model, structure)
            except DrakeDaeError:
                raise
            except Exception as error:
                what = f"{type(error).__name__}: {error}"
                raise ModelError(f"'{self.maker}' cannot be loaded and made: {what}") from error
            if not isinstance(plant, Plant):
                raise ModelError(
                    f"'{self.maker}' makes no plant that keeps the contract of drake_dae.Plant"
                )
            return plant


@dataclass(frozen=True)
class MeasuredForce:
    """The law uses the constraint force that a `ForceSensor` measures: (59), (71), (81).

    Attributes:
        time_constant: The time constant of the sensor's lag, in s; 0 for none.
        sample_period: The time between samples, in s; 0 for none.
        bias: A constant error in N or N m, one number for all forces or one per force.
        noise_deviation: The standard deviation of the noise in N or N m, one number for all forces
            or one per force.
        drift: The rate at which the bias changes, in N/s or N m/s, one number for all forces or one
            per force; nothing estimates it.
        seed: The seed of the noise.
    """

    time_constant: float = 0.0
    sample_period: float = 0.0
    bias: ArrayLike = 0.0
    noise_deviation: ArrayLike = 0.0
    drift: ArrayLike = 0.0
    seed: Annotated[int, Field(ge=0, lt=2**32)] = 0


@dataclass(frozen=True)
class Sensors:
    """What the law measures; it knows exactly what no sensor measures.

    Attributes:
        encoders: The measurement of positions and velocities, with `sampling`.
        force: The measurement of the constraint force, in place of that of the law's model.
    """

    encoders: systems.Encoders | None = None
    force: MeasuredForce | None = None

    @property
    def force_noise(self) -> float:
        """The largest standard deviation of the noise of the measured force, in N or N m."""
        return 0.0 if self.force is None else float(np.asarray(self.force.noise_deviation).max())


@dataclass(frozen=True)
class LargestErrors:
    """The largest rms errors by which gains are computed, see `AdvisedGains`.

    Attributes:
        position: Of a point that follows a path, in m; no bound if left out.
        force: Of a contact force, in N; no bound if left out.
    """

    position: Positive | None = None
    force: Positive | None = None


@dataclass(frozen=True)
class Estimator(Observing):
    """The settings of a `StateEstimator` of model errors.

    Attributes:
        rate: k_o in 1/s, the rate of disturbances along the free directions; it is computed with
            the gains if it is left out.
        parameters: Names of parameters that are estimated while the robot moves: coefficients of
            friction of contacts, as "wall.friction", whose initial value is that of the constraint
            (write 0 if it is unknown); and, each with a standard deviation and within `bounds`,
            masses and places of payloads, friction of joints, "wall.rpy" of a surface. If they are
            left out, on contact that gives way: where all surfaces are planes, the joints rigid
            and velocities measured (no `state_rate`): friction of contacts and joints, places
            (within 10 mm) and tilts of planes, and the mass of a load "<frame>_load" at each
            contact; elsewhere friction of contacts, if gains are computed.
    """

    rate: float | None = None  # type: ignore[assignment]
    parameters: list[str] | None = None
    ranges: dict[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.rate is not None:
            super().__post_init__()


@dataclass(frozen=True)
class PerOutput:
    """Numbers for all outputs, or for each output.

    Attributes:
        all: The numbers for every output.
        outputs: Output name -> its numbers; "*" is all others. Only without `all`.
    """

    all: list[float] = field(default_factory=list)
    outputs: dict[str, list[float]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.all and self.outputs:
            raise GainError("give either 'all' or 'outputs', not both")


@dataclass(frozen=True)
class Poles(PerOutput):
    """Real poles of the errors in 1/s, one number or mu_i per output; see also Coefficients."""

    def design(self) -> GainDesign:
        return poles(self.all or self.outputs)


@dataclass(frozen=True)
class Coefficients(PerOutput):
    """Gains K_i1, ..., K_i mu_i of (32), lowest derivative first; in 1/s^mu_i, ..., 1/s."""

    def design(self) -> GainDesign:
        return gain_coefficients(self.all or self.outputs)


@dataclass(frozen=True)
class Matrices:
    """Gains that couple outputs of equal degree; see `gain_matrices`.

    Attributes:
        groups: For each degree mu, highest first, its Lambda_1, ..., Lambda_mu, each row by row,
            in 1/s^mu, ..., 1/s.
    """

    groups: list[list[list[list[float]]]]

    def design(self) -> GainDesign:
        return gain_matrices(*self.groups)


Gains = Poles | Coefficients | Matrices


@dataclass(frozen=True)
class Law:
    """The tracking law (28).

    Attributes:
        gains: Its gains. If they are left out: poles at -4 1/s with ideal constraints. With contact
            that gives way gains are computed, together with `integral`, `constraint_damping`,
            `estimator` and `sensors.force` if these are left out; the scenario in the folder of the
            run contains them; not with `actuation`.
        integral: Names of outputs whose errors are integrated as well, with one more pole:
            positions, and forces if `sensors.force` measures them; none if left out while `gains`
            are given.
        constraint_damping: Damping of compliant constraints by the law, written as gains, with r_i
            - 1 poles per constraint; none if left out while `gains` are given.
        contact_stiffness: The stiffness of compliant contacts in N/m, if it is known and references
            of forces change within periods of the contact: its deflection is then fed ahead. It
            needs rigid joints, and references, no task.
        force_gain: Gbar of (59), 0 or more, with `sensors.force`; for rigid joints only.
        control_weights: One weight per actuator, if there are more actuators than outputs. The law
            then chooses the control with the least sum of weight * (u - free_control)^2. The
            parameter "free_control" is zero unless it is in `exogenous`.
        largest_roughness: The largest permitted rms change of the controls from sample to sample by
            the noise of encoders, over all joints, in N m, for computed gains; if left out 0.3 % of
            the largest effort limit, or 1 N m without limits.
        largest_errors: The largest permitted errors for computed gains: those are then the
            smoothest ones within them, and without a bound the ones with the least errors.
    """

    gains: Gains | None = None
    integral: list[str] | None = None
    constraint_damping: Gains | None = None
    contact_stiffness: float | None = None
    force_gain: float = 0.0
    control_weights: list[float] = field(default_factory=list)
    largest_roughness: Positive | None = None
    largest_errors: LargestErrors | None = None


@dataclass(frozen=True)
class ScenarioTask:
    """A sequence of phases, in place of `references`.

    It starts at rest at start.positions, or in contact near them if the first phase requires
    contact. Without start.positions it starts 20 mm before the surface, with the first reference of
    each output. While the contact is open, its distance, such as "wall.distance", is an output in
    place of its force. `plant` has a contact that opens, such as `!CompliantContact`.

    Attributes:
        phases: The phases in their order; after the last one the robot rests.
        contact: The name of the constraint that opens and closes; not needed if there is only one.
        contact_force: The force in N below which the contact counts as open.
        patience: The time in s after which a contact without force counts as lost.
        tare_time: The time in s at the beginning for which a task without contact measures the bias
            of the force sensor. No phase ends before, and the bias is subtracted afterwards. 0 for
            no taring.
        retries: How many times a phase may be entered again, where it does not say it itself.
        signals: Name -> reference of a signal that conditions of phases watch.
        gains: The gains of the law without contact, with the distance among its outputs; those of
            `law.gains` if left out.
    """

    phases: Sequence[systems.Phase]
    contact: str = ""
    contact_force: float = 0.5
    patience: float = 0.25
    tare_time: float = 0.0
    retries: int = 10
    signals: Mapping[str, Reference | float] = field(default_factory=dict)
    gains: Gains | None = None

    def __post_init__(self) -> None:
        signals = self.make().watched("signal")
        for name in self.signals:
            if name not in signals:
                text = unknown_name("signal of a condition", name, signals)
                raise ModelError(f"signals: {text}")

    def make(self, force_noise: float = 0.0) -> systems.Task:
        """The `Task` of these phases, for a standard deviation of the force sensor's noise in N."""
        limits = self.contact_force, self.patience, force_noise, self.tare_time, self.retries
        return systems.Task(tuple(self.phases), *limits)


@dataclass(frozen=True)
class Judgement:
    """What counts in the verdict of a run.

    Attributes:
        tolerances: Output name -> the tolerated error in its unit; null if its error does not
            count, as for joints that complete the outputs. For others it is 1 % of the
            range of the references in their unit.
        friction_cones: Contacts that must not slide, such as grips: `analyze` and the verdict say
            where their forces leave these cones.
        may_diverge: Whether a run continues when its errors or states diverge; otherwise it ends
            with the reason.
    """

    tolerances: dict[str, Positive | None] = field(default_factory=dict)
    friction_cones: list[FrictionCone] = field(default_factory=list)
    may_diverge: bool = False


@dataclass(frozen=True)
class Start:
    """A start at rest, on the constraints, with given errors of the outputs.

    The constraints are those of the plant, and the outputs those of the law's model, which may
    assume another wall (`plant.parameters`): the law sees no other errors than these. If a scenario
    has `exogenous` signals, the robot starts in motion with its references.

    Attributes:
        positions: Joint name -> position near which the robot starts, in rad or m; by default that
            of the robot's file.
        velocities: Velocity name -> its value in rad/s or m/s, for a start in motion; the others
            follow from the constraints.
        errors: Output name -> z - r at the start, in the output's unit; 0 by default. Errors of
            forces are possible only if actuators have dynamics.
    """

    positions: dict[str, float] = field(default_factory=dict)
    velocities: dict[str, float] = field(default_factory=dict)
    errors: dict[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class Write:
    """The files that a run writes, besides the scenario and the summary.

    Attributes:
        record: Whether it writes record.npz, all signals at all times.
        plots: Whether it writes plots, as `drake-dae plot FOLDER --all` does at any later time.
            Drawing takes about as long as all else of a short run.
        animation: Whether it writes animation.html, which plays in a browser.
    """

    record: bool = True
    plots: bool = False
    animation: bool = True
