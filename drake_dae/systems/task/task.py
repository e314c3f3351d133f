"""A task: phases in a valid order."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from math import ceil, inf

from drake_dae.arguments import checked
from drake_dae.arrays import positive
from drake_dae.errors import ModelError
from drake_dae.systems.task.phases import Phase
from drake_dae.systems.task.phases.condition import Watched
from drake_dae.systems.task.phases.plan import PhasePlan, check_forces, named

_STEADY = 6.0
"""The least `contact_force` in standard deviations of the filtered noise: one sample in 1e9 exceeds
it."""

_STRONGEST = 10.0
"""The largest factor by which the low-pass reduces noise; its time constant is then 50 samples."""


@checked(ModelError)
@dataclass(frozen=True)
class Task:
    """Phases in order, or in the order that they choose; after the last one the robot rests.

    If it rests in contact and the contact is lost, the law of the free robot keeps it at rest.

    Attributes:
        phases: The phases, with distinct names. If the first one begins in contact, its force
            starts at `contact_force`.
        contact_force: Forces below this, in N, count as zero: at this force the robot has touched,
            and below it the contact is open.
        patience: How long the force may be below `contact_force` before a contact that a phase
            holds counts as lost, in s; a compliant contact may bounce at first.
        force_noise: The standard deviation of the force sensor's noise, in N; 0 without noise. For
            guards the force passes a low-pass, after which the standard deviation is at most a
            sixth of `contact_force`, so that noise does not count as a touch.
        tare_time: The time in s at the start of a task that starts free, over which the mean of the
            measured force is taken as the sensor's bias. No phase ends before; then the bias is
            subtracted for guards, laws and observers. 0 for no taring.
        retries: How many times a task may go back by "approach"; then the run ends with an error.
        plan: The order of the phases.

    Raises:
        ModelError: There are no phases; one begins in contact although the one before does not end
            in contact, or the other way round; a successor is not a phase, or the task may not end;
            or a number is not valid.
    """

    phases: Sequence[Phase]
    contact_force: float = 0.5
    patience: float = 0.25
    force_noise: float = 0.0
    tare_time: float = 0.0
    retries: int = 10
    plan: PhasePlan = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        positive("contact_force", self.contact_force)
        positive("patience", self.patience)
        for name in ("force_noise", "tare_time"):
            if not 0.0 <= getattr(self, name) < inf:
                raise ModelError(f"{name} must be 0 or more, got {getattr(self, name):g}")
        if self.retries < 0:
            raise ModelError(f"retries must be 0 or more, got {self.retries}")
        least = self.force_noise * _STEADY / _STRONGEST
        if self.contact_force < least:
            raise ModelError(
                f"contact_force: noise of {self.force_noise:g} N hides a force of "
                f"{self.contact_force:g} N; it must be {least:.2g} N or more"
            )
        object.__setattr__(self, "phases", tuple(self.phases))
        if not self.phases:
            raise ModelError("a task needs phases, such as Approach(0.05), Press(20.0), Release()")
        if self.tare_time and self.phases[0].begins_in_contact:
            raise ModelError("tare_time: a task that begins in contact finds no bias; leave it out")
        phases = named(self.phases)
        check_forces(phases, self.contact_force)
        plan = PhasePlan(phases, self.retries)
        object.__setattr__(self, "phases", phases)
        object.__setattr__(self, "plan", plan)

    @property
    def force_gain(self) -> float:
        """The gain of the low-pass of the force, y += gain (F - y) at each sample, from 0 to 1.

        Its output has gain / (2 - gain) of the variance of white noise.
        """
        if not self.force_noise:
            return 1.0
        kept = min((self.contact_force / (_STEADY * self.force_noise)) ** 2, 1.0)
        return 2.0 * kept / (1.0 + kept)

    def tare_samples(self, sample_period: float) -> int:
        """The number of samples in the mean for the bias of the force; 0 without a tare_time.

        Args:
            sample_period: The sample period, in s.

        Raises:
            ModelError: There are so few samples that the noise of their mean may count as a touch.
        """
        if not self.tare_time:
            return 0
        count = ceil(self.tare_time / sample_period - 1e-9)
        needed = ceil((_STEADY * self.force_noise / self.contact_force) ** 2)
        if count < needed:
            raise ModelError(
                f"tare_time: a mean over {self.tare_time:g} s keeps too much of the force sensor's "
                f"noise of {self.force_noise:g} N; it must be {needed * sample_period:g} s or more"
            )
        return count

    @property
    def contacts(self) -> tuple[bool, ...]:
        """Whether each phase begins in contact, and whether the robot rests in contact at last."""
        return self.plan.contacts

    @property
    def signals(self) -> tuple[str, ...]:
        """The names of the signals that its phases watch."""
        return self._watched("signal")

    @property
    def controls(self) -> tuple[str, ...]:
        """The names of the controls that its phases watch; "" for the largest."""
        return self._watched("control")

    def _watched(self, of: Watched) -> tuple[str, ...]:
        conditions = [each for phase in self.phases for each in phase.conditions]
        return tuple(dict.fromkeys(each.name for each in conditions if each.of == of))

    def __repr__(self) -> str:
        return f"Task({', '.join(phase.name for phase in self.phases)})"

    def __str__(self) -> str:
        """One line for each phase, with the condition that ends it."""
        return "\n".join(
            f"{index + 1}. {phase.name}, until {phase.awaits(self.contact_force)}"
            for index, phase in enumerate(self.phases)
        )
