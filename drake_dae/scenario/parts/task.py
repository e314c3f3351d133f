"""A task in a scenario: phases in place of references."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from drake_dae.arrays import unknown_name
from drake_dae.errors import ModelError
from drake_dae.references import Reference
from drake_dae.scenario.parts.parts import Gains
from drake_dae.systems.task.phases import Phase
from drake_dae.systems.task.task import Task


@dataclass(frozen=True)
class ScenarioTask:
    """A sequence of phases, in place of `references`.

    It starts at rest at start.positions, or in contact near them if the first phase requires
    contact. Without start.positions it starts 20 mm before the surface, with the first reference of
    each output. While the contact is open, its distance, such as "wall.distance", is an output in
    place of its force, and so is each distance of several points. `plant` has a contact that opens,
    such as `!CompliantContact`.

    Attributes:
        phases: The phases in their order; after the last one the robot rests.
        contact: The name of the constraint that opens and closes; not needed if there is only one.
            Or the list of points that do so together, with as many `!ForceCombination`s of their
            forces, one of them their sum.
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

    phases: Sequence[Phase]
    contact: str | Sequence[str] = ""
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

    def make(self, force_noise: float = 0.0) -> Task:
        """Makes the `Task` of these phases.

        Args:
            force_noise: The standard deviation of the force sensor's noise in N.

        Raises:
            ModelError: The phases are not consistent.
        """
        limits = self.contact_force, self.patience, force_noise, self.tare_time, self.retries
        return Task(tuple(self.phases), *limits)
