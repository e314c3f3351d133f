"""Parts of a scenario without a class in the library: force feedback, gains, start."""

from dataclasses import dataclass, field
from typing import ClassVar

from pydrake.systems.framework import Context

from drake_dae.arrays import positive
from drake_dae.dae.tracking.gains import GainDesign, gain_coefficients, gain_matrices, poles
from drake_dae.errors import GainError, ModelError
from drake_dae.scenario.forms.values import Numbers
from drake_dae.systems.observing.observer_rates import Observing
from drake_dae.systems.sensing.force_sensor import ForceSensor


@dataclass(frozen=True)
class ModelForce:
    """The law computes the constraint force from its model: (28)."""

    is_measured: ClassVar = False
    seed: ClassVar = 0
    gain: ClassVar = 0.0

    def sensor(self, size: int) -> ForceSensor | None:
        """None, since the force is not measured."""
        return None

    def begin(self, sensor: ForceSensor, context: Context) -> None:
        """Does nothing: there is no sensor."""


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
            per force. No law and no observer knows it; a task subtracts the bias that it finds
            within `tare_time`, and feels what the drift adds from then on.
        seed: The seed of the noise.
        gain: Gbar of (59), a number or a matrix row by row; for rigid joints only.
    """

    time_constant: float = 0.0
    sample_period: float = 0.0
    bias: Numbers = 0.0
    noise_deviation: Numbers = 0.0
    drift: Numbers = 0.0
    seed: int = 0
    gain: Numbers = 0.0
    is_measured: ClassVar = True

    def __post_init__(self) -> None:
        if not 0 <= self.seed < 2**32:
            raise ModelError(f"seed: a whole number from 0 to 2^32 - 1 is needed, got {self.seed}")

    def sensor(self, size: int) -> ForceSensor | None:
        """The sensor of m = `size` forces."""
        lags = self.time_constant, self.sample_period
        return ForceSensor(size, *lags, self.bias, self.noise_deviation, self.drift)

    def begin(self, sensor: ForceSensor, context: Context) -> None:
        """Sets the sensor's errors in its context."""
        sensor.set_errors(context, self.bias, self.noise_deviation, self.drift)


@dataclass(frozen=True)
class LargestErrors:
    """The largest rms errors by which gains are computed, see `AdvisedGains`.

    Attributes:
        position: Of a point that follows a path, in m; no bound if left out.
        force: Of a contact force, in N; no bound if left out.
    """

    position: float | None = None
    force: float | None = None

    def __post_init__(self) -> None:
        for name, most in vars(self).items():
            if most is not None:
                positive(f"largest {name} error", most)


@dataclass(frozen=True)
class Observer(Observing):
    """The settings of a `DisturbanceObserver` of model errors.

    Attributes:
        identify_friction: The names of constraints whose coefficient of friction is identified. The
            initial value is the coefficient of the constraint; write 0 if it is unknown.
    """

    identify_friction: list[str] = field(default_factory=list)


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
    """Real poles of the errors, one number or mu_i numbers per output; see also Coefficients.

    Attributes:
        all: The poles of every output, in 1/s.
        outputs: Output name -> its poles, in 1/s; "*" is all others. Only without `all`.
    """

    def design(self) -> GainDesign:
        """The design of the gains."""
        return poles(self.all or self.outputs)


@dataclass(frozen=True)
class Coefficients(PerOutput):
    """Gains K_i1, ..., K_i mu_i of (32), lowest derivative first; in 1/s^mu_i, ..., 1/s.

    Attributes:
        all: The gains of every output, in 1/s^mu_i, ..., 1/s.
        outputs: Output name -> its gains, in 1/s^mu_i, ..., 1/s; "*" is all others. Only without
            `all`.
    """

    def design(self) -> GainDesign:
        """The design of the gains."""
        return gain_coefficients(self.all or self.outputs)


@dataclass(frozen=True)
class Matrices:
    """Gains that couple outputs of equal degree; see `gain_matrices`.

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

    The constraints are those of the plant, and the outputs those of the law's model, which may
    assume another wall (`plant_parameters`): the law sees no other errors than these. If a scenario
    has `exogenous` signals, the robot starts in motion with its references.

    Attributes:
        positions: Joint name -> position near which the robot starts, in rad or m; by default that
            of the robot's file.
        errors: Output name -> z - r at the start, in the output's unit; 0 by default. Errors of
            forces are possible only if actuators have dynamics.
    """

    positions: dict[str, float] = field(default_factory=dict)
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
