"""What happened to contacts, and when."""

from dataclasses import dataclass
from enum import Enum

from drake_dae.arguments import checked
from drake_dae.errors import ModelError


class ContactChange(Enum):
    """What happens to a contact; the value says it."""

    IMPACT = "impact"
    REST = "comes to rest"
    CLOSING = "closes"
    OPENING = "opens"


@checked(ModelError)
@dataclass(frozen=True)
class ContactEvent:
    """One event of contacts that open and close.

    Attributes:
        time: When it was, in s.
        kind: What happened: an impact, from which a contact bounces or slides on; an impact that
            ends bouncing for good; a touch without impact; the end of a contact whose force came to
            zero.
        contacts: The names of the contacts that it happened to.
        closed: The names of the contacts that are closed after it.
        impulses: What each of `contacts` did to the robot along its normal, N s, zero without an
            impact.
        energy_lost: Kinetic energy, J, never negative, where surfaces stand still.
        rest_time: When bouncing would have ended, in s: the limit of the times of infinitely many
            impacts. None unless it comes to rest.
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
            given = ", ".join(f"{impulse:.6g}" for impulse in self.impulses)
            text += f", {given} N s, {self.energy_lost:.6g} J lost"
        if self.rest_time is not None:
            text += f", bouncing ends at {self.rest_time:.12g} s"
        return f"{text}; closed: {', '.join(self.closed) or 'none'}"
