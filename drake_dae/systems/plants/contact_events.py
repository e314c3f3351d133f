"""Events of contacts."""

from dataclasses import dataclass
from enum import Enum

from drake_dae.arguments import checked
from drake_dae.errors import ModelError


class ContactChange(Enum):
    """The kind of an event of a contact; the value describes it."""

    IMPACT = "impact"
    REST = "comes to rest"
    CLOSING = "closes"
    OPENING = "opens"


@checked(ModelError)
@dataclass(frozen=True)
class ContactEvent:
    """One event of contacts that open and close.

    Attributes:
        time: The time, in s.
        kind: The kind: an impact after which the contact bounces or stays closed; an impact that
            ends a series of bounces; a touch without impact; an opening when the force reaches
            zero.
        contacts: The names of the contacts of the event.
        closed: The names of the contacts that are closed after it.
        impulses: The normal impulse of each of `contacts` on the robot, N s, zero without an
            impact.
        energy_lost: The loss of kinetic energy, J, not negative for surfaces at rest.
        rest_time: The end of bouncing, in s: the limit of the times of infinitely many impacts.
            None unless bouncing ends.
    """

    time: float
    kind: ContactChange
    contacts: tuple[str, ...]
    closed: tuple[str, ...]
    impulses: tuple[float, ...] = ()
    energy_lost: float = 0.0
    rest_time: float | None = None

    def __str__(self) -> str:
        names = ", ".join(self.contacts)
        text = f"{self.time:.12g} s: {names} {self.kind.value}"
        if any(self.impulses):
            impulses = ", ".join(f"{impulse:.6g}" for impulse in self.impulses)
            text += f", {impulses} N s, {self.energy_lost:.6g} J lost"
        if self.rest_time is not None:
            text += f", bouncing ends at {self.rest_time:.12g} s"
        return f"{text}; closed: {', '.join(self.closed) or 'none'}"
