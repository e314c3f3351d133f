"""A task in a scenario: phases in place of references."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

from drake_dae.scenario.forms.forms import Choice
from drake_dae.scenario.parts.parts import Coefficients, Matrices, Poles
from drake_dae.systems.task.phases import Phase
from drake_dae.systems.task.task import Task


@dataclass(frozen=True)
class ScenarioTask:
    """What the robot does phase by phase, in place of `references`.

    It begins free, or in contact where the first phase does, at rest at start.positions or, on what
    it touches, next to them. Where the contact is open its distance is an output, "wall.distance"
    for example, in place of its force. With ideal constraints in `plant` the contact opens and
    closes without a bounce.

    Attributes:
        phases: The phases, one after the other; after the last one the robot rests.
        contact: The name of the constraint that opens and closes; not needed where one alone can.
        contact_force: A force that is less than this, in N, is none.
        patience: How long the force of a contact that shall hold may be none before the contact is
            lost, in s.
        gains: The gains of the law of the free robot, with the distance among its outputs; those of
            `gains` where left out.
    """

    phases: Sequence[Phase]
    contact: str = ""
    contact_force: float = 0.5
    patience: float = 0.25
    gains: Annotated[Poles | Coefficients | Matrices, Choice()] | None = None

    def __post_init__(self) -> None:
        self.made()

    def made(self) -> Task:
        """The task.

        Raises:
            ModelError: The phases make no sense.
        """
        return Task(self.phases, self.contact_force, self.patience)
