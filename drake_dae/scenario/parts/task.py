"""A task in a scenario: phases in place of references."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Annotated

from drake_dae.arrays import positive, unknown_name
from drake_dae.dae.references import Reference
from drake_dae.errors import ModelError
from drake_dae.scenario.forms.forms import Choice, Form
from drake_dae.scenario.parts.parts import Coefficients, Matrices, Poles
from drake_dae.systems.task.phases import Phase
from drake_dae.systems.task.phases.plan import named
from drake_dae.systems.task.task import Task


@dataclass(frozen=True)
class WithinLimits:
    """Phases are slowed down until the law's model of the task keeps the limits of the robot.

    Before the run the task is run by the law's model, as `drake-dae analyze` does, and each phase
    that exceeds a limit gets a `pace` below 1; one that keeps them all keeps its pace.

    Attributes:
        efforts: The fraction of the drives' effort limits that phases may use; the rest is left for
            feedback.
        joint_speeds: The fraction of the joints' velocity limits that phases may use.
    """

    efforts: float = 0.95
    joint_speeds: float = 0.95

    def __post_init__(self) -> None:
        for name in ("efforts", "joint_speeds"):
            if not 0.0 < getattr(self, name) <= 1.0:
                raise ModelError(
                    f"{name} is a fraction of the robot's own limits, above 0 and at most 1, got "
                    f"{getattr(self, name):g}"
                )


@dataclass(frozen=True)
class ScenarioTask:
    """A sequence of phases, in place of `references`.

    It starts at rest at start.positions, or in contact near them if the first phase requires
    contact. Without start.positions it starts 20 mm before the surface, with the first reference of
    each output. While the contact is open, its distance, such as "wall.distance", is an output in
    place of its force, and each distance of a face. With ideal constraints in `plant` the contact
    opens and closes without bouncing.

    Attributes:
        phases: The phases in their order; after the last one the robot rests.
        contact: The name of the constraint that opens and closes; not needed if there is only one.
            Or the list of the points of a face, whose force and moments are outputs by
            `!FaceForces`. Left out where the phases name the latches that they open and close.
        contact_force: The force in N below which the contact counts as open.
        patience: The time in s after which a contact without force counts as lost.
        tare_time: The time in s at the beginning for which a task without contact measures the bias
            of the force sensor. No phase ends before, and the bias is subtracted afterwards. 0 for
            no taring.
        retries: How many times phases may return to the approach; then the run ends with an error.
        signals: Name -> reference of a signal for which a phase waits. The signal is set where the
            reference is above 1/2.
        pace: Name of a phase -> the multiple of its speed at which it moves: it passes through the
            same values, with a longer `over`, a lower `speed`, and slower references. 1 if left
            out.
        within_limits: Slows phases down until they keep the limits of drives and joints; the
            scenario in the folder of the run has the result as `pace`. No phase is slowed down if
            left out.
        gains: The gains of the law without contact, with the distance among its outputs; those of
            `gains` if left out.
    """

    phases: Sequence[Phase]
    contact: str | Sequence[str] = ""
    contact_force: float = 0.5
    patience: float = 0.25
    tare_time: float = 0.0
    retries: int = 10
    signals: Mapping[str, Reference | float] = field(default_factory=dict)
    pace: Mapping[str, float] = field(default_factory=dict)
    within_limits: Annotated[WithinLimits, Form()] | None = None
    gains: Annotated[Poles | Coefficients | Matrices, Choice()] | None = None

    def __post_init__(self) -> None:
        signals = self.make().signals
        for name in self.signals:
            if name not in signals:
                text = unknown_name("phase that waits for the signal", name, signals)
                raise ModelError(f"signals: {text}")

    def make(self, force_noise: float = 0.0) -> Task:
        """Makes the `Task` of these phases.

        Args:
            force_noise: The standard deviation of the force sensor's noise in N.

        Raises:
            ModelError: The phases are not consistent.
        """
        phases = {phase.name: phase for phase in named(self.phases)}
        for name, pace in self.pace.items():
            if name not in phases:
                raise ModelError(f"pace: {unknown_name('phase', name, phases)}")
            phases[name] = phases[name].at_pace(positive(f"pace: {name}", pace))
        limits = self.contact_force, self.patience, force_noise, self.tare_time, self.retries
        return Task(tuple(phases.values()), *limits)
